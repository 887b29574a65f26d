use std::borrow::Cow;
use std::fmt::Display;

use thiserror::Error;

/// A field of a message is not what it must be.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{message}")]
pub struct FieldError {
    /// Path of the field in the request, such as `volume.pose.orientation` or `views[1].camera.k`.
    pub field: Cow<'static, str>,
    /// The path, the value, and what it must be.
    pub message: String,
}

impl FieldError {
    /// `{field} is {value}, {needed}`.
    pub fn new(field: impl Into<Cow<'static, str>>, value: impl Display, needed: impl Display) -> Self {
        let field = field.into();
        let message = format!("{field} is {value}, {needed}");
        Self { field, message }
    }

    /// `{field}: {reason}`.
    pub fn refused(field: impl Into<Cow<'static, str>>, reason: impl Display) -> Self {
        let field = field.into();
        let message = format!("{field}: {reason}");
        Self { field, message }
    }

    /// The same of a field inside of `outer`.
    #[must_use]
    pub fn inside(self, outer: impl Display) -> Self {
        Self { field: format!("{outer}.{}", self.field).into(), message: format!("{outer}.{}", self.message) }
    }
}
