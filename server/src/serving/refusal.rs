use std::time::Duration;

use grasp_proto::{FieldError, pb};
use thiserror::Error;
use tonic::Code;

use super::engine::Overloaded;
use super::job::EngineError;

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
    #[error("the token of the stream is no longer accepted; open a new stream with a valid one")]
    TokenRemoved,
    #[error("loading and unloading of models is not allowed; start the server with --allow-model-control")]
    NoModelControl,
    #[error("{0}")]
    NotChanged(String),
    #[error("{0} requests to load or unload models already wait; retry after {1:?}")]
    ManyChanges(usize, Duration),
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

/// Retry hint when all streams are in use: streams live long.
const STREAMS_IN_USE: Duration = Duration::from_secs(1);

impl Refusal {
    pub fn code(&self) -> Code {
        match self {
            Self::Field(_) => Code::InvalidArgument,
            Self::UnknownModel { .. } => Code::NotFound,
            Self::Overloaded(_) | Self::TooManyTracked { .. } | Self::ManyChanges(..) => Code::ResourceExhausted,
            Self::Starting(_) | Self::Draining => Code::Unavailable,
            Self::TrackExpired(_) => Code::Aborted,
            Self::TokenRemoved => Code::Unauthenticated,
            Self::NoModelControl => Code::PermissionDenied,
            Self::NotChanged(_) => Code::FailedPrecondition,
            Self::Failed(EngineError::Expired | EngineError::NoTimeLeft(_)) => Code::DeadlineExceeded,
            Self::Failed(EngineError::NoSession) => Code::Unavailable,
            Self::Failed(_) => Code::Internal,
        }
    }

    /// The invalid field of the request, if a field is the reason.
    pub fn field(&self) -> Option<&str> {
        match self {
            Self::Field(error) => Some(&error.field),
            Self::UnknownModel { field, .. } => Some(field),
            _ => None,
        }
    }

    /// The retry hint; None if a retry does not help.
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Overloaded(overloaded) => Some(overloaded.retry_after),
            Self::Starting(retry_after) | Self::ManyChanges(_, retry_after) => Some(*retry_after),
            Self::TooManyTracked { .. } => Some(STREAMS_IN_USE),
            Self::Field(_)
            | Self::UnknownModel { .. }
            | Self::Draining
            | Self::TrackExpired(_)
            | Self::TokenRemoved
            | Self::NoModelControl
            | Self::NotChanged(_)
            | Self::Failed(_) => None,
        }
    }
}

impl From<&Refusal> for pb::Error {
    fn from(refusal: &Refusal) -> Self {
        Self {
            code: refusal.code().into(),
            retry_after: refusal.retry_after().map(|after| after.as_secs_f64()),
            field: refusal.field().unwrap_or_default().to_owned(),
            message: refusal.to_string(),
            views_added: false,
        }
    }
}
