//! Importance sampling from a mixture of local normal approximations, for posteriors that are far thinner than the flow's draws.
//!
//! Accurate frequencies confine the parameters to a thin curved layer, or to a few thin spots, of which a single normal or Student
//! distribution covers a part at best: its weights look even while the rest of the posterior is missed. The draws of the flow cover
//! all of it, but only coarsely. Each is therefore moved onto the layer, in the directions in which the layer is narrow, and becomes the
//! centre of a distribution that follows the layer there:
//!
//! ```text
//!  u: position between the bounds of the prior, in the unit box;    r_i(u) = (y_i − f_i(u))/s_i,    J = −∂r/∂u
//!  Jᵀ J = Σ_j σ_j⁻² v_j v_jᵀ,    direction j is narrow if σ_j < τ,    τ = 0.7 √σ_min
//!  u ← u + Σ_narrow σ_j² v_j v_jᵀ Jᵀ r                          Gauss–Newton steps, which do not move along the layer
//!  s_j = 1.1 σ_j in narrow directions,    s_j⁻² = (1.1 σ_j)⁻² + b⁻² in the others
//!  q(u) = Σ_n p_n t_ν(u; u_n, Σ_j s_j² v_j v_jᵀ),    w(u) = p(y | u) p(u)/q(u) inside the unit box, 0 outside
//! ```
//!
//! τ is where the layer, whose radius of curvature is about the width of the prior, bends away from its tangent by a part of its smallest
//! thickness σ_min. b is the distance to the fourth nearest point, at most 1.5 τ. Some of the starting points are drawn from the prior, so
//! that parts that the flow misses can be found too.
//!
//! Where too few draws are effective, the next stage has its points at weighted draws of the one before. The components of all stages
//! stay in the mixture, so that no part of the posterior that one of them covers is lost.
//!
//! Source: R. Douc, A. Guillin, J.-M. Marin, C. P. Robert (2007), Convergence of adaptive mixtures of importance sampling schemes, Annals of
//! Statistics 35, 420–448; the components are ours.

use nalgebra::{DMatrix, DVector, Dyn, SymmetricEigen};
use rand::Rng as _;

use super::mixture::Mixture;
use super::observation::Observation;
use super::resample::log_posteriors;
use structures::parameter::{Parameter, ParameterSpace};
use structures::simulator::Simulator;
use structures::stats::{self, Stream};

/// Starting points, those from the prior not included.
pub(super) const STARTS: usize = 128;

/// How many starting points there are for each one that is drawn from the prior.
const STARTS_PER_PRIOR_DRAW: usize = 4;

/// Starting points after which the search for others ends if they have come together in less than half as many points: the posterior is
/// then a few spots, and not a layer that points must cover.
const STARTS_FOR_SPOTS: usize = 80;

/// Points of the later stages.
const POINTS: usize = 160;

/// Draws of each stage for each effective draw that is needed, and the fewest.
const DRAWS: [f64; 4] = [2.0, 4.0, 6.0, 6.0];
const FEWEST_DRAWS: usize = 512;

/// Least number of draws for each effective one after flattening, from which the points of the next stage are chosen.
const DRAWS_PER_POINT: f64 = 0.3;

/// Share of the components of earlier stages.
const EARLIER: f64 = 0.15;

/// Gauss–Newton steps of the first stage, and of the later ones, whose points are near the layer already.
const STEPS: [usize; 2] = [6, 1];

/// τ/√σ_min.
const NARROW: f64 = 0.7;

/// Largest b, as a multiple of τ, and smallest b, as a share of the prior.
const LARGEST_DISTANCE: f64 = 1.5;
const SMALLEST_DISTANCE: f64 = 1e-5;

/// Which neighbour b is the distance to.
const NEIGHBOUR: usize = 4;

/// Factor of the standard deviations: a proposal that is a little wide keeps the weights bounded.
const WIDENED: f64 = 1.1;

/// Points whose distance is less than this share of the smallest thickness are the same.
const SAME: f64 = 0.1;

/// Largest distance from the layer at which a point is used, in standard deviations of the noise, and the one at which it has arrived.
const OFF: f64 = 10.0;
const ARRIVED: f64 = 0.1;

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
    /// Simulations that were computed.
    pub(super) simulations: usize,
}

