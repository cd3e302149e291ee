//! What a diagnosis says about a learned discrepancy.

use serde::{Deserialize, Serialize};

use super::change::ChangeInTime;
use super::constant::constant;
use super::gain::{held_out_gain, left_out_gain, LearnedGain};
use super::input::{choose, standardised, Chosen};
use super::learn::{learn, Learned, WhyNot};
use crate::chance::chance;
use crate::fit::Fit;
use crate::model::RowView;
use crate::study::Study;
use structures::simulator::discrepancy::definition::InputDefinition;
use structures::stats;

/// Fewest rows held out on which the gain is measured; with fewer, blocks of the other rows are left out in turn.
const FEWEST_HELD: usize = 8;

/// A discrepancy that could be learned: not understood, but predictable.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct LearnedOffer {
    /// The answer in one or a few sentences.
    pub summary: String,
    /// Covariates and settings that it depends on.
    pub inputs: Vec<String>,
    /// A sentence for each covariate or setting that is not an input because it is a function of time.
    pub refused: Vec<String>,
    /// Effect range (5–95 %) of its mean over the rows that it was learned from, for each mode, per cent of the frequency; its mean if it
    /// is a constant.
    pub size_percent: Vec<f64>,
    /// A change of a stiffness in time among these rows: the discrepancy is then not added to a structure.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub change_in_time: Option<ChangeInTime>,
    /// Its gain on rows that it was not learned from.
    pub gain: LearnedGain,
}

/// An offer, and what it is about.
pub struct Offered {
    /// The offer.
    pub offer: LearnedOffer,
    /// The discrepancy.
    pub learned: Learned,
    /// Standardised inputs of all rows of the data.
    pub u: Vec<Option<Vec<f64>>>,
    /// Measured deviations from the simulation alone, differences in ln f, of all rows of the data and all modes; NaN if missing.
    pub deviations: Vec<Vec<f64>>,
}

/// Learns a discrepancy from the rows `training` and measures its gain on the rows `held`, or, if these are fewer than eight, by
/// leaving out blocks of the rows `training`. `base`: fit of the simulation alone to the rows `training`; `everywhere`: the fit with a
/// deviation of all parts, if that is the only cause, whose constants are then learned.
///
/// # Errors
/// [`WhyNot`].
pub fn offer(
    study: &Study<'_>,
    training: &[usize],
    held: &[usize],
    base: &Fit,
    everywhere: Option<&Fit>,
) -> Result<Offered, WhyNot> {
    let chosen = everywhere.map_or_else(|| choose(study.simulator, study.data, training), |_| Chosen::default());
    let Chosen { inputs, refused } = chosen;
    let u = standardised(study.simulator, study.data, &inputs);
    let learned = match everywhere {
        Some(with) => constant(study, training, with)?,
        None => learn(study, training, base, &inputs, &u)?,
    };
    let gain = if held.len() >= FEWEST_HELD {
        held_out_gain(study, held, base, &learned, &u)
    } else {
        left_out_gain(study, training, &base.effects, everywhere)
    };
    let gain = gain.ok_or(WhyNot::NoFit)?;
    let inputs: Vec<String> = inputs.iter().map(|input: &InputDefinition| input.name().to_owned()).collect();
    let offer = LearnedOffer {
        summary: in_words(&inputs, learned.change.as_ref(), &gain, study.data.time_unit),
        size_percent: sizes(&learned, training, &u),
        change_in_time: learned.change.clone(),
        inputs,
        refused,
        gain,
    };
    let deviations = deviations(study, &learned.fit).ok_or(WhyNot::NoFit)?;
    Ok(Offered { offer, learned, u, deviations })
}

/// Residuals of all rows under a fit, `[n][m]`, NaN for a mode that is missing; `None` if the frequencies cannot be computed.
fn deviations(study: &Study<'_>, fit: &Fit) -> Option<Vec<Vec<f64>>> {
    let all: Vec<usize> = (0..study.data.rows()).collect();
    let one = |view: &RowView| {
        let mut of_row = vec![f64::NAN; study.simulator.modes()];
        view.present[..view.frequencies]
            .iter()
            .zip(view.residual.iter())
            .for_each(|(mode, residual)| of_row[*mode] = *residual);
        of_row
    };
    Some(study.view(&all, fit)?.iter().map(one).collect())
}

/// Effect range of the mean of the discrepancy over some rows, for each mode, per cent; the mean itself if it is a constant.
fn sizes(learned: &Learned, rows: &[usize], u: &[Option<Vec<f64>>]) -> Vec<f64> {
    if learned.discrepancy.definition().inputs.is_empty() {
        return learned.discrepancy.at(Some(&[])).iter().map(|m| 100.0 * m.mean).collect();
    }
    let known = rows.iter().filter_map(|row| u[*row].as_deref());
    let means: Vec<Vec<f64>> =
        known.map(|u| learned.discrepancy.at(Some(u)).iter().map(|m| m.mean).collect()).collect();
    let size = |mode: usize| {
        let values: Vec<f64> = means.iter().map(|row| row[mode]).collect();
        100.0 * (stats::quantile(&values, 0.95) - stats::quantile(&values, 0.05))
    };
    (0..learned.discrepancy.modes().len()).map(size).collect()
}

impl ChangeInTime {
    /// The change as a part of a sentence.
    pub fn in_words(&self, time_unit: &str) -> String {
        let when = match self.after {
            Some(after) => format!("after {time_unit} {after:.1}"),
            None => "steadily with time".to_owned(),
        };
        format!("{} changes by {:.2} % {when} ({})", self.target, self.size_percent, chance(self.p_value))
    }
}

fn in_words(inputs: &[String], change: Option<&ChangeInTime>, gain: &LearnedGain, time_unit: &str) -> String {
    let of = inputs.join(", ");
    let density = &gain.log_density_per_row;
    let (difference, error) = (density.difference, density.standard_error);
    let rows = gain.rows;
    let mut text = if gain.is_clear() {
        let rms = &gain.rms_error_percent;
        let gained = |mode: usize| rms.before[mode] - rms.after[mode];
        let known = (0..rms.before.len()).filter(|m| gained(*m).is_finite());
        let most = known.max_by(|a, b| gained(*a).total_cmp(&gained(*b))).unwrap_or(0);
        let (mode, before, after) = (most + 1, rms.before[most], rms.after[most]);
        let raises =
            format!("raises the log density of {rows} rows it has not seen by {difference:.2} ± {error:.2} per row");
        let falls = format!("the prediction error of mode {mode} falls from {before:.2} % to {after:.2} %");
        if inputs.is_empty() {
            format!(
                "It can be accepted as it is, as a constant discrepancy of each mode, which {raises}. Changes of the stiffnesses are then \
                 judged, but their values, and the size and the place of a change, stay as uncertain as the simulation. Rows of the same \
                 state confirm that the deviation lasts, not where it comes from."
            )
        } else {
            format!(
                "It is not understood, but predictable: a discrepancy learned from {of} {raises} (1 is a factor of 2.7 in probability), \
                 and {falls}."
            )
        }
    } else {
        let what = if inputs.is_empty() {
            "A constant discrepancy of each mode".to_owned()
        } else {
            format!("A discrepancy learned from {of}")
        };
        format!(
            "{what} does not predict rows better that it has not seen (log density {difference:+.2} ± {error:.2} per row)."
        )
    };
    if let Some(change) = change {
        let what = change.in_words(time_unit);
        text.push_str(" It is not added to a structure, because among the rows it would be learned from ");
        text.push_str(&what);
        text.push_str(", which may be damage.");
    }
    text
}
