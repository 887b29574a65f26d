use std::time::Duration;

use grasp::RequestError;
use grasp_proto::pb;
use thiserror::Error;
use tonic::{Code, Status};
use tonic_types::StatusExt;

/// Why a call failed.
#[derive(Debug, Error)]
pub enum Error {
    /// The server cannot be reached.
    #[error("cannot connect to graspd at {address}: {reason}")]
    Connect {
        /// The address as given.
        address: String,
        /// What happened, and what to check.
        reason: String,
    },
    /// The server was not ready in time.
    #[error("graspd at {address} was not ready within {timeout:?}: {last}")]
    NotReady {
        /// The address as given.
        address: String,
        /// The time limit.
        timeout: Duration,
        /// The last failure.
        last: String,
    },
    /// The server refused the request, or the connection broke.
    #[error("{code:?}: {message}")]
    Refused {
        /// The gRPC status code.
        code: Code,
        /// What is wrong, with the value, and what to do.
        message: String,
        /// The server's retry hint, if it sent one.
        retry_after: Option<Duration>,
        /// Path of the invalid field of the request, such as `volume.voxel_size`, if the request is invalid.
        field: Option<String>,
        /// Id of the request in the server's log. `None` if the request did not reach the server.
        request_id: Option<String>,
        /// Whether the views of a request of [`Tracking`](crate::Tracking) are in the volume.
        views_added: bool,
    },
    /// The server's reply violates the protocol.
    #[error("invalid reply from the server: {0}; check that client and server have the same version")]
    Reply(#[from] RequestError),
}

impl Error {
    /// The gRPC status code; `None` unless the call was refused.
    #[must_use]
    pub fn code(&self) -> Option<Code> {
        match self {
            Self::Refused { code, .. } => Some(*code),
            Self::Connect { .. } | Self::NotReady { .. } | Self::Reply(_) => None,
        }
    }

    /// The server's retry hint: the shortest useful pause before the next attempt.
    #[must_use]
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Refused { retry_after, .. } => *retry_after,
            Self::Connect { .. } | Self::NotReady { .. } | Self::Reply(_) => None,
        }
    }

    /// Path of the invalid field of the request, if the request is invalid.
    #[must_use]
    pub fn field(&self) -> Option<&str> {
        match self {
            Self::Refused { field, .. } => field.as_deref(),
            Self::Connect { .. } | Self::NotReady { .. } | Self::Reply(_) => None,
        }
    }

    /// Id of the request in the server's log, if the server refused it.
    #[must_use]
    pub fn request_id(&self) -> Option<&str> {
        match self {
            Self::Refused { request_id, .. } => request_id.as_deref(),
            Self::Connect { .. } | Self::NotReady { .. } | Self::Reply(_) => None,
        }
    }

    /// Whether the views of a request of [`Tracking`](crate::Tracking) are in the volume although it was refused:
    /// repeat the request without them.
    #[must_use]
    pub fn views_added(&self) -> bool {
        matches!(self, Self::Refused { views_added: true, .. })
    }

    /// The same error with the id of the request. In a stream the reply contains it, not its error.
    pub(crate) fn of_request(mut self, id: String) -> Self {
        if let Self::Refused { request_id, .. } = &mut self {
            *request_id = Some(id).filter(|id| !id.is_empty());
        }
        self
    }
}

impl Error {
    pub(crate) fn connect(address: String, error: &tonic::transport::Error) -> Self {
        let error = root(error).to_string();
        let known = CONNECTION_ERRORS.iter().find(|(part, _)| error.contains(part));
        let reason = match known {
            Some((_, advice)) => (*advice).to_owned(),
            None => format!("{error}; check the address and that graspd runs there"),
        };
        Self::Connect { address, reason }
    }
}

