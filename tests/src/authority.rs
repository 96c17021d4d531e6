//! A certificate authority for tests, and the files that it issues.

use std::net::Ipv4Addr;

use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair, SanType};

use crate::Scene;

/// Signs certificates for this machine.
#[derive(Debug)]
pub struct Authority {
    issuer: Issuer<'static, KeyPair>,
    certificate: String,
}

impl Default for Authority {
    fn default() -> Self {
        Self::new()
    }
}

impl Authority {
    /// A new one, unlike all others.
    ///
    /// # Panics
    /// If no key can be made.
    pub fn new() -> Self {
        let key = KeyPair::generate().expect("a key");
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let certificate = params.self_signed(&key).expect("a certificate").pem();
        Self { issuer: Issuer::new(params, key), certificate }
    }

    /// Writes the authority's own certificate to `NAME`.
    pub fn write(&self, scene: &Scene, name: &str) {
        scene.write(name, &self.certificate);
    }

    /// Writes a certificate for 127.0.0.1 to `NAME.pem` and its key to `NAME.key`.
    ///
    /// # Panics
    /// If none can be made.
    pub fn issue(&self, scene: &Scene, name: &str) {
        let key = KeyPair::generate().expect("a key");
        let mut params = CertificateParams::default();
        params.subject_alt_names.push(SanType::IpAddress(Ipv4Addr::LOCALHOST.into()));
        let certificate = params.signed_by(&key, &self.issuer).expect("a certificate");
        scene.write(&format!("{name}.pem"), &certificate.pem());
        scene.write(&format!("{name}.key"), &key.serialize_pem());
    }
}
