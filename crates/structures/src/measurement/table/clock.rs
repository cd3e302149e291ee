//! Times as people and loggers write them: `01.03.2026 12:00`, `2026-03-01 12:00:00`, `3/1/2026 2:30 PM`, `2026-03-01T12:00Z`.
//!
//! What a cell does not say is asked for and never guessed: the zone of a time without one, and whether 03/04/2026 is in March or in
//! April. The order of day and month is taken from the table where one of its dates has only one reading.

use std::fmt;

use jiff::civil::{Date, DateTime, Time};
use jiff::tz::Offset;
use serde::Serialize;

use super::zone::{instant, offset, Zone};
use crate::measurement::times::{number, TimeReading, TimeUnit};
use crate::quantity::{shown, Timestamp};

/// Order of day and month in dates that begin with neither the year.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum DateOrder {
    /// 31/12/2026.
    DayMonthYear,
    /// 12/31/2026.
    MonthDayYear,
}

impl DateOrder {
    /// Reads `dmy` or `mdy`.
    ///
    /// # Errors
    /// A sentence for other text.
    pub fn parse(text: &str) -> Result<Self, String> {
        match text {
            "dmy" => Ok(Self::DayMonthYear),
            "mdy" => Ok(Self::MonthDayYear),
            _ => Err(format!("{} is not an order of dates: write dmy (day first) or mdy (month first)", shown(text))),
        }
    }
}

impl fmt::Display for DateOrder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::DayMonthYear => "day-month-year",
            Self::MonthDayYear => "month-day-year",
        })
    }
}

/// A date as written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum WrittenDate {
    /// The year comes first.
    Certain(Date),
    /// Two numbers, then the year.
    Ordered {
        /// The two numbers.
        numbers: (i8, i8),
        /// The year.
        year: i16,
        /// Whether they are separated by dots, which only the order day, month, year uses.
        dotted: bool,
    },
}

/// A cell of a column of times.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Written {
    /// An instant: a time with its offset.
    Instant(Timestamp),
    /// A number, whose unit the reader of the table must know.
    Number(f64),
    /// Date, time of day, or both, and the offset if it is stated.
    Parts {
        /// The date.
        date: Option<WrittenDate>,
        /// Time of day.
        time: Option<Time>,
        /// Offset from UTC.
        offset: Option<Offset>,
    },
}

impl Written {
    /// Reads a cell. `comma` says that numbers have a decimal comma.
    ///
    /// # Errors
    /// A sentence for text that is neither a date, a time of day nor a number.
    pub fn parse(cell: &str, comma: bool) -> Result<Self, String> {
        let cell = cell.trim();
        if let Ok(time) = Timestamp::parse(cell) {
            return Ok(Self::Instant(time));
        }
        let compact = cell.len() == 8 && cell.bytes().all(|b| b.is_ascii_digit());
        if !compact {
            if let Some(value) = number(&if comma { cell.replace(',', ".") } else { cell.to_owned() }) {
                return Ok(Self::Number(value));
            }
        }
        let wrong = || {
            format!(
                "{} is not a time: write 2026-03-01T12:00:00Z, 2026-03-01 12:00:00 or 01.03.2026 12:00",
                shown(cell)
            )
        };
        let (first, rest) = match cell.split_once([' ', 'T', 't', '\u{a0}']) {
            Some((first, rest)) => (first.trim_end_matches(','), rest.trim()),
            None => (cell, ""),
        };
        if first.contains(':') {
            let (time, offset) = time_of_day(cell).ok_or_else(wrong)?;
            return Ok(Self::Parts { date: None, time: Some(time), offset });
        }
        let date = date(first).unwrap_or_else(|| Err(wrong()))?;
        if rest.is_empty() {
            return Ok(Self::Parts { date: Some(date), time: None, offset: None });
        }
        let (time, offset) = time_of_day(rest).ok_or_else(wrong)?;
        Ok(Self::Parts { date: Some(date), time: Some(time), offset })
    }

