//! Quantities and identifiers that are exchanged over HTTP, SQL or files. Their constructors check them, so that every existing
//! value is valid.

use std::fmt;

use data_encoding::HEXLOWER;
use jiff::fmt::temporal::Pieces;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

/// A value is outside the valid range of its quantity.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{value} {unit} is not a valid {quantity}: it must be {must}")]
pub struct OutOfRange {
    /// Name of the quantity.
    pub quantity: &'static str,
    /// Unit of `value`; empty for text and pure numbers.
    pub unit: &'static str,
    /// The value as received.
    pub value: String,
    /// What the value must be.
    pub must: &'static str,
}

/// A natural frequency in Hz, finite and above 0.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, utoipa::ToSchema)]
#[serde(transparent)]
#[schema(value_type = f64, exclusive_minimum = 0)]
pub struct Hertz(f64);

impl Hertz {
    /// Checks a value in Hz.
    ///
    /// # Errors
    /// [`OutOfRange`] unless `value` is finite and positive.
    pub fn new(value: f64) -> Result<Self, OutOfRange> {
        let valid = value.is_finite() && value > 0.0;
        valid.then_some(Self(value)).ok_or_else(|| OutOfRange {
            quantity: "natural frequency",
            unit: "Hz",
            value: value.to_string(),
            must: "finite and above 0",
        })
    }

    /// The value in Hz.
    pub const fn get(self) -> f64 {
        self.0
    }
}

/// A probability in [0, 1].
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize)]
#[serde(transparent)]
pub struct Probability(f64);

impl Probability {
    /// Checks a probability.
    ///
    /// # Errors
    /// [`OutOfRange`] unless `value` is in [0, 1].
    pub fn new(value: f64) -> Result<Self, OutOfRange> {
        let valid = (0.0..=1.0).contains(&value);
        valid.then_some(Self(value)).ok_or_else(|| OutOfRange {
            quantity: "probability",
            unit: "",
            value: value.to_string(),
            must: "between 0 and 1",
        })
    }

    /// The probability, in [0, 1].
    pub const fn get(self) -> f64 {
        self.0
    }
}

/// A point in time with a resolution of one microsecond, written as RFC 3339 in UTC.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, utoipa::ToSchema)]
#[schema(value_type = String, format = DateTime, examples("2026-03-01T12:00:00Z"))]
pub struct Timestamp(jiff::Timestamp);

impl Timestamp {
    /// Reads a time in RFC 3339 with an offset. Fractions of a microsecond are dropped.
    ///
    /// # Errors
    /// [`OutOfRange`] if the text is not such a time, has no offset or one of a day or more, or is outside the calendar.
    pub fn parse(text: &str) -> Result<Self, OutOfRange> {
        let refused = |must| OutOfRange { quantity: "time", unit: "", value: shown(text), must };
        let text = text.trim();
        match text.parse::<jiff::Timestamp>() {
            // The parser takes offsets of up to 25 hours.
            Ok(_) if !text.ends_with(['Z', 'z']) && offset_of(text).is_some_and(|o| o.seconds().abs() >= DAY_S) => {
                Err(refused("RFC 3339 with an offset of less than 24 hours"))
            }
            Ok(time) => Self::from_micros(time.as_microsecond()),
            Err(_) if offset_of(text).is_some() => {
                Err(refused("within the calendar, which ends at 9999-12-30T22:00:00Z"))
            }
            Err(_) => Err(refused("RFC 3339 with an offset, such as 2026-03-01T12:00:00Z")),
        }
    }

    /// The earliest time.
    pub const MIN: Self = Self(jiff::Timestamp::MIN);
    /// The latest time.
    pub const MAX: Self = Self(jiff::Timestamp::MAX);

    /// The time a number of microseconds after 1970-01-01T00:00:00Z.
    ///
    /// # Errors
    /// [`OutOfRange`] outside the years ±9999.
    pub fn from_micros(micros: i64) -> Result<Self, OutOfRange> {
        let time = jiff::Timestamp::from_microsecond(micros);
        time.map(Self).map_err(|_| OutOfRange {
            quantity: "time",
            unit: "µs",
            value: micros.to_string(),
            must: "between the years -9999 and 9999",
        })
    }

