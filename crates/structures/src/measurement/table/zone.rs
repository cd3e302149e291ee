//! The zone of times that do not state one.

use std::fmt;

use jiff::civil::DateTime;
use jiff::tz::{AmbiguousOffset, Offset, TimeZone};

use crate::quantity::{shown, Timestamp};

/// A time zone of the IANA database, which is part of the program, or a fixed offset from UTC.
#[derive(Debug, Clone, PartialEq)]
pub struct Zone {
    name: String,
    zone: TimeZone,
}

impl Zone {
    /// Coordinated universal time.
    pub fn utc() -> Self {
        Self { name: "UTC".to_owned(), zone: TimeZone::UTC }
    }

    /// Reads `Europe/Berlin`, `UTC`, or an offset such as `+01:00`, whose plus sign may have become a blank in a URL.
    ///
    /// # Errors
    /// A sentence for a name that the database does not contain, or an offset outside ±14 h.
    pub fn parse(text: &str) -> Result<Self, String> {
        let name = text.trim_end();
        if ["utc", "z", "gmt"].iter().any(|utc| name.trim().eq_ignore_ascii_case(utc)) {
            return Ok(Self::utc());
        }
        let wrong = || {
            let names = "such as Europe/Berlin, America/New_York, UTC or +01:00";
            format!("{} is not a zone of the IANA time zone database: write one {names}", shown(text))
        };
        if name.starts_with(['+', '-', ' ']) {
            let offset = offset(&name.replacen(' ', "+", 1)).ok_or_else(wrong)?;
            return Ok(Self { name: offset.to_string(), zone: TimeZone::fixed(offset) });
        }
        let zone = TimeZone::get(name).map_err(|_| wrong())?;
        let name = zone.iana_name().unwrap_or(name).to_owned();
        Ok(Self { name, zone })
    }

    /// The instant of a local time.
    ///
    /// # Errors
    /// A sentence for a time that the clocks skipped or showed twice when they were changed.
    pub fn instant(&self, local: DateTime) -> Result<Timestamp, String> {
        let ambiguous = self.zone.to_ambiguous_timestamp(local);
        let zone = &self.name;
        match ambiguous.offset() {
            AmbiguousOffset::Unambiguous { offset } => instant(local, offset),
            AmbiguousOffset::Gap { .. } => {
                Err(format!("{local} did not exist in {zone}: the clocks were put forward; write the time with its offset"))
            }
            AmbiguousOffset::Fold { before, after } => Err(format!(
                "{local} was shown twice in {zone} when the clocks were put back: write the time with its offset, {before} or {after}"
            )),
        }
    }

    /// The local time of an instant.
    pub fn local(&self, time: Timestamp) -> DateTime {
        let time = jiff::Timestamp::from_microsecond(time.micros()).expect("a time is within the calendar");
        self.zone.to_datetime(time)
    }
}

impl fmt::Display for Zone {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)
    }
}

/// The instant of a local time with a known offset.
///
/// # Errors
/// A sentence for a time outside the calendar.
pub fn instant(local: DateTime, offset: Offset) -> Result<Timestamp, String> {
    let outside = || format!("{local} is outside the calendar");
    let time = offset.to_timestamp(local).map_err(|_| outside())?;
    Timestamp::from_micros(time.as_microsecond()).map_err(|_| outside())
}

/// An offset: `Z`, `UTC`, `+01`, `+0100` or `+01:00`.
pub fn offset(text: &str) -> Option<Offset> {
    const MOST_HOURS: i32 = 14;
    if ["z", "utc", "gmt"].iter().any(|utc| text.eq_ignore_ascii_case(utc)) {
        return Some(Offset::UTC);
    }
    let (sign, digits) = match text.split_at_checked(1)? {
        ("+", digits) => (1, digits),
        ("-", digits) => (-1, digits),
        _ => return None,
    };
    let digits = digits.replacen(':', "", 1);
    let number = |part: &str| part.parse::<i32>().ok().filter(|_| part.bytes().all(|b| b.is_ascii_digit()));
    let (hours, minutes) = match digits.len() {
        2 => (number(&digits)?, 0),
        4 => (number(&digits[..2])?, number(&digits[2..])?),
        _ => return None,
    };
    let valid = minutes < 60 && 60 * hours + minutes <= 60 * MOST_HOURS;
    Offset::from_seconds(sign * (3_600 * hours + 60 * minutes)).ok().filter(|_| valid)
}
