//! Which quantities have changed, and by how much: one posterior over all sets of them.
//!
//! The errors of a batch are correlated, so that a loss of one quantity alone would explain a part of what the loss of another one
//! does. Each set S of quantities is therefore a hypothesis of its own, with the changes of its members and small ones of the others,
//! which leave room for what the process and the estimates of batches get wrong:
//!
//! ```text
//!  p(S) ∝ 2^(−|S|)/C(d, |S|),    δ ~ N(0, W_S),    W_S = diag(w_k² for k in S, e_k² for the others)
//!  p(S | b, I) ∝ p(S) det(W_S A)^(−1/2) exp(½ bᵀA⁻¹b) Π_(k in S) 2(q Φ(l_k) + (1 − q) Φ(−l_k)),    A = I + W_S⁻¹
//! ```
//!
//! b, I: [`Score`] of a change; l_k: mean over standard deviation of the present loss of quantity k under N(A⁻¹b, A⁻¹); q: probability that
//! a change is a loss and no gain. A change is a step, or a step that goes on to grow, whose growth may have ended; the growths of the
//! members since the onset have the prior variance w_k², too, and those of the others none. The coordinates of a [misfit](super::misfit) are
//! one member of a set together.
//!
//! Source: E. I. George, R. E. McCulloch (1993), Variable selection via Gibbs sampling, J. American Statistical Association 88, 881–889,
//! for the two normal priors. Here the sets are enumerated.

use std::collections::BTreeSet;

use nalgebra::{DMatrix, DVector};

use super::direction::ChangeDirection;
use super::one_factor::{self, FactorPoint, OneFactor};
use super::score::Score;
use structures::stats;

/// Standard deviation w of the change of a quantity that has changed, as a share of its mean.
const WIDE: f64 = 0.3;

/// Standard deviation e of the change of another one: a share of its mean, and of the largest change.
const SMALL: f64 = 0.001;
const SMALL_OF_LARGEST: f64 = 0.02;

/// The same of a coordinate of the misfit: 2 % of a frequency; 0.015 % of it, and 0.75 % of the largest change of a quantity.
const WIDE_MISFIT: f64 = 0.04;
const SMALL_MISFIT: f64 = 0.0003;
const SMALL_MISFIT_OF_LARGEST: f64 = 0.015;

/// A change is clear from this number of standard deviations on.
const CLEAR: f64 = 3.0;

/// Probability that a change grows after its onset, and that such a growth has ended.
const GROWTH: f64 = 0.3;
const ENDED: f64 = 0.3;

/// Probability q that a change is a loss.
const LOSS: f64 = 0.9;

/// Prior probability that all frequencies have changed by one factor.
const ALL_FREQUENCIES_SHARE: f64 = 0.03;

/// Sets that are extended by one further quantity, the most probable ones of each size.
const BEAM: usize = 8;

/// Largest number of quantities in a set.
const MOST: usize = 6;

/// Sets are not extended any further when those of the last size have less than this share of the posterior together.
const LEAST_SHARE: f64 = 1e-3;

/// What is known of changes before batches are looked at.
#[derive(Debug, Clone, PartialEq)]
pub struct ChangePrior {
    /// In which direction a change is looked for, `[d]`.
    pub directions: Vec<ChangeDirection>,
    /// The mean of each quantity, of which changes are shares, in standardised units, `[d]`; of a coordinate of the misfit, what changes a
    /// frequency by half of itself, as the loss of all stiffness would.
    pub sizes: Vec<f64>,
    /// What one factor of all frequencies does to the quantities, standardised; empty where it is not known.
    pub one_factor: Vec<FactorPoint>,
}

/// A set of quantities that may have changed, as a step or with growth.
#[derive(Debug, Clone)]
pub struct Hypothesis {
    /// The places of its members, ascending; empty where only all frequencies have changed.
    pub members: Vec<usize>,
    /// Mean and variance of ln factor, where all frequencies have changed by one.
    pub factor: Option<[f64; 2]>,
    /// Logarithm of prior times likelihood.
    pub log_weight: f64,
    /// Mean of the part of the change that the newest prediction contains, standardised, `[d]`.
    pub predicted: DVector<f64>,
    /// Mean of the present changes, standardised, `[d]`.
    pub mean: DVector<f64>,
    /// Their variances, `[d]`.
    pub variance: DVector<f64>,
}