/// A point on the layer.
struct Point {
    at: DVector<f64>,
    /// Number of starting points that came here.
    count: f64,
    /// Eigenvalues σ_j⁻² and eigenvectors of Jᵀ J.
    precision: SymmetricEigen<f64, Dyn>,
}

/// Draws of one stage.
struct Drawn {
    /// `[n, d]` in the unit box, and in parameter units.
    units: DMatrix<f64>,
    theta: DMatrix<f64>,
    /// ln w, nats, `[n]`.
    log_weights: Vec<f64>,
}

impl Drawn {
    /// The weights, `[n]`; `None` unless `needed` draws are effective.
    fn weights(&self, needed: f64) -> Option<Vec<f64>> {
        stats::weights(&self.log_weights, needed / self.log_weights.len() as f64)
    }

    /// The draws of both, which are of the same mixture.
    fn joined(mut self, other: &Self) -> Self {
        let below = |above: &DMatrix<f64>, below: &DMatrix<f64>| {
            let first = above.nrows();
            let mut all = above.clone().resize_vertically(first + below.nrows(), 0.0);
            all.rows_mut(first, below.nrows()).copy_from(below);
            all
        };
        self.units = below(&self.units, &other.units);
        self.theta = below(&self.theta, &other.theta);
        self.log_weights.extend(&other.log_weights);
        self
    }
}

impl<'a> Target<'a> {
    pub(super) fn new(simulator: &'a Simulator, observation: &'a Observation) -> Self {
        let under_effects = observation.simulator(simulator);
        Self { simulator, under_effects, space: simulator.space(), observation, simulations: 0 }
    }

    /// `draws` samples, `[draws, d]` in parameter units, from starting points `starts`, `[n, d]` in parameter units; `None` unless `needed`
    /// draws are effective.
    pub(super) fn sample(
        &mut self,
        starts: &DMatrix<f64>,
        draws: usize,
        needed: f64,
        stream: &mut Stream,
    ) -> Option<DMatrix<f64>> {
        let starts = self.with_prior_draws(starts, stream);
        let mut mixture = mixture(&self.points(&starts, STEPS[0]), self.space.len());
        for (stage, each) in DRAWS.into_iter().enumerate() {
            if mixture.is_empty() {
                return None;
            }
            let many = FEWEST_DRAWS.max((each * needed) as usize);
            // Often half of the draws suffice.
            let mut drawn = self.drawn(&mixture, many / 2, stream);
            if drawn.weights(needed).is_none() {
                drawn = drawn.joined(&self.drawn(&mixture, many - many / 2, stream));
            }
            if let Some(weights) = drawn.weights(needed) {
                let chosen = stats::systematic(&weights, draws, stream);
                return Some(drawn.theta.select_rows(&chosen));
            }
            if stage + 1 < DRAWS.len() {
                let wanted = (POINTS as f64).min(DRAWS_PER_POINT * many as f64);
                let weights = stats::tempered_weights(&drawn.log_weights, wanted)?;
                let chosen = stats::systematic(&weights, POINTS, stream);
                let centres: Vec<DVector<f64>> = chosen.iter().map(|row| drawn.units.row(*row).transpose()).collect();
                let next = self::mixture(&self.points(&centres, STEPS[1]), self.space.len());
                mixture = next.scaled_to(1.0 - EARLIER).joined(mixture.scaled_to(EARLIER));
            }
        }
        None
    }

    /// The starting points in the unit box, with some of the prior among them.
    fn with_prior_draws(&self, starts: &DMatrix<f64>, stream: &mut Stream) -> Vec<DVector<f64>> {
        let d = self.space.len();
        let mut units = Vec::with_capacity(starts.nrows() + starts.nrows() / STARTS_PER_PRIOR_DRAW + 1);
        for (index, start) in starts.row_iter().enumerate() {
            if index % STARTS_PER_PRIOR_DRAW == 0 {
                units.push(DVector::from_fn(d, |_, _| stream.random::<f64>()));
            }
            let unit = |(parameter, value): (&Parameter, &f64)| parameter.to_unit(*value);
            units.push(DVector::from_iterator(d, self.space.iter().zip(start.iter()).map(unit)));
        }
        units
    }

