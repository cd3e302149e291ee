//! Importance sampling from a mixture of local normal approximations, for posteriors that are a thin curve or a thin surface.
//!
//! Fewer accurate frequencies than parameters leave a set of parameters that reproduce the measurement. The posterior is a thin layer
//! about this set, and no single normal or Student distribution is near it. Points on the set are therefore spread along it, and each
//! gets the normal approximation of the likelihood in the directions that the frequencies determine, and the distance to its neighbours
//! in the others:
//!
//! ```text
//!  u: position between the bounds of the prior, in the unit box;    r_i(u) = (y_i − f_i(u))/s_i,    A = Jᵀ J,  J = −∂r/∂u
//!  u ← u + (A + τ⁻² I)⁻¹ Jᵀ r                    Gauss–Newton steps onto the set; they do not move along it
//!  A = Σ_j λ_j v_j v_jᵀ,    C = Σ_j c_j v_j v_jᵀ,    c_j = 1/λ_j where λ_j > τ⁻², otherwise 1/(λ_j + b⁻²)
//!  q(u) = 1/N Σ_n t_ν(u; u_n, C_n),              w(u) = p(y | u) p(u)/q(u) inside the unit box, 0 outside
//! ```
//!
//! b is the distance to the fourth nearest point. Stage by stage, the points are drawn from the weighted draws of the stage before, and
//! become more.
//!
//! Source: R. Douc, A. Guillin, J.-M. Marin, C. P. Robert (2007), Convergence of adaptive mixtures of importance sampling schemes, Annals of
//! Statistics 35, 420–448; the local normal approximations are ours.

use nalgebra::{Cholesky, DMatrix, DVector, SymmetricEigen};

use super::observation::Observation;
use super::proposal::Proposal;
use super::resample::log_posteriors;
use crate::parameter::{Parameter, ParameterSpace};
use crate::simulator::Simulator;
use crate::stats::{self, Stream};

/// Starting points of the first stage, and points of the others.
pub(super) const STARTS: usize = 96;
const POINTS: [usize; 2] = [160, 256];

/// Draws of each stage for each draw that is needed, and the fewest.
const DRAWS: [f64; 3] = [4.0, 6.0, 8.0];
const FEWEST_DRAWS: usize = 384;

/// Gauss–Newton steps onto the set.
const STEPS: usize = 6;

/// τ: a direction is determined by the frequencies if its standard deviation is less than this share of the prior.
const DETERMINED: f64 = 0.1;

/// Largest and smallest b, as shares of the prior.
const LARGEST_DISTANCE: f64 = 0.1;
const SMALLEST_DISTANCE: f64 = 1e-4;

/// Which neighbour b is the distance to.
const NEIGHBOUR: usize = 4;

/// Factor of the standard deviations in determined directions: a proposal that is a little wide keeps the weights bounded.
const WIDENED: f64 = 1.1;

/// Smallest distance of a point from the bounds of the unit box.
const MARGIN: f64 = 1e-6;

/// Longest Gauss–Newton step, as a share of the prior.
const LONGEST_STEP: f64 = 0.25;

/// One measurement, as this search sees it.
pub(super) struct Target<'a> {
    /// The simulation without the effects of the measurement.
    simulator: &'a Simulator,
    /// The same with the effects of the measurement.
    under_effects: Simulator,
    space: &'a ParameterSpace,
    observation: &'a Observation,
}

/// What the search has found.
pub(super) struct Found {
    /// Samples, `[draws, d]`, parameter units; `None` where too few draws are effective.
    pub(super) theta: Option<DMatrix<f64>>,
    /// Simulations that were computed.
    pub(super) simulations: usize,
}

/// A point on the set, and the distribution about it.
struct Point {
    at: DVector<f64>,
    /// Eigenvalues and eigenvectors of A.
    precision: SymmetricEigen<f64, nalgebra::Dyn>,
}

impl<'a> Target<'a> {
    pub(super) fn new(simulator: &'a Simulator, observation: &'a Observation) -> Self {
        Self { simulator, under_effects: observation.simulator(simulator), space: simulator.space(), observation }
    }

