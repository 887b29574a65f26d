//! Who may ask: bearers of a token, where there is one.

use std::fs;
use std::path::PathBuf;
use std::sync::{Arc, PoisonError, RwLock};

use anyhow::{Context, ensure};
use sha2::{Digest, Sha256};
use subtle::{Choice, ConstantTimeEq};
use tokio::signal::unix::Signal;
use tonic::metadata::MetadataMap;
use tonic::{Code, Request, Status};
use tracing::{error, info};

use crate::telemetry::metrics::Metrics;

/// Before the token in the header `authorization` (RFC 6750, section 2.1; the scheme's case does not matter).
const SCHEME: &str = "bearer ";

/// What a caller without a token is told to do.
const NEEDED: &str = "send the header `authorization: Bearer TOKEN`";

/// The tokens that are taken, read from a file with one in a line, so that an old and a new one can both be good for a
/// while. Nothing here can show a token: only their hashes are kept.
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

    /// Reads the file anew at each SIGHUP; one that cannot be read changes nothing.
    pub async fn watch(self: Arc<Self>, mut hangup: Signal) {
        while hangup.recv().await.is_some() {
            match hashes(&self.file) {
                Ok(hashes) => {
                    info!(tokens = hashes.len(), "the tokens were read anew");
                    *self.hashes.write().unwrap_or_else(PoisonError::into_inner) = hashes;
                }
                Err(error) => error!(error = format!("{error:#}"), "the tokens stay as they are"),
            }
        }
    }

    /// Lets a request pass, or says what it lacks; never what it had.
    pub fn check(&self, metadata: &MetadataMap) -> Result<(), Status> {
        let header = metadata.get("authorization");
        let header = header.ok_or_else(|| Status::unauthenticated(format!("no token; {NEEDED}")))?;
        let token = header
            .to_str()
            .ok()
            .filter(|text| text.get(..SCHEME.len()).is_some_and(|scheme| scheme.eq_ignore_ascii_case(SCHEME)));
        let token = token.map(|text| text[SCHEME.len()..].trim());
        let token = token.ok_or_else(|| Status::unauthenticated(format!("no bearer token; {NEEDED}")))?;
        // Every hash is looked at, and to its end, however early one differs: how long this takes tells nothing.
        let hash: Hash = Sha256::digest(token).into();
        let hashes = self.hashes.read().unwrap_or_else(PoisonError::into_inner);
        let known = hashes.iter().fold(Choice::from(0), |known, one| known | one.ct_eq(&hash));
        if bool::from(known) { Ok(()) } else { Err(Status::unauthenticated("the token is not one that is taken")) }
    }
}

fn hashes(file: &PathBuf) -> anyhow::Result<Vec<Hash>> {
    let text = fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))?;
    let tokens = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let hashes: Vec<Hash> = tokens.map(|token| Sha256::digest(token).into()).collect();
    ensure!(!hashes.is_empty(), "{} holds no token; write one in a line", file.display());
    Ok(hashes)
}

/// An interceptor that lets only bearers of a token pass, and everyone where there is none.
pub(crate) fn guard(
    tokens: Option<Arc<Tokens>>,
    metrics: Arc<Metrics>,
) -> impl Fn(Request<()>) -> Result<Request<()>, Status> + Clone {
    move |request| {
        if let Some(tokens) = &tokens
            && let Err(status) = tokens.check(request.metadata())
        {
            metrics.ended("", Code::Unauthenticated);
            return Err(status);
        }
        Ok(request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bearers_of_any_of_the_tokens_pass() {
        let file = std::env::temp_dir().join(format!("graspd-tokens-{}", std::process::id()));
        fs::write(&file, "old\n\n  new \n").unwrap();
        let tokens = Tokens::read(file.clone()).unwrap();
        fs::write(&file, "\n").unwrap();
        assert!(Tokens::read(file.clone()).err().unwrap().to_string().contains("holds no token"));
        fs::remove_file(&file).unwrap();
        assert!(Tokens::read(file).err().unwrap().to_string().starts_with("cannot read"));

        let check = |header: Option<&str>| {
            let mut metadata = MetadataMap::new();
            if let Some(header) = header {
                metadata.insert("authorization", header.parse().unwrap());
            }
            tokens.check(&metadata).map_err(|status| status.message().to_owned())
        };
        for good in ["Bearer old", "bearer new", "BEARER  old "] {
            assert_eq!(check(Some(good)), Ok(()), "{good}");
        }
        let said = |header| check(header).unwrap_err();
        assert!(said(None).starts_with("no token"));
        assert!(said(Some("Basic old")).starts_with("no bearer token"));
        for wrong in ["Bearer secret", "Bearer ", "Bearer ol", "Bearer oldd", "Bearer"] {
            assert!(!said(Some(wrong)).contains("secret"), "{wrong}");
        }
    }
}
