//! Times and lists of a condition report.

use std::fmt::Write as _;

use crate::plot::escaped;
use crate::quantity::Timestamp;

/// A time to the minute.
pub fn time(at: Timestamp) -> String {
    at.to_string().chars().take(16).collect::<String>().replace('T', " ")
}

/// A list of sentences.
pub fn list(items: &[String]) -> String {
    let mut text = "<ul>".to_owned();
    for item in items {
        let _ = write!(text, "<li>{}</li>", escaped(item));
    }
    text + "</ul>"
}

/// `1 batch`, `2 batches`.
pub fn counted(n: u64, one: &str, many: &str) -> String {
    format!("{n} {}", if n == 1 { one } else { many })
}
