//! Authentication with bearer tokens.

use std::fs;
use std::path::PathBuf;
use std::sync::{Arc, PoisonError, RwLock};

use anyhow::{Context, ensure};
use grasp_engine::Caller;
use sha2::{Digest, Sha256};
use subtle::{Choice, ConstantTimeEq};
use tokio::signal::unix::Signal;
use tokio::task::spawn_blocking;
use tonic::metadata::MetadataMap;
use tonic::{Code, Request, Status};
use tracing::{error, info};

use crate::telemetry::metrics::Metrics;

/// Scheme of the header `authorization` (RFC 6750, section 2.1), case-insensitive.
const SCHEME: &str = "bearer ";

const NEEDED: &str = "send the header `authorization: Bearer TOKEN`";

/// The accepted tokens, read from a file with one token per line. Several tokens allow a rotation without downtime.
/// Only their hashes are stored, so no message can contain a token.
pub(crate) struct Tokens {
    file: PathBuf,
    hashes: RwLock<Vec<Hash>>,
}

type Hash = [u8; 32];

impl Tokens {
    pub fn read(file: PathBuf) -> anyhow::Result<Self> {
        let hashes = RwLock::new(hashes(&file)?);
        Ok(Self { file, hashes })
    }

    /// Reloads the file at each SIGHUP. If it cannot be read, the tokens are unchanged.
    pub async fn watch(self: Arc<Self>, mut hangup: Signal) {
        while hangup.recv().await.is_some() {
            // On a blocking thread, because a network file system may hang.
            let file = self.file.clone();
            let read = spawn_blocking(move || hashes(&file)).await;
            match read.unwrap_or_else(|panic| Err(panic.into())) {
                Ok(hashes) => {
                    info!(tokens = hashes.len(), "tokens reloaded");
                    *self.hashes.write().unwrap_or_else(PoisonError::into_inner) = hashes;
                }
                Err(error) => {
                    error!(error = format!("{error:#}"), "cannot reload the tokens; the accepted tokens are unchanged")
                }
            }
        }
    }

    /// Checks the token of a request, which identifies the caller. Errors never contain the received token.
    pub fn check(&self, metadata: &MetadataMap) -> Result<Caller, Status> {
        let header = metadata.get("authorization");
        let header = header.ok_or_else(|| Status::unauthenticated(format!("no token; {NEEDED}")))?;
        let token = header
            .to_str()
            .ok()
            .filter(|text| text.get(..SCHEME.len()).is_some_and(|scheme| scheme.eq_ignore_ascii_case(SCHEME)));
        let token = token.map(|text| text[SCHEME.len()..].trim());
        let token = token.ok_or_else(|| Status::unauthenticated(format!("no bearer token; {NEEDED}")))?;
        let caller = Caller::Token(Sha256::digest(token).into());
        if self.accept(&caller) {
            Ok(caller)
        } else {
            Err(Status::unauthenticated("invalid token; send one of the server's --token-file"))
        }
    }

    /// Whether the token of a caller is accepted now.
    pub fn accept(&self, caller: &Caller) -> bool {
        let Caller::Token(hash) = caller else { return false };
        // Compares with every hash in constant time, so that the duration reveals nothing about the tokens.
        let hashes = self.hashes.read().unwrap_or_else(PoisonError::into_inner);
        let known = hashes.iter().fold(Choice::from(0), |known, accepted| known | accepted.ct_eq(hash));
        known.into()
    }
}

fn hashes(file: &PathBuf) -> anyhow::Result<Vec<Hash>> {
    let text = fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))?;
    let tokens = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let hashes: Vec<Hash> = tokens.map(|token| Sha256::digest(token).into()).collect();
    ensure!(!hashes.is_empty(), "{} contains no token; write one token per line", file.display());
    Ok(hashes)
}

/// An interceptor that refuses requests without a valid token; without `tokens` it accepts all requests.
pub(crate) fn guard(
    tokens: Option<Arc<Tokens>>,
    metrics: Arc<Metrics>,
) -> impl Fn(Request<()>) -> Result<Request<()>, Status> + Clone {
    move |mut request| {
        if let Some(tokens) = &tokens {
            let checked = tokens.check(request.metadata());
            let caller = checked.inspect_err(|_| metrics.ended("", Code::Unauthenticated))?;
            request.extensions_mut().insert(caller);
        }
        Ok(request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_with_any_of_the_tokens_are_accepted() {
        let file = std::env::temp_dir().join(format!("graspd-tokens-{}", std::process::id()));
        fs::write(&file, "old\n\n  new \n").unwrap();
        let tokens = Tokens::read(file.clone()).unwrap();
        fs::write(&file, "\n").unwrap();
        assert!(Tokens::read(file.clone()).err().unwrap().to_string().contains("contains no token"));
        fs::remove_file(&file).unwrap();
        assert!(Tokens::read(file).err().unwrap().to_string().starts_with("cannot read"));

        let check = |header: Option<&str>| {
            let mut metadata = MetadataMap::new();
            if let Some(header) = header {
                metadata.insert("authorization", header.parse().unwrap());
            }
            tokens.check(&metadata).map(|_| ()).map_err(|status| status.message().to_owned())
        };
        for valid in ["Bearer old", "bearer new", "BEARER  old "] {
            assert_eq!(check(Some(valid)), Ok(()), "{valid}");
        }
        let error = |header| check(header).unwrap_err();
        assert!(error(None).starts_with("no token"));
        assert!(error(Some("Basic old")).starts_with("no bearer token"));
        for invalid in ["Bearer secret", "Bearer ", "Bearer ol", "Bearer oldd", "Bearer"] {
            assert!(!error(Some(invalid)).contains("secret"), "{invalid}");
        }
    }
}