    /// `draws` samples from starting points `starts` (`[n, d]`, parameter units) near the posterior, if at least `needed` draws are
    /// effective.
    pub(super) fn sample(&self, starts: &DMatrix<f64>, draws: usize, needed: f64, stream: &mut Stream) -> Found {
        let mut simulations = 0;
        let mut starts = starts.clone();
        for (stage, per_needed) in DRAWS.into_iter().enumerate() {
            let points = self.points(&starts, &mut simulations);
            let proposals = proposals(&points);
            if proposals.is_empty() {
                break;
            }
            let many = FEWEST_DRAWS.max((per_needed * needed) as usize);
            let (units, log_q) = draw(&proposals, many, stream);
            let theta = self.to_parameters(&units);
            let logs = log_posteriors(self.simulator, std::slice::from_ref(self.observation), &theta);
            simulations += many;
            let inside = |row: usize| units.row(row).iter().all(|u| (0.0..1.0).contains(u));
            let log_weights: Vec<f64> = (0..many)
                .map(|row| logs[row] - log_q[row])
                .enumerate()
                .map(|(row, weight)| if inside(row) && weight.is_finite() { weight } else { f64::NEG_INFINITY })
                .collect();
            if let Some(weights) = stats::weights(&log_weights, needed / many as f64) {
                let chosen = stats::systematic(&weights, draws, stream);
                let theta = DMatrix::from_fn(draws, self.space.len(), |row, column| theta[(chosen[row], column)]);
                return Found { theta: Some(theta), simulations };
            }
            let Some(count) = POINTS.get(stage).copied() else { break };
            let Some(weights) = stats::tempered_weights(&log_weights, count as f64) else { break };
            let chosen = stats::systematic(&weights, count, stream);
            starts = DMatrix::from_fn(count, self.space.len(), |row, column| theta[(chosen[row], column)]);
        }
        Found { theta: None, simulations }
    }

    /// The starting points, moved onto the set.
    fn points(&self, starts: &DMatrix<f64>, simulations: &mut usize) -> Vec<Point> {
        let mut points: Vec<Point> = Vec::with_capacity(starts.nrows());
        for start in starts.row_iter() {
            let unit = |(parameter, value): (&Parameter, &f64)| parameter.to_unit(*value).clamp(MARGIN, 1.0 - MARGIN);
            let mut at = DVector::from_iterator(self.space.len(), self.space.iter().zip(start.iter()).map(unit));
            let mut best: Option<(f64, Point)> = None;
            for step in 0..=STEPS {
                *simulations += 1;
                let Some((residuals, slopes)) = self.linearised(&at) else { break };
                let chi_squared = residuals.norm_squared();
                let precision = slopes.tr_mul(&slopes);
                let gradient = slopes.tr_mul(&residuals);
                let improved = best.as_ref().is_none_or(|(before, _)| chi_squared < *before);
                let settled = best.as_ref().is_some_and(|(before, _)| (before - chi_squared).abs() < 0.01);
                if improved {
                    best =
                        Some((chi_squared, Point { at: at.clone(), precision: precision.clone().symmetric_eigen() }));
                }
                if step == STEPS || settled {
                    break;
                }
                let damped = precision + DMatrix::identity(at.len(), at.len()) / DETERMINED.powi(2);
                let Some(mut move_by) = Cholesky::new(damped).map(|factor| factor.solve(&gradient)) else { break };
                let length = move_by.amax();
                if length > LONGEST_STEP {
                    move_by *= LONGEST_STEP / length;
                }
                at += move_by;
                at.apply(|u| *u = u.clamp(MARGIN, 1.0 - MARGIN));
            }
            points.extend(best.map(|(_, point)| point));
        }
        points
    }

