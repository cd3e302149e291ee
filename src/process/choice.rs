//! Whether the misfits of the modes help to predict the parameters.
//!
//! More modes than parameters leave misfits m beside the parameters x. Where the simulation is exact, they are noise. Where it is an
//! approximation, they move with the same weather as the parameters, and then they show which part of a change is weather: the
//! coordinates of the process are then the frequencies of all modes, which contain both. That is only worth something if the relation
//! lasts: a relation of one winter that no longer holds in spring looks like damage. The reference itself is asked:
//!
//! ```text
//!  gain of a block = ln p(x, m | x, m before) − ln p(x | x before) − ln p(m | m before)
//! ```
//!
//! Each density is that of a process fitted to the batches before the block. The misfits help if each of the [`BLOCKS`] blocks of the
//! later half of the reference gains more than [`LEAST_GAIN`].

use std::sync::atomic::AtomicUsize;

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use rayon::prelude::*;

use super::estimate::{BatchEstimate, Observation, Scale};
use super::filter::Filter;
use super::model::{Numbers, Process, Sizes};
use super::search::{most_probable, Watch};
use super::smoother::log_likelihood;
use crate::stats;

/// Blocks of the later half of a reference that are predicted from what is before them.
const BLOCKS: usize = 3;

/// Least gain of a block, nats: without a relation the gains scatter about 0 by some tenths.
const LEAST_GAIN: f64 = 1.0;

/// Most modes: the search takes time with about the third power of their number.
const MOST_MODES: usize = 12;

/// Fewest batches before the first block.
const FEWEST_BEFORE: usize = 20;

/// Standard deviation that stands for a mode that was not measured, of ln f. It is wide beside any season.
const NOT_MEASURED: f64 = 0.1;

/// Eigenvalues of effects below this share of the largest are 0: a quantity has no effect of its own on the modes.
const NO_EFFECT: f64 = 1e-9;

/// ln f of the batches in some linear combinations: means, `[batches]` of `[combinations]`, and covariances of their errors.
struct Combined {
    means: Vec<DVector<f64>>,
    covariances: Vec<DMatrix<f64>>,
}

/// Whether the misfits of the modes help to predict the parameters in each later block of a reference. `effects`: ∂ ln f/∂quantity,
/// `[modes, quantities]`.
pub(super) fn misfits_help(
    process: &Process,
    effects: &DMatrix<f64>,
    estimates: &[BatchEstimate],
    evaluations: &AtomicUsize,
    watch: Watch<'_>,
) -> bool {
    let (modes, d) = effects.shape();
    let half = estimates.len() / 2;
    if modes <= d || modes > MOST_MODES || half < FEWEST_BEFORE || estimates.iter().any(|e| e.frequencies.is_none()) {
        return false;
    }
    let Some((parameters, misfits)) = combinations(effects) else { return false };
    let all = DMatrix::from_fn(modes, modes, |i, j| if i < d { parameters[(i, j)] } else { misfits[(i - d, j)] });
    let steps: Vec<f64> = steps(process, estimates);
    let covariates: Vec<DVector<f64>> = estimates.iter().map(|e| process.observation(e, None).covariates).collect();
    let series = [all, parameters, misfits].map(|matrix| combined(&matrix, estimates));
    let gain = |block: usize| -> Option<f64> {
        let [first, end] = [block, block + 1].map(|end| half + (estimates.len() - half) * end / BLOCKS);
        let density = |combined: &Combined| {
            let covariates = (process.covariates.len(), &covariates[..]);
            predicted(combined, (&steps[..], covariates), [first, end], evaluations, watch)
        };
        let found: Vec<Option<f64>> = series.par_iter().map(density).collect();
        Some(found[0]? - found[1]? - found[2]?)
    };
    (0..BLOCKS).into_par_iter().all(|block| gain(block).is_some_and(|gain| gain > LEAST_GAIN))
}

