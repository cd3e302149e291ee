//! Where a table is cut into batches.

use std::fmt;

use super::zone::Zone;
use crate::quantity::{shown, Timestamp};

/// A table of measurements that span more than this is cut only as its sender says: 48 h.
pub const LONGEST_UNSPLIT_MICROS: i64 = 48 * HOUR_MICROS;

const MINUTE_MICROS: i64 = 60_000_000;
const HOUR_MICROS: i64 = 60 * MINUTE_MICROS;
const DAY_MICROS: i64 = 24 * HOUR_MICROS;

/// Rule by which measurements become batches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Split {
    /// All in one batch.
    None,
    /// A batch for each interval of this length, µs of local time. Intervals are counted from midnight of 1970-01-01, so that whole
    /// days, and hours that divide a day, begin at midnight.
    Every(i64),
    /// A new batch after a pause longer than this, µs.
    Gap(i64),
}

impl Split {
    /// Reads `none`, `1d`, `6h`, `30min`, or `gap:2h`.
    ///
    /// # Errors
    /// A sentence for other text.
    pub fn parse(text: &str) -> Result<Self, String> {
        let wrong = || {
            format!(
                "{} is not a rule: write 1d for a batch a day, 6h or 30min for shorter ones, gap:2h for a new batch after a pause of \
                 two hours, or none for one batch",
                shown(text)
            )
        };
        let split = match (text, text.strip_prefix("gap:")) {
            ("none", _) => return Ok(Self::None),
            (_, Some(pause)) => Self::Gap(micros(pause).ok_or_else(wrong)?),
            _ => Self::Every(micros(text).ok_or_else(wrong)?),
        };
        Ok(split)
    }

    /// Number of the interval in which a time lies; the same for all times if the rule has no intervals.
    pub fn interval(self, time: Timestamp, zone: &Zone) -> i64 {
        let Self::Every(length) = self else { return 0 };
        let local = zone.local(time).duration_since(jiff::civil::date(1970, 1, 1).at(0, 0, 0, 0));
        i64::try_from(local.as_micros()).expect("the calendar has fewer than 2^63 µs").div_euclid(length)
    }

    /// Whether two measurements of an interval, between which there is no other, are in one batch; their times in µs.
    pub fn joins(self, earlier_micros: i64, later_micros: i64) -> bool {
        match self {
            Self::Gap(pause) => later_micros - earlier_micros <= pause,
            Self::None | Self::Every(_) => true,
        }
    }
}

/// A length of time such as `1d`, `6h` or `30min`, µs; `None` for other text, and for less than a minute or more than ten years.
fn micros(text: &str) -> Option<i64> {
    let end = text.find(|c: char| !c.is_ascii_digit())?;
    let unit = match &text[end..] {
        "d" => DAY_MICROS,
        "h" => HOUR_MICROS,
        "min" => MINUTE_MICROS,
        _ => return None,
    };
    let count: i64 = text[..end].parse().ok()?;
    count.checked_mul(unit).filter(|micros| (MINUTE_MICROS..=3_660 * DAY_MICROS).contains(micros))
}

impl fmt::Display for Split {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let length = |micros: i64| match micros {
            whole if whole % DAY_MICROS == 0 => format!("{}d", whole / DAY_MICROS),
            whole if whole % HOUR_MICROS == 0 => format!("{}h", whole / HOUR_MICROS),
            other => format!("{}min", other / MINUTE_MICROS),
        };
        match self {
            Self::None => f.write_str("none"),
            Self::Every(micros) => f.write_str(&length(*micros)),
            Self::Gap(micros) => write!(f, "gap:{}", length(*micros)),
        }
    }
}