/// The changes of all quantities as their posterior has them.
#[derive(Debug, Clone, PartialEq)]
pub struct Parts {
    /// Probability that the quantity is among those that have changed, `[d]`.
    pub probability: Vec<f64>,
    /// Mean and standard deviation of its change if it is, standardised, `[d]`; `None` for one that is in no set.
    pub change: Vec<Option<(f64, f64)>>,
    /// Probability that all frequencies have changed by one factor, and mean and standard deviation of its logarithm; `None` where this is not
    /// among the hypotheses.
    pub factor: Option<[f64; 3]>,
    /// Mean over all sets of the part of the change that the newest prediction contains, standardised, `[d]`.
    pub predicted: DVector<f64>,
}

impl ChangePrior {
    /// The hypothesis that all informed quantities have changed and go on to grow: how well a change with this score explains the batches at
    /// best. `None` if nothing is informed.
    pub fn widest(&self, score: &Score) -> Option<Hypothesis> {
        let informed = self.informed(score);
        let of = informed.len();
        (of > 0).then(|| self.hypothesis(informed.concat(), of, score, 0.0, can_grow(score)))?
    }

    /// Whether [`Self::widest`], of this weight, explains the batches better than a step of all informed quantities.
    pub fn grows(&self, score: &Score, widest: f64) -> bool {
        let informed = self.informed(score);
        let step = self.hypothesis(informed.concat(), informed.len(), score, 0.0, false);
        can_grow(score) && step.is_some_and(|step| widest > step.log_weight)
    }

    /// The hypotheses about a change with this score. Empty if nothing is informed.
    pub fn hypotheses(&self, score: &Score) -> Vec<Hypothesis> {
        let Some(widest) = self.widest(score) else { return Vec::new() };
        // The largest change that is clear.
        let clear = |k: &usize| widest.mean[*k].abs() > CLEAR * widest.variance[*k].sqrt();
        let share = |k: usize| (widest.mean[k] / self.sizes[k]).abs();
        let largest = (0..self.sizes.len()).filter(clear).map(share).fold(0.0, f64::max).min(1.0);
        let informed = self.informed(score);
        // A growth that has ended is a course of its own.
        let courses: &[bool] = match (can_grow(score), score.growth_ends) {
            (false, _) => &[false],
            (true, None) => &[false, true],
            (true, Some(_)) => &[true],
        };
        let mut all: Vec<Hypothesis> = Vec::new();
        let mut last: Vec<Vec<usize>> = vec![Vec::new()];
        for size in 1..=MOST.min(informed.len()) {
            let mut sets: BTreeSet<Vec<usize>> = BTreeSet::new();
            for own in &last {
                for part in informed.iter().filter(|part| !own.contains(&part[0])) {
                    let mut set = [own.as_slice(), part].concat();
                    set.sort_unstable();
                    sets.insert(set);
                }
            }
            let of = informed.len();
            let of_set = |set: Vec<usize>| {
                courses.iter().filter_map(move |grows| self.hypothesis(set.clone(), of, score, largest, *grows))
            };
            let mut own: Vec<Hypothesis> = sets.into_iter().flat_map(of_set).collect();
            own.sort_by(|a, b| b.log_weight.total_cmp(&a.log_weight));
            last.clear();
            for hypothesis in &own {
                if last.len() < BEAM && !last.contains(&hypothesis.members) {
                    last.push(hypothesis.members.clone());
                }
            }
            all.append(&mut own);
            let weights = shares(&all);
            let of_size: f64 =
                all.iter().zip(&weights).filter(|(h, _)| self.parts(&h.members) == size).map(|(_, w)| w).sum();
            if of_size < LEAST_SHARE {
                break;
            }
        }
        all.extend(self.of_all_frequencies(&informed, score, largest));
        all
    }

