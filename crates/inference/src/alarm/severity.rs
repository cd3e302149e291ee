//! Severity of an alarm: how large the loss is with certainty.

use serde::{Deserialize, Serialize};

use crate::process::lasting::{LastingChange, QuantityChange};

/// How severe an alarm is, from the least to the most.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = AlarmGrade)]
pub enum Grade {
    /// A loss is certain only below the first limit.
    Slight,
    /// At or above the first limit, or nothing can be said about the size.
    Moderate,
    /// At or above the second limit.
    Severe,
    /// At or above the third limit.
    Critical,
}

impl Grade {
    /// All grades, from the least to the most.
    pub const ALL: [Self; 4] = [Self::Slight, Self::Moderate, Self::Severe, Self::Critical];

    /// Its name in settings, answers and messages.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Slight => "slight",
            Self::Moderate => "moderate",
            Self::Severe => "severe",
            Self::Critical => "critical",
        }
    }

    /// Its number as stored, from 0.
    pub const fn number(self) -> i64 {
        self as i64
    }

    /// The grade of a stored number; `None` if there is no such grade.
    pub fn of_number(number: i64) -> Option<Self> {
        Self::ALL.into_iter().find(|grade| grade.number() == number)
    }
}

/// Limits of the grades, in per cent of the mean of the parameter in the undamaged reference.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SeverityLimits {
    /// A loss that is certainly at least this large is moderate.
    pub moderate_percent: f64,
    /// … severe.
    pub severe_percent: f64,
    /// … critical.
    pub critical_percent: f64,
}

impl Default for SeverityLimits {
    fn default() -> Self {
        Self { moderate_percent: 2.0, severe_percent: 5.0, critical_percent: 10.0 }
    }
}

/// Change of the quantity of an alarm in a batch, relative to its mean in the undamaged reference.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(from = "[f64; 3]")]
pub struct BatchChange {
    /// The estimate.
    pub change: f64,
    /// Its interval of 90 %.
    pub interval: [f64; 2],
}

impl From<[f64; 3]> for BatchChange {
    fn from([change, low, high]: [f64; 3]) -> Self {
        Self { change, interval: [low, high] }
    }
}

/// What is stored of an alarm that its severity follows from.
#[derive(Debug, Clone, Copy)]
pub struct AlarmFacts<'a> {
    /// `damage`, `simulation_does_not_fit`, `silence` or `not_assessed`.
    pub kind: &'a str,
    /// The lasting change; `None` without a process behind the undamaged reference.
    pub change: Option<&'a LastingChange>,
    /// The change in the newest batch of the alarm that was above a limit.
    pub batch_change: Option<BatchChange>,
}

/// The severity of an alarm.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
#[schema(as = AlarmSeverity)]
pub struct Severity {
    /// The grade.
    pub grade: Grade,
    /// The change towards damage that is exceeded with a probability of 95 %, in per cent of the mean in the undamaged reference; absent if
    /// the size is not known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub certain_loss_percent: Option<f64>,
    /// Why the alarm has this grade, in one sentence.
    pub sentence: String,
}

impl SeverityLimits {
    /// The first setting out of range, as (key, value, allowed range); `None` when all are in range.
    pub fn problem(&self) -> Option<(&'static str, String, &'static str)> {
        let Self { moderate_percent: moderate, severe_percent: severe, critical_percent: critical } = *self;
        let above_zero = moderate.is_finite() && moderate > 0.0;
        if !above_zero {
            return Some(("monitor.severity.moderate_percent", moderate.to_string(), "a number above 0"));
        }
        if !(severe > moderate && severe.is_finite()) {
            let must = "a number above monitor.severity.moderate_percent";
            return Some(("monitor.severity.severe_percent", severe.to_string(), must));
        }
        if !(critical > severe && critical.is_finite()) {
            let must = "a number above monitor.severity.severe_percent";
            return Some(("monitor.severity.critical_percent", critical.to_string(), must));
        }
        None
    }