    /// `many` draws of a mixture with their weights.
    fn drawn(&mut self, mixture: &Mixture, many: usize, stream: &mut Stream) -> Drawn {
        let d = self.space.len();
        let units = mixture.draw(many, stream);
        let parameters = self.space.as_slice();
        let value = |row: usize, k: usize| parameters[k].from_unit(units[(row, k)].clamp(0.0, 1.0));
        let theta = DMatrix::from_fn(many, d, value);
        let logs = log_posteriors(self.simulator, std::slice::from_ref(self.observation), &theta);
        self.simulations += many;
        let mut at = vec![0.0; d];
        let log_weight = |row: usize| {
            at.iter_mut().zip(units.row(row).iter()).for_each(|(own, u)| *own = *u);
            if !logs[row].is_finite() || !at.iter().all(|u| (0.0..1.0).contains(u)) {
                return f64::NEG_INFINITY;
            }
            logs[row] - mixture.log_density(&at)
        };
        let log_weights = (0..many).map(log_weight).collect();
        Drawn { units, theta, log_weights }
    }

    /// Different points on the layer, from starting points in the unit box.
    fn points(&mut self, starts: &[DVector<f64>], steps: usize) -> Vec<Point> {
        let (first, others) = starts.split_at(STARTS_FOR_SPOTS.min(starts.len()));
        let mut points = Vec::with_capacity(starts.len());
        self.settled(first, steps).into_iter().for_each(|point| join(point, &mut points));
        if points.len() >= STARTS_FOR_SPOTS / 2 {
            self.settled(others, steps).into_iter().for_each(|point| join(point, &mut points));
        }
        points
    }

    /// The nearest points to the layer on the ways from `starts`, those that are near enough. All ways are gone together, so that their
    /// simulations can be batched.
    fn settled(&mut self, starts: &[DVector<f64>], steps: usize) -> Vec<Point> {
        let within = |u: f64| u.clamp(MARGIN, 1.0 - MARGIN);
        let mut ways: Vec<Way> = starts.iter().map(|start| Way { at: start.map(within), best: None }).collect();
        let mut open: Vec<usize> = (0..ways.len()).collect();
        for step in 0..=steps {
            self.simulations += open.len();
            let linearised = self.linearised(open.iter().map(|index| &ways[*index].at));
            let mut going = Vec::with_capacity(open.len());
            for (index, linearised) in open.into_iter().zip(linearised) {
                let Some((residuals, slopes)) = linearised else { continue };
                let way = &mut ways[index];
                let Some(mut move_by) = way.judged(&residuals, &slopes) else { continue };
                let length = move_by.amax();
                if length > LONGEST_STEP {
                    move_by *= LONGEST_STEP / length;
                }
                if step < steps {
                    way.at += move_by;
                    way.at.apply(|u| *u = within(*u));
                    going.push(index);
                }
            }
            open = going;
        }
        let near = |way: Way| way.best.filter(|(off, _)| *off < OFF * OFF).map(|(_, point)| point);
        ways.into_iter().filter_map(near).collect()
    }

    /// Residuals r, `[modes present]`, and J = −∂r/∂u, `[modes present, d]`, at positions in the unit box; `None` where the simulation
    /// fails.
    fn linearised<'p>(&self, positions: impl Iterator<Item = &'p DVector<f64>>) -> Vec<Option<Linearised>> {
        let (d, modes) = (self.space.len(), self.simulator.modes());
        let units: Vec<f64> = positions.flat_map(|at| at.iter().copied()).collect();
        let parameters = self.space.as_slice();
        let theta = DMatrix::from_fn(units.len() / d, d, |row, k| parameters[k].from_unit(units[row * d + k]));
        let near_hz = &self.observation.frequencies_hz;
        let found = self.under_effects.slopes_near(&theta, 0..theta.nrows(), near_hz);
        let present: Vec<(usize, f64)> =
            self.observation.frequencies_hz.iter().enumerate().filter_map(|(mode, f)| f.map(|f| (mode, f))).collect();
        let of_run = |(frequencies_hz, derivatives): (&[f64], &[f64])| {
            let std_hz: Vec<f64> = (present.iter())
                .map(|(mode, _)| {
                    self.under_effects.std_hz(*mode, frequencies_hz[*mode]) * self.observation.noise_multiple[*mode]
                })
                .collect();
            let residual = |row: usize, _| {
                let (mode, measured_hz) = present[row];
                (measured_hz - frequencies_hz[mode]) / std_hz[row]
            };
            let slope = |row: usize, k: usize| {
                derivatives[present[row].0 * d + k] * (parameters[k].upper - parameters[k].lower) / std_hz[row]
            };
            let residuals = DVector::from_fn(present.len(), residual);
            let slopes = DMatrix::from_fn(present.len(), d, slope);
            let finite = residuals.iter().chain(slopes.iter()).all(|value| value.is_finite());
            finite.then_some((residuals, slopes))
        };
        let runs = found.frequencies_hz.chunks_exact(modes).zip(found.slopes.chunks_exact(modes * d));
        runs.map(of_run).collect()
    }
}

