//! Modes that scatter more than their noise and the spread of the parameters explain.

use serde::{Deserialize, Serialize};

use super::data::Data;
use super::fit::{Fit, Start};
use super::notes::any_noisy_shape;
use super::study::Study;
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

/// How much the modes scatter.
pub(super) struct Scatter {
    /// The modes that scatter more than stated.
    pub(super) excess: Vec<ExcessScatter>,
    /// The fit whose noise factors are those of the differences between rows; `None` if no noise factor of the fit itself is large.
    pub(super) of_differences: Option<Fit>,
}

/// How much the modes scatter in the rows with the indices `rows`. Noise factors of a fit are large also where the mean of a mode is off;
/// those of the differences between rows are never larger.
pub(super) fn scatter(study: &Study<'_>, rows: &[usize], fit: &Fit) -> Scatter {
    let measured = |mode: usize| rows.iter().any(|row| study.data.log_frequencies[*row][mode].is_finite());
    let seems_noisy = !excess_scatter(fit, measured).is_empty() || any_noisy_shape(fit);
    let of_differences = seems_noisy.then(|| fit_of_differences(study, rows, fit)).flatten();
    Scatter { excess: excess_scatter(of_differences.as_ref().unwrap_or(fit), measured), of_differences }
}

/// The fit with the same effects to the rows with the indices `rows`, of which the mean residual of each output is taken away first, so that
/// its noise factors are those of the differences between rows. A mode whose frequency the simulation has wrong in all rows alike does not
/// scatter. `None` if the frequencies cannot be computed in some row.
fn fit_of_differences(study: &Study<'_>, rows: &[usize], fit: &Fit) -> Option<Fit> {
    let mut sums = vec![(0.0, 0.0); study.outputs()];
    for view in study.view(rows, fit)? {
        for (output, residual) in view.present.iter().zip(view.residual.iter()) {
            let (sum, weight) = &mut sums[*output];
            *sum += view.weight * residual;
            *weight += view.weight;
        }
    }
    let means: Vec<f64> = sums.iter().map(|(sum, weight)| if *weight > 0.0 { sum / weight } else { 0.0 }).collect();
    let (of_frequencies, of_shapes) = means.split_at(study.simulator.modes());
    let mut data: Data = study.data.clone();
    let take =
        |values: &mut [f64], means: &[f64]| values.iter_mut().zip(means).for_each(|(value, mean)| *value -= mean);
    for row in &mut data.log_frequencies {
        take(row, of_frequencies);
    }
    for row in data.shapes.iter_mut().flat_map(|shapes| &mut shapes.coordinates) {
        take(row, of_shapes);
    }
    Study::new(study.simulator, &data).fit(rows, &fit.effects, Some(&Start::at(fit)))
}

/// The modes whose noise factor s, of the differences between rows, exceeds 1.25 with a probability above 99 %, given its normal posterior
/// in ln s. Modes that were never measured in `measured` are left out.
fn excess_scatter(of_differences: &Fit, measured: impl Fn(usize) -> bool) -> Vec<ExcessScatter> {
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
    of_differences.noise_factor.iter().zip(&of_differences.noise_factor_ln_std).enumerate().filter_map(one).collect()
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