    /// A date with the time of day of another cell.
    ///
    /// # Errors
    /// A sentence if the cells do not complement each other.
    pub fn with_time_of_day(self, other: Self) -> Result<Self, String> {
        let midnight = |time: Option<Time>| time.is_none_or(|time| time == Time::midnight());
        match (self, other) {
            (
                Self::Parts { date: Some(date), time: there, offset: None },
                Self::Parts { date: None, time: Some(time), offset },
            ) if midnight(there) => Ok(Self::Parts { date: Some(date), time: Some(time), offset }),
            (Self::Parts { date: Some(_), .. }, Self::Parts { date: None, .. }) => {
                Err("both columns contain a time of day: ignore one of them".to_owned())
            }
            _ => Err("a column of dates and one of times of day are expected, such as 01.03.2026 and 12:00".to_owned()),
        }
    }
}

/// A time of day, `2:30 PM` and `14:30:00.5` alike, with the offset that may follow it.
fn time_of_day(text: &str) -> Option<(Time, Option<Offset>)> {
    let lower = text.trim().to_ascii_lowercase();
    let (clock, half) = match lower.strip_suffix("pm").map(|t| (t, 12)).or(lower.strip_suffix("am").map(|t| (t, 0))) {
        Some((clock, half)) => (clock.trim().to_owned(), Some(half)),
        None => (lower, None),
    };
    let end = clock.find(|c: char| !(c.is_ascii_digit() || ":.,".contains(c))).unwrap_or(clock.len());
    let (clock, zone) = (clock[..end].trim(), clock[end..].trim());
    let offset = if zone.is_empty() { None } else { Some(offset(zone).filter(|_| half.is_none())?) };
    let mut parts = clock.split(':');
    let whole = |part: &str| part.parse::<i8>().ok().filter(|_| (1..=2).contains(&part.len()));
    let (hour, minute) = (whole(parts.next()?)?, whole(parts.next()?)?);
    let (second, nanosecond) = match parts.next() {
        None => (0, 0),
        Some(seconds) => {
            let (second, fraction) = seconds.split_once(['.', ',']).unwrap_or((seconds, ""));
            let digits = fraction.bytes().all(|b| b.is_ascii_digit()) && fraction.len() <= 9;
            let nanosecond = format!("{fraction:0<9}").parse().ok().filter(|_| digits)?;
            (whole(second)?, nanosecond)
        }
    };
    let hour = match half {
        None => hour,
        Some(half) if (1..=12).contains(&hour) => hour % 12 + half,
        Some(_) => return None,
    };
    if parts.next().is_some() {
        return None;
    }
    Some((Time::new(hour, minute, second, nanosecond).ok()?, offset))
}

/// A date; `None` for text that has not the form of one.
fn date(text: &str) -> Option<Result<WrittenDate, String>> {
    let digits = |part: &str| !part.is_empty() && part.len() <= 4 && part.bytes().all(|b| b.is_ascii_digit());
    let certain = |year: &str, month: &str, day: &str| {
        let (year, month, day) = (year.parse().ok()?, month.parse().ok()?, day.parse().ok()?);
        let date = Date::new(year, month, day).map(WrittenDate::Certain);
        Some(date.map_err(|_| format!("{} is not a day of the calendar", shown(text))))
    };
    if text.len() == 8 && text.bytes().all(|b| b.is_ascii_digit()) {
        return certain(&text[..4], &text[4..6], &text[6..]);
    }
    let separator = ['-', '/', '.'].into_iter().find(|c| text.contains(*c))?;
    let mut parts = text.split(separator);
    let (first, second, third) = (parts.next()?, parts.next()?, parts.next()?);
    if parts.next().is_some() {
        return None;
    }
    if ![first, second, third].into_iter().all(digits) {
        return None;
    }
    match (first.len(), second.len(), third.len()) {
        (4, 1..=2, 1..=2) => certain(first, second, third),
        (1..=2, 1..=2, 4) => {
            let numbers = (first.parse().ok()?, second.parse().ok()?);
            Some(Ok(WrittenDate::Ordered { numbers, year: third.parse().ok()?, dotted: separator == '.' }))
        }
        (1..=2, 1..=2, 1..=2) => Some(Err(format!("{}: write the year with four digits", shown(text)))),
        _ => None,
    }
}