    /// The hypotheses that all frequencies have changed by one factor, alone or with one of the informed quantities. `largest`
    /// as in [`Self::hypothesis`].
    fn of_all_frequencies(&self, informed: &[Vec<usize>], score: &Score, largest: f64) -> Vec<Hypothesis> {
        let of_set = |members: &[usize]| {
            let variance = |k: usize, _: usize| (self.share(k, members, largest) * self.sizes[k]).powi(2);
            let variances = DVector::from_fn(self.sizes.len(), variance);
            let OneFactor { ln_factor, log_evidence, change, mean, variance } =
                one_factor::hypothesis(&self.one_factor, score, &variances)?;
            let directed: f64 = members.iter().map(|k| self.directed(*k, &mean, &variance)).sum();
            let beside = if members.is_empty() { 0.0 } else { directed - (2.0 * informed.len() as f64).ln() };
            Some(Hypothesis {
                members: members.to_vec(),
                factor: Some(ln_factor),
                log_weight: ALL_FREQUENCIES_SHARE.ln() + log_evidence + beside,
                predicted: &score.predicted * change.resize_vertically(score.score.len(), 0.0),
                mean,
                variance,
            })
        };
        std::iter::once(&[][..]).chain(informed.iter().map(Vec::as_slice)).filter_map(of_set).collect()
    }

    /// Logarithm of the odds that a quantity which has changed has this change and not one in the opposite direction, 0 without a damage
    /// direction.
    fn directed(&self, k: usize, mean: &DVector<f64>, variance: &DVector<f64>) -> f64 {
        if !self.directions[k].is_damage() {
            return 0.0;
        }
        let loss = stats::normal_cdf(self.directions[k].sign() * mean[k] / variance[k].sqrt());
        (2.0 * (LOSS * loss + (1.0 - LOSS) * (1.0 - loss))).ln()
    }

    /// What can be a member of a set: each informed quantity, and the coordinates of the misfit together, as their places.
    fn informed(&self, score: &Score) -> Vec<Vec<usize>> {
        let informed = (0..self.sizes.len()).filter(|k| score.information[(*k, *k)] > 0.0);
        let (misfit, single): (Vec<usize>, Vec<usize>) = informed.partition(|k| self.is_of_misfit(*k));
        let single = single.into_iter().map(|k| vec![k]);
        single.chain((!misfit.is_empty()).then_some(misfit)).collect()
    }

    /// Standard deviation of the change of quantity k as a share of its size, where some have changed by `largest`.
    fn share(&self, k: usize, members: &[usize], largest: f64) -> f64 {
        match (members.contains(&k), self.is_of_misfit(k)) {
            (true, false) => WIDE,
            (true, true) => WIDE_MISFIT,
            (false, false) => SMALL + SMALL_OF_LARGEST * largest,
            (false, true) => SMALL_MISFIT + SMALL_MISFIT_OF_LARGEST * largest,
        }
    }

    /// Whether quantity k is a coordinate of the misfit.
    pub fn is_of_misfit(&self, k: usize) -> bool {
        self.directions[k] == ChangeDirection::Either
    }

    /// Number of members of a set of places, the coordinates of the misfit as one.
    fn parts(&self, places: &[usize]) -> usize {
        let misfit = places.iter().filter(|k| self.is_of_misfit(**k)).count();
        places.len() - misfit.saturating_sub(1)
    }

