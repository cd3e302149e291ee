//! Who does something, and the texts that people write.

use super::error::ApiError;
use crate::access::Grant;
use crate::quantity::shown;

/// Maximum length of a name or a line of text, characters.
const LONGEST_TEXT: usize = 500;

/// Maximum length of a comment or note, characters.
pub const LONGEST_COMMENT: usize = 2_000;

/// The author of an action: the name of the token, as the audit has it. Without tokens it must be stated.
///
/// # Errors
/// 422 if it is missing without tokens, or if another name than that of the token is stated.
pub fn author(grant: &Grant, stated: Option<&str>) -> Result<String, ApiError> {
    let wrong = |message: String| ApiError::invalid_field("/author".to_owned(), message);
    stated.map(|name| check_text("/author", name)).transpose()?;
    match (grant.actor().name(), stated) {
        (Some(name), Some(other)) if name != other => Err(wrong(format!(
            "{} is not the name of the token, {}: leave `author` out, the name of the token is recorded",
            shown(other),
            shown(name)
        ))),
        (Some(name), _) | (None, Some(name)) => Ok(name.to_owned()),
        (None, None) => Err(wrong("is missing: without tokens the service does not know who you are".to_owned())),
    }
}

/// Checks a comment or note, which may have line breaks.
///
/// # Errors
/// 422 with the pointer unless it has 1 to 2000 characters, one of them visible, and no control characters but line breaks and tabs.
pub fn check_comment(pointer: &str, text: &str) -> Result<(), ApiError> {
    let control = |c: char| c.is_control() && !['\n', '\t'].contains(&c);
    let length = text.chars().count();
    if (1..=LONGEST_COMMENT).contains(&length) && !text.trim().is_empty() && !text.chars().any(control) {
        return Ok(());
    }
    let message = format!(
        "{} must have 1 to {LONGEST_COMMENT} characters, of which only line breaks and tabs may be control characters",
        shown(text)
    );
    Err(ApiError::invalid_field(pointer.to_owned(), message))
}

/// Checks a name or a line of text.
///
/// # Errors
/// 422 with the pointer unless it has 1 to 500 printable characters.
pub fn check_text(pointer: &str, text: &str) -> Result<(), ApiError> {
    let length = text.chars().count();
    if (1..=LONGEST_TEXT).contains(&length) && !text.chars().any(char::is_control) {
        return Ok(());
    }
    let message = format!("{} must have 1 to {LONGEST_TEXT} printable characters", shown(text));
    Err(ApiError::invalid_field(pointer.to_owned(), message))
}