/// What the cells of a column say about how they are to be read.
#[derive(Debug, Clone, Default)]
pub struct Evidence {
    /// Line and text of the first time without a zone.
    pub without_zone: Option<(u64, String)>,
    /// Line and text of the first number.
    pub number: Option<(u64, String)>,
    /// Line and text of the first date whose order of day and month is not clear by itself.
    pub unordered: Option<(u64, String)>,
    /// Whether a date can only begin with the day, and whether one can only begin with the month.
    pub certain: (bool, bool),
    /// Whether some time states its zone.
    pub with_zone: bool,
    /// Whether dates are written with dots.
    pub dotted: bool,
}

impl Evidence {
    /// Adds a cell of a line.
    pub fn add(&mut self, line: u64, cell: &str, written: &Written) {
        let here = || Some((line, cell.to_owned()));
        match written {
            Written::Instant(_) => self.with_zone = true,
            Written::Number(_) => self.number = self.number.take().or_else(here),
            Written::Parts { date, offset, .. } => {
                if offset.is_none() {
                    self.without_zone = self.without_zone.take().or_else(here);
                } else {
                    self.with_zone = true;
                }
                if let Some(WrittenDate::Ordered { numbers: (first, second), dotted, .. }) = date {
                    self.dotted |= dotted;
                    if !dotted {
                        self.certain.0 |= *first > 12;
                        self.certain.1 |= *second > 12;
                        if first != second {
                            self.unordered = self.unordered.take().or_else(here);
                        }
                    }
                }
            }
        }
    }

    /// The order of day and month that the dates without dots have, if they all agree with one of them alone.
    pub fn order(&self) -> Option<DateOrder> {
        match self.certain {
            (true, false) => Some(DateOrder::DayMonthYear),
            (false, true) => Some(DateOrder::MonthDayYear),
            _ => None,
        }
    }
}

/// How times that a cell does not determine are read.
#[derive(Debug, Clone, Default)]
pub struct Clock {
    /// Zone of times without one.
    pub zone: Option<Zone>,
    /// Order of day and month.
    pub order: Option<DateOrder>,
    /// Unit of numbers.
    pub unit: Option<TimeUnit>,
}

impl Clock {
    /// The instant that a cell means.
    ///
    /// # Errors
    /// A sentence that says what is missing or wrong.
    pub fn instant(&self, written: Written) -> Result<Timestamp, String> {
        match written {
            Written::Instant(time) => Ok(time),
            Written::Number(value) => self.of_number(value),
            Written::Parts { date: None, .. } => {
                Err("a time of day without a date: a column date is needed".to_owned())
            }
            Written::Parts { date: Some(date), time, offset } => {
                let local = self.day(date)?.to_datetime(time.unwrap_or(Time::midnight()));
                match (offset, &self.zone) {
                    (Some(offset), _) => instant(local, offset),
                    (None, Some(zone)) => zone.instant(local),
                    (None, None) => Err(format!("{local} has no zone: write an offset, or name the zone")),
                }
            }
        }
    }

    fn day(&self, date: WrittenDate) -> Result<Date, String> {
        let (first, second, year, dotted) = match date {
            WrittenDate::Certain(date) => return Ok(date),
            WrittenDate::Ordered { numbers: (first, second), year, dotted } => (first, second, year, dotted),
        };
        let own = if dotted { Some(DateOrder::DayMonthYear) } else { None };
        let order = match self.order.or(own) {
            Some(order) => order,
            None if first == second => DateOrder::DayMonthYear,
            None => return Err("day or month first: write date_order=dmy or date_order=mdy".to_owned()),
        };
        let (day, month) = if order == DateOrder::DayMonthYear { (first, second) } else { (second, first) };
        Date::new(year, month, day)
            .map_err(|_| format!("day {day} of month {month} of {year} does not exist (read as {order})"))
    }

    /// A number in the unit of the column. Serial days and decimal years count local days, so that they are in the zone if one is
    /// named, and in UTC otherwise.
    fn of_number(&self, value: f64) -> Result<Timestamp, String> {
        let unit = self.unit.ok_or_else(|| format!("{value} is a number: name its unit by time_unit"))?;
        let reading = TimeReading::dates(unit)
            .ok_or("days do not say when they begin: use seconds, milliseconds, serial-days or decimal-year")?;
        let time = reading.time(value)?;
        match &self.zone {
            Some(zone) if matches!(unit, TimeUnit::SerialDays | TimeUnit::DecimalYear) => {
                let local: DateTime = Zone::utc().local(time);
                zone.instant(local)
            }
            _ => Ok(time),
        }
    }
}
