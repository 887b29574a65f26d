//! Deadlines of requests from the `grpc-timeout` header.

use std::time::{Duration, Instant};

use http::{Extensions, HeaderMap};

/// The header (gRPC over HTTP/2, "Requests"): up to eight digits and a unit.
const HEADER: &str = "grpc-timeout";

/// The server's deadline is earlier than the client's by this margin, because tonic applies the same header and ends
/// expired requests as cancelled.
const MARGIN: Duration = Duration::from_millis(2);

/// When a request expires.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Deadline(pub Instant);

impl Deadline {
    pub fn has_passed(self) -> bool {
        self.0 <= Instant::now()
    }
}

/// The deadline of a request whose headers were just received. Receiving the message may take longer.
pub(crate) fn read(headers: &HeaderMap) -> Option<Deadline> {
    Some(Deadline(Instant::now() + timeout(headers)?.saturating_sub(MARGIN)))
}

/// The deadline that was stored when the headers were received.
pub(crate) fn of(extensions: &Extensions) -> Option<Deadline> {
    extensions.get().copied()
}

/// The timeout in the headers; None if it is missing or malformed.
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
    fn timeouts_are_parsed_as_the_grpc_specification_defines() {
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
        for invalid in ["", "S", "10", "-1S", "1.5S", "123456789S", "5 S", "5s"] {
            assert_eq!(read(invalid), None, "{invalid}");
        }
        assert_eq!(timeout(&HeaderMap::new()), None);
    }
}