/// Residuals r and J = −∂r/∂u.
type Linearised = (DVector<f64>, DMatrix<f64>);

/// The way from a starting point to the layer.
struct Way {
    /// Where it is, in the unit box.
    at: DVector<f64>,
    /// The point nearest to the layer so far, with its squared distance from it in standard deviations of the noise.
    best: Option<(f64, Point)>,
}

impl Way {
    /// Notes the place where the way is, with residuals and slopes there. Returns the Gauss–Newton step to the layer, `None` if it has
    /// arrived.
    fn judged(&mut self, residuals: &DVector<f64>, slopes: &DMatrix<f64>) -> Option<DVector<f64>> {
        let precision = slopes.tr_mul(slopes).symmetric_eigen();
        let gradient = precision.eigenvectors.tr_mul(&slopes.tr_mul(residuals));
        let narrow = narrow(&precision);
        let (mut move_by, mut off) = (DVector::zeros(self.at.len()), 0.0);
        for (j, precise) in precision.eigenvalues.iter().enumerate() {
            if *precise > narrow.powi(-2) {
                move_by.axpy(gradient[j] / precise, &precision.eigenvectors.column(j), 1.0);
                off += gradient[j].powi(2) / precise;
            }
        }
        if self.best.as_ref().is_none_or(|(before, _)| off < *before) {
            self.best = Some((off, Point { at: self.at.clone(), count: 1.0, precision }));
        }
        (off >= ARRIVED * ARRIVED).then_some(move_by)
    }
}

/// Adds a point, or counts it where the same is there already.
fn join(point: Point, points: &mut Vec<Point>) {
    let same = SAME * SAME / point.precision.eigenvalues.max().max(1.0);
    match points.iter_mut().find(|other| (&other.at - &point.at).norm_squared() < same) {
        Some(other) => other.count += 1.0,
        None => points.push(point),
    }
}

/// τ from the eigenvalues σ_j⁻² of Jᵀ J.
fn narrow(precision: &SymmetricEigen<f64, Dyn>) -> f64 {
    NARROW * precision.eigenvalues.max().max(1.0).powf(-0.25)
}

/// The mixture with a component at each point.
fn mixture(points: &[Point], d: usize) -> Mixture {
    let mut mixture = Mixture::new(d);
    for point in points {
        let mut distances: Vec<f64> = points.iter().map(|other| (&other.at - &point.at).norm()).collect();
        distances.sort_by(f64::total_cmp);
        let narrow = narrow(&point.precision);
        // The nearest is the point itself.
        let distance = distances.get(NEIGHBOUR).copied().unwrap_or(f64::INFINITY);
        let distance = distance.clamp(SMALLEST_DISTANCE, LARGEST_DISTANCE * narrow);
        let std = |precise: &f64| {
            let own = 1.0 / precise.max(1e-12).sqrt();
            if own < narrow {
                WIDENED * own
            } else {
                ((WIDENED * own).powi(-2) + distance.powi(-2)).powf(-0.5)
            }
        };
        let stds: Vec<f64> = point.precision.eigenvalues.iter().map(std).collect();
        mixture.add(point.count, &point.at, &point.precision.eigenvectors, &stds);
    }
    mixture.scaled_to(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use structures::simulator::definition::StructureDefinition;

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
        let (repeats, draws) = (20, 100);
        let (mut values, mut worst) = (Vec::new(), 0.0_f64);
        for seed in 0..repeats {
            let mut stream = stats::stream(seed, "test");
            let starts = DMatrix::from_fn(100, 2, |_, column| {
                space.as_slice()[column].from_unit(rand::Rng::random(&mut stream))
            });
            let mut target = Target::new(&simulator, &observation);
            let theta = target.sample(&starts, draws, draws as f64, &mut stream).expect("a curve is within reach");
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