    /// The severity of an alarm.
    ///
    /// ```text
    ///  L_k = max(0, min(|a_k|, |b_k|)) if a_k and b_k have the same sign, towards damage, otherwise 0
    ///  L = max_k L_k,    grade = number of limits that L reaches
    /// ```
    ///
    /// `[a_k, b_k]` is the interval of 90 % of the change of quantity k, in per cent of its mean in the undamaged reference. Each end is
    /// exceeded with a probability of 95 %, so L is the loss that is certain at that level; the charts only test changes towards
    /// damage. A large but uncertain loss is thus graded by what is certain of it, and its grade rises with more batches. The interval is
    /// that of the lasting change, which excludes what weather and seasons explain. Without a process behind the reference, it is that of
    /// the newest batch above its limit, which includes the weather.
    ///
    /// Where no quantity has changed with certainty, L is the smallest L_k of those that may have.
    ///
    /// A change of the misfit has no size in terms of stiffness: an alarm with one is moderate, unless the parameters beside it have certainly
    /// lost more.
    ///
    /// An alarm without a size is moderate: it shows no loss, but while it lasts a loss would not be seen or could not be measured.
    pub fn severity(&self, alarm: AlarmFacts<'_>) -> Severity {
        let unknown = |reason: &str| Severity {
            grade: Grade::Moderate,
            certain_loss_percent: None,
            sentence: format!("Moderate: {reason}"),
        };
        match alarm.kind {
            "silence" => return unknown("no measurements arrive, so that a loss would not be seen."),
            "not_assessed" => return unknown("the newest batches cannot be judged, so that a loss would not be seen."),
            "simulation_does_not_fit" => {
                return unknown(
                    "the simulation does not fit the measurements, so that the size of a loss cannot be stated.",
                );
            }
            _ => {}
        }
        let (certain, of) = match (alarm.change, alarm.batch_change) {
            (Some(change), _) => match certain_of(change) {
                Some(found) => found,
                None => return unknown("the size of the change is not known."),
            },
            (None, Some(batch)) => {
                let certain = certain_size(batch.interval.map(|end| 100.0 * end));
                (certain, "the change in the newest batch of the alarm, weather included,".to_owned())
            }
            (None, None) => return unknown("the size of the change is not known."),
        };
        let graded = self.graded(certain, &of);
        let beside =
            |change: &LastingChange| change.changes.iter().chain(&change.candidates).any(QuantityChange::is_of_misfit);
        if graded.grade == Grade::Slight && alarm.change.is_some_and(beside) {
            return unknown(
                "the frequencies have changed beside all that the parameters can give, so that the size of a loss cannot be stated.",
            );
        }
        graded
    }

    fn graded(&self, certain: f64, of: &str) -> Severity {
        let (grade, limit) = match certain {
            l if l >= self.critical_percent => (Grade::Critical, self.critical_percent),
            l if l >= self.severe_percent => (Grade::Severe, self.severe_percent),
            l if l >= self.moderate_percent => (Grade::Moderate, self.moderate_percent),
            _ => (Grade::Slight, self.moderate_percent),
        };
        let sentence = if certain <= 0.0 {
            format!("Slight: no size of {of} is certain yet.")
        } else if grade == Grade::Slight {
            format!("Slight: {of} is at least {certain:.1} % with 95 % certainty, below the limit of {limit} %.")
        } else {
            let mut name = grade.as_str().to_owned();
            name[..1].make_ascii_uppercase();
            format!("{name}: {of} is at least {certain:.1} % with 95 % certainty; the limit is {limit} %.")
        };
        Severity { grade, certain_loss_percent: Some(certain), sentence }
    }
}

/// The loss of a lasting change that is certain, and of what it is; `None` if the size is not known.
fn certain_of(change: &LastingChange) -> Option<(f64, String)> {
    let certain = |q: &QuantityChange| {
        if q.towards_damage {
            certain_size(q.interval.map(|end| q.percent(end)))
        } else {
            0.0
        }
    };
    if change.changes.is_empty() {
        // Whichever of them has changed, the loss is at least the smallest that one of them would have.
        let least = change.candidates.iter().map(certain).min_by(f64::total_cmp)?;
        return Some((least, "the lasting change, whichever parameter has changed,".to_owned()));
    }
    if !change.changes.iter().any(QuantityChange::is_of_quantity) {
        return Some((0.0, "a loss of stiffness".to_owned()));
    }
    let all = change.changes.iter().map(|q| (certain(q), structures::parameter::in_words(&q.name)));
    let (largest, name) = all.max_by(|a, b| a.0.total_cmp(&b.0))?;
    Some((largest, format!("the lasting change of {name}")))
}