/// Parts of the transport's errors, and what to do.
const CONNECTION_ERRORS: [(&str, &str); 5] = [
    ("CertificateRequired", "it needs a client certificate (tls_cert and tls_key)"),
    ("InvalidContentType", "the server does not use TLS: give an address without https://, and no CA or certificate"),
    (
        "CaUsedAsEndEntity",
        "its certificate is that of a CA, which no server may use: make one that a CA signed, as in docs/operations.md",
    ),
    ("UnknownIssuer", "its certificate is signed by an unknown CA: give the file of that CA (tls_ca)"),
    ("NotValidForName", "its certificate is for another name: use that name in the address, or another certificate"),
];

/// The transport's messages for calls to something that is not gRPC.
const NOT_GRPC: [&str; 2] = ["transport error", "h2 protocol error: http2 error"];

impl From<Status> for Error {
    fn from(status: Status) -> Self {
        // The server's statuses have no source.
        let is_not_grpc = std::error::Error::source(&status).is_some() && NOT_GRPC.contains(&status.message());
        let milliseconds = status.metadata().get("grpc-retry-pushback-ms");
        let milliseconds = milliseconds.and_then(|value| value.to_str().ok()?.parse().ok());
        let violation =
            status.get_details_bad_request().and_then(|request| request.field_violations.into_iter().next());
        let request_id = status.get_details_request_info().map(|info| info.request_id);
        Self::Refused {
            code: status.code(),
            message: if is_not_grpc && source(&status).contains("CertificateRequired") {
                "the server needs a client certificate (tls_cert and tls_key)".to_owned()
            } else if is_not_grpc {
                format!(
                    "no valid reply ({}): if no call succeeds, the address may be the port for HTTP, or need https:// \
                     and a CA",
                    source(&status)
                )
            } else {
                status.message().to_owned()
            },
            retry_after: milliseconds.map(Duration::from_millis),
            field: violation.map(|violation| violation.field),
            request_id: request_id.filter(|id| !id.is_empty()),
            views_added: false,
        }
    }
}

impl From<pb::Error> for Error {
    fn from(error: pb::Error) -> Self {
        Self::Refused {
            code: Code::from_i32(error.code),
            message: error.message,
            retry_after: error.retry_after.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok()),
            field: Some(error.field).filter(|field| !field.is_empty()),
            request_id: None,
            views_added: error.views_added,
        }
    }
}

fn source(status: &Status) -> String {
    std::error::Error::source(status).map_or_else(String::new, |source| root(source).to_string())
}

/// The innermost source. The transport's own message is only "transport error".
fn root<'a>(error: &'a (dyn std::error::Error + 'static)) -> &'a (dyn std::error::Error + 'static) {
    error.source().map_or(error, root)
}

#[cfg(test)]
mod tests {
    use tonic_types::ErrorDetails;

    use super::*;

    #[test]
    fn the_invalid_field_is_read_from_a_status_and_from_a_stream_reply() {
        let details = ErrorDetails::with_bad_request_violation("volume.data", "volume.data is short");
        let status = Status::with_error_details(Code::InvalidArgument, "volume.data is short", details);
        assert_eq!(Error::from(status).field(), Some("volume.data"));
        assert_eq!(Error::from(Status::unavailable("connection refused")).field(), None);
        let from_stream = |field: &str| Error::from(pb::Error { field: field.to_owned(), ..pb::Error::default() });
        assert_eq!(from_stream("volume.data").field(), Some("volume.data"));
        assert_eq!(from_stream("").field(), None);
    }

    #[test]
    fn the_request_id_is_read_from_a_status_and_set_for_a_stream_reply() {
        let mut details = ErrorDetails::new();
        details.set_request_info("shelf 7", "");
        let status = Status::with_error_details(Code::Internal, "the model failed", details);
        assert_eq!(Error::from(status).request_id(), Some("shelf 7"));
        assert_eq!(Error::from(Status::unavailable("connection refused")).request_id(), None);
        let from_stream = |id: &str| Error::from(pb::Error::default()).of_request(id.to_owned());
        assert_eq!(from_stream("shelf 7").request_id(), Some("shelf 7"));
        assert_eq!(from_stream("").request_id(), None);
    }
}