    /// Residuals r, `[modes present]`, and J = −∂r/∂u, `[modes present, d]`; `None` where the simulation fails.
    fn linearised(&self, at: &DVector<f64>) -> Option<(DVector<f64>, DMatrix<f64>)> {
        let theta: Vec<f64> = self.space.iter().zip(at.iter()).map(|(parameter, u)| parameter.from_unit(*u)).collect();
        let scales: Vec<f64> = self.space.iter().map(|parameter| parameter.upper - parameter.lower).collect();
        let (frequencies_hz, jacobian) = self.under_effects.frequencies_and_jacobian(&theta).ok()?;
        let present: Vec<(usize, f64)> =
            self.observation.frequencies_hz.iter().enumerate().filter_map(|(mode, f)| f.map(|f| (mode, f))).collect();
        let mut residuals = DVector::zeros(present.len());
        let mut slopes = DMatrix::zeros(present.len(), scales.len());
        for (row, (mode, measured_hz)) in present.into_iter().enumerate() {
            let std_hz = self.under_effects.std_hz(mode, frequencies_hz[mode]) * self.observation.noise_multiple[mode];
            residuals[row] = (measured_hz - frequencies_hz[mode]) / std_hz;
            for (column, scale) in scales.iter().enumerate() {
                slopes[(row, column)] = jacobian[(mode, column)] * scale / std_hz;
            }
        }
        let finite = residuals.iter().chain(slopes.iter()).all(|value| value.is_finite());
        finite.then_some((residuals, slopes))
    }

    fn to_parameters(&self, units: &DMatrix<f64>) -> DMatrix<f64> {
        let value =
            |row: usize, column: usize| self.space.as_slice()[column].from_unit(units[(row, column)].clamp(0.0, 1.0));
        DMatrix::from_fn(units.nrows(), units.ncols(), value)
    }
}

/// The distribution about each point; identical points count once.
fn proposals(points: &[Point]) -> Vec<Proposal> {
    let mut distinct: Vec<&Point> = Vec::with_capacity(points.len());
    for point in points {
        if distinct.iter().all(|other| (&other.at - &point.at).amax() > 1e-9) {
            distinct.push(point);
        }
    }
    let about = |point: &&Point| {
        let mut distances: Vec<f64> = distinct.iter().map(|other| (&other.at - &point.at).norm()).collect();
        distances.sort_by(f64::total_cmp);
        // The nearest is the point itself.
        let distance = distances.get(NEIGHBOUR).copied().unwrap_or(LARGEST_DISTANCE);
        let distance = distance.clamp(SMALLEST_DISTANCE, LARGEST_DISTANCE);
        let vectors = &point.precision.eigenvectors;
        let mut scaled = vectors.clone();
        for (j, precision) in point.precision.eigenvalues.iter().enumerate() {
            let variance = if *precision > DETERMINED.powi(-2) {
                WIDENED.powi(2) / precision
            } else {
                1.0 / (precision.max(0.0) + distance.powi(-2))
            };
            scaled.column_mut(j).scale_mut(variance);
        }
        Proposal::student(point.at.clone(), scaled * vectors.transpose())
    };
    distinct.iter().filter_map(about).collect()
}

