//! Times that a table gives as numbers: which unit they are in, and the points in time that they mean.
//!
//! [`TimeReading::guess`] decides from the whole column, because a single number can mean many things: 45000 is a day of the year
//! 2023 in a spreadsheet, and half past twelve in seconds since midnight.

use std::fmt;
use std::str::FromStr;

use crate::quantity::{shown, Timestamp};
use crate::stats;

const MICROS_A_DAY: f64 = 86_400e6;

/// 1970-01-01 as a serial day of a spreadsheet, which counts from 1899-12-30.
const SERIAL_DAY_OF_1970: f64 = 25_569.0;

/// Spreadsheets: serial days of the years 1982 to 2064.
const SERIAL_DAYS: (f64, f64) = (30_000.0, 60_000.0);

const DECIMAL_YEARS: (f64, f64) = (1_900.0, 2_100.0);

/// Unix time: seconds from 1973 on. Smaller numbers are seconds since the start of a recording.
const LEAST_UNIX_SECONDS: f64 = 1e8;

/// A recording is at most this long, days: 50 years.
const LONGEST_DAYS: f64 = 18_263.0;

/// Largest number of days since any epoch in use: the Julian day of today is 2.5 million.
const MOST_DAYS: f64 = 3e6;

/// Share of the numbers of a column that must be plausible in a unit: a few wrong cells do not decide about the others.
const PLAUSIBLE: f64 = 0.95;

/// Seconds are as plausible as days if all numbers are whole and this far apart: few structures are measured every ten days, and
/// many every ten seconds or minutes.
const STEP_OF_SECONDS: f64 = 10.0;

/// Unit of times that are given as numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TimeUnit {
    /// Days since an unknown start.
    Days,
    /// Seconds since 1970-01-01T00:00:00Z (Unix time), or since an unknown start.
    Seconds,
    /// Milliseconds since 1970-01-01T00:00:00Z, or since an unknown start.
    Milliseconds,
    /// Days since 1899-12-30, as spreadsheets store times.
    SerialDays,
    /// Years, such as 2024.5 for the middle of 2024.
    DecimalYear,
}

impl TimeUnit {
    /// All units.
    pub const ALL: [Self; 5] = [Self::Days, Self::Seconds, Self::Milliseconds, Self::SerialDays, Self::DecimalYear];

    /// Its name as an option.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Days => "days",
            Self::Seconds => "seconds",
            Self::Milliseconds => "milliseconds",
            Self::SerialDays => "serial-days",
            Self::DecimalYear => "decimal-year",
        }
    }

    /// Microseconds in one unit; `None` for years, which differ in length.
    const fn micros(self) -> Option<f64> {
        match self {
            Self::Days | Self::SerialDays => Some(MICROS_A_DAY),
            Self::Seconds => Some(1e6),
            Self::Milliseconds => Some(1e3),
            Self::DecimalYear => None,
        }
    }
}

impl fmt::Display for TimeUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for TimeUnit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let names = Self::ALL.map(Self::as_str).join(", ");
        let found = Self::ALL.into_iter().find(|unit| unit.as_str() == text);
        found.ok_or_else(|| format!("{} is not a unit of time: use one of {names}", shown(text)))
    }
}

/// What a number of a column of times counts from.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Origin {
    /// A fixed point in time; a number outside the range is not a time.
    Calendar { least: f64, most: f64 },
    /// An unknown start. The smallest number of the column is put at 1970-01-01, because only differences are known.
    Start(f64),
}

/// How the numbers of a column of times are read.
#[derive(Debug, Clone, PartialEq)]
pub struct TimeReading {
    unit: TimeUnit,
    origin: Origin,
    /// Other units in which the column is as plausible.
    alternatives: Vec<TimeUnit>,
}

/// A number in a cell; `None` for text, and for a number that is not finite.
pub fn number(cell: &str) -> Option<f64> {
    cell.trim().parse().ok().filter(|value: &f64| value.is_finite())
}

