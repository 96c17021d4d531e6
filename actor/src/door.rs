//! The way to the learner: its address, and what an actor shows and wants to see there. The files are read anew for each
//! connection, so that they can be replaced while an actor runs.

use std::path::Path;

use popgym_proto::{Token, transport};
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint, Identity};

use crate::args::Args;

/// What a connection needs.
#[derive(Debug)]
pub struct Door {
    /// Address and TLS.
    pub endpoint: Endpoint,
    /// The secret that the learner wants to see.
    pub token: Option<Token>,
}

impl Door {
    /// Reads the files that `args` name.
    ///
    /// # Errors
    /// The file that cannot be read, or holds something else than it should.
    pub fn new(args: &Args) -> Result<Self, String> {
        let token = args.token_file.as_deref().map(Token::read).transpose()?;
        let endpoint = transport::endpoint(&args.learner).map_err(|error| innermost(&error))?;
        let Some(ca) = &args.tls_ca else { return Ok(Self { endpoint, token }) };
        let mut tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(read(ca)?));
        if let (Some(certificate), Some(key)) = (&args.tls_certificate, &args.tls_key) {
            tls = tls.identity(Identity::from_pem(read(certificate)?, read(key)?));
        }
        let endpoint = endpoint.tls_config(tls).map_err(|error| {
            let files = [Some(ca), args.tls_certificate.as_ref(), args.tls_key.as_ref()];
            let files: Vec<String> = files.into_iter().flatten().map(|file| file.display().to_string()).collect();
            format!("{}: {}", files.join(", "), innermost(&error))
        })?;
        Ok(Self { endpoint, token })
    }
}

fn read(file: &Path) -> Result<Vec<u8>, String> {
    std::fs::read(file).map_err(|error| format!("cannot read {}: {error}", file.display()))
}

/// The cause at the bottom, which is the one that says something ("connection refused").
pub(crate) fn innermost(error: &dyn std::error::Error) -> String {
    let mut cause = error;
    while let Some(next) = cause.source() {
        cause = next;
    }
    cause.to_string()
}
