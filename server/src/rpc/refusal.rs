use std::time::Duration;

use grasp_proto::{FieldError, pb};
use thiserror::Error;
use tonic::metadata::{MetadataMap, MetadataValue};
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use crate::serving::engine::{EngineError, Overloaded};

/// Why a request gets no grasps.
#[derive(Debug, Error)]
pub(crate) enum Refusal {
    #[error(transparent)]
    Field(#[from] FieldError),
    #[error("{field} is `{wanted}`, there is no such; there are {available}")]
    UnknownModel { field: &'static str, wanted: String, available: String },
    #[error(transparent)]
    Overloaded(#[from] Overloaded),
    #[error("the server is warming up; come back in {0:?}")]
    Starting(Duration),
    #[error("the server is shutting down; another one may be up")]
    Draining,
    #[error("{0} volumes are kept already, no more are; end a stream, or raise --max-tracked")]
    TooManyTracked(usize),
    #[error("no request came for {0:?}: the volume is gone; open another stream")]
    TrackExpired(Duration),
    #[error(transparent)]
    Failed(#[from] EngineError),
}

/// The trailer with which gRPC servers tell clients when to retry (gRPC proposal A6).
const RETRY_PUSHBACK: &str = "grpc-retry-pushback-ms";

/// When it is worth asking again for a volume to be kept: streams live long.
const KEPT: Duration = Duration::from_secs(1);

impl Refusal {
    pub fn code(&self) -> Code {
        match self {
            Self::Field(_) => Code::InvalidArgument,
            Self::UnknownModel { .. } => Code::NotFound,
            Self::Overloaded(_) | Self::TooManyTracked(_) => Code::ResourceExhausted,
            Self::Starting(_) | Self::Draining => Code::Unavailable,
            Self::TrackExpired(_) => Code::Aborted,
            Self::Failed(EngineError::Expired) => Code::DeadlineExceeded,
            Self::Failed(_) => Code::Internal,
        }
    }

    /// The field of the request that is not what it must be.
    fn field(&self) -> Option<&str> {
        match self {
            Self::Field(error) => Some(&error.field),
            Self::UnknownModel { field, .. } => Some(field),
            _ => None,
        }
    }

    /// When it is worth coming back, where it is.
    fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Overloaded(overloaded) => Some(overloaded.retry_after),
            Self::Starting(retry_after) => Some(*retry_after),
            Self::TooManyTracked(_) => Some(KEPT),
            Self::Field(_) | Self::UnknownModel { .. } | Self::Draining | Self::TrackExpired(_) | Self::Failed(_) => {
                None
            }
        }
    }
}

impl Refusal {
    /// With what clients need to react to it by themselves: `google.rpc.BadRequest` names the field, `google.rpc.RetryInfo`
    /// says when to come back, and so does the trailer that gRPC's own retries look at; `google.rpc.RequestInfo` has the
    /// id by which the server's log knows the request.
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

impl From<Refusal> for pb::Error {
    fn from(refusal: Refusal) -> Self {
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
    fn clients_are_told_when_to_come_back_in_every_way_they_look_at() {
        let after = Duration::from_millis(1500);
        let status = Refusal::Starting(after).status("7");
        assert_eq!(status.get_details_retry_info().and_then(|info| info.retry_delay), Some(after));
        assert_eq!(status.metadata().get(RETRY_PUSHBACK).unwrap(), "1500");
        let gone = Refusal::Failed(EngineError::Gone).status("7");
        assert_eq!(gone.message(), "the session is gone (request 7)");
        assert_eq!(gone.get_details_request_info().unwrap().request_id, "7");
        assert!(gone.get_details_retry_info().is_none() && gone.metadata().get(RETRY_PUSHBACK).is_none());
        assert_eq!(Refusal::Failed(EngineError::Expired).status("7").code(), Code::DeadlineExceeded);
    }
}
