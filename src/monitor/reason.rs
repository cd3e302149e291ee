//! A stable code with a sentence, for the health of the service.

use serde::Serialize;

/// Something that an operator should know.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct Reason {
    /// Stable code, part of the API.
    pub code: &'static str,
    /// A sentence for people.
    pub message: String,
}

impl Reason {
    /// A reason with its code and a sentence for people.
    pub fn new(code: &'static str, message: impl Into<String>) -> Self {
        Self { code, message: message.into() }
    }
}