impl TimeReading {
    /// The most plausible reading of all numbers of a column; `now` is the present time, after which nothing was measured.
    ///
    /// # Errors
    /// A sentence for a column that is not plausible in any unit.
    pub fn guess(values: &[f64], now: Timestamp) -> Result<Self, String> {
        let (lowest, highest) = ends(values);
        // The clock of the instrument may be ahead by a day.
        let now_days = now.micros() as f64 / MICROS_A_DAY + 1.0;
        let unix_most = now_days * 86_400.0;
        let calendar = [
            (TimeUnit::Milliseconds, 1e3 * LEAST_UNIX_SECONDS, 1e3 * unix_most),
            (TimeUnit::Seconds, LEAST_UNIX_SECONDS, unix_most),
            (TimeUnit::SerialDays, SERIAL_DAYS.0, SERIAL_DAYS.1.min(now_days + SERIAL_DAY_OF_1970)),
            (TimeUnit::DecimalYear, DECIMAL_YEARS.0, DECIMAL_YEARS.1.min(1_970.0 + now_days / 365.2)),
        ];
        for (unit, least, most) in calendar {
            let inside = values.iter().filter(|v| (least..=most).contains(*v)).count();
            if inside > 0 && inside as f64 >= PLAUSIBLE * values.len() as f64 {
                let origin = Origin::Calendar { least, most };
                return Ok(Self { unit, origin, alternatives: alternatives(unit, values) });
            }
        }
        let span = highest - lowest;
        let (day, longest_s) = (lowest.abs().max(highest.abs()), LONGEST_DAYS * 86_400.0);
        let unit = if span <= LONGEST_DAYS && day <= MOST_DAYS {
            TimeUnit::Days
        } else if span <= longest_s && day < LEAST_UNIX_SECONDS.max(longest_s) {
            TimeUnit::Seconds
        } else if span <= 1e3 * longest_s && day < 1e3 * longest_s {
            TimeUnit::Milliseconds
        } else {
            let names = TimeUnit::ALL.map(TimeUnit::as_str).join(", ");
            return Err(format!(
                "the numbers from {lowest} to {highest} are not plausible times in any of {names}: write the times as RFC 3339, such \
                 as 2026-03-01T12:00:00Z, or in one of these units"
            ));
        };
        Ok(Self { unit, origin: Origin::Start(lowest), alternatives: alternatives(unit, values) })
    }

    /// The reading of all numbers of a column in a given unit.
    pub fn in_unit(unit: TimeUnit, values: &[f64]) -> Self {
        let (lowest, _) = ends(values);
        let from_start = match unit {
            TimeUnit::Seconds => lowest < LEAST_UNIX_SECONDS,
            TimeUnit::Milliseconds => lowest < 1e3 * LEAST_UNIX_SECONDS,
            TimeUnit::Days | TimeUnit::SerialDays | TimeUnit::DecimalYear => false,
        };
        let start = Self { unit, origin: Origin::Start(lowest), alternatives: Vec::new() };
        Self::dates(unit).filter(|_| !from_start).unwrap_or(start)
    }

    /// The reading of numbers in a given unit as dates; `None` for days, which do not say when they begin.
    pub fn dates(unit: TimeUnit) -> Option<Self> {
        let origin = Origin::Calendar { least: f64::NEG_INFINITY, most: f64::INFINITY };
        (unit != TimeUnit::Days).then(|| Self { unit, origin, alternatives: Vec::new() })
    }

    /// Whether the numbers count from an unknown start, so that only their differences are known.
    pub fn from_unknown_start(&self) -> bool {
        matches!(self.origin, Origin::Start(_))
    }

    /// The point in time that a number means, rounded to microseconds. With an unknown start, the smallest number of the column means
    /// 1970-01-01T00:00:00Z.
    ///
    /// # Errors
    /// A sentence for a number that is not plausible in the unit of the column, or outside the calendar.
    pub fn time(&self, value: f64) -> Result<Timestamp, String> {
        let unit = self.unit;
        let start = match self.origin {
            Origin::Calendar { least, most } if !(least..=most).contains(&value) => {
                return Err(format!("{value} is not plausible as a time in {unit}, in which the column is read"));
            }
            Origin::Calendar { .. } if unit == TimeUnit::SerialDays => SERIAL_DAY_OF_1970,
            Origin::Calendar { .. } => 0.0,
            Origin::Start(lowest) => lowest,
        };
        let micros = match unit.micros() {
            Some(micros) => (value - start) * micros,
            None => decimal_year_micros(value)?,
        };
        let outside = || format!("{value} {unit} is outside the calendar");
        if micros.abs() >= 2f64.powi(62) {
            return Err(outside());
        }
        Timestamp::from_micros(micros.round() as i64).map_err(|_| outside())
    }

