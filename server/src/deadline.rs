//! When a caller stops waiting, as its `grpc-timeout` header has it.

use std::time::{Duration, Instant};

use tonic::metadata::MetadataMap;
use tonic::{Extensions, Request, Status};

/// The header (gRPC over HTTP/2, "Requests"): up to eight digits and a unit.
const HEADER: &str = "grpc-timeout";

/// So much earlier than the caller gives up it is told: tonic watches the same header, and calls what it ends cancelled.
const MARGIN: Duration = Duration::from_millis(2);

/// A moment after which nobody waits for the answer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Deadline(pub Instant);

/// The deadline that was [noted](note).
pub(crate) fn of(extensions: &Extensions) -> Option<Deadline> {
    extensions.get().copied()
}

/// Notes the deadline of a request, counted from its headers: the message may take a while to come.
#[expect(clippy::unnecessary_wraps, reason = "the form of tonic's interceptors")]
pub(crate) fn note(mut request: Request<()>) -> Result<Request<()>, Status> {
    if let Some(timeout) = timeout(request.metadata()) {
        let deadline = Deadline(Instant::now() + timeout.saturating_sub(MARGIN));
        request.extensions_mut().insert(deadline);
    }
    Ok(request)
}

/// The timeout, if there is one that can be read.
fn timeout(metadata: &MetadataMap) -> Option<Duration> {
    let text = metadata.get(HEADER)?.to_str().ok()?;
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    if digits.is_empty() || digits.len() > 8 || !digits.bytes().all(|byte| byte.is_ascii_digit()) {
        return None;
    }
    let count: u64 = digits.parse().ok()?;
    Some(match unit {
        "H" => Duration::from_secs(count * 3600),
        "M" => Duration::from_secs(count * 60),
        "S" => Duration::from_secs(count),
        "m" => Duration::from_millis(count),
        "u" => Duration::from_micros(count),
        "n" => Duration::from_nanos(count),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timeouts_are_read_as_grpc_writes_them() {
        let read = |text: &str| {
            let mut metadata = MetadataMap::new();
            metadata.insert(HEADER, text.parse().unwrap());
            timeout(&metadata)
        };
        assert_eq!(read("2H"), Some(Duration::from_secs(7200)));
        assert_eq!(read("3M"), Some(Duration::from_secs(180)));
        assert_eq!(read("10S"), Some(Duration::from_secs(10)));
        assert_eq!(read("250m"), Some(Duration::from_millis(250)));
        assert_eq!(read("99999999u"), Some(Duration::from_micros(99_999_999)));
        assert_eq!(read("7n"), Some(Duration::from_nanos(7)));
        for wrong in ["", "S", "10", "-1S", "1.5S", "123456789S", "5 S", "5s"] {
            assert_eq!(read(wrong), None, "{wrong}");
        }
        assert_eq!(timeout(&MetadataMap::new()), None);
    }
}
