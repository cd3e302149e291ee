//! The sentence that says why a chart is above its limit.

use std::fmt::Write as _;

use super::estimate::percent;
use super::reference::{LastingChange, QuantityChange};
use structures::parameter::in_words;

impl LastingChange {
    /// What has changed since when, by how much, and what the seasons explain, in one sentence.
    pub fn sentence(&self) -> String {
        let mut clear: Vec<&QuantityChange> = self.changes.iter().filter(|change| change.is_clear()).collect();
        if clear.is_empty() {
            let size = |change: &&QuantityChange| change.percent(change.change).abs();
            clear.extend(self.changes.iter().max_by(|a, b| size(a).total_cmp(&size(b))));
        }
        let parts: Vec<String> = clear.iter().map(|change| change.phrase()).collect();
        let day = |time: structures::quantity::Timestamp| time.to_string().chars().take(10).collect::<String>();
        let [from, to] = self.onset_interval.map(day);
        let chart =
            if self.fast { "fast chart, which finds steps," } else { "slow chart, which finds small lasting changes," };
        let mut sentence = format!(
            "{} since {} (between {from} and {to}); the {chart} is above its limit.",
            joined(&parts),
            day(self.onset)
        );
        if !self.not_seen.is_empty() {
            let _ = write!(
                sentence,
                " Weather may contribute: the undamaged reference has not seen {}.",
                self.not_seen.join(", ")
            );
        }
        sentence
    }
}

impl QuantityChange {
    /// Whether the interval of the change excludes zero.
    pub fn is_clear(&self) -> bool {
        self.interval[0] > 0.0 || self.interval[1] < 0.0
    }

    /// A difference of the quantity in per cent of its mean in the reference.
    pub fn percent(&self, difference: f64) -> f64 {
        percent(&self.unit, self.reference_mean, difference)
    }

    fn phrase(&self) -> String {
        let percent = self.percent(self.change);
        let mut ends = self.interval.map(|end| self.percent(end).abs());
        let direction = if percent < 0.0 { "fallen" } else { "risen" };
        ends.sort_by(f64::total_cmp);
        let explained = self.percent(self.explained);
        let beside = if explained.abs() < 0.05 {
            "which weather and seasons do not explain,".to_owned()
        } else {
            format!("beside {explained:+.1} % that weather and seasons explain,").replace('-', "−")
        };
        format!(
            "{} has {direction} by {:.1} % ({:.1} to {:.1} %), {beside}",
            in_words(&self.name),
            percent.abs(),
            if self.is_clear() { ends[0] } else { 0.0 },
            ends[1],
        )
    }
}

/// Several phrases with commas and "and".
fn joined(parts: &[String]) -> String {
    match parts {
        [] => "something has changed".to_owned(),
        [one] => one.clone(),
        [first @ .., last] => format!("{} and {last}", first.join(" ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use structures::quantity::Timestamp;

    fn change(name: &str, unit: &str, change: f64, half: f64) -> QuantityChange {
        QuantityChange {
            name: name.to_owned(),
            unit: unit.to_owned(),
            change,
            interval: [change - half, change + half],
            reference_mean: 4.0,
            explained: 0.04,
        }
    }

    fn lasting(changes: Vec<QuantityChange>) -> LastingChange {
        let at = |text: &str| Timestamp::parse(text).unwrap();
        LastingChange {
            fast: false,
            onset: at("2026-08-04T12:00:00Z"),
            onset_interval: [at("2026-08-02T00:00:00Z"), at("2026-08-06T00:00:00Z")],
            changes,
            not_seen: Vec::new(),
        }
    }

    #[test]
    fn the_sentence_names_what_is_clear_with_its_interval() {
        let sentence = lasting(vec![change("k1", "N/m", 0.01, 0.1), change("k2", "N/m", -0.12, 0.04)]).sentence();
        assert_eq!(
            sentence,
            "k2 has fallen by 3.0 % (2.0 to 4.0 %), beside +1.0 % that weather and seasons explain, since 2026-08-04 (between \
             2026-08-02 and 2026-08-06); the slow chart, which finds small lasting changes, is above its limit."
        );
    }

    #[test]
    fn what_weather_does_not_explain_is_not_stated_as_minus_zero() {
        let mut none = change("k2", "N/m", -0.12, 0.04);
        none.explained = -0.0001;
        let sentence = lasting(vec![none]).sentence();
        assert!(
            sentence
                .starts_with("k2 has fallen by 3.0 % (2.0 to 4.0 %), which weather and seasons do not explain, since"),
            "{sentence}"
        );
    }

    #[test]
    fn a_logarithm_is_stated_as_a_factor_and_an_unclear_change_from_zero() {
        let sentence = lasting(vec![change("ei", "ln", -0.10, 0.2)]).sentence();
        assert!(sentence.starts_with("ei has fallen by 9.5 % (0.0 to 25.9 %)"), "{sentence}");
    }
}
