//! The result of a diagnosis.

use serde::{Deserialize, Serialize};

use super::describe::Cause;
use super::fit::Fit;
use super::gain::Gain;
use super::gain_words::gain_in_words;
use super::grammar::Class;
use super::lasting::found::LastingChange;
use super::learned::offer::{LearnedOffer, Offered};
use super::left_out_modes::LeftOutModes;
use super::misfit::{Misfit, Remainder};
use super::mode_numbers::{self, ModeNumber};
use super::next::experiment::NextMeasurement;
use super::outside::OutsideSetting;
use super::rank::Ranked;
use super::scatter::ExcessScatter;
use super::sentence::capitalised;
use structures::physics::effect::Target;
use structures::quantity::Digest;

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
    /// The simulation is off by a little everywhere; no single place explains the deviation.
    Distributed,
    /// Some modes scatter more than their stated noise and the spread of the parameters explain, whether or not causes were found.
    UnexplainedScatter,
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
    /// The measurement, of those that are possible, that best distinguishes the two if both are equally probable.
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
    /// A change in time that neither the causes nor the recorded quantities nor the seasons explain; `null` if none was found.
    #[serde(default)]
    pub lasting_change: Option<LastingChange>,
    /// Parameters of which settings lie outside the prior, or outside the runs of a table.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub settings_outside: Vec<OutsideSetting>,
    /// Modes that, by their measured shapes, are other modes of the simulation than those of their numbers.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub mode_numbers: Vec<ModeNumber>,
    /// Modes that scatter more than stated.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub scatter: Vec<ExcessScatter>,
    /// Deviations of the simulation without further causes, the most significant first.
    pub misfit: Vec<Misfit>,
    /// The causes; with an ambiguous verdict, the few of which one is the cause.
    pub causes: Vec<Cause>,
    /// Causes that were not chosen.
    pub alternatives: Vec<Alternative>,
    /// Measurements that would decide between the candidates of a cause that is not sure, the best first.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub next_measurements: Vec<NextMeasurement>,
    /// Deviation that no cause explains.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub remainder: Option<Remainder>,
    /// Gain from the causes on rows that they were not fitted to; `null` when no cause was found.
    pub gain: Option<Gain>,
    /// Errors of modes that were left out of the fits in turn; only of constant causes, with enough modes.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub left_out_modes: Option<LeftOutModes>,
    /// A discrepancy that could be learned, where no known cause explains the deviation.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub learned: Option<LearnedOffer>,
    /// Properties of the data that limit the diagnosis.
    pub notes: Vec<String>,
    /// Rows that were searched for causes.
    pub training_rows: usize,
    /// Rows held out.
    pub holdout_rows: usize,
    /// Rows since a lasting change, which were neither searched nor held out.
    #[serde(default)]
    pub set_aside_rows: usize,
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

/// Least probability of what a sentence names as another explanation.
const LEAST_TOLD: f64 = 0.05;

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
    /// Rows since a lasting change, which are used for neither.
    pub set_aside: Vec<usize>,
    /// The discrepancy that could be learned.
    pub offered: Option<Offered>,
}

impl Outcome {
    /// The fit with a deviation of all parts, if that is the only cause, or the most probable of those that it may be, and nothing remains
    /// unexplained.
    pub(super) fn everywhere(&self) -> Option<&Fit> {
        let [only] = self.causes.as_slice() else { return None };
        let explained = self.diagnosis.verdict != DiagnosisVerdict::NoneOfThese;
        (explained && matches!(only.candidate.target, Target::Everywhere(_))).then_some(&self.after)
    }
}

impl Diagnosis {
    /// How the probabilities of the causes that an earlier diagnosis named have changed, one sentence for each.
    pub fn changes_since(&self, earlier: &[Cause]) -> Vec<String> {
        let same = |a: &Cause, b: &Cause| (&a.target, &a.covariate) == (&b.target, &b.covariate);
        let change = |before: &Cause| {
            let others = self.alternatives.iter().map(|a| &a.cause);
            let now = self.causes.iter().chain(others).find(|now| same(now, before));
            let now = now.map_or_else(|| "below that of those listed".to_owned(), |c| format!("{:.3}", c.probability));
            format!(
                "with the further rows, the probability of \u{201c}{}\u{201d} is {now}; it was {:.3}",
                before.sentence, before.probability
            )
        };
        earlier.iter().map(change).collect()
    }

    /// The answer in words.
    pub(super) fn in_words(&self) -> String {
        let mut text = self.lasting_change.as_ref().map_or_else(String::new, |change| format!("{} ", change.sentence));
        text += &self.settings_outside.iter().map(|s| capitalised(&s.sentence()) + ". ").collect::<String>();
        if !self.mode_numbers.is_empty() {
            text += &(capitalised(&mode_numbers::sentence(&self.mode_numbers)) + ". ");
        }
        if self.set_aside_rows > 0 {
            let rows = self.training_rows + self.holdout_rows;
            text.extend(["In the ", &rows.to_string(), " measurements before: "]);
        }
        text += &self.finding_in_words();
        let is = |class: Class| self.causes.iter().any(|cause| cause.class == class);
        if is(Class::PossibleDamage) {
            text.push_str(
                " A structure that becomes softer with time may be damaged: inspect it there. The change is not compensated.",
            );
        }
        if is(Class::Rise) {
            text.push_str(
                " A structure that becomes stiffer with time has lost nothing there: look for a repair, a support that holds more than before, or a \
                 change of the instrument. The change is not compensated.",
            );
        }
        let with = match self.verdict {
            DiagnosisVerdict::Ambiguous if self.causes.len() > 1 => "With the first of them",
            _ if self.causes.len() > 1 => "With them",
            _ => "With it",
        };
        if let Some(gain) = self.gain.as_ref().and_then(|gain| gain_in_words(gain, with)) {
            text.push_str(&gain);
        }
        if let Some(modes) = &self.left_out_modes {
            text.extend([" ", &modes.sentence(with)]);
        }
        if let Some(learned) = &self.learned {
            text.push(' ');
            text.push_str(&learned.summary);
        }
        text
    }

