//! A lasting change: what has changed, since when, by how much, and the sentence that says it.

use std::fmt::Write as _;

use serde::{Deserialize, Serialize};

use super::estimate::percent;
use structures::parameter::{in_words, ALL_FREQUENCIES, MISFIT};
use structures::quantity::Timestamp;

/// 95 % quantile of the normal distribution, for intervals of 90 %.
pub(super) const NORMAL_95: f64 = 1.645;

/// Modes whose change is smaller than this share of the largest one are not named.
const LEAST_SHARE: f64 = 0.1;

/// A lasting change on a chart that is above its limit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(from = "Stored")]
pub struct LastingChange {
    /// Whether the fast chart is above its limit, which finds steps; otherwise only the slow one is, which finds small lasting losses.
    pub fast: bool,
    /// Time of the first batch after the most probable onset.
    pub onset: Timestamp,
    /// Interval of 90 % for the onset: from the last batch before it to the first one after it.
    pub onset_interval: [Timestamp; 2],
    /// Change of each quantity that has certainly changed: with a probability above 0.9.
    pub changes: Vec<QuantityChange>,
    /// Changes of other quantities that may have changed, the most probable first; of each, what it would be.
    #[serde(default)]
    pub candidates: Vec<QuantityChange>,
    /// Conditions of the newest batch that the reference has not seen, each in some words: they may be a part of the cause.
    #[serde(default)]
    pub not_seen: Vec<String>,
    /// What coincides with the onset apart from the structure, each in some words: another source of the batches, a pause, modes that are
    /// missing or new, maintenance, notes.
    #[serde(default)]
    pub coinciding: Vec<String>,
}

/// The change of a quantity since an onset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct QuantityChange {
    /// Its name.
    pub name: String,
    /// Its unit.
    pub unit: String,
    /// Probability that it is among the quantities that have changed; 1 in alarms of earlier versions of the program.
    #[serde(default = "certain")]
    pub probability: f64,
    /// Whether it is a change towards damage.
    #[serde(default = "yes")]
    pub towards_damage: bool,
    /// Most probable change that the process does not explain, in the unit of the quantity.
    pub change: f64,
    /// Its interval of 90 %.
    pub interval: [f64; 2],
    /// Mean of the quantity in the reference, in its unit.
    pub reference_mean: f64,
    /// Difference from that mean that the weather and other healthy causes explain at the newest batch, in its unit.
    pub explained: f64,
    /// Of a change of the misfit, what it is in each mode; otherwise empty. `change` is that of the mode in which it is largest.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub modes: Vec<ModeChange>,
}

/// The change of the frequency of a mode.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ModeChange {
    /// Number of the mode, from 1 on.
    pub mode: usize,
    /// Most probable change, per cent.
    pub percent: f64,
    /// Its interval of 90 %.
    pub interval_percent: [f64; 2],
}

/// As it is stored.
#[derive(Deserialize)]
struct Stored {
    fast: bool,
    onset: Timestamp,
    onset_interval: [Timestamp; 2],
    changes: Vec<QuantityChange>,
    #[serde(default)]
    candidates: Vec<QuantityChange>,
    #[serde(default)]
    not_seen: Vec<String>,
    #[serde(default)]
    coinciding: Vec<String>,
}

impl From<Stored> for LastingChange {
    /// Earlier versions of the program stored all quantities, with a probability of 1 now: those whose change is not clear have not certainly
    /// changed.
    fn from(stored: Stored) -> Self {
        let Stored { fast, onset, onset_interval, mut changes, candidates, not_seen, coinciding } = stored;
        changes.retain(|own| own.probability < certain() || own.is_clear());
        Self { fast, onset, onset_interval, changes, candidates, not_seen, coinciding }
    }
}

const fn certain() -> f64 {
    1.0
}

const fn yes() -> bool {
    true
}

impl LastingChange {
    /// The only quantity that has certainly changed; `None` if several have or none, or all frequencies.
    pub fn only(&self) -> Option<&str> {
        match self.changes.as_slice() {
            [one] if one.is_of_quantity() => Some(&one.name),
            _ => None,
        }
    }