/// `many` draws of the mixture of `proposals` with equal shares, `[many, d]`, and the logarithm of its density at each, nats, up to a
/// constant.
fn draw(proposals: &[Proposal], many: usize, stream: &mut Stream) -> (DMatrix<f64>, Vec<f64>) {
    let d = proposals[0].mean.len();
    let mut units = DMatrix::zeros(many, d);
    for row in 0..many {
        // As many draws of each as possible: they differ by at most one.
        units.set_row(row, &proposals[row % proposals.len()].draw(stream).transpose());
    }
    let density = |row: usize| {
        let at: Vec<f64> = units.row(row).iter().copied().collect();
        let logs: Vec<f64> = proposals.iter().map(|proposal| proposal.log_density(&at)).collect();
        let largest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        largest + logs.iter().map(|log| (log - largest).exp()).sum::<f64>().ln()
    };
    let log_q = (0..many).map(density).collect();
    (units, log_q)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::definition::StructureDefinition;

    fn simulator() -> Simulator {
        let text = "id = \"two\"\nmodes = 2\nmeasurement_noise = { relative = 0.001 }\n\
                    [[mass]]\nname = \"a\"\nkg = 1.0\n[[mass]]\nname = \"b\"\nkg = 1.5\n\
                    [[spring]]\nname = \"k1\"\nfrom = \"ground\"\nto = \"a\"\nn_per_m = 100.0\n\
                    [[spring]]\nname = \"k2\"\nfrom = \"a\"\nto = \"b\"\nn_per_m = 60.0\n\
                    [[parameter]]\nname = \"p1\"\nprior = { uniform = [50.0, 150.0] }\nsets = { spring = \"k1\" }\n\
                    [[parameter]]\nname = \"p2\"\nprior = { uniform = [30.0, 90.0] }\nsets = { spring = \"k2\" }\n";
        Simulator::new(StructureDefinition::parse_toml(text).unwrap()).unwrap()
    }

    /// With an accurate frequency f₁ alone, p(p1 | y) ∝ 1/|∂f₁/∂p2| along the curve f₁(p1, p2) = y, as long as p2 is inside its prior.
    fn exact_moments(simulator: &Simulator, measured_hz: f64) -> (f64, f64) {
        let (mut total, mut first, mut second) = (0.0, 0.0, 0.0);
        let steps = 4_000;
        for step in 0..steps {
            let p1 = 50.0 + 100.0 * (f64::from(step) + 0.5) / f64::from(steps);
            let f1 = |p2: f64| simulator.frequencies_hz(&[p1, p2]).unwrap()[0];
            if !(f1(30.0)..f1(90.0)).contains(&measured_hz) {
                continue;
            }
            let (mut low, mut high) = (30.0, 90.0);
            for _ in 0..50 {
                let middle = 0.5 * (low + high);
                *(if f1(middle) < measured_hz { &mut low } else { &mut high }) = middle;
            }
            let density = 1.0 / ((f1(low + 1e-4) - f1(low - 1e-4)) / 2e-4);
            total += density;
            first += density * p1;
            second += density * p1 * p1;
        }
        (first / total, (second / total - (first / total).powi(2)).sqrt())
    }

    #[test]
    fn samples_lie_along_the_whole_curve_of_a_single_accurate_frequency() {
        let simulator = simulator();
        let space = simulator.space().clone();
        let exact_hz = simulator.frequencies_hz(&[104.0, 55.0]).unwrap();
        // A tenth of the noise, 0.01 % of the frequency: the layer is a thousandth as thick as the prior is wide.
        let observation = Observation {
            frequencies_hz: vec![Some(exact_hz[0]), None],
            noise_multiple: vec![0.1, 1.0],
            ..Observation::complete(&exact_hz)
        };
        let (mean, std) = exact_moments(&simulator, exact_hz[0]);
        let target = Target::new(&simulator, &observation);
        let (repeats, draws) = (20, 100);
        let (mut values, mut worst) = (Vec::new(), 0.0_f64);
        for seed in 0..repeats {
            let mut stream = stats::stream(seed, "test");
            let starts = DMatrix::from_fn(100, 2, |_, column| {
                space.as_slice()[column].from_unit(rand::Rng::random(&mut stream))
            });
            let found = target.sample(&starts, draws, draws as f64, &mut stream);
            let theta = found.theta.expect("a curve is within reach");
            for row in theta.row_iter() {
                let f1 = simulator.frequencies_hz(&[row[0], row[1]]).unwrap()[0];
                worst = worst.max((f1 / exact_hz[0] - 1.0).abs() / 1e-4);
                values.push(row[0]);
            }
        }
        assert!(worst < 6.0, "a sample is {worst} standard deviations of the noise away");
        // As many effective draws as are kept, of which some repeat: five errors of half as many.
        let error = 5.0 / (0.5 * values.len() as f64).sqrt();
        assert!((stats::mean(&values) - mean).abs() < error * std, "{} against {mean} ± {std}", stats::mean(&values));
        let ratio = stats::sample_std(&values).unwrap() / std;
        assert!((ratio - 1.0).abs() < error / 2.0_f64.sqrt(), "{ratio}");
    }
}
