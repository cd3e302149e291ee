//! Modes that scatter more than their noise and the spread of the parameters explain.

use serde::{Deserialize, Serialize};

use super::fit::Fit;
use structures::stats;

/// Factor by which the stated noise may be too small without being reported: a stated noise is seldom known better.
const STATED: f64 = 1.25;

/// One-sided level of the limit.
const LEVEL: f64 = 0.99;

/// A mode that scatters more than stated, beyond the scatter that the spread of the parameters explains.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ExcessScatter {
    /// The mode, from 1.
    pub mode: usize,
    /// Its scatter as a factor on the stated noise.
    pub factor: f64,
    /// 90 % interval of the factor.
    pub interval90: [f64; 2],
}

/// The modes whose noise factor s exceeds 1.25 with a probability above 99 %, given its normal posterior in ln s. Modes that were
/// never measured in `measured` are left out.
pub(super) fn excess_scatter(fit: &Fit, measured: impl Fn(usize) -> bool) -> Vec<ExcessScatter> {
    let one = |(mode, (factor, std)): (usize, (&f64, &f64))| {
        let at = |z: f64| factor * (z * std).exp();
        let limit = at(-stats::normal_quantile(LEVEL));
        let z90 = stats::normal_quantile(0.95);
        (measured(mode) && limit > STATED).then(|| ExcessScatter {
            mode: mode + 1,
            factor: *factor,
            interval90: [at(-z90), at(z90)],
        })
    };
    fit.noise_factor.iter().zip(&fit.noise_factor_ln_std).enumerate().filter_map(one).collect()
}

impl ExcessScatter {
    /// The finding as a sentence without capital and full stop.
    pub fn sentence(&self) -> String {
        format!(
            "mode {} scatters {:.1} times ({:.1} to {:.1}) as much as its stated noise, beyond the scatter that the spread of the \
             parameters explains",
            self.mode, self.factor, self.interval90[0], self.interval90[1]
        )
    }
}
