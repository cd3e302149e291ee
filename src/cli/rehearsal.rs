//! Values of the flags of `modalwatch simulate`: times, durations, courses of covariates, changes of parameters.

use crate::quantity::{shown, Timestamp};
use crate::simulator::rehearsal::Course;

/// Days of a month, on average.
const MONTH_DAYS: f64 = 30.436_875;

/// Default time that weather lasts, days.
const WEATHER_LASTS_DAYS: f64 = 3.0;

/// A change of a parameter per unit of a covariate, as its flag states it.
#[derive(Debug, Clone, PartialEq)]
pub struct EffectFlag {
    /// Name of the parameter.
    pub parameter: String,
    /// Relative change per unit of the covariate.
    pub share_per_unit: f64,
    /// Name of the covariate.
    pub covariate: String,
}

/// A loss of a parameter, as its flag states it.
#[derive(Debug, Clone, PartialEq)]
pub struct LossFlag {
    /// Name of the parameter.
    pub parameter: String,
    /// Loss as a share.
    pub share: f64,
    /// Time of the loss, if the flag states it.
    pub from: Option<Timestamp>,
}

/// A trend of a parameter, as its flag states it.
#[derive(Debug, Clone, PartialEq)]
pub struct TrendFlag {
    /// Name of the parameter.
    pub parameter: String,
    /// Relative change per day.
    pub share_per_day: f64,
}

/// Reads a time: RFC 3339 with an offset, or a date, which means its midnight in UTC.
///
/// # Errors
/// Another text.
pub fn time(text: &str) -> Result<Timestamp, String> {
    let date_only = text.len() == 10 && !text.contains(['T', ' ']);
    let whole = if date_only { format!("{text}T00:00:00Z") } else { text.to_owned() };
    Timestamp::parse(&whole).map_err(|_| {
        format!(
            "{} must be a date such as 2026-01-01 (midnight in UTC) or a time such as 2026-01-01T12:00:00+01:00",
            shown(text)
        )
    })
}

/// Reads a duration with its unit, such as `90s`, `10m`, `1h`, `2d` or `1w`, in seconds.
///
/// # Errors
/// Another text, or a duration that is not above 0.
pub fn seconds(text: &str) -> Result<f64, String> {
    let wrong =
        || format!("{} must be a number above 0 with a unit: s, m (minutes), h, d or w, such as 1h", shown(text));
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit = match &text[digits.len()..] {
        "s" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3_600.0,
        "d" => 86_400.0,
        "w" => 604_800.0,
        _ => return Err(wrong()),
    };
    let number: f64 = digits.trim().parse().map_err(|_| wrong())?;
    (number.is_finite() && number > 0.0).then_some(number * unit).ok_or_else(wrong)
}

/// Reads the course of a covariate from `name=MEAN[,year=A][,day=A][,weather=STD][,lasting=3d]` or `name=A|B|C`.
///
/// # Errors
/// A text of another form.
pub fn course(text: &str) -> Result<(String, Course), String> {
    let wrong = |what: &str| {
        format!(
            "{}: {what}; write name=MEAN,year=AMPLITUDE,day=AMPLITUDE,weather=STD,lasting=3d (all but the mean may be left out), or \
             name=A|B for categories",
            shown(text)
        )
    };
    let (name, value) = text.split_once('=').ok_or_else(|| wrong("there is no ="))?;
    let name = name.trim().to_owned();
    if name.is_empty() {
        return Err(wrong("there is no name"));
    }
    if value.contains('|') {
        let categories: Vec<String> = value.split('|').map(|c| c.trim().to_owned()).collect();
        return if categories.iter().any(String::is_empty) {
            Err(wrong("a category is empty"))
        } else {
            Ok((name, Course::Categories(categories)))
        };
    }
    let mut parts = value.split(',');
    let finite = |text: &str| text.trim().parse().ok().filter(|number: &f64| number.is_finite());
    let mean = parts.next().and_then(finite).ok_or_else(|| wrong("the mean is not a number"))?;
    let (mut year, mut day, mut weather_std, mut lasting_days) = (0.0, 0.0, 0.0, WEATHER_LASTS_DAYS);
    for part in parts {
        let (key, value) = part.split_once('=').ok_or_else(|| wrong("a part has no ="))?;
        let number = || finite(value).ok_or_else(|| wrong(&format!("{} is not a number", shown(value))));
        match key.trim() {
            "year" => year = number()?,
            "day" => day = number()?,
            "weather" => weather_std = number()?,
            "lasting" => lasting_days = seconds(value.trim())? / 86_400.0,
            other => return Err(wrong(&format!("{} is not one of year, day, weather, lasting", shown(other)))),
        }
    }
    if weather_std < 0.0 {
        return Err(wrong("the standard deviation of the weather is negative"));
    }
    Ok((name, Course::Seasons { mean, year, day, weather_std, lasting_days }))
}

