//! Noise that is learned from how far measurements scatter about the simulation.
//!
//! The stated noise is a first guess. Where there are more modes than parameters, the residuals that no parameters can explain tell how large
//! it is: of a measurement j with stated noise, χ²_j/κ² is χ²-distributed if the true noise is κ times the stated one,
//!
//! ```text
//!  κ² = median_j χ²_j / q_ν,    q_ν the median of the χ² distribution with the degrees of freedom of measurement j
//! ```
//!
//! and the residuals of the batches of a reference tell it for each mode, as far as they can be told apart:
//!
//! ```text
//!  E r_i² = Σ_k P_ik² κ_k²,    P the projector on the residuals that the parameters cannot absorb
//!  κ_k² ← (Σ_i w_ik κ_k² r̄_i²/E r_i² + 0.1 κ²)/(Σ_i w_ik + 0.1),    w_ik the mean of P_ik²
//! ```
//!
//! A misfit of the simulation is the same in all measurements, and no noise. The residuals of a reference are therefore those about the mean of
//! their batch, times √(n/(n − 1)) for n measurements; where all batches have one, the differences of successive ones, divided by √2. One
//! batch by itself learns from its residuals as they are: with a misfit they have a mean that no scatter explains, so that the [test of
//! fit](super::fit) with the learned noise rejects it.

use nalgebra::DVector;
use statrs::distribution::{ChiSquared, ContinuousCDF as _};

use super::finding::{Finding, FindingCode, FindingEffect};
use super::fit::Fit;
use crate::baseline::nearest::Nearest;
use crate::baseline::observation::Observation;
use structures::stats;

/// Fewest measurements from which noise is learned, and fewest from which it is learned for each mode.
const FEWEST: usize = 12;
const FEWEST_FOR_MODES: usize = 100;

/// Factor by which the learned noise must differ from the stated one to take its place.
const LEAST: f64 = 1.5;

/// Limits of κ.
const LIMITS: [f64; 2] = [0.1, 10.0];

/// Weight of the noise of all modes in that of each, in measurements for each measurement: a mode of which hardly anything is left in the
/// residuals has the noise of all.
const PRIOR: f64 = 0.1;

/// Iterations for the noise of each mode.
const ITERATIONS: usize = 100;

/// A test of fit, and κ of the noise that it was made with.
#[derive(Debug, Clone, Copy)]
pub struct Tested<'a> {
    /// The test.
    pub fit: &'a Fit,
    /// κ.
    pub noise: f64,
}

/// Residuals of one measurement with stated noise, as far as they can be tested.
struct Residuals<'a> {
    point: &'a Nearest,
    /// In standard deviations of the stated noise, `[modes]`.
    residuals: DVector<f64>,
}

impl Residuals<'_> {
    /// χ²_j/q_ν.
    fn relative(&self) -> f64 {
        let degrees = self.point.degrees_of_freedom as f64;
        let median = ChiSquared::new(degrees).map_or(f64::NAN, |chi| chi.inverse_cdf(0.5));
        self.residuals.norm_squared() / median
    }
}

/// The measurements of a batch with residuals that parameters cannot absorb: those with more modes than parameters and without shapes.
fn testable<'a>(tested: &Tested<'a>) -> Vec<Residuals<'a>> {
    let Tested { fit, noise } = *tested;
    let is_tested =
        |point: &&Nearest| point.degrees_of_freedom > 0 && point.chi_squared > 0.0 && point.projector.trace() > 0.5;
    let residuals = |point: &'a Nearest| Residuals { point, residuals: &point.standardised_residuals * noise };
    fit.nearest.iter().filter(is_tested).map(residuals).collect()
}

/// The residuals of the batches of a reference, in the order of time, without what is the same in all measurements of a batch.
fn scattered<'a>(tested: &[Tested<'a>]) -> Vec<Residuals<'a>> {
    let batches: Vec<Vec<Residuals<'a>>> = tested.iter().map(testable).collect();
    let has = |row: &Residuals<'_>, mode: usize| row.point.projector[(mode, mode)] > 0.0;
    let about_mean = |batch: &Vec<Residuals<'a>>| {
        let modes = batch.first().map_or(0, |row| row.residuals.len());
        let mut count = DVector::zeros(modes);
        let mut sum: DVector<f64> = DVector::zeros(modes);
        for row in batch {
            count += DVector::from_fn(modes, |mode, _| f64::from(u8::from(has(row, mode))));
            sum += &row.residuals;
        }
        let of_row = |row: &Residuals<'a>| {
            let of_mode = |mode: usize, _: usize| {
                let off = row.residuals[mode] - sum[mode] / count[mode];
                if has(row, mode) {
                    off * (count[mode] / (count[mode] - 1.0)).sqrt()
                } else {
                    0.0
                }
            };
            let shows = (0..modes).all(|mode| !has(row, mode) || count[mode] > 1.0);
            shows.then(|| Residuals { point: row.point, residuals: DVector::from_fn(modes, of_mode) })
        };
        batch.iter().filter_map(of_row).collect::<Vec<_>>()
    };
    let found: Vec<Residuals<'a>> = batches.iter().flat_map(about_mean).collect();
    if found.len() >= FEWEST {
        return found;
    }
    let all: Vec<&Residuals<'a>> = batches.iter().flatten().collect();
    let alike =
        |pair: &&[&Residuals<'a>]| (0..pair[0].residuals.len()).all(|mode| has(pair[0], mode) == has(pair[1], mode));
    let difference = |pair: &[&Residuals<'a>]| Residuals {
        point: pair[1].point,
        residuals: (&pair[1].residuals - &pair[0].residuals) / std::f64::consts::SQRT_2,
    };
    all.windows(2).filter(alike).map(difference).collect()
}

