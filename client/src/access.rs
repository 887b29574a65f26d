use std::fmt::{self, Debug};
use std::str::FromStr;
use std::time::Duration;

use rand::RngExt;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::transport::{Certificate, ClientTlsConfig, Identity};
use tonic::{Code, Request, Status};

/// How to get in where not everybody may, and what to do when nobody answers. The default is neither TLS nor a token,
/// and a single attempt.
///
/// TLS is spoken with addresses that begin with `https://`, or where a CA or an identity is given.
#[derive(Clone, Default)]
pub struct Access {
    /// The CA that signed the server's certificate; without one, those that this machine trusts.
    pub ca: Option<Certificate>,
    /// What this client shows of itself, where the server wants to see it.
    pub identity: Option<Identity>,
    /// What the server wants to hear.
    pub token: Option<Token>,
    /// When to ask again.
    pub retry: Retry,
}

/// A bearer's token. It shows itself to nobody but the server.
#[derive(Clone)]
pub struct Token(MetadataValue<Ascii>);

/// When to ask again, where that can help: nobody was there, the connection broke, or the server was busy. Asking for
/// grasps twice does no harm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Retry {
    /// How often to ask, the first time included; once where this is 0.
    pub attempts: u32,
    /// The first pause; each further one is twice as long. Half of it is left to chance, so that many who were refused
    /// together do not come back together. Where the server says when to come back, it is not sooner.
    pub pause: Duration,
    /// The longest pause.
    pub longest: Duration,
}

impl Retry {
    /// A single attempt.
    pub const NONE: Self = Self { attempts: 1, pause: Duration::ZERO, longest: Duration::ZERO };

    /// For a robot that wants its grasp: over a replica that is lost, or a queue that is full, in half a second or so.
    pub const RECOMMENDED: Self =
        Self { attempts: 6, pause: Duration::from_millis(20), longest: Duration::from_millis(500) };

    /// How long to wait after so many attempts, if there is one more.
    pub(crate) fn pause(&self, attempts: u32, told: Option<Duration>) -> Option<Duration> {
        if attempts >= self.attempts {
            return None;
        }
        let pause = self.pause.saturating_mul(1 << attempts.saturating_sub(1).min(20)).min(self.longest);
        Some(pause.mul_f64(rand::rng().random_range(0.5..=1.0)).max(told.unwrap_or_default()))
    }
}

impl Default for Retry {
    fn default() -> Self {
        Self::NONE
    }
}

/// Whether the same request may fare better another time. What this end made of a connection that broke has a cause,
/// which no status that a server sent has.
pub(crate) fn may_pass(status: &Status) -> bool {
    matches!(status.code(), Code::Unavailable | Code::ResourceExhausted) || std::error::Error::source(status).is_some()
}

impl Access {
    /// TLS, where these or the address want it.
    pub(crate) fn tls(&self, address: &str) -> Option<ClientTlsConfig> {
        if self.ca.is_none() && self.identity.is_none() && !address.starts_with("https://") {
            return None;
        }
        let tls = match &self.ca {
            Some(ca) => ClientTlsConfig::new().ca_certificate(ca.clone()),
            None => ClientTlsConfig::new().with_native_roots(),
        };
        Some(match &self.identity {
            Some(identity) => tls.identity(identity.clone()),
            None => tls,
        })
    }
}

impl Debug for Access {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { ca, identity, token, retry } = self;
        let mut access = f.debug_struct("Access");
        access.field("ca", &ca.is_some()).field("identity", &identity.is_some()).field("token", &token.is_some());
        access.field("retry", retry).finish()
    }
}

impl Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(…)")
    }
}

impl FromStr for Token {
    type Err = &'static str;

    fn from_str(token: &str) -> Result<Self, Self::Err> {
        let token = token.trim();
        if token.is_empty() {
            return Err("the token is empty");
        }
        let mut value: MetadataValue<Ascii> =
            format!("Bearer {token}").parse().map_err(|_| "the token has characters that a header cannot carry")?;
        value.set_sensitive(true);
        Ok(Self(value))
    }
}

/// Puts the token on every request.
#[derive(Clone, Debug, Default)]
pub(crate) struct Bearer(pub Option<Token>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(Token(token)) = &self.0 {
            request.metadata_mut().insert("authorization", token.clone());
        }
        Ok(request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_grow_up_to_the_longest_and_end() {
        let retry = Retry { attempts: 6, pause: Duration::from_millis(100), longest: Duration::from_millis(400) };
        for (attempts, most) in [(1, 100), (2, 200), (3, 400), (4, 400), (5, 400)] {
            let pause = retry.pause(attempts, None).unwrap().as_millis();
            assert!((most / 2..=most).contains(&pause), "{pause} ms after {attempts} attempts");
        }
        assert_eq!(retry.pause(6, None), None);
        assert_eq!(retry.pause(1, Some(Duration::from_secs(3))), Some(Duration::from_secs(3)));
        assert_eq!(Retry::NONE.pause(1, Some(Duration::from_secs(3))), None);
        assert!(Retry { attempts: 100, ..retry }.pause(99, None).unwrap() <= retry.longest);
    }

    #[test]
    fn a_token_shows_itself_to_nobody() {
        let token: Token = " secret\n".parse().unwrap();
        let access = Access { token: Some(token.clone()), ..Access::default() };
        let shown = format!("{access:?} {token:?} {:?}", token.0);
        assert!(!shown.contains("secret"), "{shown}");
        assert!(" ".parse::<Token>().is_err() && "a\nb".parse::<Token>().is_err());
        let request = Bearer(access.token).call(Request::new(())).unwrap();
        assert_eq!(request.metadata().get("authorization").unwrap(), "Bearer secret");
    }
}