/// The parameters by least squares, `[d, modes]`, and an orthonormal basis of what no parameter does, `[modes − d, modes]`; `None` if the
/// modes do not determine the parameters.
fn combinations(effects: &DMatrix<f64>) -> Option<(DMatrix<f64>, DMatrix<f64>)> {
    let (modes, d) = effects.shape();
    // Columns of equal length, so that the units of the parameters do not matter.
    let mut scaled = effects.clone();
    let lengths: Vec<f64> = effects.column_iter().map(|column| column.norm()).collect();
    if lengths.contains(&0.0) {
        return None;
    }
    for (mut column, length) in scaled.column_iter_mut().zip(&lengths) {
        column /= *length;
    }
    let eigen = SymmetricEigen::new(&scaled * scaled.transpose());
    let mut order: Vec<usize> = (0..modes).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    let determined = eigen.eigenvalues[order[d - 1]] > NO_EFFECT * eigen.eigenvalues[order[0]];
    let misfits = DMatrix::from_fn(modes - d, modes, |i, j| eigen.eigenvectors[(j, order[d + i])]);
    let parameters = effects.tr_mul(effects).cholesky()?.solve(&effects.transpose());
    determined.then_some((parameters, misfits))
}

/// Time between batches in steps of the process; 0 before the first.
fn steps(process: &Process, estimates: &[BatchEstimate]) -> Vec<f64> {
    let before = std::iter::once(None).chain(estimates.iter().map(|e| Some(e.at)));
    estimates.iter().zip(before).map(|(estimate, before)| process.observation(estimate, before).steps).collect()
}

/// The frequencies of the batches in the combinations of the rows of a matrix, `[combinations, modes]`. A mode that was not measured has
/// its mean over the batches and the error [`NOT_MEASURED`].
fn combined(matrix: &DMatrix<f64>, estimates: &[BatchEstimate]) -> Combined {
    let modes = matrix.ncols();
    let ratio = |e: &BatchEstimate, mode: usize| e.frequencies.as_ref().and_then(|f| f.ln_ratio[mode]);
    let usual = |mode: usize| stats::mean(&estimates.iter().filter_map(|e| ratio(e, mode)).collect::<Vec<_>>());
    let usual: Vec<f64> = (0..modes).map(usual).collect();
    let variance = |e: &BatchEstimate, mode: usize| match (&e.frequencies, ratio(e, mode)) {
        (Some(frequencies), Some(_)) => frequencies.variance[mode],
        _ => NOT_MEASURED.powi(2),
    };
    let mean = |e: &BatchEstimate| {
        matrix * DVector::from_fn(modes, |mode, _| ratio(e, mode).map_or(0.0, |ratio| ratio - usual[mode]))
    };
    let covariance = |e: &BatchEstimate| {
        matrix * DMatrix::from_diagonal(&DVector::from_fn(modes, |mode, _| variance(e, mode))) * matrix.transpose()
    };
    Combined { means: estimates.iter().map(mean).collect(), covariances: estimates.iter().map(covariance).collect() }
}

/// ln of the density of the batches from `first` to before `end`, nats, predicted from those before `first` by the process that is most
/// probable for them; `None` if it cannot be computed.
fn predicted(
    combined: &Combined,
    (steps, (m, covariates)): (&[f64], (usize, &[DVector<f64>])),
    [first, end]: [usize; 2],
    evaluations: &AtomicUsize,
    watch: Watch<'_>,
) -> Option<f64> {
    let d = combined.means[0].len();
    let scale = |k: usize| {
        let known: Vec<f64> = combined.means[..first].iter().map(|mean| mean[k]).collect();
        Scale::of(&known, 1e-9)
    };
    let scales: Vec<Scale> = (0..d).map(scale).collect();
    let observation = |t: usize| Observation {
        steps: steps[t],
        informed: (0..d).collect(),
        quantities: (0..d).collect(),
        mean: DVector::from_fn(d, |k, _| scales[k].standardised(combined.means[t][k])),
        covariance: DMatrix::from_fn(d, d, |i, j| combined.covariances[t][(i, j)] / (scales[i].unit * scales[j].unit)),
        covariates: covariates[t].clone(),
    };
    let observations: Vec<Observation> = (0..end).map(observation).collect();
    let sizes = Sizes { quantities: d, covariates: m, factors: 0 };
    let best = most_probable(sizes, &observations[..first], evaluations, watch).ok()?;
    let filter = Filter::exact(Numbers::of(&best.unknowns, Sizes { factors: best.factors, ..sizes }));
    let density = log_likelihood(&filter, &observations)? - log_likelihood(&filter, &observations[..first])?;
    let units: f64 = scales.iter().map(|scale| scale.unit.ln()).sum();
    Some(density - (end - first) as f64 * units)
}
