use std::fmt::{self, Debug};
use std::str::FromStr;
use std::time::Duration;

use rand::RngExt;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::transport::{Certificate, ClientTlsConfig, Identity};
use tonic::{Code, Request, Status, TimeoutExpired};

/// TLS, authentication, retries and time limit of a connection. The default is no TLS, no token, a single attempt and
/// no time limit.
///
/// TLS is used when the address begins with `https://`, or when a CA or an identity is set.
#[derive(Clone, Default)]
pub struct Access {
    /// CA that signed the server's certificate. `None`: the CAs that the operating system trusts.
    pub ca: Option<Certificate>,
    /// Client certificate and private key, for servers that require mutual TLS.
    pub identity: Option<Identity>,
    /// Bearer token, for servers that require one.
    pub token: Option<Token>,
    /// When failed calls are retried.
    pub retry: Retry,
    /// Time limit of each attempt of a call whose options have none. It is sent to the server as the deadline. It does
    /// not apply to streams or tracking. `None`: no limit.
    pub timeout: Option<Duration>,
}

/// A bearer token. `Debug` does not print it.
#[derive(Clone)]
pub struct Token(MetadataValue<Ascii>);

/// When a call is retried. Only transient failures are retried: the server is unreachable, the connection breaks,
/// or the server is busy. Detection is idempotent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Retry {
    /// Maximum number of attempts, including the first. 0 means 1.
    pub attempts: u32,
    /// First pause; it doubles with each further attempt. The actual pause is drawn uniformly from [0.5, 1] of this, so
    /// that clients that were refused together do not retry together. It is never shorter than the server's retry hint.
    pub pause: Duration,
    /// Upper limit of the pause, before the server's retry hint.
    pub longest: Duration,
}

impl Retry {
    /// A single attempt.
    pub const NONE: Self = Self { attempts: 1, pause: Duration::ZERO, longest: Duration::ZERO };

    /// For robots: bridges a lost replica or a full queue within about half a second.
    pub const RECOMMENDED: Self =
        Self { attempts: 6, pause: Duration::from_millis(20), longest: Duration::from_millis(500) };

    /// The pause after this many failed attempts; `None` when no attempts are left. `hint` is the server's retry hint.
    pub(crate) fn pause(&self, attempts: u32, hint: Option<Duration>) -> Option<Duration> {
        if attempts >= self.attempts {
            return None;
        }
        let pause = self.pause.saturating_mul(1 << attempts.saturating_sub(1).min(20)).min(self.longest);
        Some(pause.mul_f64(rand::rng().random_range(0.5..=1.0)).max(hint.unwrap_or_default()))
    }
}

impl Default for Retry {
    fn default() -> Self {
        Self::NONE
    }
}

/// Whether the same request may succeed later. A status with a source was created by this client because the connection
/// broke; a status from the server has no source.
pub(crate) fn is_transient(status: &Status) -> bool {
    // What tonic reports if a connection ended within a response, for example when a load balancer lost the server.
    let is_truncated = status.code() == Code::Unknown && status.message().contains("missing grpc-status");
    let is_refused = matches!(status.code(), Code::Unavailable | Code::ResourceExhausted);
    is_refused || is_truncated || std::error::Error::source(status).is_some()
}

/// Whether this client ended the call because its time limit has passed. tonic reports that as CANCELLED.
pub(crate) fn has_timed_out(status: &Status) -> bool {
    let mut source = std::error::Error::source(status);
    while let Some(error) = source {
        if error.is::<TimeoutExpired>() {
            return true;
        }
        source = error.source();
    }
    false
}

impl Access {
    /// The TLS configuration; `None` when neither these settings nor the address require TLS.
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
        let Self { ca, identity, token, retry, timeout } = self;
        let mut access = f.debug_struct("Access");
        access.field("ca", &ca.is_some()).field("identity", &identity.is_some()).field("token", &token.is_some());
        access.field("retry", retry).field("timeout", timeout).finish()
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
            return Err("the token is empty; it must be on the first line of the file");
        }
        let mut value: MetadataValue<Ascii> = format!("Bearer {token}")
            .parse()
            .map_err(|_| "the token contains characters that are not allowed in a header; use visible ASCII")?;
        value.set_sensitive(true);
        Ok(Self(value))
    }
}

/// Adds the token to every request.
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
    fn pauses_grow_to_the_limit_and_end_with_the_attempts() {
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
    fn only_a_passed_time_limit_of_this_client_is_a_timeout() {
        assert!(has_timed_out(&Status::from_error(Box::new(TimeoutExpired(())))));
        assert!(!has_timed_out(&Status::from_error(Box::new(std::io::Error::other("the connection broke")))));
        assert!(!has_timed_out(&Status::cancelled("by the server")));
    }

    #[test]
    fn a_token_is_not_printed() {
        let token: Token = " secret\n".parse().unwrap();
        let access = Access { token: Some(token.clone()), ..Access::default() };
        let shown = format!("{access:?} {token:?} {:?}", token.0);
        assert!(!shown.contains("secret"), "{shown}");
        assert!(" ".parse::<Token>().is_err() && "a\nb".parse::<Token>().is_err());
        let request = Bearer(access.token).call(Request::new(())).unwrap();
        assert_eq!(request.metadata().get("authorization").unwrap(), "Bearer secret");
    }

    #[test]
    fn a_truncated_response_is_transient_and_other_unknown_errors_are_not() {
        let status = |message: &str| Status::new(Code::Unknown, message);
        assert!(is_transient(&status("protocol error: missing grpc-status trailer, stream was terminated")));
        assert!(!is_transient(&status("the model is broken")));
    }
}