    /// The day in UTC in words, such as `7 August 2026`.
    pub fn day(self) -> String {
        self.0.to_zoned(jiff::tz::TimeZone::UTC).strftime("%-d %B %Y").to_string()
    }

    /// The month of the year in UTC, 1 to 12.
    pub fn month(self) -> u8 {
        self.0.to_zoned(jiff::tz::TimeZone::UTC).month().unsigned_abs()
    }

    /// Its day in UTC in words: `7 August 2025`.
    pub fn day_in_words(self) -> String {
        self.0.strftime("%-d %B %Y").to_string()
    }

    /// Its minute in UTC in words: `7 August 2025, 14:05 UTC`.
    pub fn minute_in_words(self) -> String {
        self.0.strftime("%-d %B %Y, %H:%M UTC").to_string()
    }

    /// Reads a day such as `2025-08-07`, which stands for its midnight in UTC, or a time in RFC 3339 with an offset.
    ///
    /// # Errors
    /// [`OutOfRange`] if the text is neither.
    pub fn parse_day_or_time(text: &str) -> Result<Self, OutOfRange> {
        let day: Result<jiff::civil::Date, _> = text.trim().parse();
        // A time with an offset can be read as a civil date as well: only the length tells a day.
        if let (Ok(day), true) = (day, text.trim().len() <= "2025-08-07".len()) {
            let midnight = day.to_zoned(jiff::tz::TimeZone::UTC).map(|zoned| zoned.timestamp().as_microsecond());
            return Self::from_micros(midnight.unwrap_or(i64::MAX));
        }
        Self::parse(text).map_err(|_| OutOfRange {
            quantity: "time",
            unit: "",
            value: shown(text),
            must: "a day such as 2025-08-07, or RFC 3339 with an offset, such as 2026-03-01T12:00:00Z",
        })
    }

    /// Microseconds since 1970-01-01T00:00:00Z.
    pub fn micros(self) -> i64 {
        self.0.as_microsecond()
    }
}

/// Seconds of a day.
const DAY_S: i32 = 86_400;

/// The offset of a text that has the form of a time with an offset.
fn offset_of(text: &str) -> Option<jiff::tz::Offset> {
    let pieces = Pieces::parse(text).ok()?;
    pieces.time().and(pieces.to_numeric_offset())
}

impl fmt::Display for Timestamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl Serialize for Timestamp {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Timestamp {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        Self::parse(&text).map_err(serde::de::Error::custom)
    }
}

/// Name of a structure: 1 to 64 of `a–z 0–9 - _ .`, beginning with a letter or digit.
///
/// It is used as a URL path segment and as a folder name, so that no other characters are allowed.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(try_from = "String", into = "String")]
#[schema(value_type = String, min_length = 1, max_length = 64, pattern = "^[a-z0-9][a-z0-9._-]*$", examples("three-dof"))]
pub struct StructureId(String);

impl StructureId {
    /// Checks an id.
    ///
    /// # Errors
    /// [`OutOfRange`] if it is empty, longer than 64 characters or contains other characters.
    pub fn parse(text: &str) -> Result<Self, OutOfRange> {
        let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "-_.".contains(c);
        let starts_well = text.chars().next().is_some_and(|c| c.is_ascii_alphanumeric());
        let valid = starts_well && text.len() <= 64 && text.chars().all(allowed);
        valid.then(|| Self(text.to_owned())).ok_or_else(|| OutOfRange {
            quantity: "structure id",
            unit: "",
            value: shown(text),
            must: "1 to 64 of a-z, 0-9, '-', '_', '.', beginning with a letter or digit",
        })
    }

    /// The id as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for StructureId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl TryFrom<String> for StructureId {
    type Error = OutOfRange;

    fn try_from(text: String) -> Result<Self, OutOfRange> {
        Self::parse(&text)
    }
}

impl From<StructureId> for String {
    fn from(id: StructureId) -> Self {
        id.0
    }
}

/// A SHA-256 digest, written as 64 hexadecimal digits.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(transparent)]
#[schema(value_type = String, pattern = "^[0-9a-f]{64}$")]
pub struct Digest(String);

impl Digest {
    /// Digest of several byte strings. Each is preceded by its length, so that different lists do not give the same input.
    pub fn of(parts: &[&[u8]]) -> Self {
        let mut hasher = Sha256::new();
        for part in parts {
            hasher.update((part.len() as u64).to_le_bytes());
            hasher.update(part);
        }
        Self::from_hasher(hasher)
    }

