//! Weighed bodies as data: what a fit predicts for the mass of a body, and the density of what was weighed.

use nalgebra::{DMatrix, DVector};

use super::data::Data;
use super::declared::WEIGHING_STD;
use super::fit::Fit;
use structures::physics::effect::Target;
use structures::simulator::law::Input;

/// Logarithm of the mass of body `mass` under a fit over that of the structure file, and its derivative by the free means and
/// all ψ, `[free + ψ]`. `input`: value of the covariate of each effect.
///
/// ```text
///  ln r = Σ ln(1 + g),    ∂ ln r/∂ψ = ∂g/∂ψ / (1 + g)      over the effects on the mass of the body
///  ln r = Σ g_q a_q,      ∂ ln r/∂g_q = a_q                for a deviation of all parts
/// ```
///
/// `None` if a mass is not positive.
pub(super) fn log_ratio(fit: &Fit, mass: usize, input: impl Fn(usize) -> Input) -> Option<(f64, DVector<f64>)> {
    let numbers = fit.psi.iter().map(Vec::len).sum::<usize>();
    let mut slopes = DVector::zeros(fit.free.len() + numbers);
    let mut ratio = 0.0;
    let mut first = fit.free.len();
    for (index, (effect, psi)) in fit.effects.iter().zip(&fit.psi).enumerate() {
        if matches!(&effect.target, Target::Masses(bodies) if bodies.contains(&mass)) {
            let (mut size, mut by_number) = ([0.0], vec![0.0; psi.len()]);
            effect.sizes(input(index), psi, &mut size, &mut by_number);
            let factor = 1.0 + size[0];
            if factor <= 0.0 {
                return None;
            }
            ratio += factor.ln();
            for (place, slope) in by_number.iter().enumerate() {
                slopes[first + place] += slope / factor;
            }
        }
        if let Target::Everywhere(directions) = &effect.target {
            for (place, (direction, size)) in directions.iter().zip(psi).enumerate() {
                let by = direction.masses.get(mass).copied().unwrap_or(0.0);
                ratio += size * by;
                slopes[first + place] += by;
            }
        }
        first += psi.len();
    }
    Some((ratio, slopes))
}

/// Log density of all weighings under a fit to the frequencies, nats: normal, with the covariance of the numbers of the fit
/// divided by the share of independent rows.
///
/// ```text
///  w ~ N( ln r, J C Jᵀ/share + 0.005² ),    J = ∂ ln r/∂(μ, ψ)
/// ```
///
/// The product with the evidence of the frequencies is the evidence of both. Zero without weighings; −∞ if a mass is not
/// positive.
pub(super) fn log_density(data: &Data, fit: &Fit, independent_share: f64) -> f64 {
    if data.weighings.is_empty() {
        return 0.0;
    }
    let inputs: Vec<Vec<Input>> = fit
        .effects
        .iter()
        .zip(&fit.psi)
        .map(|(effect, psi)| data.inputs(&effect.law, effect.lag().map(|lag| psi[lag])))
        .collect();
    let count = data.weighings.len();
    let mut residual = DVector::zeros(count);
    let mut slopes = DMatrix::zeros(count, fit.covariance.nrows());
    for (place, weighing) in data.weighings.iter().enumerate() {
        let Some((ratio, by)) = log_ratio(fit, weighing.mass, |effect| inputs[effect][weighing.row]) else {
            return f64::NEG_INFINITY;
        };
        residual[place] = weighing.log_ratio - ratio;
        slopes.row_mut(place).copy_from(&by.transpose());
    }
    let mut covariance = &slopes * &fit.covariance * slopes.transpose() / independent_share;
    for a in 0..count {
        for b in 0..count {
            // The same body is weighed with the same balance: its error does not average out.
            if data.weighings[a].mass == data.weighings[b].mass {
                covariance[(a, b)] += WEIGHING_STD.powi(2);
            }
        }
        covariance[(a, a)] += (0.1 * WEIGHING_STD).powi(2);
    }
    let Some(factor) = covariance.cholesky() else { return f64::NEG_INFINITY };
    let half_log_det: f64 = factor.l_dirty().diagonal().iter().map(|l| l.ln()).sum();
    -0.5 * residual.dot(&factor.solve(&residual)) - half_log_det - 0.5 * count as f64 * std::f64::consts::TAU.ln()
}
