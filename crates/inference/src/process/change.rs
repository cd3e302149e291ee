//! Lasting changes that a process does not explain: test, onset and size.
//!
//! A change δ of the parameters that lasts from batch τ on adds G_s,τ δ to the innovation of each later batch s, where G follows from
//! the filter, which takes part of the change for weather. For each onset, the innovations since then give a score and its variance:
//!
//! ```text
//!  ν_s ~ N(G_s δ, S_s),    G_s = 1 − H M_s,    M_τ = 0,    M_s+1 = F (M_s + K_s G_s)
//!  b = Σ_s G_sᵀ S_s⁻¹ ν_s,    I = Σ_s G_sᵀ S_s⁻¹ G_s
//!  one parameter: z_k = ∓b_k/√I_kk,        several: z² = max over losses δ of 2 bᵀδ − δᵀIδ
//! ```
//!
//! Source: A. S. Willsky, H. L. Jones (1976), IEEE Trans. Automatic Control 21, 108–112.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::filter::Innovation;
use structures::parameter::DamageDirection;

/// Ages of a change, in batches since its onset, that are tested.
pub const AGES: [usize; 10] = [1, 2, 3, 5, 8, 13, 20, 30, 45, 60];

/// Ages up to this one make the fast chart, which finds steps; the others make the slow chart, which finds small lasting losses.
pub const FAST_AGE: usize = 3;

/// Number of batches, the newest included, in which the onset of a change is looked for.
pub const WINDOW: usize = AGES[AGES.len() - 1];

/// Sweeps of the search for the most likely losses, and the relative change at which it ends.
const SWEEPS: usize = 100;
const SETTLED: f64 = 1e-6;

/// Evidence of a change on the two charts, in standard deviations.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Evidence {
    /// Largest over the ages up to [`FAST_AGE`].
    pub fast: f64,
    /// Largest over the other ages.
    pub slow: f64,
}

impl Evidence {
    /// No evidence at any age.
    pub const NONE: Self = Self { fast: 0.0, slow: 0.0 };

    /// Takes the evidence at an age into account.
    pub(super) fn take(&mut self, age: usize, z: f64) {
        let chart = if age <= FAST_AGE { &mut self.fast } else { &mut self.slow };
        *chart = chart.max(z);
    }
}

/// Evidence for a loss.
#[derive(Debug, Clone, PartialEq)]
pub struct LossEvidence {
    /// In each quantity alone, `[d]`; `None` without a damage direction, or if the newest batch does not inform it.
    pub quantities: Vec<Option<Evidence>>,
    /// In any of them, together; `None` if fewer than two have a damage direction.
    pub joint: Option<Evidence>,
}

/// Score b and information I of a change since an onset.
#[derive(Debug, Clone, PartialEq)]
pub struct Score {
    /// b, `[d]`.
    pub score: DVector<f64>,
    /// I, `[d, d]`.
    pub information: DMatrix<f64>,
    /// M: what the states have taken of the change, `[q + d, d]`.
    pub taken: DMatrix<f64>,
    /// H M at the newest innovation: the part of the change that its prediction contains, `[d, d]`.
    pub predicted: DMatrix<f64>,
}

impl Score {
    /// Before the first changed innovation, with `states` = q + d states and `quantities` = d.
    pub fn new(states: usize, quantities: usize) -> Self {
        Self {
            score: DVector::zeros(quantities),
            information: DMatrix::zeros(quantities, quantities),
            taken: DMatrix::zeros(states, quantities),
            predicted: DMatrix::zeros(quantities, quantities),
        }
    }

    /// Adds the next innovation. `contributions`: H, `[d, q + d]`.
    pub fn add(&mut self, innovation: &Innovation, contributions: &DMatrix<f64>) {
        for (mut row, decay) in self.taken.row_iter_mut().zip(innovation.decay.iter()) {
            row *= *decay;
        }
        let d = contributions.nrows();
        self.predicted = contributions * &self.taken;
        let left = DMatrix::identity(d, d) - &self.predicted;
        let signature = left.select_rows(&innovation.informed);
        let weighted = signature.transpose() * &innovation.precision;
        self.score += &weighted * &innovation.difference;
        self.information += &weighted * &signature;
        self.taken += &innovation.gain * &signature;
    }

