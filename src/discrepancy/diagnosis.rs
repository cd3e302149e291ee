//! The result of a diagnosis.

use serde::{Deserialize, Serialize};

use super::describe::Cause;
use super::fit::Fit;
use super::gain::Gain;
use super::grammar::Class;
use super::learned::offer::{LearnedOffer, Offered};
use super::misfit::{Misfit, Remainder};
use super::rank::Ranked;
use crate::quantity::Digest;

/// A cause with a probability above this is named alone.
pub(super) const SURE: f64 = 0.9;

/// What a diagnosis concludes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DiagnosisVerdict {
    /// One cause, with a probability above 0.9.
    Cause,
    /// More than one cause at the same time.
    Several,
    /// One cause out of a few that these data cannot distinguish.
    Ambiguous,
    /// The data deviate from the simulation in a way that no known cause explains.
    NoneOfThese,
    /// The simulation explains the data.
    NothingFound,
}

/// A cause that was not chosen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Alternative {
    /// The cause.
    #[serde(flatten)]
    pub cause: Cause,
    /// Number, from 1, of the chosen cause that it would replace.
    pub instead_of: usize,
    /// Its log evidence minus that of the chosen cause, prior included, nats.
    pub log_evidence_difference: f64,
    /// A measurement that would distinguish the two.
    #[serde(rename = "told_apart_by")]
    pub discriminating_measurement: String,
}

/// The answer to the question what the simulation gets wrong.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Diagnosis {
    /// Id of the structure.
    pub structure: String,
    /// The conclusion.
    pub verdict: DiagnosisVerdict,
    /// The answer in one or a few sentences.
    pub summary: String,
    /// Deviations of the simulation without further causes, the most significant first.
    pub misfit: Vec<Misfit>,
    /// The causes; with an ambiguous verdict, the few of which one is the cause.
    pub causes: Vec<Cause>,
    /// Causes that were not chosen.
    pub alternatives: Vec<Alternative>,
    /// Deviation that no cause explains.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub remainder: Option<Remainder>,
    /// Gain from the causes on the rows held out; `null` when no cause was found.
    pub gain: Option<Gain>,
    /// A discrepancy that could be learned, where no known cause explains the deviation.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub learned: Option<LearnedOffer>,
    /// Properties of the data that limit the diagnosis.
    pub notes: Vec<String>,
    /// Rows that were searched for causes.
    pub training_rows: usize,
    /// Rows held out.
    pub holdout_rows: usize,
    /// Combinations of target, law and covariate that were considered.
    pub candidates: usize,
    /// Effective number of independent rows as a share of all rows.
    pub independent_share: f64,
    /// Seed of the bootstrap.
    pub seed: u64,
    /// Digest of the measurements.
    pub data_digest: Digest,
    /// Digest of the structure.
    pub structure_digest: Digest,
}

/// A diagnosis and the fits that it is based on.
pub struct Outcome {
    /// The answer.
    pub diagnosis: Diagnosis,
    /// Fit of the simulation without further causes.
    pub before: Fit,
    /// Fit with the causes; their effects follow those that the structure already has.
    pub after: Fit,
    /// The chosen candidates.
    pub causes: Vec<Ranked>,
    /// For each chosen candidate, whether a stiffness that changes with time is among the causes it cannot be distinguished
    /// from.
    pub maybe_damage: Vec<bool>,
    /// Rows held out.
    pub holdout: Vec<usize>,
    /// Rows that were searched for causes.
    pub training: Vec<usize>,
    /// The discrepancy that could be learned.
    pub offered: Option<Offered>,
}

impl Diagnosis {
    /// The answer in words.
    pub(super) fn in_words(&self) -> String {
        let mut text = self.finding_in_words();
        if self.causes.iter().any(|c| c.class == Class::PossibleDamage) {
            text.push_str(" A stiffness that changes with time may be damage: it is reported, but not compensated.");
        }
        if let Some(learned) = &self.learned {
            text.push(' ');
            text.push_str(&learned.summary);
        }
        if let Some(gain) = self.gain.as_ref().and_then(|gain| gain_in_words(gain, self.causes.len() > 1)) {
            text.push_str(&gain);
        }
        text
    }

    /// The verdict in words, with the causes and their probabilities.
    fn finding_in_words(&self) -> String {
        let sure = |p: f64| if p > 0.9995 { "above 0.999".to_owned() } else { format!("{p:.3}") };
        match self.verdict {
            DiagnosisVerdict::NothingFound => {
                "No cause was found: the simulation explains these data within their noise.".to_owned()
            }
            DiagnosisVerdict::NoneOfThese => {
                let left = self.remainder.as_ref().map_or_else(String::new, |r| r.function.clone());
                let partly = if self.causes.is_empty() {
                    String::new()
                } else {
                    let each: Vec<&str> = self.causes.iter().map(|c| c.sentence.as_str()).collect();
                    format!(" The following explains only a part of the deviation: {}.", each.join("; "))
                };
                format!(
                    "The data deviate from the simulation in a way that no known cause explains: the remaining residuals depend \
                     on {left}.{partly}"
                )
            }
            DiagnosisVerdict::Cause => {
                let cause = &self.causes[0];
                let probability = sure(cause.probability);
                format!(
                    "The simulation does not account for one cause: {} (probability {probability}).",
                    cause.sentence
                )
            }
            DiagnosisVerdict::Several => {
                let each = |c: &Cause| format!("{} (probability {})", c.sentence, sure(c.probability));
                let each: Vec<String> = self.causes.iter().map(each).collect();
                format!("The simulation does not account for {} causes: {}.", each.len(), each.join("; and "))
            }
            DiagnosisVerdict::Ambiguous => {
                let each = |c: &Cause| format!("{} (probability {:.2})", c.sentence, c.probability);
                let each: Vec<String> = self.causes.iter().map(each).collect();
                format!(
                    "The simulation does not account for one cause, and these data cannot tell which of the following it is: {}.",
                    each.join("; or ")
                )
            }
        }
    }
}

/// The gain in words: change of the error of the mode that improves most, and of the false alarms. `None` if no mode was measured
/// in the rows held out.
fn gain_in_words(gain: &Gain, several: bool) -> Option<String> {
    let rms = &gain.rms_error_percent;
    let finite = |m: &usize| rms.before[*m].is_finite() && rms.after[*m].is_finite();
    let mode = (0..rms.before.len()).filter(finite).max_by(|a, b| {
        let gained = |m: usize| rms.before[m] - rms.after[m];
        gained(*a).total_cmp(&gained(*b))
    })?;
    let (before, after) = (rms.before[mode], rms.after[mode]);
    let with = if several { "With them" } else { "With it" };
    let moved = if after < before { "falls" } else { "rises" };
    let alarms = &gain.false_alarms_per_1000;
    Some(format!(
        " {with} in the simulation, the prediction error of mode {} on the {} rows held out {moved} from {before:.2} % to \
         {after:.2} %, and the false alarms change from {:.0} to {:.0} per 1000 undamaged batches.",
        mode + 1,
        gain.holdout_rows,
        alarms.before,
        alarms.after
    ))
}
