//! The files of TLS, checked before the models are loaded.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::Context;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::{self, RootCertStore};
use tracing::warn;
use x509_parser::pem::Pem;

/// Remaining validity of a certificate below which the server warns.
const SOON: Duration = Duration::from_secs(14 * 24 * 3600);

/// A checked configuration of TLS.
#[derive(Clone)]
pub(crate) struct Tls {
    /// Of the gRPC listener, which uses HTTP/2.
    pub grpc: TlsAcceptor,
    /// The same for HTTP/1.1.
    pub http: TlsAcceptor,
    /// When the first certificate of the chain expires, seconds since 1970.
    pub expiry: i64,
}

impl Tls {
    /// Checks that the files are PEM, and that the key belongs to the certificate. `client_ca` signs the certificates
    /// of clients.
    pub fn new(certificate: &[u8], key: &[u8], client_ca: Option<&[u8]>) -> anyhow::Result<Self> {
        let expiry = expiry(certificate).context("cannot read --tls-cert")?;
        if let Some(ca) = client_ca {
            self::expiry(ca).context("cannot read --tls-client-ca")?;
        }
        let acceptor = |protocol| acceptor(certificate, key, client_ca, protocol).context("cannot use the files");
        Ok(Self { grpc: acceptor("h2")?, http: acceptor("http/1.1")?, expiry })
    }

    /// Logs a warning if a certificate has expired or expires soon.
    pub fn warn_of_expiry(&self, now: SystemTime) {
        let left = self.expiry - now.duration_since(UNIX_EPOCH).map_or(0, |time| time.as_secs()).cast_signed();
        if left <= 0 {
            warn!(seconds = -left, "the certificate of --tls-cert has expired: clients refuse it");
        } else if left.cast_unsigned() < SOON.as_secs() {
            warn!(days = left / (24 * 3600), "the certificate of --tls-cert expires soon");
        }
    }
}

/// Accepts connections with this protocol (ALPN).
fn acceptor(certificate: &[u8], key: &[u8], client_ca: Option<&[u8]>, protocol: &str) -> anyhow::Result<TlsAcceptor> {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = rustls::ServerConfig::builder_with_provider(Arc::clone(&provider));
    let config = config.with_safe_default_protocol_versions()?;
    let config = match client_ca {
        None => config.with_no_client_auth(),
        Some(ca) => {
            let mut roots = RootCertStore::empty();
            for certificate in CertificateDer::pem_slice_iter(ca) {
                roots.add(certificate?)?;
            }
            let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider).build()?;
            config.with_client_cert_verifier(verifier)
        }
    };
    let chain = CertificateDer::pem_slice_iter(certificate).collect::<Result<Vec<_>, _>>()?;
    let mut config = config.with_single_cert(chain, PrivateKeyDer::from_pem_slice(key)?)?;
    config.alpn_protocols = vec![protocol.as_bytes().to_vec()];
    Ok(TlsAcceptor::from(Arc::new(config)))
}

/// When the first of some certificates expires, seconds since 1970.
fn expiry(pem: &[u8]) -> anyhow::Result<i64> {
    let mut first: Option<i64> = None;
    for block in Pem::iter_from_buffer(pem) {
        let block = block.context("it is not PEM")?;
        if block.label == "CERTIFICATE" {
            let end = block.parse_x509().context("a certificate is malformed")?.validity().not_after.timestamp();
            first = Some(first.map_or(end, |first| first.min(end)));
        }
    }
    first.context("it contains no certificate")
}