    /// Evidence for a loss: in each quantity, and in several together. A quantity that is not the one with the largest evidence is
    /// tested beside that one.
    pub fn evidence(&self, signs: &[f64]) -> (Vec<f64>, f64) {
        let (score, information) = (self.score.as_slice(), self.information.as_slice());
        let alone: Vec<f64> = signs.iter().enumerate().map(|(k, sign)| of_one(score, information, k, *sign)).collect();
        let best = (0..signs.len()).max_by(|a, b| alone[*a].total_cmp(&alone[*b])).unwrap_or(0);
        let of =
            |k: usize| if k == best { alone[k] } else { alone[k].min(beside(score, information, signs, [k, best])) };
        let joint = of_several(score, information, signs, &mut vec![0.0; signs.len()]);
        ((0..signs.len()).map(of).collect(), joint)
    }
}

/// Sign by which a change of each quantity is multiplied so that a loss is positive; 0 without a damage direction.
pub fn signs(directions: &[DamageDirection]) -> Vec<f64> {
    let sign = |direction: &DamageDirection| match direction {
        DamageDirection::Decrease => -1.0,
        DamageDirection::Increase => 1.0,
        DamageDirection::None => 0.0,
    };
    directions.iter().map(sign).collect()
}

/// The score of a change with the first of some successive innovations. `contributions`: H, `[d, q + d]`.
pub fn score(innovations: &[Innovation], contributions: &DMatrix<f64>) -> Score {
    let (d, n) = contributions.shape();
    let mut found = Score::new(n, d);
    for innovation in innovations {
        found.add(innovation, contributions);
    }
    found
}

/// The evidence for a loss in the newest of some successive innovations, at most [`WINDOW`].
///
/// The quantity with the largest evidence is tested alone, the others beside it, because a loss of one looks like a loss of others
/// with a similar effect. The largest evidence of all, for which the limits are computed, does not depend on that.
pub fn evidence(innovations: &[Innovation], contributions: &DMatrix<f64>, signs: &[f64]) -> LossEvidence {
    let newest = innovations.last();
    let informed = |k: usize| newest.is_some_and(|newest| newest.informed.contains(&k));
    let charted = |k: usize| signs[k] != 0.0;
    let mut quantities: Vec<Option<Evidence>> =
        (0..signs.len()).map(|k| (charted(k) && informed(k)).then_some(Evidence::NONE)).collect();
    let several = (0..signs.len()).filter(|k| charted(*k)).count() > 1;
    let mut joint = (several && quantities.iter().any(Option::is_some)).then_some(Evidence::NONE);
    for age in AGES.into_iter().filter(|age| *age <= innovations.len()) {
        let found = score(&innovations[innovations.len() - age..], contributions);
        let (alone, together) = found.evidence(signs);
        for (evidence, z) in quantities.iter_mut().zip(alone) {
            if let Some(evidence) = evidence {
                evidence.take(age, z);
            }
        }
        if let Some(joint) = &mut joint {
            joint.take(age, together);
        }
    }
    LossEvidence { quantities, joint }
}

/// z of a loss of quantity k alone; 0 if nothing informs it. `score`: b, `[d]`; `information`: I, `[d, d]`.
pub(super) fn of_one(score: &[f64], information: &[f64], k: usize, sign: f64) -> f64 {
    let own = information[k * score.len() + k];
    if own > 0.0 {
        sign * score[k] / own.sqrt()
    } else {
        0.0
    }
}

/// z of a loss of quantity k beside a loss of another one: what the other one does not explain.
///
/// ```text
///  z = ∓(b_k − I_ko b_o/I_oo) / √(I_kk − I_ko²/I_oo)
/// ```
fn beside(score: &[f64], information: &[f64], signs: &[f64], [k, other]: [usize; 2]) -> f64 {
    let d = score.len();
    let (own, cross, of_other) = (information[k * d + k], information[k * d + other], information[other * d + other]);
    let left = own - cross * cross / of_other;
    if of_other > 0.0 && left > 1e-9 * own {
        signs[k] * (score[k] - cross * score[other] / of_other) / left.sqrt()
    } else {
        0.0
    }
}

