//! Reads JSON objects from clients, and distinguishes text that is not JSON from JSON of another shape.

use serde::de::DeserializeOwned;

use super::check::Problem;
use crate::quantity::json_pointer;

/// Why a text is not the expected JSON object.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum JsonError {
    /// It is not JSON. The message contains line and column.
    Malformed(String),
    /// It is JSON of another shape, or contains a number that JSON or f64 cannot represent.
    Shape(Problem),
}

/// Reads a JSON object.
///
/// # Errors
/// [`JsonError`] with line and column, or with a JSON pointer.
pub fn read_object<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, JsonError> {
    // serde would also accept a list and read the fields of the object from it by position.
    if !begins_as_object(bytes) && serde_json::from_slice::<serde::de::IgnoredAny>(bytes).is_ok() {
        return Err(JsonError::Shape(Problem::new("/", "the body must be a JSON object")));
    }
    let mut deserializer = serde_json::Deserializer::from_slice(bytes);
    let value = serde_path_to_error::deserialize(&mut deserializer).map_err(|error| {
        let pointer = json_pointer(error.path());
        json_error(bytes, pointer, error.inner())
    })?;
    deserializer.end().map_err(|error| json_error(bytes, String::new(), &error))?;
    Ok(value)
}

fn json_error(bytes: &[u8], pointer: String, error: &serde_json::Error) -> JsonError {
    let not_a_number = not_a_number_at(bytes, error.line(), error.column());
    let message = match not_a_number {
        Some(word) => format!("{word} is not a JSON number: send null for a mode that was not identified"),
        None => error.to_string(),
    };
    let malformed = |message: &str| JsonError::Malformed(format!("the body is not valid JSON: {message}"));
    if !begins_as_object(bytes) {
        return malformed(&message);
    }
    // serde_json reports a number outside the range of f64 as a syntax error; for the client it is a wrong value.
    let wrong_value = error.is_data() || not_a_number.is_some() || message.starts_with("number out of range");
    if wrong_value {
        let pointer = if pointer.is_empty() { "/".to_owned() } else { pointer };
        return JsonError::Shape(Problem::new(pointer, message));
    }
    malformed(&message)
}

fn begins_as_object(bytes: &[u8]) -> bool {
    bytes.iter().find(|b| !b.is_ascii_whitespace()) == Some(&b'{')
}

/// `NaN` or `Infinity` at the position where the parser stopped.
fn not_a_number_at(bytes: &[u8], line: usize, column: usize) -> Option<&'static str> {
    let line = bytes.split(|b| *b == b'\n').nth(line.checked_sub(1)?)?;
    // The parser stops at or just after the first character that it cannot use.
    let around = &line[column.saturating_sub(2).min(line.len())..];
    let around = &around[..around.len().min(12)];
    ["-Infinity", "Infinity", "NaN"]
        .into_iter()
        .find(|word| around.windows(word.len()).take(3).any(|window| window == word.as_bytes()))
}
