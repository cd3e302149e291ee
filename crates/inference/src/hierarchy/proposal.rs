//! Importance proposals for the parameters of each measurement, from its posterior and the population together.

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rayon::prelude::*;

use super::populations::Populations;
use super::problem::{unit_columns, within, WIDEST};
use super::widths::Widths;
use crate::posterior::PosteriorSamples;
use structures::parameter::ParameterSpace;
use structures::stats::{self, NormalQuantiles};

/// Widths of the components of the proposal mixture, and the component of each of eight consecutive proposals.
const WIDTHS: [f64; 3] = [1.0, 1.6, 3.0];
const TURNS: [usize; 8] = [0, 1, 0, 1, 0, 1, 0, 2];

/// Draws importance proposals for noise-dominated batches, where few samples of a posterior have a significant weight under
/// the population. The proposal density is the product of the posterior and the population in normal approximation,
/// widened. Returns the proposals, `[n·draws, d]` in parameter units, and the logarithms of their densities in the unit box,
/// nats, `[n·draws]`.
///
/// ```text
///  r_j = Σ_w share_w N(x; c_j, w² C_j),    C_j = (V_j⁻¹ + Σ⁻¹)⁻¹,    c_j = C_j (V_j⁻¹ m_j + Σ⁻¹ μ)
/// ```
///
/// m_j, V_j: moments of the posterior samples of measurement j; μ, Σ: the population estimated from them (`found`), with a
/// standard deviation of at least half that of one posterior. The points form a scrambled Sobol' sequence for each
/// measurement and take the widths in turn: they integrate as accurately as several times as many random points.
///
/// Source: A. Owen, Y. Zhou (2000), Safe and effective importance sampling, JASA 95, 135–143.
pub fn proposals(
    samples: &PosteriorSamples,
    found: &Populations,
    space: &ParameterSpace,
    draws: usize,
    seed: u64,
) -> (PosteriorSamples, Vec<f64>) {
    let (d, parameters) = (space.len(), space.as_slice());
    let width = |k: usize| parameters[k].upper - parameters[k].lower;
    let within = within(&unit_columns(samples, space), samples.draws());
    let mean = DVector::from_fn(d, |k, _| parameters[k].to_unit(found.parameters[k].mean));
    // A first estimate near zero must not prevent the proposals from reaching larger values.
    let std = |k: usize| (found.parameters[k].std.unwrap_or(WIDEST) / width(k)).max(0.5 * within[k]).max(1e-6);
    let correlation = |i: usize, j: usize| match &found.correlations {
        Some(correlations) => correlations.point(i, j),
        None => f64::from(u8::from(i == j)),
    };
    let covariance = DMatrix::from_fn(d, d, |i, j| std(i) * std(j) * correlation(i, j));
    let apart = || DMatrix::from_fn(d, d, |i, j| if i == j { std(i).powi(-2) } else { 0.0 });
    let precision = covariance.cholesky().map_or_else(apart, |c| c.inverse());
    let widths = Widths::new(WIDTHS, TURNS, draws, d);
    let quantiles = NormalQuantiles::shared();
    let of_one = |(measurement, scrambling): (usize, u32)| {
        let rows = measurement * samples.draws()..(measurement + 1) * samples.draws();
        let unit = |row: usize, k: usize| parameters[k].to_unit(samples.theta()[(row, k)]);
        let count = samples.draws() as f64;
        let centre = DVector::from_fn(d, |k, _| rows.clone().map(|row| unit(row, k)).sum::<f64>() / count);
        let deviations = DMatrix::from_fn(d, samples.draws(), |k, draw| unit(rows.start + draw, k) - centre[k]);
        let covariance = DMatrix::identity(d, d) * 1e-12 + &deviations * deviations.transpose() / count;
        let own = covariance.cholesky().map_or_else(|| DMatrix::identity(d, d) * 12.0, |c| c.inverse());
        let together = (&own + &precision).cholesky().expect("a sum of positive definite matrices is one");
        let (centre, covariance) = (together.solve(&(&own * &centre + &precision * &mean)), together.inverse());
        let factor = covariance.cholesky().expect("the inverse of a positive definite matrix is one").unpack();
        let log_volume: f64 = factor.diagonal().iter().map(|x| x.ln()).sum();
        let (mut points, mut log_density) = (Vec::with_capacity(draws * d), Vec::with_capacity(draws));
        let mut stretched = vec![0.0; d];
        for draw in 0..draws {
            // The level is moved to the middle of its cell of 2⁻²⁴, so that none is 0 or 1.
            let level =
                |k: usize| f64::from(sobol_burley::sample(draw as u32, k as u32, scrambling)) + 0.5_f64.powi(25);
            for (k, stretched) in stretched.iter_mut().enumerate() {
                *stretched = widths.of(draw) * quantiles.at(level(k));
            }
            let mut inside = true;
            for k in 0..d {
                let position = centre[k] + (0..=k).map(|l| factor[(k, l)] * stretched[l]).sum::<f64>();
                inside &= (0.0..=1.0).contains(&position);
                points.push(parameters[k].from_unit(position.clamp(0.0, 1.0)));
            }
            let squared: f64 = stretched.iter().map(|z| z * z).sum();
            // Proposals outside the prior get zero weight.
            log_density.push(if inside { widths.log_density(squared) - log_volume } else { IMPOSSIBLE });
        }
        (points, log_density)
    };
    let mut stream = stats::stream(seed, "population proposals");
    let scramblings: Vec<u32> = (0..samples.measurements()).map(|_| stream.random()).collect();
    let (points, log_density): (Vec<_>, Vec<_>) = scramblings.into_par_iter().enumerate().map(of_one).unzip();
    let theta = DMatrix::from_row_iterator(samples.measurements() * draws, d, points.into_iter().flatten());
    (PosteriorSamples::new(theta, draws), log_density.concat())
}

/// Log-density so large that the importance weight of the sample is zero.
const IMPOSSIBLE: f64 = 1e9;
