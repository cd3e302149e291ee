//! Effects whose numbers are fitted to measurements: candidates, and the effects that the structure already has.

use std::sync::Arc;

use super::declared::WEIGHING_STD;
use super::mixture::Mixture;
use structures::physics::effect::Target;
use structures::simulator::effect::SimulationEffect;
use structures::simulator::law::{Input, Law, LawKind};

/// One fitted number of an effect. Its prior is normal, truncated at the bounds.
#[derive(Debug, Clone, PartialEq)]
pub struct Number {
    /// Name, as in the report.
    pub name: String,
    /// Mean of the prior, where a fit starts unless it is given another value.
    pub prior_mean: f64,
    /// Standard deviation of the prior.
    pub prior_std: f64,
    /// Lower and upper bound.
    pub bounds: (f64, f64),
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
        };
        let numbers = names.into_iter().zip(&effect.psi).zip(effect.psi_std()).map(number).collect();
        Self { target: effect.target.clone(), law: effect.law.clone(), numbers, mixture: None }
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
        let number = Number { name, prior_mean: 1.0, prior_std: WEIGHING_STD, bounds: (0.9, 1.1) };
        Self { target: Target::AddedMass(dof), law, numbers: vec![number], mixture: None }
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

    /// Whether the effect multiplies something by 1 + g.
    pub(super) fn is_factor(&self) -> bool {
        matches!(
            self.target,
            Target::Springs(_) | Target::Masses(_) | Target::ParameterScale(_) | Target::FrequencyScale(_)
        )
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
