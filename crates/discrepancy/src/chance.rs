//! p-values in words.

/// Chances below this are all "less than 1 in a million".
const LEAST: f64 = 1e-6;

/// How often chance alone would give at least what was found, as a clause: "chance alone would give this in about 3 of 100 cases".
pub fn chance(p_value: f64) -> String {
    format!("chance alone would give this in {} cases", cases(p_value))
}

/// A p-value as a number of cases: "less than 1 of a million", "about 1 of 4,000", "about 3 of 100".
pub fn cases(p_value: f64) -> String {
    match p_value {
        p if p < LEAST => "less than 1 of a million".to_owned(),
        p if p < 0.01 => {
            let one_of = 1.0 / p;
            let step = 10f64.powf(one_of.log10().floor());
            format!("about 1 of {}", thousands((one_of / step).round() * step))
        }
        p => format!("about {:.0} of 100", 100.0 * p.min(1.0)),
    }
}

/// A difference in log evidence to another cause as "20 times less probable"; up to 10 % is "equally probable".
pub fn times_less(log_difference: f64) -> String {
    let (factor, word) = (log_difference.abs().exp(), if log_difference < 0.0 { "less" } else { "more" });
    match factor {
        f if f < 1.1 => "equally probable".to_owned(),
        f if f < 10.0 => format!("{f:.1} times {word} probable"),
        f if f < 1e6 => {
            let step = 10f64.powf(f.log10().floor() - 1.0);
            format!("{} times {word} probable", thousands((f / step).round() * step))
        }
        _ => format!("more than a million times {word} probable"),
    }
}

/// A whole number with commas between the thousands.
fn thousands(value: f64) -> String {
    let digits = format!("{value:.0}");
    let mut text = String::with_capacity(digits.len() + 3);
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place) % 3 == 0 {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_p_value_is_a_number_of_cases() {
        for (p, words) in [
            (0.0, "less than 1 of a million"),
            (2.0e-8, "less than 1 of a million"),
            (2.4e-4, "about 1 of 4,000"),
            (1.0e-5, "about 1 of 100,000"),
            (0.004, "about 1 of 300"),
            (0.03, "about 3 of 100"),
            (1.0, "about 100 of 100"),
        ] {
            assert_eq!(cases(p), words, "{p}");
        }
    }

    #[test]
    fn a_difference_in_log_evidence_is_a_factor() {
        for (difference, words) in [
            (0.0, "equally probable"),
            (-1.0, "2.7 times less probable"),
            (-3.0, "20 times less probable"),
            (-8.0, "3,000 times less probable"),
            (2.0, "7.4 times more probable"),
            (-40.0, "more than a million times less probable"),
        ] {
            assert_eq!(times_less(difference), words, "{difference}");
        }
    }
}
