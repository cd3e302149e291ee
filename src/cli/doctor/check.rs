//! One check of the doctor.

use serde::Serialize;

/// The result of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum CheckVerdict {
    Ok,
    Warn,
    Fail,
}

/// A check, with what to do if its verdict is not `Ok`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Check {
    pub check: String,
    pub verdict: CheckVerdict,
    pub found: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub next_step: Option<String>,
}

impl Check {
    pub fn ok(check: impl Into<String>, found: impl Into<String>) -> Self {
        Self { check: check.into(), verdict: CheckVerdict::Ok, found: found.into(), next_step: None }
    }

    pub fn warn(check: impl Into<String>, found: impl Into<String>, next: impl Into<String>) -> Self {
        let (check, found) = (check.into(), found.into());
        Self { check, verdict: CheckVerdict::Warn, found, next_step: Some(next.into()) }
    }

    pub fn fail(check: impl Into<String>, found: impl Into<String>, next: impl Into<String>) -> Self {
        Self { verdict: CheckVerdict::Fail, ..Self::warn(check, found, next) }
    }
}

/// A number of bytes with a binary unit.
pub fn size(bytes: u64) -> String {
    let units = [("GiB", 30), ("MiB", 20), ("KiB", 10)];
    let unit = units.into_iter().find(|(_, shift)| bytes >= 1_u64 << shift);
    unit.map_or_else(
        || format!("{bytes} B"),
        |(name, shift)| format!("{:.1} {name}", bytes as f64 / (1_u64 << shift) as f64),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_readable() {
        assert_eq!([size(10), size(2048), size(3 << 30)], ["10 B", "2.0 KiB", "3.0 GiB"]);
    }
}
