//! The exact posterior of one measurement by importance sampling without a flow, as a reference.

use modalwatch::simulator::Simulator;
use modalwatch::stats::{self, Stream};
use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::{ChiSquared, StandardNormal};

/// Moments of a posterior.
pub struct Moments {
    pub mean: Vec<f64>,
    pub std: Vec<f64>,
    /// Effective sample size.
    pub effective: f64,
}

/// A normal component of the proposal, in the unit box.
struct Component {
    centre: DVector<f64>,
    /// Lower factor of the covariance.
    factor: DMatrix<f64>,
    log_normaliser: f64,
    inverse: DMatrix<f64>,
}

const DEGREES: f64 = 5.0;
const DRAWS: usize = 40_000;

/// Posterior of x under the uniform prior for modes `present` measured at `measured_hz` with standard deviation
/// `relative_std` of each.
///
/// The proposal is a mixture of multivariate t distributions about the maxima of the likelihood, with the curvature
/// there. The maxima are found by a search from a lattice of starting points. The weights are exact.
pub fn posterior(
    simulator: &Simulator,
    measured_hz: &[Option<f64>],
    relative_std: f64,
    starts_per_axis: usize,
    stream: &mut Stream,
) -> Moments {
    let parameters = simulator.space().as_slice();
    let d = parameters.len();
    let theta = |u: &DVector<f64>| -> Vec<f64> { parameters.iter().zip(u).map(|(p, u)| p.from_unit(*u)).collect() };
    let present: Vec<(usize, f64)> = measured_hz.iter().enumerate().filter_map(|(i, f)| Some((i, (*f)?))).collect();
    // The generator adds normal noise to f with standard deviation relative_std·f.
    let log_likelihood = |u: &DVector<f64>| -> f64 {
        let f = simulator.frequencies_hz(&theta(u)).unwrap();
        present.iter().map(|(i, y)| -0.5 * ((y - f[*i]) / (relative_std * f[*i])).powi(2) - f[*i].ln()).sum()
    };
    let mut components: Vec<Component> = Vec::new();
    let mut best = f64::NEG_INFINITY;
    let mut found: Vec<(f64, DVector<f64>, DMatrix<f64>)> = Vec::new();
    for number in 0..starts_per_axis.pow(d as u32) {
        let coordinate = |k: usize| ((number / starts_per_axis.pow(k as u32)) % starts_per_axis) as f64;
        let start = DVector::from_fn(d, |k, _| (coordinate(k) + 0.5) / starts_per_axis as f64);
        let (u, information) = climb(simulator, &present, relative_std, start);
        let value = log_likelihood(&u);
        best = best.max(value);
        if found.iter().all(|(_, other, _)| (other - &u).amax() > 1e-3) {
            found.push((value, u, information));
        }
    }
    for (value, centre, information) in found {
        if value < best - 12.0 {
            continue;
        }
        // The prior keeps directions that the modes do not determine within the box.
        let precision = information + DMatrix::identity(d, d) * 12.0;
        let covariance = precision.try_inverse().unwrap() * 1.3;
        let factor = covariance.clone().cholesky().unwrap().l();
        let log_normaliser = -factor.diagonal().map(f64::ln).sum();
        components.push(Component { centre, log_normaliser, inverse: covariance.try_inverse().unwrap(), factor });
    }
    let log_proposal = |u: &DVector<f64>| -> f64 {
        let terms: Vec<f64> = components
            .iter()
            .map(|c| {
                let r = u - &c.centre;
                let distance = (r.transpose() * &c.inverse * &r)[(0, 0)];
                c.log_normaliser - 0.5 * (DEGREES + d as f64) * (1.0 + distance / DEGREES).ln()
            })
            .collect();
        let largest = terms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        largest + terms.iter().map(|t| (t - largest).exp()).sum::<f64>().ln()
    };
    let (mut logs, mut points) = (Vec::new(), Vec::new());
    for draw in 0..DRAWS {
        let c = &components[draw % components.len()];
        let normal = DVector::from_fn(d, |_, _| stream.sample::<f64, _>(StandardNormal));
        let stretch = (stream.sample(ChiSquared::new(DEGREES).unwrap()) / DEGREES).sqrt();
        let u = &c.centre + &c.factor * normal / stretch;
        if u.iter().all(|x| (0.0..=1.0).contains(x)) {
            logs.push(log_likelihood(&u) - log_proposal(&u));
            points.push(theta(&u));
        }
    }
    let largest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let weights: Vec<f64> = logs.iter().map(|l| (l - largest).exp()).collect();
    let total: f64 = weights.iter().sum();
    let moment = |k: usize| {
        let mean = weights.iter().zip(&points).map(|(w, p)| w * p[k]).sum::<f64>() / total;
        let variance = weights.iter().zip(&points).map(|(w, p)| w * (p[k] - mean).powi(2)).sum::<f64>() / total;
        (mean, variance.sqrt())
    };
    let (mean, std) = (0..d).map(moment).unzip();
    Moments { mean, std, effective: total * total / weights.iter().map(|w| w * w).sum::<f64>() }
}

/// Gauss–Newton with halving steps inside the box; returns the point and the Fisher information there.
fn climb(
    simulator: &Simulator,
    present: &[(usize, f64)],
    relative_std: f64,
    start: DVector<f64>,
) -> (DVector<f64>, DMatrix<f64>) {
    let parameters = simulator.space().as_slice();
    let theta = |u: &DVector<f64>| -> Vec<f64> { parameters.iter().zip(u).map(|(p, u)| p.from_unit(*u)).collect() };
    let residual = |u: &DVector<f64>| {
        let f = simulator.frequencies_hz(&theta(u)).unwrap();
        DVector::from_iterator(present.len(), present.iter().map(|(i, y)| (y / f[*i]).ln() / relative_std))
    };
    let slope = |u: &DVector<f64>| {
        let (f, j) = (simulator.frequencies_hz(&theta(u)).unwrap(), simulator.jacobian(&theta(u)).unwrap());
        DMatrix::from_fn(present.len(), u.len(), |row, k| {
            let width = parameters[k].upper - parameters[k].lower;
            j[(present[row].0, k)] * width / (f[present[row].0] * relative_std)
        })
    };
    let mut u = start;
    for _ in 0..60 {
        let (r, s) = (residual(&u), slope(&u));
        let normal = s.transpose() * &s + DMatrix::identity(u.len(), u.len()) * 1e-3;
        let step = normal.cholesky().unwrap().solve(&(s.transpose() * &r));
        let mut scale = 1.0;
        let next = loop {
            let next = (&u + &step * scale).map(|x| x.clamp(0.0, 1.0));
            if residual(&next).norm_squared() <= r.norm_squared() || scale < 1e-4 {
                break next;
            }
            scale *= 0.5;
        };
        let moved = (&next - &u).amax();
        u = next;
        if moved < 1e-9 {
            break;
        }
    }
    let s = slope(&u);
    let information = s.transpose() * &s;
    (u, information)
}

/// A random stream for tests, whose purpose differs from those of the crate.
pub fn stream(seed: u64) -> Stream {
    stats::stream(seed, "test: exact posterior")
}