    /// `of`: number of possible members; `largest`: the largest change, as a share of its mean.
    fn hypothesis(
        &self,
        members: Vec<usize>,
        of: usize,
        score: &Score,
        largest: f64,
        grows: bool,
    ) -> Option<Hypothesis> {
        let d = self.sizes.len();
        let grown = score.grown()?;
        // The coefficients that are not 0: all steps, and the growths of the members.
        let mut places: Vec<usize> = (0..d).collect();
        if grows {
            places.extend(members.iter().map(|k| d + k));
        }
        let prior = |place: &usize| {
            let of_step = self.share(place % d, &members, largest) * self.sizes[place % d];
            (if *place < d { of_step } else { of_step / grown }).powi(2)
        };
        let prior = DVector::from_iterator(places.len(), places.iter().map(prior));
        let own = score.information.select_rows(&places).select_columns(&places);
        let given = score.score.select_rows(&places);
        let factored = (own + DMatrix::from_diagonal(&prior.map(f64::recip))).cholesky()?;
        let solved = factored.solve(&given);
        let log_det: f64 = factored.l_dirty().diagonal().iter().map(|l| 2.0 * l.ln()).sum();
        let covariance = factored.inverse();
        let mut coefficients = DVector::zeros(score.score.len());
        places.iter().zip(solved.iter()).for_each(|(place, value)| coefficients[*place] = *value);
        let mut mean: DVector<f64> = solved.rows(0, d).into_owned();
        let mut variance: DVector<f64> = covariance.diagonal().rows(0, d).into_owned();
        if grows {
            for (i, k) in members.iter().enumerate() {
                mean[*k] += grown * solved[d + i];
                variance[*k] += grown * (2.0 * covariance[(*k, d + i)] + grown * covariance[(d + i, d + i)]);
            }
        }
        let directed: f64 = members.iter().map(|k| self.directed(*k, &mean, &variance)).sum();
        let parts = self.parts(&members);
        let sets: f64 = (0..parts).map(|i| ((of - i) as f64 / (i + 1) as f64).ln()).sum();
        let course = match (grows, score.growth_ends) {
            (false, _) => 1.0 - GROWTH,
            (true, None) => GROWTH * (1.0 - ENDED),
            (true, Some(_)) => GROWTH * ENDED,
        };
        let log_prior = course.ln() - parts as f64 * std::f64::consts::LN_2 - sets;
        let log_evidence = 0.5 * (given.dot(&solved) - log_det - prior.iter().map(|w| w.ln()).sum::<f64>());
        let log_weight = log_prior + log_evidence + directed;
        let predicted = &score.predicted * coefficients;
        Some(Hypothesis { members, factor: None, log_weight, predicted, mean, variance })
    }
}

impl Parts {
    /// The posterior of some hypotheses, which may be about several onsets.
    pub fn of<'h>(hypotheses: impl Iterator<Item = &'h Hypothesis>) -> Option<Self> {
        let all: Vec<&Hypothesis> = hypotheses.collect();
        let first = all.first()?;
        let d = first.mean.len();
        let weights = shares(all.iter().copied());
        let mut predicted = DVector::zeros(d);
        let (mut probability, mut change) = (Vec::with_capacity(d), Vec::with_capacity(d));
        for (own, weight) in all.iter().zip(&weights) {
            predicted += *weight * &own.predicted;
        }
        for k in 0..d {
            let with = all.iter().zip(&weights).filter(|(own, _)| own.members.contains(&k));
            let mixed = mixed(with.map(|(own, weight)| (*weight, [own.mean[k], own.variance[k]])));
            probability.push(mixed.map_or(0.0, |[total, ..]| total));
            change.push(mixed.map(|[_, mean, std]| (mean, std)));
        }
        let factor = mixed(all.iter().zip(&weights).filter_map(|(own, weight)| Some((*weight, own.factor?))));
        Some(Self { probability, change, factor, predicted })
    }
}

/// Total weight, mean and standard deviation of a mixture of some weights, means and variances; `None` if the total is 0.
fn mixed(parts: impl Iterator<Item = (f64, [f64; 2])>) -> Option<[f64; 3]> {
    let (mut total, mut first, mut second) = (0.0, 0.0, 0.0);
    for (weight, [mean, variance]) in parts {
        total += weight;
        first += weight * mean;
        second += weight * (mean.powi(2) + variance);
    }
    let mean = first / total;
    (total > 0.0).then(|| [total, mean, (second / total - mean * mean).max(0.0).sqrt()])
}

/// Whether growth shows in a score: it has coefficients for it, and time has passed.
fn can_grow(score: &Score) -> bool {
    score.score.len() > score.predicted.nrows() && score.grown().is_some_and(|grown| grown > 0.0)
}

/// The share of each hypothesis in the posterior; empty if there is none.
pub fn shares<'h>(hypotheses: impl IntoIterator<Item = &'h Hypothesis>) -> Vec<f64> {
    let logs: Vec<f64> = hypotheses.into_iter().map(|hypothesis| hypothesis.log_weight).collect();
    let weights = stats::weights(&logs, 0.0).unwrap_or_default();
    let total: f64 = weights.iter().sum();
    weights.into_iter().map(|weight| weight / total).collect()
}
