//! Measurements that would distinguish two causes.

use super::data::Data;
use super::fit::Fit;
use super::grammar::{Candidate, Class};
use super::rank::Ranked;
use crate::physics::effect::Target;
use crate::simulator::Simulator;

/// Greatest number of further modes, above those measured, that are considered for a measurement.
const FURTHER_MODES: usize = 5;

/// Difference between the frequencies that two causes predict above which a further mode is recommended, per cent.
const LEAST_PERCENT: f64 = 0.1;

/// The measurement, in words, that would best distinguish two causes.
pub(super) fn discriminating_measurement(simulator: &Simulator, data: &Data, a: &Ranked, b: &Ranked) -> String {
    let (ca, cb) = (&a.candidate, &b.candidate);
    if ca.covariate != cb.covariate {
        return match (&ca.covariate, &cb.covariate) {
            (Some(a), Some(b)) => format!("measurements in which {a} and {b} vary independently"),
            (Some(one), None) | (None, Some(one)) => format!("measurements over a wider range of {one}"),
            (None, None) => unreachable!("the covariates differ"),
        };
    }
    if let Some((mode, percent)) = further_mode(simulator, data, &a.fit, &b.fit) {
        return format!(
            "a measurement of mode {}: the frequencies that the two predict for it differ by {percent:.1} % at the extremes of \
             these data",
            mode + 1
        );
    }
    let instrument = |c: &Candidate| c.class == Class::Instrument;
    if instrument(ca) != instrument(cb) {
        return "a second instrument beside the first: only one of them would show the fault of an instrument"
            .to_owned();
    }
    let mass = |c: &Candidate| matches!(c.target, Target::Masses(_));
    if mass(ca) != mass(cb) {
        return "weighing, or a static load test, which depends on stiffness but not on mass".to_owned();
    }
    if data.shapes.is_some() {
        "mode shapes at further points, or a further mode".to_owned()
    } else {
        "mode shapes, or a further mode".to_owned()
    }
}

/// The mode above those measured for which two fits differ most, and the difference in per cent.
fn further_mode(simulator: &Simulator, data: &Data, a: &Fit, b: &Fit) -> Option<(usize, f64)> {
    let count = simulator.available_modes().min(simulator.modes() + FURTHER_MODES);
    if count <= simulator.modes() || a.effects.len() != b.effects.len() {
        return None;
    }
    let (fa, fb) = (at_largest_effect(simulator, data, a, count)?, at_largest_effect(simulator, data, b, count)?);
    let differences = (simulator.modes()..count).map(|m| (m, 100.0 * (fa[m] / fb[m] - 1.0).abs()));
    differences.max_by(|x, y| x.1.total_cmp(&y.1)).filter(|best| best.1 > LEAST_PERCENT)
}

/// The lowest `modes` frequencies of a fit, Hz, in the row where its last effect is largest.
fn at_largest_effect(simulator: &Simulator, data: &Data, fit: &Fit, modes: usize) -> Option<Vec<f64>> {
    let last = fit.effects.len().checked_sub(1)?;
    let targets: Vec<_> = fit.effects.iter().map(|e| e.target.clone()).collect();
    if targets.iter().any(|t| matches!(t, Target::ModeOrder(_))) {
        return None;
    }
    let inputs: Vec<_> =
        fit.effects.iter().zip(&fit.psi).map(|(e, psi)| data.inputs(&e.law, e.lag().map(|l| psi[l]))).collect();
    let size = |e: usize, row: usize| {
        let (effect, psi) = (&fit.effects[e], &fit.psi[e]);
        let mut sizes = vec![0.0; effect.target.sizes()];
        effect.sizes(inputs[e][row], psi, &mut sizes, &mut vec![0.0; psi.len()]);
        sizes
    };
    let row = (0..data.rows()).max_by(|a, b| {
        let abs = |row: usize| size(last, row).first().copied().unwrap_or(0.0).abs();
        abs(*a).total_cmp(&abs(*b))
    })?;
    let sizes: Vec<f64> = (0..fit.effects.len()).flat_map(|e| size(e, row)).collect();
    simulator.respond(&fit.mean, modes, &targets, &sizes).ok().map(|r| r.frequencies_hz)
}
