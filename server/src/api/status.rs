//! Errors as gRPC statuses, and as messages of a stream.

use grasp::RequestError;
use grasp_proto::pb;
use tonic::metadata::{MetadataMap, MetadataValue};
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

/// The trailer with the server's retry hint (gRPC proposal A6).
const RETRY_PUSHBACK: &str = "grpc-retry-pushback-ms";

/// The gRPC code of an error.
pub(crate) fn code(error: &RequestError) -> Code {
    Code::from_i32(error.code as i32)
}

/// The gRPC status, with details for clients: `google.rpc.BadRequest` names the field, `google.rpc.RetryInfo` and the
/// trailer for gRPC's built-in retries contain the retry hint, and `google.rpc.RequestInfo` the request id that is in
/// the server's log.
pub(crate) fn status(error: &RequestError, request_id: &str) -> Status {
    let mut details = ErrorDetails::new();
    details.set_request_info(request_id, "");
    if let Some(field) = &error.field {
        details.add_bad_request_violation(&**field, &error.message);
    }
    let mut metadata = MetadataMap::new();
    if let Some(after) = error.retry_after {
        details.set_retry_info(Some(after));
        let milliseconds = u64::try_from(after.as_millis()).unwrap_or(u64::MAX);
        metadata.insert(RETRY_PUSHBACK, MetadataValue::from(milliseconds));
    }
    let message = match error.code {
        grasp::Code::Internal => format!("{error} (request {request_id})"),
        _ => error.message.clone(),
    };
    Status::with_error_details_and_metadata(code(error), message, details, metadata)
}

/// The message of a stream about a request that was refused.
pub(crate) fn message(error: &RequestError) -> pb::Error {
    pb::Error {
        code: error.code as i32,
        retry_after: error.retry_after.map(|after| after.as_secs_f64()),
        field: error.field().to_owned(),
        message: error.message.clone(),
        views_added: false,
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn the_status_has_the_retry_hint_in_its_details_and_in_the_trailer() {
        let after = Duration::from_millis(1500);
        let starting = RequestError::new(grasp::Code::Unavailable, "the server is warming up").after(after);
        let status_of = |error: &RequestError| status(error, "7");
        let starting = status_of(&starting);
        assert_eq!(starting.get_details_retry_info().and_then(|info| info.retry_delay), Some(after));
        assert_eq!(starting.metadata().get(RETRY_PUSHBACK).unwrap(), "1500");
        let failed = status_of(&RequestError::new(grasp::Code::Internal, "the session thread has ended"));
        assert_eq!(failed.message(), "the session thread has ended (request 7)");
        assert_eq!(failed.get_details_request_info().unwrap().request_id, "7");
        assert!(failed.get_details_retry_info().is_none() && failed.metadata().get(RETRY_PUSHBACK).is_none());
        assert_eq!(status_of(&RequestError::expired()).code(), Code::DeadlineExceeded);
    }
}