/// Reads a loss from `name=8%` or `name=8%@2026-08-07`.
///
/// # Errors
/// A text of another form.
pub fn loss(text: &str) -> Result<LossFlag, String> {
    let wrong =
        || format!("{} must have the form name=8% or name=8%@2026-08-07, with a loss of less than 100 %", shown(text));
    let (parameter, value) = text.split_once('=').ok_or_else(wrong)?;
    let (value, from) = match value.split_once('@') {
        Some((value, at)) => (value, Some(time(at)?)),
        None => (value, None),
    };
    let share = percent(value).filter(|share| *share < 1.0).ok_or_else(wrong)?;
    Ok(LossFlag { parameter: parameter.trim().to_owned(), share, from })
}

/// Reads a trend from `name=-1%/month`; the unit of time is day, month or year.
///
/// # Errors
/// A text of another form.
pub fn trend(text: &str) -> Result<TrendFlag, String> {
    let wrong = || format!("{} must have the form name=-1%/month, with day, month or year", shown(text));
    let (parameter, value) = text.split_once('=').ok_or_else(wrong)?;
    let (share, unit) = value.split_once('/').ok_or_else(wrong)?;
    let days = match unit.trim() {
        "day" => 1.0,
        "month" => MONTH_DAYS,
        "year" => 12.0 * MONTH_DAYS,
        _ => return Err(wrong()),
    };
    let share_per_day = percent(share).ok_or_else(wrong)? / days;
    Ok(TrendFlag { parameter: parameter.trim().to_owned(), share_per_day })
}

/// Reads an effect from `name=-0.3%/temperature_c`.
///
/// # Errors
/// A text of another form.
pub fn effect(text: &str) -> Result<EffectFlag, String> {
    let wrong = || {
        format!("{} must have the form parameter=-0.3%/covariate: the change per unit of the covariate", shown(text))
    };
    let (parameter, value) = text.split_once('=').ok_or_else(wrong)?;
    let (share, covariate) = value.split_once('/').ok_or_else(wrong)?;
    let share_per_unit = percent(share).ok_or_else(wrong)?;
    Ok(EffectFlag { parameter: parameter.trim().to_owned(), share_per_unit, covariate: covariate.trim().to_owned() })
}

/// Reads a probability between 0 and 1.
///
/// # Errors
/// Another number.
pub fn probability(text: &str) -> Result<f64, String> {
    let number: Option<f64> = text.trim().parse().ok();
    number
        .filter(|p| (0.0..=1.0).contains(p))
        .ok_or_else(|| format!("{} must be a probability between 0 and 1, such as 0.02", shown(text)))
}

/// A share from a number with a per cent sign; without the sign it is not clear what is meant.
fn percent(text: &str) -> Option<f64> {
    let number: f64 = text.trim().strip_suffix('%')?.trim().parse().ok()?;
    number.is_finite().then_some(number / 100.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flags_are_read_and_mistakes_get_a_sentence() {
        assert_eq!(time("2026-08-07").unwrap().to_string(), "2026-08-07T00:00:00Z");
        assert_eq!([seconds("1h"), seconds("10m"), seconds("2d")], [Ok(3_600.0), Ok(600.0), Ok(172_800.0)]);
        let (name, found) = course("temperature_c=10,year=12,weather=3,lasting=12h").unwrap();
        assert_eq!(name, "temperature_c");
        assert_eq!(found, Course::Seasons { mean: 10.0, year: 12.0, day: 0.0, weather_std: 3.0, lasting_days: 0.5 });
        assert_eq!(course("lab=a|b").unwrap().1, Course::Categories(vec!["a".to_owned(), "b".to_owned()]));
        assert_eq!(loss("k2=8%@2026-08-07").unwrap().from, Some(time("2026-08-07").unwrap()));
        assert!((loss("k2=8%").unwrap().share - 0.08).abs() < 1e-15);
        assert!((trend("k1=-1%/month").unwrap().share_per_day * MONTH_DAYS + 0.01).abs() < 1e-15);
        assert_eq!(effect("k1=-0.3%/temperature_c").unwrap().covariate, "temperature_c");

        let refused: [(Result<(), String>, &str); 11] = [
            (time("7.8.2026").map(drop), "must be a date such as 2026-01-01"),
            (seconds("1").map(drop), "with a unit"),
            (seconds("-1h").map(drop), "above 0"),
            (course("temperature_c").map(drop), "there is no ="),
            (course("t=warm").map(drop), "the mean is not a number"),
            (course("t=10,yearly=3").map(drop), "\"yearly\" is not one of year, day, weather, lasting"),
            (course("t=10,weather=-3").map(drop), "is negative"),
            (loss("k2=0.08").map(drop), "name=8%"),
            (loss("k2=100%").map(drop), "less than 100 %"),
            (trend("k1=1%/fortnight").map(drop), "day, month or year"),
            (probability("2").map(drop), "between 0 and 1"),
        ];
        for (result, part) in refused {
            let said = result.unwrap_err();
            assert!(said.contains(part), "{part}: {said}");
        }
    }
}
