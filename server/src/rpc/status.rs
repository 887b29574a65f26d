//! Refusals as gRPC statuses.

use tonic::metadata::{MetadataMap, MetadataValue};
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use crate::serving::refusal::Refusal;

/// The trailer with the server's retry hint (gRPC proposal A6).
const RETRY_PUSHBACK: &str = "grpc-retry-pushback-ms";

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

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::serving::job::EngineError;

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
