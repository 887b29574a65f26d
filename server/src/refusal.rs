use std::time::Duration;

use grasp_proto::{FieldError, pb};
use thiserror::Error;
use tonic::metadata::MetadataValue;
use tonic::{Code, Status};

use crate::engine::{EngineError, Overloaded};

/// Why a request gets no grasps.
#[derive(Debug, Error)]
pub(crate) enum Refusal {
    #[error(transparent)]
    Field(#[from] FieldError),
    #[error("model is `{wanted}`, there is no such; there are {available}")]
    UnknownModel { wanted: String, available: String },
    #[error(transparent)]
    Overloaded(#[from] Overloaded),
    #[error("the server is warming up; come back in {0:?}")]
    Starting(Duration),
    #[error(transparent)]
    Failed(#[from] EngineError),
}

/// The trailer with which gRPC servers tell clients when to retry (gRPC proposal A6).
const RETRY_PUSHBACK: &str = "grpc-retry-pushback-ms";

impl Refusal {
    pub fn code(&self) -> Code {
        match self {
            Self::Field(_) => Code::InvalidArgument,
            Self::UnknownModel { .. } => Code::NotFound,
            Self::Overloaded(_) => Code::ResourceExhausted,
            Self::Starting(_) => Code::Unavailable,
            Self::Failed(EngineError::Expired) => Code::DeadlineExceeded,
            Self::Failed(_) => Code::Internal,
        }
    }

    /// When it is worth coming back, where it is.
    fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Overloaded(overloaded) => Some(overloaded.retry_after),
            Self::Starting(retry_after) => Some(*retry_after),
            Self::Field(_) | Self::UnknownModel { .. } | Self::Failed(_) => None,
        }
    }
}

impl From<Refusal> for Status {
    fn from(refusal: Refusal) -> Self {
        let mut status = Self::new(refusal.code(), refusal.to_string());
        if let Some(after) = refusal.retry_after() {
            let milliseconds = u64::try_from(after.as_millis()).unwrap_or(u64::MAX);
            status.metadata_mut().insert(RETRY_PUSHBACK, MetadataValue::from(milliseconds));
        }
        status
    }
}

impl From<Refusal> for pb::Error {
    fn from(refusal: Refusal) -> Self {
        Self {
            code: refusal.code().into(),
            retry_after: refusal.retry_after().map(|after| after.as_secs_f64()),
            message: refusal.to_string(),
        }
    }
}
