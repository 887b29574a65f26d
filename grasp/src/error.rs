use std::borrow::Cow;
use std::fmt::Display;
use std::time::Duration;

use thiserror::Error;

/// Why a request gets no grasps.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{message}")]
pub struct RequestError {
    /// The kind of error.
    pub code: Code,
    /// Path of the invalid field in the request, such as `volume.pose.orientation` or `views[1].camera.k`, if a field is the
    /// reason.
    pub field: Option<Cow<'static, str>>,
    /// What was wrong, with the value, and what to do.
    pub message: String,
    /// When a retry may succeed; `None` if a retry does not help.
    pub retry_after: Option<Duration>,
}

/// The kind of an error, with the numbers of `google.rpc.Code`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Code {
    /// A field is invalid.
    InvalidArgument = 3,
    /// The deadline passed, or would pass before the reply.
    DeadlineExceeded = 4,
    /// The model does not exist.
    NotFound = 5,
    /// The server does not allow it.
    PermissionDenied = 7,
    /// Too many requests.
    ResourceExhausted = 8,
    /// The server's state does not allow it.
    FailedPrecondition = 9,
    /// The state of a stream was dropped.
    Aborted = 10,
    /// A defect, or a model that fails.
    Internal = 13,
    /// The server starts, stops, or hangs.
    Unavailable = 14,
    /// The token is not accepted.
    Unauthenticated = 16,
}

impl RequestError {
    /// An error that no field causes.
    pub fn new(code: Code, message: impl Into<String>) -> Self {
        Self { code, field: None, message: message.into(), retry_after: None }
    }

    /// An invalid field, with the message `{field} is {value}, {needed}`.
    pub fn invalid(field: impl Into<Cow<'static, str>>, value: impl Display, needed: impl Display) -> Self {
        let field = field.into();
        let message = format!("{field} is {value}, {needed}");
        Self::of_field(field, &message)
    }

    /// A list of an invalid length, with the message `{field} has {length} entries, {needed}`.
    pub fn of_length(field: impl Into<Cow<'static, str>>, length: usize, needed: impl Display) -> Self {
        let field = field.into();
        let message = format!("{field} has {length} entries, {needed}");
        Self::of_field(field, &message)
    }

    /// An invalid field, with the message `{field}: {reason}`.
    pub fn refused(field: impl Into<Cow<'static, str>>, reason: impl Display) -> Self {
        let field = field.into();
        let message = format!("{field}: {reason}");
        Self::of_field(field, &message)
    }

    /// An invalid field. `message` begins with its path.
    pub(crate) fn of_field(field: impl Into<Cow<'static, str>>, message: &str) -> Self {
        Self { field: Some(field.into()), ..Self::new(Code::InvalidArgument, on_a_line(message)) }
    }

    /// The deadline has passed.
    #[must_use]
    pub fn expired() -> Self {
        Self::new(Code::DeadlineExceeded, "the deadline passed before the request was finished")
    }

    /// The same error with a hint when to retry.
    #[must_use]
    pub fn after(self, retry_after: Duration) -> Self {
        Self { retry_after: Some(retry_after), ..self }
    }

    /// The path of the invalid field; empty if no field is the reason.
    #[must_use]
    pub fn field(&self) -> &str {
        self.field.as_deref().unwrap_or_default()
    }

    /// The same error with `outer` prepended to the path of its field.
    #[must_use]
    pub fn inside(self, outer: impl Display) -> Self {
        match self.field {
            None => self,
            Some(field) => {
                let message = format!("{outer}.{}", self.message);
                Self { field: Some(format!("{outer}.{field}").into()), message, ..self }
            }
        }
    }
}

/// Escapes control characters and truncates text that may contain input of the client, so that it fits on one log line
/// and into a header.
#[must_use]
pub fn on_a_line(text: &str) -> String {
    const LONGEST: usize = 1500;
    let mut line = String::new();
    for c in text.chars() {
        if line.len() > LONGEST {
            line.push('…');
            break;
        }
        if c.is_control() { line.extend(c.escape_default()) } else { line.push(c) }
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn client_input_cannot_forge_log_lines_and_fits_into_a_header() {
        let error = RequestError::invalid(
            "outputs",
            "`a\nINFO forged\u{1b}[0m`",
            "the outputs are quality, rotation and width",
        );
        assert!(error.message.starts_with("outputs is `a\\nINFO forged\\u{1b}[0m`, the"), "{error}");
        let long = RequestError::refused("inputs[0].name", "ä".repeat(1_000_000)).message;
        assert!(long.len() < 1600 && long.ends_with("ää…"));
    }
}