/// The smallest size in an interval; 0 if it contains 0 or is not finite.
fn certain_size([a, b]: [f64; 2]) -> f64 {
    if a.is_finite() && b.is_finite() && a * b > 0.0 {
        a.abs().min(b.abs())
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use structures::quantity::Timestamp;

    fn lasting(changes: &[(&str, [f64; 2])]) -> LastingChange {
        let at = Timestamp::from_micros(0).unwrap();
        let quantity = |(name, interval): &(&str, [f64; 2])| QuantityChange {
            name: (*name).to_owned(),
            unit: "N/m".to_owned(),
            probability: 1.0,
            towards_damage: interval[0] + interval[1] < 0.0,
            change: f64::midpoint(interval[0], interval[1]),
            interval: *interval,
            reference_mean: 200.0,
            explained: 0.0,
            modes: Vec::new(),
        };
        LastingChange {
            fast: true,
            onset: at,
            onset_interval: [at; 2],
            changes: changes.iter().map(quantity).collect(),
            candidates: Vec::new(),
            not_seen: Vec::new(),
            coinciding: Vec::new(),
        }
    }

    fn of(change: &LastingChange) -> Severity {
        let facts = AlarmFacts { kind: "damage", change: Some(change), batch_change: None };
        SeverityLimits::default().severity(facts)
    }

    #[test]
    fn the_grade_is_that_of_the_certain_part_of_the_largest_loss() {
        // 200 N/m: 1 N/m is half a per cent.
        for (interval, grade, certain) in [
            ([-3.9, -1.0], Grade::Slight, 0.5),
            ([-40.0, 0.1], Grade::Slight, 0.0),
            ([-40.0, -4.0], Grade::Moderate, 2.0),
            ([-12.0, -11.0], Grade::Severe, 5.5),
            ([-60.0, -20.0], Grade::Critical, 10.0),
        ] {
            let found = of(&lasting(&[("k1", [-0.4, 0.2]), ("k2", interval)]));
            assert_eq!(found.grade, grade, "{found:?}");
            assert!((found.certain_loss_percent.unwrap() - certain).abs() < 1e-9, "{found:?}");
            assert!(found.sentence.to_lowercase().starts_with(grade.as_str()), "{found:?}");
        }
        let found = of(&lasting(&[("k1", [-13.0, -12.0]), ("k2", [-60.0, -1.0])]));
        assert!(found.grade == Grade::Severe && found.sentence.contains("k1"), "{found:?}");
        // What no parameter explains may be more than the parameters have certainly lost.
        let beside = of(&lasting(&[("structure:misfit", [1.0, 2.0]), ("k2", [-3.9, -1.0])]));
        assert!(beside.grade == Grade::Moderate && beside.certain_loss_percent.is_none(), "{beside:?}");
        assert_eq!(of(&lasting(&[("structure:misfit", [1.0, 2.0]), ("k2", [-12.0, -11.0])])).grade, Grade::Severe);
        // A gain is no damage, and of several candidates the smallest loss is certain.
        assert_eq!(of(&lasting(&[("k1", [12.0, 13.0])])).grade, Grade::Slight);
        let mut either = lasting(&[("k1", [-13.0, -12.0]), ("k2", [-60.0, -20.0])]);
        std::mem::swap(&mut either.changes, &mut either.candidates);
        let found = of(&either);
        assert!(found.grade == Grade::Severe && found.sentence.contains("whichever parameter"), "{found:?}");
    }

    #[test]
    fn without_a_process_the_newest_batch_decides_and_without_a_size_a_reason_is_given() {
        let limits = SeverityLimits::default();
        let batch = BatchChange { change: -0.12, interval: [-0.17, -0.07] };
        let found = limits.severity(AlarmFacts { kind: "damage", change: None, batch_change: Some(batch) });
        assert!(found.grade == Grade::Severe && found.sentence.contains("7.0 %"), "{found:?}");
        for (kind, words) in [
            ("silence", "no measurements"),
            ("not_assessed", "cannot be judged"),
            ("simulation_does_not_fit", "does not fit"),
            ("damage", "not known"),
        ] {
            let found = limits.severity(AlarmFacts { kind, change: None, batch_change: None });
            assert_eq!((found.grade, found.certain_loss_percent), (Grade::Moderate, None));
            assert!(found.sentence.contains(words), "{found:?}");
        }
    }

    #[test]
    fn limits_must_ascend_from_above_zero() {
        assert_eq!(SeverityLimits::default().problem(), None);
        for (limits, key) in
            [([0.0, 5.0, 10.0], "moderate"), ([2.0, 2.0, 10.0], "severe"), ([2.0, 5.0, f64::NAN], "critical")]
        {
            let [moderate_percent, severe_percent, critical_percent] = limits;
            let limits = SeverityLimits { moderate_percent, severe_percent, critical_percent };
            assert!(limits.problem().unwrap().0.contains(key));
        }
    }

    proptest! {
        /// A narrower interval around the same change never lowers the grade, and neither does a proportionally larger loss.
        #[test]
        fn certainty_and_size_never_lower_the_grade(change in 0.1_f64..80.0, half in 0.0_f64..80.0, shrink in 0.0_f64..1.0, grow in 1.0_f64..3.0) {
            let wide = of(&lasting(&[("k", [-change - half, -change + half])]));
            let narrow = of(&lasting(&[("k", [-change - shrink * half, -change + shrink * half])]));
            let larger = of(&lasting(&[("k", [-grow * (change + half), -grow * (change - half)])]));
            prop_assert!(narrow.grade >= wide.grade && larger.grade >= wide.grade);
        }
    }
}
