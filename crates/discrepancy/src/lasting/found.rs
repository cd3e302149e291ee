//! A lasting change in numbers and words.

use serde::{Deserialize, Serialize};

use crate::chance::chance;
use crate::data::Data;
use crate::describe::rounded;
use crate::sentence::capitalised;
use structures::quantity::Timestamp;

/// Data over fewer years than this do not show whether a change comes every year.
const YEARS_TO_KNOW_A_SEASON: f64 = 2.0;

/// The change of a measured mean is told beside that of the residuals if they differ by more than this many standard errors.
const OTHER_ERRORS: f64 = 4.0;

/// A change of a mode is clear from this many standard errors on.
const CLEAR_ERRORS: f64 = 2.0;

/// A step of the frequency of a mode.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ModeChange {
    /// The mode, from 1.
    pub mode: usize,
    /// Change of its frequency that neither causes nor recorded quantities nor seasons explain, per cent.
    pub percent: f64,
    /// Standard error, per cent.
    pub standard_error_percent: f64,
    /// Difference between the mean measured frequencies since the change and before it, whatever explains it, per cent; `null` if the mode
    /// was not measured on both sides.
    #[serde(default)]
    pub measured_percent: Option<f64>,
}

impl ModeChange {
    /// The change as a phrase: "mode 1 −0.80 ± 0.03 %", with that of the measured means where it is another one.
    fn in_words(&self) -> String {
        let (percent, error) = rounded(self.percent, self.standard_error_percent);
        let other = |measured: &f64| (measured - self.percent).abs() > OTHER_ERRORS * self.standard_error_percent;
        let measured = self.measured_percent.filter(other).map_or_else(String::new, |measured| {
            format!(" (its measured mean: {} %)", with_sign(&format!("{measured:.2}")))
        });
        format!("mode {} {} ± {error} %{measured}", self.mode, with_sign(&percent))
    }
}

/// A step of a stiffness, or of another parameter, that explains the steps of the frequencies.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct StiffnessChange {
    /// Name of the parameter or spring.
    pub name: String,
    /// Its change, per cent.
    pub percent: f64,
    /// Standard error, per cent.
    pub standard_error_percent: f64,
    /// Whether it is a stiffness, and not a parameter that is a mass or a deviation.
    #[serde(default = "yes")]
    pub is_stiffness: bool,
}

/// Answers of earlier versions named stiffnesses only.
const fn yes() -> bool {
    true
}

/// From a time on, the measurements differ from those before, and neither the causes found nor the recorded quantities nor the seasons
/// explain it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = DiagnosedChange)]
pub struct LastingChange {
    /// Most probable time of the first measurement after the change.
    pub since: Timestamp,
    /// 90 % interval of that time.
    pub since_interval90: [Timestamp; 2],
    /// The same time in days from the first measurement.
    pub since_days: f64,
    /// Index of the first row after the change, and of the first one that may lie after it.
    #[serde(skip)]
    pub(crate) first_row: usize,
    #[serde(skip)]
    pub(crate) first_possible_row: usize,
    /// Measurements before the change.
    pub rows_before: usize,
    /// Measurements since the change.
    pub rows_since: usize,
    /// Quantity in which the change is clearest.
    pub clearest_in: String,
    /// Change of the frequency of each mode.
    pub modes: Vec<ModeChange>,
    /// The stiffness whose change looks like it; or the parameter that is a mass or a deviation; several if these frequencies do not tell
    /// which; empty if none does.
    pub stiffness: Vec<StiffnessChange>,
    /// Probability of at least this change by chance, times the number of tests (Bonferroni).
    pub p_value: f64,
    /// Share of data without a change in which one is found by chance, at most.
    pub error_rate: f64,
    /// Years that the measurements cover.
    pub covered_years: f64,
    /// What the diagnosis does with the measurements since then, in a sentence.
    pub consequence: String,
    /// The finding in sentences.
    pub sentence: String,
}

impl LastingChange {
    /// The start of a sentence: since when.
    fn since_in_words(&self, data: &Data) -> String {
        let at = |time: Timestamp| {
            let row = data.measured_at.partition_point(|measured| *measured < time);
            data.time_in_words(row.min(data.rows() - 1))
        };
        let [low, high] = self.since_interval90.map(at);
        let since = at(self.since);
        if low == high {
            format!("since {since}")
        } else {
            format!("since {since} (between {low} and {high})")
        }
    }

    /// Writes the sentences.
    pub(crate) fn describe(&mut self, data: &Data, consequence: &str) {
        let modes: Vec<String> = self.modes.iter().map(ModeChange::in_words).collect();
        let each = |stiffness: &StiffnessChange| {
            let (percent, error) = rounded(stiffness.percent, stiffness.standard_error_percent);
            format!("{} ({} ± {error} %)", stiffness.name, with_sign(&percent))
        };
        let named: Vec<String> = self.stiffness.iter().map(each).collect();
        let looks_like = match named.as_slice() {
            [] => " No change of a single stiffness or other parameter explains it.".to_owned(),
            [one] if self.stiffness[0].is_stiffness => format!(" It looks like a change of the stiffness {one}."),
            [one] => format!(" It looks like a change of {one}."),
            several => format!(
                " It looks like a change of one {}, and these frequencies do not tell which: {}.",
                self.what_changed(),
                several.join(", or ")
            ),
        };
        let is_clear = |mode: &&ModeChange| mode.percent.abs() > CLEAR_ERRORS * mode.standard_error_percent;
        let clear: Vec<&ModeChange> = self.modes.iter().filter(is_clear).collect();
        // Beside what the recorded quantities explain, and as measured: a loss that goes with one of them may be partly taken for its influence.
        let rise =
            |mode: &ModeChange| mode.percent > 0.0 && mode.measured_percent.is_none_or(|measured| measured > 0.0);
        let rises = !clear.is_empty() && clear.into_iter().all(rise);
        let meaning = if rises {
            "these frequencies rise, which a loss of stiffness does not cause"
        } else {
            "this may be damage"
        };
        consequence.clone_into(&mut self.consequence);
        self.sentence = format!(
            "{} these measurements behave differently from those before: the frequencies change by {}. Neither the causes that were \
             found nor the recorded quantities nor a yearly or daily cycle explains it; {meaning}.{looks_like} {consequence}",
            capitalised(&self.since_in_words(data)),
            modes.join(", ")
        );
    }

    /// What those in [`Self::stiffness`] are, in the singular.
    pub(crate) fn what_changed(&self) -> &'static str {
        if self.stiffness.iter().all(|stiffness| stiffness.is_stiffness) {
            "stiffness"
        } else {
            "stiffness or other parameter"
        }
    }

    /// How sure the finding is, and what it cannot be told from, as a sentence without capital and full stop.
    pub fn reliability(&self) -> String {
        let season = if self.covered_years < YEARS_TO_KNOW_A_SEASON {
            format!(
                "; these data cover {:.1} years, so that a change which comes every year at this time, and goes with nothing that was \
                 recorded, cannot be told from a lasting one",
                self.covered_years
            )
        } else {
            String::new()
        };
        format!(
            "a lasting change is reported where chance alone would give one in about {:.0} of 100 data sets, or in up to 4 where scatter \
             persists for weeks; here {}{season}",
            100.0 * self.error_rate,
            chance(self.p_value)
        )
    }
}

/// A rounded number with its sign.
fn with_sign(number: &str) -> String {
    number.strip_prefix('-').map_or_else(|| format!("+{number}"), |rest| format!("−{rest}"))
}