    /// Whether it is certain that nothing has changed by as much as this, in per cent of its mean in the reference: the intervals of all that
    /// has changed or may have are inside. Changes of frequencies count twice, as the stiffnesses that would have caused them.
    pub fn is_below(&self, percent: f64) -> bool {
        let inside = |own: &QuantityChange| {
            let times = if own.is_of_quantity() { 1.0 } else { 2.0 };
            own.interval.iter().all(|end| times * own.percent(*end).abs() < percent)
        };
        let mut all = self.changes.iter().chain(&self.candidates).peekable();
        all.peek().is_some() && all.all(inside)
    }

    /// What has changed since when, by how much, and what the seasons explain, without a full stop.
    pub fn happening(&self) -> String {
        let phrases = |of: &[QuantityChange]| of.iter().map(QuantityChange::phrase).collect::<Vec<_>>();
        let what = match (self.changes.as_slice(), self.candidates.as_slice()) {
            ([], []) => "The parameters together have changed".to_owned(),
            ([], possible) => {
                let each: Vec<String> = possible.iter().map(QuantityChange::possibility).collect();
                format!("The measurements do not tell for certain which parameter has changed: {},", each.join(", "))
            }
            (certain, []) => joined(&phrases(certain)),
            (certain, others) => {
                let names: Vec<String> = others.iter().map(|own| in_words(&own.name)).collect();
                format!("{} and perhaps {} too,", joined(&phrases(certain)), names.join(", "))
            }
        };
        // The name of a quantity is never changed.
        let begins = [("all ", "All "), ("the ", "The ")];
        let begin = begins.iter().find_map(|(small, large)| Some(format!("{large}{}", what.strip_prefix(small)?)));
        let what = begin.unwrap_or(what);
        let day = |time: Timestamp| time.to_string().chars().take(10).collect::<String>();
        let [from, to] = self.onset_interval.map(day);
        format!("{what} since {} (between {from} and {to})", day(self.onset))
    }

    /// [`Self::happening`], the chart that shows it, and what may contribute.
    pub fn sentence(&self) -> String {
        let chart =
            if self.fast { "fast chart, which finds steps," } else { "slow chart, which finds small lasting changes," };
        let mut sentence = format!("{}; the {chart} is above its limit.", self.happening());
        if self.changes.iter().any(QuantityChange::is_of_misfit)
            && self.changes.iter().any(QuantityChange::is_of_quantity)
        {
            sentence.push_str(
                " The structure file does not describe this change: what it says of parameters is only what comes nearest to it.",
            );
        }
        if !self.not_seen.is_empty() {
            let _ = write!(
                sentence,
                " Weather may contribute: the undamaged reference has not seen {}.",
                self.not_seen.join(", ")
            );
        }
        if !self.coinciding.is_empty() {
            let _ = write!(sentence, " With its onset coincides: {}.", self.coinciding.join("; "));
        }
        sentence
    }
}

impl QuantityChange {
    /// Whether all frequencies have changed by one factor, and no quantity.
    pub fn is_of_all_frequencies(&self) -> bool {
        self.name == ALL_FREQUENCIES
    }

    /// Whether the misfit has changed: the frequencies, as no change of a quantity changes them.
    pub fn is_of_misfit(&self) -> bool {
        self.name == MISFIT
    }

    /// Whether it is the change of a monitored quantity, and not of frequencies that no quantity explains.
    pub fn is_of_quantity(&self) -> bool {
        !self.is_of_all_frequencies() && !self.is_of_misfit()
    }

    /// What a change of the misfit is in the modes in which it is clear and not small, or else in that in which it is largest, such as
    /// `mode 2 −0.81 %, mode 3 +0.46 %`.
    pub fn in_modes(&self) -> String {
        self.each_mode(|own| format!("mode {} {} %", own.mode, signed(own.percent)))
    }

    /// [`Self::in_modes`] with intervals.
    fn in_modes_with_intervals(&self) -> String {
        self.each_mode(|own| {
            let [low, high] = own.interval_percent.map(signed);
            format!("mode {} {} % ({low} to {high} %)", own.mode, signed(own.percent))
        })
    }

