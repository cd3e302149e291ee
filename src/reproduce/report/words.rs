//! Formatting of numbers and names.

use crate::reproduce::result::{Compared, Method, Row};

/// A number with a given number of decimals; a dash if it is not finite.
pub fn fixed(value: f64, decimals: usize) -> String {
    if !value.is_finite() {
        return "–".to_owned();
    }
    let text = format!("{value:.decimals$}");
    let zero = text.chars().all(|c| matches!(c, '-' | '0' | '.'));
    if zero {
        text.replace('-', "")
    } else {
        text.replace('-', "−")
    }
}

/// Decimals that show three significant digits.
pub fn decimals(value: f64) -> usize {
    let size = value.abs().log10().floor();
    if size.is_finite() {
        (2.0 - size).clamp(0.0, 8.0) as usize
    } else {
        3
    }
}

/// Three significant digits.
pub fn digits(value: f64) -> String {
    fixed(value, decimals(value))
}

/// Decimals of mean and standard deviation of a row: three significant digits of the latter.
pub fn row_decimals(row: &Row) -> usize {
    let std = row.std.target;
    decimals(if std.is_finite() && std > 0.0 { std } else { row.mean.target })
}

/// A share in per cent. A share that is nearly but not exactly 0 or 1 is shown as an inequality.
pub fn percent(share: f64) -> String {
    match 100.0 * share {
        p if p > 99.95 && share < 1.0 => "&gt; 99.9".to_owned(),
        p if p < 0.05 && share > 0.0 => "&lt; 0.1".to_owned(),
        p => fixed(p, 1),
    }
}

/// A duration in suitable units.
pub fn duration(seconds: f64) -> String {
    let whole = seconds.round().max(0.0) as u64;
    match seconds {
        s if !s.is_finite() => "–".to_owned(),
        s if s < 0.001 => format!("{} ms", fixed(1000.0 * s, 2)),
        s if s < 1.0 => format!("{} ms", digits(1000.0 * s)),
        s if s < 59.95 => format!("{} s", fixed(s, 1)),
        _ if whole < 3600 => format!("{} min {} s", whole / 60, whole % 60),
        _ => format!("{} h {} min", whole / 3600, whole % 3600 / 60),
    }
}

/// A count with thin spaces between thousands.
pub fn grouped(count: usize) -> String {
    let text = count.to_string();
    let mut shown = String::new();
    for (i, c) in text.chars().enumerate() {
        if i > 0 && (text.len() - i).is_multiple_of(3) {
            shown.push('\u{202f}');
        }
        shown.push(c);
    }
    shown
}

/// A ratio of speeds.
pub fn factor(ratio: f64) -> String {
    if ratio >= 10.0 {
        fixed(ratio, 0)
    } else {
        fixed(ratio, decimals(ratio).min(3).saturating_sub(1))
    }
}

/// Whether the value of the paper is in our 5–95 % range; `None` if the paper has no value.
pub fn paper_is_inside(c: &Compared) -> Option<bool> {
    // Shares of a few hundred samples are often equal except for rounding.
    c.paper.map(|paper| (c.ours.low - 1e-12..=c.ours.high + 1e-12).contains(&paper))
}

/// Name of a method.
pub fn method(method: Method) -> &'static str {
    match method {
        Method::Sensitivity => "sensitivity",
        Method::Tmcmc => "TMCMC",
        Method::Cinn => "cINN",
    }
}

/// The text with its first letter in upper case.
pub fn capital(text: &str) -> String {
    let mut rest = text.chars();
    rest.next().map_or_else(String::new, |first| first.to_uppercase().chain(rest).collect())
}

/// A list in words: `a, b and c`.
pub fn listed(items: &[String]) -> String {
    match items {
        [] => String::new(),
        [one] => one.clone(),
        [first @ .., last] => format!("{} and {last}", first.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_formatted_for_readers() {
        assert_eq!([fixed(-0.0004, 2), fixed(-1.5, 1), fixed(f64::NAN, 1)], ["0.00", "−1.5", "–"]);
        assert_eq!([digits(0.011_64), digits(3202.4), digits(0.0)], ["0.0116", "3202", "0.000"]);
        assert_eq!(
            [percent(1.0), percent(0.9998), percent(0.0002), percent(0.456)],
            ["100.0", "&gt; 99.9", "&lt; 0.1", "45.6"]
        );
        assert_eq!(
            [duration(0.0213), duration(12.34), duration(433.0), duration(7300.0)],
            ["21.3 ms", "12.3 s", "7 min 13 s", "2 h 1 min"]
        );
        assert_eq!(listed(&["a", "b", "c"].map(str::to_owned)), "a, b and c");
    }
}
