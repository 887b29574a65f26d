use std::time::Duration;

use grasp_proto::{FieldError, pb};
use thiserror::Error;
use tonic::{Code, Status};
use tonic_types::StatusExt;

/// Why there is no answer.
#[derive(Debug, Error)]
pub enum Error {
    /// The server cannot be reached.
    #[error("cannot reach graspd at {address}: {}; is it running there?", root(source))]
    Connect {
        /// Where it was looked for.
        address: String,
        /// What the network said.
        source: tonic::transport::Error,
    },
    /// The server was not ready in time.
    #[error("graspd at {address} was not ready within {timeout:?}: {last}")]
    NotReady {
        /// Where it was looked for.
        address: String,
        /// How long was waited.
        timeout: Duration,
        /// What it said last.
        last: String,
    },
    /// The server, or the connection to it, refused.
    #[error("{code:?}: {message}")]
    Refused {
        /// The gRPC status code.
        code: Code,
        /// What is wrong, with the value, and what is needed.
        message: String,
        /// When it is worth coming back, where the server says so.
        retry_after: Option<Duration>,
        /// Path of the request's field that is not what it must be, where it is one: `volume.voxel_size`.
        field: Option<String>,
    },
    /// The reply breaks the interface's rules.
    #[error("the server's reply is not valid: {0}")]
    Reply(#[from] FieldError),
}

impl Error {
    /// The gRPC status code, where it comes from the server.
    #[must_use]
    pub fn code(&self) -> Option<Code> {
        match self {
            Self::Refused { code, .. } => Some(*code),
            Self::Connect { .. } | Self::NotReady { .. } | Self::Reply(_) => None,
        }
    }

    /// When it is worth coming back, where the server says so.
    #[must_use]
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Refused { retry_after, .. } => *retry_after,
            Self::Connect { .. } | Self::NotReady { .. } | Self::Reply(_) => None,
        }
    }

    /// Path of the request's field that is not what it must be, where it is one.
    #[must_use]
    pub fn field(&self) -> Option<&str> {
        match self {
            Self::Refused { field, .. } => field.as_deref(),
            Self::Connect { .. } | Self::NotReady { .. } | Self::Reply(_) => None,
        }
    }
}

impl From<Status> for Error {
    fn from(status: Status) -> Self {
        let milliseconds = status.metadata().get("grpc-retry-pushback-ms");
        let milliseconds = milliseconds.and_then(|value| value.to_str().ok()?.parse().ok());
        let violation =
            status.get_details_bad_request().and_then(|request| request.field_violations.into_iter().next());
        Self::Refused {
            code: status.code(),
            message: status.message().to_owned(),
            retry_after: milliseconds.map(Duration::from_millis),
            field: violation.map(|violation| violation.field),
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
        }
    }
}

/// The transport's own message is "transport error"; what happened lies below it.
fn root<'a>(error: &'a (dyn std::error::Error + 'static)) -> &'a (dyn std::error::Error + 'static) {
    error.source().map_or(error, root)
}

#[cfg(test)]
mod tests {
    use tonic_types::ErrorDetails;

    use super::*;

    #[test]
    fn the_field_is_told_by_a_status_and_in_a_stream() {
        let details = ErrorDetails::with_bad_request_violation("volume.data", "volume.data is short");
        let status = Status::with_error_details(Code::InvalidArgument, "volume.data is short", details);
        assert_eq!(Error::from(status).field(), Some("volume.data"));
        assert_eq!(Error::from(Status::unavailable("nobody is there")).field(), None);
        let told = |field: &str| Error::from(pb::Error { field: field.to_owned(), ..pb::Error::default() });
        assert_eq!(told("volume.data").field(), Some("volume.data"));
        assert_eq!(told("").field(), None);
    }
}