/// z of losses of any quantities together. The most likely losses, in the direction of damage and not negative, are written to
/// `losses`, `[d]`.
///
/// The maximum over losses is found by coordinates: each in turn takes its best value, given the others.
pub(super) fn of_several(score: &[f64], information: &[f64], signs: &[f64], losses: &mut [f64]) -> f64 {
    let d = signs.len();
    losses.fill(0.0);
    for _ in 0..SWEEPS {
        let (mut moved, mut largest) = (0.0_f64, 0.0_f64);
        for k in 0..d {
            let own = information[k * d + k];
            if signs[k] == 0.0 || own <= 0.0 {
                continue;
            }
            let row = &information[k * d..(k + 1) * d];
            let all: f64 = row.iter().zip(signs).zip(&*losses).map(|((i, sign), loss)| i * sign * loss).sum();
            let others = signs[k] * all - own * losses[k];
            let best = ((signs[k] * score[k] - others) / own).max(0.0);
            moved = moved.max((best - losses[k]).abs() * own.sqrt());
            largest = largest.max(best * own.sqrt());
            losses[k] = best;
        }
        if moved <= SETTLED * largest {
            break;
        }
    }
    // At the maximum, the gain 2 bᵀδ − δᵀIδ is bᵀδ.
    let gain: f64 = score.iter().zip(signs).zip(&*losses).map(|((b, sign), loss)| b * sign * loss).sum();
    gain.max(0.0).sqrt()
}

/// Onset and size of a change.
#[derive(Debug, Clone, PartialEq)]
pub struct Change {
    /// Index of the first changed innovation: the most probable one, and the 5 % and 95 % quantiles.
    pub onset: usize,
    /// 5 % and 95 % quantiles of the index.
    pub onset_interval: [usize; 2],
    /// Loss of each quantity, standardised and positive towards damage: mean and standard deviation, `[d]`; `None` for one that the
    /// innovations do not inform.
    pub losses: Vec<Option<(f64, f64)>>,
}

/// Onset and size of a change in some successive innovations: in quantity `only`, or in all of them.
///
/// ```text
///  p(τ) ∝ exp(½ z_τ²) / √det I_τ,    δ | τ ~ N(I⁻¹ b, I⁻¹)
/// ```
///
/// The prior is uniform over the onsets. `None` without innovations that inform it.
pub fn change(
    innovations: &[Innovation],
    contributions: &DMatrix<f64>,
    signs: &[f64],
    only: Option<usize>,
) -> Option<Change> {
    let d = signs.len();
    let onset = |first: usize| {
        let found = score(&innovations[first..], contributions);
        let sought =
            |k: &usize| only.is_none_or(|only| only == *k) && signs[*k] != 0.0 && found.information[(*k, *k)] > 0.0;
        let places: Vec<usize> = (0..d).filter(sought).collect();
        let information = found.information.select_rows(&places).select_columns(&places);
        let score = found.score.select_rows(&places);
        let factored = information.clone().cholesky().filter(|_| !places.is_empty())?;
        let log_det = 2.0 * factored.l_dirty().diagonal().iter().map(|l| l.ln()).sum::<f64>();
        let own: Vec<f64> = places.iter().map(|k| signs[*k]).collect();
        let mut losses = vec![0.0; own.len()];
        let z = of_several(score.as_slice(), information.as_slice(), &own, &mut losses);
        Some((0.5 * z * z - 0.5 * log_det, places, losses, factored.inverse()))
    };
    let found: Vec<_> = (0..innovations.len()).filter_map(|first| Some((first, onset(first)?))).collect();
    let largest = found.iter().map(|(_, o)| o.0).fold(f64::NEG_INFINITY, f64::max);
    let total: f64 = found.iter().map(|(_, o)| (o.0 - largest).exp()).sum();
    let weights: Vec<f64> = found.iter().map(|(_, o)| (o.0 - largest).exp() / total).collect();
    let best = found.iter().max_by(|a, b| a.1 .0.total_cmp(&b.1 .0))?.0;
    let quantile = |level: f64| {
        let mut sum = 0.0;
        let at = weights.iter().position(|weight| {
            sum += weight;
            sum >= level
        });
        found[at.unwrap_or(found.len() - 1)].0
    };
    let loss = |k: usize| {
        let (mut weight, mut mean, mut square) = (0.0, 0.0, 0.0);
        for (own, (_, (_, places, losses, covariance))) in weights.iter().zip(&found) {
            let Some(place) = places.iter().position(|p| *p == k) else { continue };
            weight += own;
            mean += own * losses[place];
            square += own * (losses[place].powi(2) + covariance[(place, place)]);
        }
        let mean = mean / weight;
        (weight > 0.5).then(|| (mean, (square / weight - mean * mean).max(0.0).sqrt()))
    };
    Some(Change { onset: best, onset_interval: [quantile(0.05), quantile(0.95)], losses: (0..d).map(loss).collect() })
}
