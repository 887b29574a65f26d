//! When a caller stops waiting, as its `grpc-timeout` header has it.

use std::time::{Duration, Instant};

use http::{Extensions, HeaderMap};

/// The header (gRPC over HTTP/2, "Requests"): up to eight digits and a unit.
const HEADER: &str = "grpc-timeout";

/// So much earlier than the caller gives up it is told: tonic watches the same header, and calls what it ends cancelled.
const MARGIN: Duration = Duration::from_millis(2);

/// A moment after which nobody waits for the answer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Deadline(pub Instant);

impl Deadline {
    pub fn has_passed(self) -> bool {
        self.0 <= Instant::now()
    }
}

/// The deadline of a request whose headers have just come: the message may take a while.
pub(crate) fn read(headers: &HeaderMap) -> Option<Deadline> {
    Some(Deadline(Instant::now() + timeout(headers)?.saturating_sub(MARGIN)))
}

/// The deadline that was read when the headers came.
pub(crate) fn of(extensions: &Extensions) -> Option<Deadline> {
    extensions.get().copied()
}

/// The timeout, if there is one that can be read.
fn timeout(headers: &HeaderMap) -> Option<Duration> {
    let text = headers.get(HEADER)?.to_str().ok()?;
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
            let mut headers = HeaderMap::new();
            headers.insert(HEADER, text.parse().unwrap());
            timeout(&headers)
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
        assert_eq!(timeout(&HeaderMap::new()), None);
    }
}