    fn each_mode(&self, in_words: impl Fn(&ModeChange) -> String) -> String {
        let largest = self.modes.iter().map(|own| own.percent.abs()).fold(0.0, f64::max);
        let is_clear = |own: &&ModeChange| {
            let [low, high] = own.interval_percent;
            low * high > 0.0 && own.percent.abs() >= LEAST_SHARE * largest
        };
        let mut named: Vec<&ModeChange> = self.modes.iter().filter(is_clear).collect();
        if named.is_empty() {
            named.extend(self.modes.iter().find(|own| own.percent.abs() >= largest));
        }
        named.into_iter().map(in_words).collect::<Vec<_>>().join(", ")
    }

    /// Whether the interval of the change excludes zero.
    pub fn is_clear(&self) -> bool {
        self.interval[0] > 0.0 || self.interval[1] < 0.0
    }

    /// Digits of a percentage behind the point: a factor of all frequencies is known far better than a parameter.
    fn digits(&self) -> usize {
        if self.is_of_quantity() {
            1
        } else {
            2
        }
    }

    /// A difference of the quantity in per cent of its mean in the reference, with its sign, such as `−7.9`.
    pub fn signed_percent(&self, difference: f64) -> String {
        format!("{:+.*}", self.digits(), self.percent(difference)).replace('-', "−")
    }

    /// A difference of the quantity in per cent of its mean in the reference.
    pub fn percent(&self, difference: f64) -> f64 {
        percent(&self.unit, self.reference_mean, difference)
    }

    /// The change and its interval in words.
    fn size(&self) -> String {
        let mut ends = self.interval.map(|end| self.percent(end));
        ends.sort_by(f64::total_cmp);
        if !self.is_clear() {
            return format!("changed, by now by {:+.1} to {:+.1} %", ends[0], ends[1]).replace('-', "−");
        }
        let percent = self.percent(self.change);
        let direction = if percent < 0.0 { "fallen" } else { "risen" };
        let mut sizes = ends.map(f64::abs);
        sizes.sort_by(f64::total_cmp);
        let digits = self.digits();
        format!("{direction} by {:.digits$} % ({:.digits$} to {:.digits$} %)", percent.abs(), sizes[0], sizes[1])
    }

    fn phrase(&self) -> String {
        if self.is_of_all_frequencies() {
            return format!(
                "all frequencies have {} by one factor, as if an instrument or its clock were off, or all stiffnesses or masses had changed \
                 alike,",
                self.size()
            );
        }
        if self.is_of_misfit() {
            return format!(
                "the frequencies have changed beside all that the parameters of the structure file can give: {}, as with damage to a part without \
                 a parameter, or an instrument that is off,",
                self.in_modes_with_intervals()
            );
        }
        let explained = self.percent(self.explained);
        let beside = if explained.abs() < 0.05 {
            "which weather and seasons do not explain,".to_owned()
        } else {
            format!("beside {explained:+.1} % that weather and seasons explain,").replace('-', "−")
        };
        format!("{} has {}, {beside}", in_words(&self.name), self.size())
    }

    fn possibility(&self) -> String {
        if self.is_of_misfit() {
            let (modes, probability) = (self.in_modes(), self.probability);
            return format!("{} ({modes}) with a probability of {probability:.2}", in_words(MISFIT));
        }
        format!("{} {} with a probability of {:.2}", in_words(&self.name), self.size(), self.probability)
    }
}

fn signed(percent: f64) -> String {
    format!("{percent:+.2}").replace('-', "−")
}

/// Several phrases with commas and "and".
fn joined(parts: &[String]) -> String {
    match parts {
        [] => String::new(),
        [one] => one.clone(),
        [first @ .., last] => format!("{} and {last}", first.join(" ")),
    }
}

#[cfg(test)]
mod tests {
    use super::super::misfit::MisfitBasis;
    use super::*;

    fn change(name: &str, unit: &str, change: f64, half: f64) -> QuantityChange {
        QuantityChange {
            name: name.to_owned(),
            unit: unit.to_owned(),
            probability: 1.0,
            towards_damage: change < 0.0,
            change,
            interval: [change - half, change + half],
            reference_mean: 4.0,
            explained: 0.04,
            modes: Vec::new(),
        }
    }

