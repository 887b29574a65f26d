use std::time::Duration;

use grasp_proto::{FieldError, pb};
use thiserror::Error;
use tonic::{Code, Status};

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
}

impl From<Status> for Error {
    fn from(status: Status) -> Self {
        let milliseconds = status.metadata().get("grpc-retry-pushback-ms");
        let milliseconds = milliseconds.and_then(|value| value.to_str().ok()?.parse().ok());
        Self::Refused {
            code: status.code(),
            message: status.message().to_owned(),
            retry_after: milliseconds.map(Duration::from_millis),
        }
    }
}

impl From<pb::Error> for Error {
    fn from(error: pb::Error) -> Self {
        Self::Refused {
            code: Code::from_i32(error.code),
            message: error.message,
            retry_after: error.retry_after.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok()),
        }
    }
}

/// The transport's own message is "transport error"; what happened lies below it.
fn root<'a>(error: &'a (dyn std::error::Error + 'static)) -> &'a (dyn std::error::Error + 'static) {
    error.source().map_or(error, root)
}
