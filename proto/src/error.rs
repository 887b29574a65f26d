use std::fmt::Display;

use thiserror::Error;

/// A field of a message is not what it must be.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{message}")]
pub struct FieldError {
    /// Path of the field in the request, such as `volume.pose.orientation`.
    pub field: &'static str,
    /// The path, the value, and what it must be.
    pub message: String,
}

impl FieldError {
    /// `{field} is {value}, {needed}`.
    pub fn new(field: &'static str, value: impl Display, needed: impl Display) -> Self {
        Self { field, message: format!("{field} is {value}, {needed}") }
    }
}