    /// A sentence about how a column is read; `decided` if the user named the unit.
    pub fn note(&self, column: &str, values: &[f64], decided: bool) -> String {
        let (lowest, highest) = ends(values);
        let since = match (self.unit, self.origin) {
            (_, Origin::Start(_)) => format!("{} since an unknown start", self.unit),
            (TimeUnit::Seconds | TimeUnit::Milliseconds, _) => {
                format!("{} since 1970-01-01 UTC (Unix time)", self.unit)
            }
            (TimeUnit::SerialDays, _) => "serial days of a spreadsheet, which count from 1899-12-30".to_owned(),
            _ => "decimal years".to_owned(),
        };
        let span = match (self.time(lowest), self.time(highest)) {
            (Ok(first), Ok(last)) if !self.from_unknown_start() => format!(" ({first} to {last})"),
            _ => String::new(),
        };
        let read = format!("column {column} holds numbers from {lowest} to {highest}: they are read as {since}{span}");
        let alternatives: Vec<String> = self
            .alternatives
            .iter()
            .map(|unit| format!("{unit} would be as plausible: --time-unit {unit} reads them so"))
            .collect();
        match alternatives.as_slice() {
            _ if decided => read,
            [] => format!("{read}; --time-unit names another unit"),
            some => format!("{read}; {}", some.join("; ")),
        }
    }
}

/// The smallest and the largest of some numbers.
fn ends(values: &[f64]) -> (f64, f64) {
    values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)))
}

/// Units in which a column is as plausible as in `unit`.
fn alternatives(unit: TimeUnit, values: &[f64]) -> Vec<TimeUnit> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.dedup();
    let steps: Vec<f64> = sorted.windows(2).map(|pair| pair[1] - pair[0]).collect();
    if steps.is_empty() || values.iter().any(|v| v.fract() != 0.0) {
        return Vec::new();
    }
    let step = stats::quantile(&steps, 0.5);
    match unit {
        TimeUnit::Days | TimeUnit::SerialDays if step >= STEP_OF_SECONDS => vec![TimeUnit::Seconds],
        // Below 10⁸ these are seconds since a start.
        TimeUnit::Seconds if step >= 1e3 * STEP_OF_SECONDS && sorted[0] < LEAST_UNIX_SECONDS => {
            vec![TimeUnit::Milliseconds]
        }
        TimeUnit::DecimalYear => vec![TimeUnit::Days],
        _ => Vec::new(),
    }
}