    /// Digest of the bytes of a file, as `sha256sum` prints it.
    pub fn of_file(bytes: &[u8]) -> Self {
        let mut hasher = Sha256::new();
        hasher.update(bytes);
        Self::from_hasher(hasher)
    }

    /// A digest that was stored as text. It is not checked.
    pub fn from_stored(text: String) -> Self {
        Self(text)
    }

    /// The hexadecimal digits.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    fn from_hasher(hasher: Sha256) -> Self {
        Self(HEXLOWER.encode(&hasher.finalize()))
    }
}

impl fmt::Display for Digest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A value with about four significant digits and, for a large value, the prefix k, M or G of its unit: `30 MN/m`, `0.7 kg`, `3.2 kN/m`.
/// A number without a unit, "–", stands alone.
pub fn with_prefix(value: f64, unit: &str) -> String {
    if unit == "–" {
        return significant(value);
    }
    let prefixes = [("G", 1e9), ("M", 1e6), ("k", 1e3)];
    // Tonnes are not written as Mg, and per cent take no prefix.
    let prefixed = if unit == "kg" || unit.is_empty() || unit.starts_with('%') {
        None
    } else {
        prefixes.into_iter().find(|(_, size)| value.abs() >= *size)
    };
    let (prefix, scaled) = prefixed.map_or(("", value), |(prefix, size)| (prefix, value / size));
    format!("{} {prefix}{unit}", significant(scaled)).trim_end().to_owned()
}

/// A number with four significant digits, without the zeros at its end; with an exponent where it would be too long.
pub fn significant(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let magnitude = value.abs().log10().floor();
    if !(-4.0..=6.0).contains(&magnitude) {
        return format!("{value:.3e}");
    }
    let decimals = (3.0 - magnitude).max(0.0) as usize;
    let text = format!("{value:.decimals$}");
    if text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        text
    }
}

/// Text from a client as it is shown in a message: in quotation marks, cut to 80 characters, with control characters escaped.
pub fn shown(text: &str) -> String {
    let mut short: String = text.chars().take(80).flat_map(char::escape_debug).collect();
    if text.chars().nth(80).is_some() {
        short.push('…');
    }
    format!("\"{short}\"")
}

/// The path of a value as a JSON pointer (RFC 6901), such as `/mass/0/kg`; empty for the whole document.
pub fn json_pointer(path: &serde_path_to_error::Path) -> String {
    use serde_path_to_error::Segment;
    let segment = |segment: &Segment| match segment {
        Segment::Seq { index } => format!("/{index}"),
        Segment::Map { key } => format!("/{}", key.replace('~', "~0").replace('/', "~1")),
        Segment::Enum { variant } => format!("/{variant}"),
        Segment::Unknown => String::new(),
    };
    path.iter().map(segment).collect()
}

#[cfg(test)]
mod tests {
    use super::Timestamp;

    #[test]
    fn a_time_that_is_refused_is_told_why() {
        for (text, must) in [
            ("9999-12-31T23:59:59Z", "within the calendar, which ends at 9999-12-30T22:00:00Z"),
            ("9999-12-30T23:00:00-01:00", "within the calendar, which ends at 9999-12-30T22:00:00Z"),
            ("2026-03-01T12:00:00-24:00", "RFC 3339 with an offset of less than 24 hours"),
            ("2026-03-01T12:00:00+25:00", "RFC 3339 with an offset of less than 24 hours"),
            ("2026-03-01T12:00:00", "RFC 3339 with an offset, such as 2026-03-01T12:00:00Z"),
            ("2026-02-30T12:00:00Z", "RFC 3339 with an offset, such as 2026-03-01T12:00:00Z"),
            ("yesterday", "RFC 3339 with an offset, such as 2026-03-01T12:00:00Z"),
        ] {
            assert_eq!(Timestamp::parse(text).unwrap_err().must, must, "{text}");
        }
        for text in ["9999-12-30T22:00:00Z", "2026-03-01T12:00:00+23:59", " 2026-03-01T12:00:00.5-14:00"] {
            assert!(Timestamp::parse(text).is_ok(), "{text}");
        }
    }
}