    /// What no cause explains, as a clause.
    fn unexplained_in_words(&self) -> String {
        let still_outside = |s: &OutsideSetting| s.outside_rows_corrected > 0;
        match &self.remainder {
            Some(left) => left.sentence(),
            None if self.settings_outside.iter().any(still_outside) => "settings remain outside the prior".to_owned(),
            None => "settings lie inside the priors, but where the table has no runs".to_owned(),
        }
    }

    /// What else one of several causes may be, as the end of its clause; empty where that is improbable.
    fn instead_of(&self, cause: &Cause) -> String {
        let number = 1 + self.causes.iter().position(|c| std::ptr::eq(c, cause)).unwrap_or_default();
        let others = self.alternatives.iter().filter(|a| a.instead_of == number).map(|a| &a.cause);
        let each = |c: &Cause| format!(", or instead {} (probability {:.2})", c.sentence, c.probability);
        others.filter(|c| c.probability > LEAST_TOLD).map(each).collect()
    }

    /// Several causes in words, those that may be damage first.
    fn several_in_words(&self, each: &dyn Fn(&&Cause) -> String) -> String {
        let listed = |causes: &[&Cause]| causes.iter().map(each).collect::<Vec<_>>().join("; and ");
        let of = |class: Class| self.causes.iter().filter(|cause| cause.class == class).collect::<Vec<&Cause>>();
        let others: Vec<&Cause> = self.causes.iter().filter(|cause| !cause.class.is_change()).collect();
        let told =
            [("What may be damage", of(Class::PossibleDamage)), ("What has risen, and is no loss", of(Class::Rise))];
        let told = told.iter().filter(|(_, causes)| !causes.is_empty());
        let told: Vec<String> = told.map(|(what, causes)| format!("{what}: {}.", listed(causes))).collect();
        let first = if told.is_empty() {
            "The simulation".to_owned()
        } else {
            format!("{} Apart from that, the simulation", told.join(" "))
        };
        match others.as_slice() {
            [] => told.join(" "),
            [one] => format!("{first} does not account for one cause: {}.", each(one)),
            others => format!("{first} does not account for {} causes: {}.", others.len(), listed(others)),
        }
    }

    /// The verdict in words, with the causes and their probabilities.
    fn finding_in_words(&self) -> String {
        let sure = |p: f64| if p > 0.9995 { "above 0.999".to_owned() } else { format!("{p:.3}") };
        match self.verdict {
            DiagnosisVerdict::NothingFound => {
                "No cause was found: the simulation explains these data within their noise.".to_owned()
            }
            DiagnosisVerdict::NoneOfThese => {
                let left = self.unexplained_in_words();
                let partly = if self.causes.is_empty() {
                    String::new()
                } else {
                    let each: Vec<&str> = self.causes.iter().map(|c| c.sentence.as_str()).collect();
                    format!(" The following explains only a part of the deviation: {}.", each.join("; "))
                };
                format!("The data deviate from the simulation in a way that no known cause explains: {left}.{partly}")
            }
            DiagnosisVerdict::UnexplainedScatter => {
                let each: Vec<String> = self.scatter.iter().map(ExcessScatter::sentence).collect();
                let causes = if self.causes.is_empty() {
                    "no known cause explains this scatter".to_owned()
                } else {
                    let each = |c: &Cause| format!("{} (probability {})", c.sentence, sure(c.probability));
                    let each: Vec<String> = self.causes.iter().map(each).collect();
                    format!("the causes found do not explain this scatter: {}", each.join("; and "))
                };
                format!(
                    "{}, and it goes with nothing that was recorded: either the stated noise is too small, or something else acts on \
                     these modes; {causes}.",
                    capitalised(&each.join("; "))
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
            DiagnosisVerdict::Distributed => {
                let cause = &self.causes[0];
                let scatter: Vec<String> = self.scatter.iter().map(ExcessScatter::sentence).collect();
                let scatter = if scatter.is_empty() {
                    String::new()
                } else {
                    format!(
                        " {}; how the modes follow the parameters is off in such a simulation as well, which may be the reason.",
                        capitalised(&scatter.join("; "))
                    )
                };
                format!(
                    "No single place explains how the data deviate from the simulation: {} (probability {}).{scatter}",
                    cause.sentence,
                    sure(cause.probability)
                )
            }
            DiagnosisVerdict::Several => {
                let each =
                    |c: &&Cause| format!("{} (probability {}){}", c.sentence, sure(c.probability), self.instead_of(c));
                self.several_in_words(&each)
            }
            DiagnosisVerdict::Ambiguous => {
                let each = |c: &Cause| format!("{} (probability {:.2})", c.sentence, c.probability);
                let each: Vec<String> = self.causes.iter().map(each).collect();
                let next = self.next_measurements.first().map_or_else(String::new, |m| format!(" {}", m.sentence));
                format!(
                    "The simulation does not account for one cause, and these data cannot tell which of the following it is: \
                     {}.{next}",
                    each.join("; or ")
                )
            }
        }
    }
}