    fn lasting(changes: Vec<QuantityChange>) -> LastingChange {
        let at = |text: &str| Timestamp::parse(text).unwrap();
        LastingChange {
            fast: false,
            onset: at("2026-08-04T12:00:00Z"),
            onset_interval: [at("2026-08-02T00:00:00Z"), at("2026-08-06T00:00:00Z")],
            changes,
            candidates: Vec::new(),
            not_seen: Vec::new(),
            coinciding: Vec::new(),
        }
    }

    #[test]
    fn the_sentence_names_what_has_changed_with_its_interval() {
        let sentence = lasting(vec![change("k2", "N/m", -0.12, 0.04)]).sentence();
        assert_eq!(
            sentence,
            "k2 has fallen by 3.0 % (2.0 to 4.0 %), beside +1.0 % that weather and seasons explain, since 2026-08-04 (between \
             2026-08-02 and 2026-08-06); the slow chart, which finds small lasting changes, is above its limit."
        );
    }

    #[test]
    fn a_change_that_no_parameter_explains_is_told_by_its_modes() {
        let basis = MisfitBasis { modes: 3, effects: vec![0.001, -0.004, 0.0002] };
        let sentence = lasting(vec![basis.change(1.0, &[(2.0, 0.1)]), change("k2", "N/m", -0.12, 0.04)]).sentence();
        assert!(
            sentence.starts_with(
                "The frequencies have changed beside all that the parameters of the structure file can give: mode 1 +0.20 % (+0.18 to +0.22 \
                 %), mode 2 −0.80 % (−0.86 to −0.73 %), as with damage to a part without a parameter, or an instrument that is off, and k2 has \
                 fallen by 3.0 % (2.0 to 4.0 %),"
            ) && sentence.contains("only what comes nearest"),
            "{sentence}"
        );
    }

    #[test]
    fn what_the_measurements_do_not_tell_apart_is_named_together() {
        let of = |name: &str, probability: f64| QuantityChange { probability, ..change(name, "N/m", -0.12, 0.04) };
        let mut several = lasting(Vec::new());
        several.candidates = vec![of("k1", 0.6), of("k3", 0.4)];
        assert!(
            several.sentence().starts_with(
                "The measurements do not tell for certain which parameter has changed: k1 fallen by 3.0 % (2.0 to 4.0 %) with a \
                 probability of 0.60, k3 fallen by 3.0 % (2.0 to 4.0 %) with a probability of 0.40, since 2026-08-04"
            ),
            "{}",
            several.sentence()
        );
        several.changes = vec![of("k2", 0.98)];
        several.candidates.truncate(1);
        assert!(several.sentence().contains("explain, and perhaps k1 too, since 2026-08-04"), "{}", several.sentence());
    }

    #[test]
    fn a_change_of_an_earlier_version_names_what_is_clear() {
        let mut stored =
            serde_json::to_value(lasting(vec![change("k1", "N/m", 0.01, 0.1), change("k2", "N/m", -0.12, 0.04)]))
                .unwrap();
        for own in stored["changes"].as_array_mut().unwrap() {
            own.as_object_mut().unwrap().remove("probability");
        }
        stored.as_object_mut().unwrap().remove("candidates");
        let read: LastingChange = serde_json::from_value(stored).unwrap();
        assert_eq!((read.only(), read.candidates.len()), (Some("k2"), 0));
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
    fn a_logarithm_is_stated_as_a_factor_and_of_an_unclear_change_only_the_interval() {
        let sentence = lasting(vec![change("ei", "ln", -0.10, 0.05)]).sentence();
        assert!(sentence.starts_with("ei has fallen by 9.5 % (4.9 to 13.9 %)"), "{sentence}");
        let sentence = lasting(vec![change("ei", "ln", -0.10, 0.2)]).sentence();
        assert!(sentence.starts_with("ei has changed, by now by −25.9 to +10.5 %"), "{sentence}");
    }
}