/// Microseconds between 1970 and a decimal year; the fraction is a share of that year, 365 or 366 days long.
fn decimal_year_micros(value: f64) -> Result<f64, String> {
    let year = value.floor();
    if !(1.0..9_999.0).contains(&year) {
        return Err(format!("{value} is outside the calendar: a year from 1 to 9998 is expected"));
    }
    let start = |year: f64| Timestamp::parse(&format!("{year:04}-01-01T00:00:00Z")).map_err(|e| e.to_string());
    let (this, next) = (start(year)?.micros(), start(year + 1.0)?.micros());
    Ok(this as f64 + (value - year) * (next - this) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn now() -> Timestamp {
        Timestamp::parse("2026-03-01T00:00:00Z").unwrap()
    }

    fn steps(from: f64, step: f64, count: usize) -> Vec<f64> {
        (0..count).map(|i| from + step * i as f64).collect()
    }

    #[test]
    fn a_column_is_read_as_what_it_looks_like() {
        use TimeUnit::{Days, DecimalYear, Milliseconds, Seconds, SerialDays};
        // 2024-01-01T00:00:00Z in each unit, and a recording that starts then.
        type Case<'a> = (&'a str, Vec<f64>, TimeUnit, bool, &'a [TimeUnit]);
        let cases: Vec<Case<'_>> = vec![
            ("days with fractions", steps(0.0, 0.25, 100), Days, true, &[]),
            ("days from −3", steps(-3.0, 0.5, 20), Days, true, &[]),
            ("whole days", steps(1.0, 1.0, 400), Days, true, &[]),
            ("days or seconds", steps(0.0, 60.0, 100), Days, true, &[Seconds]),
            ("Julian days", steps(2_460_310.5, 1.0, 50), Days, true, &[]),
            ("modified Julian days", steps(60_310.0, 0.5, 50), Days, true, &[]),
            ("Unix seconds", steps(1_704_067_200.0, 600.0, 100), Seconds, false, &[]),
            ("Unix seconds with fractions", steps(1_704_067_200.25, 600.0, 100), Seconds, false, &[]),
            ("Unix milliseconds", steps(1_704_067_200_000.0, 600e3, 100), Milliseconds, false, &[]),
            ("seconds of a week", steps(0.0, 600.0, 1008), Seconds, true, &[]),
            ("milliseconds of a year", steps(0.0, 3.6e6, 8760), Milliseconds, true, &[]),
            ("serial days", steps(45_292.0, 0.125, 100), SerialDays, false, &[]),
            ("seconds of a day, or serial days", steps(30_000.0, 60.0, 100), SerialDays, false, &[Seconds]),
            ("decimal years", steps(2_019.117, 0.001, 700), DecimalYear, false, &[]),
            ("whole years", steps(1_990.0, 1.0, 30), DecimalYear, false, &[Days]),
            ("a single Unix time", vec![1_704_067_200.0], Seconds, false, &[]),
            ("a single day", vec![12.25], Days, true, &[]),
        ];
        for (name, values, unit, unknown_start, alternatives) in cases {
            let reading = TimeReading::guess(&values, now()).unwrap();
            assert_eq!(
                (reading.unit, reading.from_unknown_start(), reading.alternatives.as_slice()),
                (unit, unknown_start, alternatives),
                "{name}"
            );
            for unit in alternatives {
                let note = reading.note("t", &values, false);
                assert!(note.contains(&format!("--time-unit {unit}")), "{name}: {note}");
            }
        }
        for values in [steps(1.7e18, 6e11, 10), vec![-1e300, 1e300]] {
            let refused = TimeReading::guess(&values, now()).unwrap_err();
            assert!(refused.contains("RFC 3339") && refused.contains("serial-days"), "{refused}");
        }
    }

    #[test]
    fn the_same_time_is_found_in_every_unit() {
        let noon = Timestamp::parse("2024-07-01T12:00:00Z").unwrap();
        let day_of_year = 182.5;
        for (unit, value) in [
            (TimeUnit::Seconds, 1_719_835_200.0),
            (TimeUnit::Milliseconds, 1_719_835_200_000.0),
            (TimeUnit::SerialDays, 45_474.5),
            (TimeUnit::DecimalYear, 2024.0 + day_of_year / 366.0),
        ] {
            for reading in [TimeReading::guess(&[value], now()).unwrap(), TimeReading::in_unit(unit, &[value])] {
                assert_eq!(reading.unit, unit);
                // A decimal year of today has 53 − 11 bits after the point: 7 µs.
                let error = reading.time(value).unwrap().micros() - noon.micros();
                assert!(error.abs() <= 10, "{unit}: {error} µs");
            }
        }
    }

    #[test]
    fn differences_survive_an_unknown_start() {
        for (unit, values, micros) in [
            (TimeUnit::Days, [-2.0, 0.5], 216_000e6),
            (TimeUnit::Seconds, [30.0, 90.5], 60.5e6),
            (TimeUnit::Milliseconds, [30.0, 90.5], 60.5e3),
        ] {
            let reading = TimeReading::in_unit(unit, &values);
            let [first, last] = values.map(|v| reading.time(v).unwrap().micros() as f64);
            assert!((last - first - micros).abs() <= 1.0, "{unit}");
        }
    }

    #[test]
    fn one_wrong_cell_does_not_decide_about_the_others() {
        let mut values = steps(1_704_067_200.0, 600.0, 100);
        values[40] = 0.0;
        let reading = TimeReading::guess(&values, now()).unwrap();
        assert_eq!(reading.unit, TimeUnit::Seconds);
        assert!(reading.time(0.0).unwrap_err().contains("not plausible as a time in seconds"));
        assert_eq!(reading.time(values[0]).unwrap().to_string(), "2024-01-01T00:00:00Z");
        for value in [1e300, -1e300] {
            assert!(TimeReading::in_unit(TimeUnit::SerialDays, &values).time(value).is_err());
            assert!(TimeReading::in_unit(TimeUnit::DecimalYear, &values).time(value).is_err());
        }
    }

    #[test]
    fn units_are_known_by_name() {
        for unit in TimeUnit::ALL {
            assert_eq!(unit.to_string().parse(), Ok(unit));
        }
        assert!("hours".parse::<TimeUnit>().unwrap_err().contains("serial-days"));
    }
}