/// κ of the measurements of a batch; `None` where it cannot be learned or hardly differs from 1.
pub fn learned(tested: &Tested<'_>) -> Option<f64> {
    of_all(&testable(tested))
}

fn of_all(rows: &[Residuals<'_>]) -> Option<f64> {
    if rows.len() < FEWEST {
        return None;
    }
    let relative: Vec<f64> = rows.iter().map(Residuals::relative).collect();
    let noise = stats::quantile(&relative, 0.5).sqrt().clamp(LIMITS[0], LIMITS[1]);
    (noise.is_finite() && !(1.0 / LEAST..=LEAST).contains(&noise)).then_some(noise)
}

/// κ of each mode, `[modes]`, from the batches of a reference, in the order of time; `None` where none can be learned or all hardly differ from 1.
pub fn learned_of_modes(tested: &[Tested<'_>]) -> Option<Vec<f64>> {
    let rows = scattered(tested);
    let modes = rows.first()?.residuals.len();
    let of_all = of_all(&rows);
    if rows.len() < FEWEST_FOR_MODES {
        return of_all.map(|noise| vec![noise; modes]);
    }
    let usual = of_all.unwrap_or(1.0).powi(2);
    // Measurements with a wrong frequency would count for many.
    let near: Vec<&Residuals<'_>> = rows.iter().filter(|row| row.relative() < 10.0 * usual).collect();
    let mut observed = vec![0.0; modes];
    let mut shares = vec![vec![0.0; modes]; modes];
    for row in &near {
        for i in 0..modes {
            observed[i] += row.residuals[i].powi(2);
            (0..modes).for_each(|k| shares[i][k] += row.point.projector[(i, k)].powi(2));
        }
    }
    let mut squares = vec![usual; modes];
    for _ in 0..ITERATIONS {
        let ratio = |i: usize| {
            let expected: f64 = (0..modes).map(|k| shares[i][k] * squares[k]).sum();
            if expected > 0.0 {
                observed[i] / expected
            } else {
                1.0
            }
        };
        let ratios: Vec<f64> = (0..modes).map(ratio).collect();
        for (k, square) in squares.iter_mut().enumerate() {
            let weight: f64 = (0..modes).map(|i| shares[i][k]).sum();
            let shown = *square * (0..modes).map(|i| shares[i][k] * ratios[i]).sum::<f64>();
            let prior = PRIOR * near.len() as f64;
            *square = (shown + prior * usual) / (weight + prior);
        }
    }
    let found: Vec<f64> = squares.iter().map(|square| square.sqrt().clamp(LIMITS[0], LIMITS[1])).collect();
    found.iter().any(|noise| !(1.0 / LEAST..=LEAST).contains(noise)).then_some(found)
}

/// The measurements with κ times the noise in each mode, but no less than `least`, the least multiple of the structure's noise that the
/// model covers.
pub fn scaled(observations: &mut [Observation], noise: &[f64], least: f64) {
    for observation in observations {
        let modes = observation.noise_multiple.iter_mut().zip(noise).zip(&observation.frequencies_hz);
        for ((multiple, noise), _) in modes.filter(|(_, frequency)| frequency.is_some()) {
            *multiple = (*multiple * noise).max(least);
        }
    }
}

/// The finding about a batch whose noise was learned from itself.
pub fn finding(noise: f64) -> Finding {
    let message = format!(
        "the frequencies scatter about the simulation {noise:.1} times as far as their noise states, and by no more than that differently from \
         it: this noise is used for the batch; check std_hz, or the measurement_noise of the structure"
    );
    Finding::new(FindingCode::NoiseUnderstated, FindingEffect::Note, message)
}

/// The noise that a reference has learned, as a sentence.
pub fn in_words(noise: &[f64]) -> String {
    let parts: Vec<String> =
        noise.iter().enumerate().map(|(mode, noise)| format!("mode {} {noise:.1} times", mode + 1)).collect();
    format!(
        "the frequencies of its batches scatter otherwise than their noise states ({}): the noise that they show is used for it and for \
         the batches that are compared with it",
        parts.join(", ")
    )
}
