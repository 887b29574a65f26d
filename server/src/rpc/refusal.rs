use std::time::Duration;

use grasp_proto::{FieldError, pb};
use thiserror::Error;
use tonic::metadata::{MetadataMap, MetadataValue};
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use crate::serving::engine::Overloaded;
use crate::serving::job::EngineError;

/// Why a request ends without grasps.
#[derive(Debug, Error)]
pub(crate) enum Refusal {
    #[error(transparent)]
    Field(#[from] FieldError),
    #[error("{field}: `{requested}` not found; available: {available}")]
    UnknownModel { field: &'static str, requested: String, available: String },
    #[error(transparent)]
    Overloaded(#[from] Overloaded),
    #[error("the server is warming up; retry after {0:?}")]
    Starting(Duration),
    #[error("the server is shutting down; retry on another replica")]
    Draining,
    #[error(
        "not enough of the {limit} tracked volumes are free for {needed} more; close a stream, or raise --max-tracked"
    )]
    TooManyTracked { needed: usize, limit: usize },
    #[error("no request for {0:?} (--track-timeout), the volume was dropped; open a new stream")]
    TrackExpired(Duration),
    #[error("loading and unloading of models is not allowed; start the server with --allow-model-control")]
    NoModelControl,
    #[error("{0}")]
    NotChanged(String),
    #[error(transparent)]
    Failed(EngineError),
}

impl From<EngineError> for Refusal {
    fn from(error: EngineError) -> Self {
        match error {
            EngineError::Overloaded(overloaded) => Self::Overloaded(overloaded),
            error => Self::Failed(error),
        }
    }
}

/// The trailer with the server's retry hint (gRPC proposal A6).
const RETRY_PUSHBACK: &str = "grpc-retry-pushback-ms";

/// Retry hint when all streams are in use: streams live long.
const STREAMS_IN_USE: Duration = Duration::from_secs(1);

impl Refusal {
    pub fn code(&self) -> Code {
        match self {
            Self::Field(_) => Code::InvalidArgument,
            Self::UnknownModel { .. } => Code::NotFound,
            Self::Overloaded(_) | Self::TooManyTracked { .. } => Code::ResourceExhausted,
            Self::Starting(_) | Self::Draining => Code::Unavailable,
            Self::TrackExpired(_) => Code::Aborted,
            Self::NoModelControl => Code::PermissionDenied,
            Self::NotChanged(_) => Code::FailedPrecondition,
            Self::Failed(EngineError::Expired) => Code::DeadlineExceeded,
            Self::Failed(EngineError::NoSession) => Code::Unavailable,
            Self::Failed(_) => Code::Internal,
        }
    }

    /// The invalid field of the request, if a field is the reason.
    fn field(&self) -> Option<&str> {
        match self {
            Self::Field(error) => Some(&error.field),
            Self::UnknownModel { field, .. } => Some(field),
            _ => None,
        }
    }

    /// The retry hint; None if a retry does not help.
    fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Overloaded(overloaded) => Some(overloaded.retry_after),
            Self::Starting(retry_after) => Some(*retry_after),
            Self::TooManyTracked { .. } => Some(STREAMS_IN_USE),
            Self::Field(_)
            | Self::UnknownModel { .. }
            | Self::Draining
            | Self::TrackExpired(_)
            | Self::NoModelControl
            | Self::NotChanged(_)
            | Self::Failed(_) => None,
        }
    }
}

impl Refusal {
    /// The gRPC status, with details for clients: `google.rpc.BadRequest` names the field, `google.rpc.RetryInfo` and
    /// the trailer for gRPC's built-in retries contain the retry hint, and `google.rpc.RequestInfo` the request id that
    /// is in the server's log.
    pub fn status(self, request_id: &str) -> Status {
        let mut details = ErrorDetails::new();
        details.set_request_info(request_id, "");
        if let Some(field) = self.field() {
            details.add_bad_request_violation(field, self.to_string());
        }
        let mut metadata = MetadataMap::new();
        if let Some(after) = self.retry_after() {
            details.set_retry_info(Some(after));
            let milliseconds = u64::try_from(after.as_millis()).unwrap_or(u64::MAX);
            metadata.insert(RETRY_PUSHBACK, MetadataValue::from(milliseconds));
        }
        let message = match self.code() {
            Code::Internal => format!("{self} (request {request_id})"),
            _ => self.to_string(),
        };
        Status::with_error_details_and_metadata(self.code(), message, details, metadata)
    }
}

impl From<&Refusal> for pb::Error {
    fn from(refusal: &Refusal) -> Self {
        Self {
            code: refusal.code().into(),
            retry_after: refusal.retry_after().map(|after| after.as_secs_f64()),
            field: refusal.field().unwrap_or_default().to_owned(),
            message: refusal.to_string(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_status_has_the_retry_hint_in_its_details_and_in_the_trailer() {
        let after = Duration::from_millis(1500);
        let status = Refusal::Starting(after).status("7");
        assert_eq!(status.get_details_retry_info().and_then(|info| info.retry_delay), Some(after));
        assert_eq!(status.metadata().get(RETRY_PUSHBACK).unwrap(), "1500");
        let failed = Refusal::Failed(EngineError::SessionEnded).status("7");
        assert_eq!(failed.message(), "the session thread has ended (request 7)");
        assert_eq!(failed.get_details_request_info().unwrap().request_id, "7");
        assert!(failed.get_details_retry_info().is_none() && failed.metadata().get(RETRY_PUSHBACK).is_none());
        assert_eq!(Refusal::Failed(EngineError::Expired).status("7").code(), Code::DeadlineExceeded);
    }
}
