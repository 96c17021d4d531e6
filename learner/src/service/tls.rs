//! TLS on the port for actors (rustls), with certificates of the actors' own where a CA for them is given.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::{WantsServerCert, WebPkiClientVerifier};
use tokio_rustls::rustls::{ConfigBuilder, RootCertStore, ServerConfig};

use super::reloaded::Reloaded;

/// Files of the learner's identity, all PEM.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TlsFiles {
    /// Its certificate, and those between it and the CA.
    pub certificate: PathBuf,
    /// The certificate's private key.
    pub key: PathBuf,
    /// Who signs the certificates of actors. `None`: they need none.
    pub client_ca: Option<PathBuf>,
}

impl TlsFiles {
    /// Reads the files, now and whenever they change.
    pub(super) fn load(self) -> anyhow::Result<Reloaded<ServerConfig>> {
        let files = [&self.certificate, &self.key].into_iter().chain(&self.client_ca).cloned().collect();
        Reloaded::new("the TLS certificate", files, move || self.config())
    }

    fn config(&self) -> anyhow::Result<ServerConfig> {
        let certificates = certificates(&self.certificate)?;
        let key = PrivateKeyDer::from_pem_file(&self.key)
            .with_context(|| format!("no private key in {}", self.key.display()))?;
        let mut config = self.clients()?.with_single_cert(certificates, key).with_context(|| {
            format!("the certificate in {} and the key in {}", self.certificate.display(), self.key.display())
        })?;
        config.alpn_protocols = vec![b"h2".to_vec()];
        Ok(config)
    }

    fn clients(&self) -> anyhow::Result<ConfigBuilder<ServerConfig, WantsServerCert>> {
        let provider = Arc::new(ring::default_provider());
        let builder = ServerConfig::builder_with_provider(provider.clone()).with_safe_default_protocol_versions()?;
        let Some(file) = &self.client_ca else { return Ok(builder.with_no_client_auth()) };
        let mut roots = RootCertStore::empty();
        for certificate in certificates(file)? {
            roots.add(certificate).with_context(|| format!("a CA certificate in {}", file.display()))?;
        }
        let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider).build()?;
        Ok(builder.with_client_cert_verifier(verifier))
    }
}

fn certificates(file: &Path) -> anyhow::Result<Vec<CertificateDer<'static>>> {
    let read = || CertificateDer::pem_file_iter(file)?.collect::<Result<Vec<_>, _>>();
    let certificates = read().with_context(|| format!("no certificate in {}", file.display()))?;
    anyhow::ensure!(!certificates.is_empty(), "no certificate in {}", file.display());
    Ok(certificates)
}
