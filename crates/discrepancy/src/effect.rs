//! Effects whose numbers are fitted to measurements: candidates, and the effects that the structure already has.

use std::sync::Arc;

use super::declared::WEIGHING_STD;
use super::mixture::Mixture;
use structures::physics::effect::Target;
use structures::simulator::effect::SimulationEffect;
use structures::simulator::law::{Input, Law, LawKind};

/// Smallest factor on a stiffness or mass in a fit.
const LEAST_FACTOR: f64 = 0.02;

/// One fitted number ψ of an effect, with its prior, truncated at the bounds:
///
/// ```text
///  ψ ~ N(mean, std²),    ln(1 + ψ) ~ N(mean, std²) of a factor 1 + ψ
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Number {
    /// Name, as in the report.
    pub name: String,
    /// Mean of the prior of ψ, or of ln(1 + ψ), where a fit starts unless it is given another value.
    pub prior_mean: f64,
    /// Standard deviation of the prior.
    pub prior_std: f64,
    /// Lower and upper bound of ψ.
    pub bounds: (f64, f64),
    /// Whether 1 + ψ is a factor with a log-normal prior: all masses by half is then as probable as all stiffnesses by two, which has the same
    /// frequencies.
    pub of_factor: bool,
}

impl Number {
    /// The number in standard deviations of its prior from its mean; its inverse is [`Self::at`].
    pub(super) fn score(&self, psi: f64) -> f64 {
        let value = if self.of_factor { psi.max(LEAST_FACTOR - 1.0).ln_1p() } else { psi };
        (value - self.prior_mean) / self.prior_std
    }

    /// The number ψ with a standard score of its prior.
    pub(super) fn at(&self, score: f64) -> f64 {
        let value = self.prior_mean + self.prior_std * score;
        if self.of_factor {
            value.exp_m1()
        } else {
            value
        }
    }

    /// Derivative of ψ by its standard score.
    pub(super) fn by_score(&self, psi: f64) -> f64 {
        self.prior_std * if self.of_factor { 1.0 + psi } else { 1.0 }
    }
}

/// An effect whose numbers ψ are unknowns of a fit: what changes, by which law, and the prior of ψ.
#[derive(Debug, Clone, PartialEq)]
pub struct FittedEffect {
    /// What changes.
    pub target: Target,
    /// By how much, and with which covariate.
    pub law: Law,
    /// The numbers ψ: those of the law, then the frequency of an oscillator; of a switched target those that it has besides the
    /// switch.
    pub numbers: Vec<Number>,
    /// For a deviation of all parts, the priors of its sizes that the evidence of a fit is the mean over; `None` for other effects.
    pub mixture: Option<Arc<Mixture>>,
    /// 90 % interval of the time of a step, in the unit of the time; `None` for other laws.
    pub onset90: Option<[f64; 2]>,
}

impl FittedEffect {
    /// An effect that the structure already has; its numbers and their covariance become the prior.
    pub fn known(effect: &SimulationEffect) -> Self {
        let mut names = effect.law.numbers();
        match effect.target {
            Target::Oscillator(_) => names.push("frequency_hz".to_owned()),
            Target::ModeOrder(_) => names.clear(),
            _ => {}
        }
        let number = |((name, mean), std): ((String, &f64), f64)| Number {
            name,
            prior_mean: *mean,
            // A prior of width zero would make the information matrix infinite.
            prior_std: std.max(1e-6 * mean.abs()).max(1e-12),
            bounds: (f64::NEG_INFINITY, f64::INFINITY),
            of_factor: false,
        };
        let numbers = names.into_iter().zip(&effect.psi).zip(effect.psi_std()).map(number).collect();
        Self { target: effect.target.clone(), law: effect.law.clone(), numbers, mixture: None, onset90: None }
    }

    /// A known mass that was hung at a degree of freedom in some rows; `column` holds its kg in each row.
    ///
    /// The effect is kg·s, where the factor s is 1 within the error of a weighing.
    pub fn hung(dof: usize, column: &str) -> Self {
        let law = Law {
            kind: LawKind::Linear,
            covariate: Some(column.to_owned()),
            reference: 0.0,
            with_level: false,
            levels: Vec::new(),
        };
        let name = "slope_per_unit".to_owned();
        let number = Number { name, prior_mean: 1.0, prior_std: WEIGHING_STD, bounds: (0.9, 1.1), of_factor: false };
        Self { target: Target::AddedMass(dof), law, numbers: vec![number], mixture: None, onset90: None }
    }

    /// Index of the lag among the numbers, if the law has one.
    pub fn lag(&self) -> Option<usize> {
        (self.law.kind == LawKind::Lagged).then(|| self.numbers.len() - 1)
    }

    /// Writes the sizes of the effect at one input, `[target.sizes()]`, and the derivative of the moved size by each number,
    /// `[ψ]`. Units are those of the target.
    pub fn sizes(&self, input: Input, psi: &[f64], sizes: &mut [f64], slopes: &mut [f64]) {
        match self.target {
            Target::ModeOrder(_) => {}
            Target::Oscillator(_) | Target::ModeGain { .. } | Target::Everywhere(_) => {
                sizes.copy_from_slice(psi);
                slopes.fill(1.0);
            }
            _ if self.target.is_switch() => {
                sizes[0] = f64::from(u8::from(self.law.acts(input)));
                sizes[1..].copy_from_slice(psi);
                slopes.fill(1.0);
            }
            _ => sizes[0] = self.law.size(input, psi, slopes),
        }
    }

    /// Index of the size that a number moves.
    pub(super) fn moved(&self, number: usize) -> usize {
        match self.target {
            Target::Oscillator(_) | Target::ModeGain { .. } | Target::Everywhere(_) => number,
            _ if self.target.is_switch() => number + 1,
            _ => 0,
        }
    }
}

/// Whether an effect of size g on this target multiplies something by 1 + g.
pub(super) fn is_factor(target: &Target) -> bool {
    matches!(target, Target::Springs(_) | Target::Masses(_) | Target::ParameterScale(_) | Target::FrequencyScale(_))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_and_its_score_are_inverse_and_its_derivative_is_a_difference() {
        for of_factor in [false, true] {
            let (prior_mean, prior_std, bounds) = (0.02, 0.1, (f64::NEG_INFINITY, f64::INFINITY));
            let number = Number { name: String::new(), prior_mean, prior_std, bounds, of_factor };
            for psi in [-0.6, -0.05, 0.0, 0.4, 3.0] {
                let score = number.score(psi);
                assert!((number.at(score) - psi).abs() < 1e-12, "{psi}");
                let difference = (number.at(score + 1e-5) - number.at(score - 1e-5)) / 2e-5;
                assert!((number.by_score(psi) - difference).abs() < 1e-8, "{psi}");
            }
        }
    }
}
