use std::borrow::Cow;
use std::fmt::Display;

use thiserror::Error;

/// A field of a message is invalid.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{message}")]
pub struct FieldError {
    /// Path of the field in the request, such as `volume.pose.orientation` or `views[1].camera.k`.
    pub field: Cow<'static, str>,
    /// The path, the value, and the requirement.
    pub message: String,
}

impl FieldError {
    /// An error with the message `{field} is {value}, {needed}`.
    pub fn new(field: impl Into<Cow<'static, str>>, value: impl Display, needed: impl Display) -> Self {
        let field = field.into();
        let message = on_a_line(&format!("{field} is {value}, {needed}"));
        Self { field, message }
    }

    /// An error with the message `{field}: {reason}`.
    pub fn refused(field: impl Into<Cow<'static, str>>, reason: impl Display) -> Self {
        let field = field.into();
        let message = on_a_line(&format!("{field}: {reason}"));
        Self { field, message }
    }

    /// The same error with `outer` prepended to the path.
    #[must_use]
    pub fn inside(self, outer: impl Display) -> Self {
        Self { field: format!("{outer}.{}", self.field).into(), message: format!("{outer}.{}", self.message) }
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
        let error =
            FieldError::new("outputs", "`a\nINFO forged\u{1b}[0m`", "the outputs are quality, rotation and width");
        assert!(error.message.starts_with("outputs is `a\\nINFO forged\\u{1b}[0m`, the"), "{error}");
        let long = FieldError::refused("inputs[0].name", "ä".repeat(1_000_000)).message;
        assert!(long.len() < 1600 && long.ends_with("ää…"));
    }
}
