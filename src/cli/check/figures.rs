//! The figures of `modalwatch check`.

use nalgebra::DMatrix;
use rand::Rng as _;
use serde::Serialize;

use crate::baseline::identifiability::local_covariance;
use crate::parameter::{DamageDirection, Parameter, PriorForm};
use crate::quantity::significant;
use crate::simulator::definition::Sets;
use crate::simulator::plausibility::MISTAKEN;
use crate::simulator::{SimulationModel, Simulator};
use crate::stats;

/// Points of the prior at which the frequencies are computed, and fewer for a structure with many degrees of freedom.
const POINTS: usize = 500;
const POINTS_OF_LARGE: usize = 20;
const LARGE_DOFS: usize = 100;

/// Correlation of two parameters, given one measurement, above which the modes cannot tell them apart.
const TOGETHER: f64 = 0.95;

/// Share of the prior variance above which one measurement says little about a parameter.
const LITTLE: f64 = 0.5;

/// What is known about a structure without any measurement.
#[derive(Debug, Serialize)]
pub struct Figures {
    pub structure: String,
    pub digest: String,
    pub parameters: Vec<ParameterFigures>,
    pub modes: Vec<ModeFigures>,
    /// Names of the points of the shapes.
    pub shape_points: Vec<String>,
    /// Ratio of the largest and the smallest singular value of the sensitivities; infinite values are `None`.
    pub condition: Option<f64>,
    /// Parameters that the modes cannot tell apart, with the correlation of each pair.
    pub together: Vec<(String, String, f64)>,
    pub notes: Vec<String>,
    /// Contradictions, which end the command with an error.
    pub problems: Vec<String>,
}

/// A parameter.
#[derive(Debug, Serialize)]
pub struct ParameterFigures {
    pub name: String,
    pub unit: String,
    pub prior: [f64; 2],
    pub prior_form: PriorForm,
    pub nominal: f64,
    pub damage: DamageDirection,
    pub sets: Vec<String>,
    /// Share of the prior variance that one complete measurement leaves.
    pub variance_left: f64,
    /// Standard deviation given one complete measurement, in the unit.
    pub std: f64,
}

/// A mode at the nominal parameters.
#[derive(Debug, Serialize)]
pub struct ModeFigures {
    pub mode: usize,
    pub nominal_hz: f64,
    pub noise_std_hz: f64,
    /// Lowest and highest frequency of the mode within the prior.
    pub prior_hz: [f64; 2],
    /// Displacement of each point, the largest 1.
    pub shape: Vec<f64>,
    /// Change of the frequency in per cent when a parameter rises by 1 % of itself.
    pub sensitivity: Vec<f64>,
    pub measured_hz: Option<f64>,
    pub measured_is_possible: Option<bool>,
}

impl Figures {
    /// Computes the figures. `measured`: frequencies from the lowest mode, Hz; may be empty.
    pub fn of(simulator: &Simulator, measured: &[f64]) -> anyhow::Result<Self> {
        anyhow::ensure!(
            measured.len() <= simulator.modes(),
            "--measured has {} frequencies, but only {} modes are measured",
            measured.len(),
            simulator.modes()
        );
        if let Some(wrong) = measured.iter().find(|f| !(f.is_finite() && **f > 0.0)) {
            anyhow::bail!("--measured has a frequency of {wrong} Hz: it must be above 0");
        }
        let nominal = simulator.nominal_parameters();
        let (frequencies, jacobian) = simulator.frequencies_and_jacobian(&nominal)?;
        let covariance = local_covariance(simulator, &nominal, &frequencies)?;
        let sensitivity = sensitivities(simulator, &nominal, &frequencies, &jacobian);
        let ranges = prior_ranges(simulator);
        let (shape_points, shapes) = shapes(simulator, &nominal)?;
        let mode = |mode: usize| {
            let measured_hz = measured.get(mode).copied();
            let [low, high] = ranges[mode];
            ModeFigures {
                mode: mode + 1,
                nominal_hz: frequencies[mode],
                noise_std_hz: simulator.std_hz(mode, frequencies[mode]),
                prior_hz: ranges[mode],
                shape: shapes.get(mode).cloned().unwrap_or_default(),
                sensitivity: sensitivity.row(mode).iter().copied().collect(),
                measured_hz,
                measured_is_possible: measured_hz.map(|f| (low..=high).contains(&f)),
            }
        };
        let parameter = |(k, p): (usize, &Parameter)| ParameterFigures {
            name: p.name.clone(),
            unit: p.unit.clone(),
            prior: [p.lower, p.upper],
            prior_form: p.form,
            nominal: nominal[k],
            damage: p.damage,
            sets: sets(simulator, k),
            variance_left: (p.box_precision() * covariance[(k, k)]).min(1.0),
            std: covariance[(k, k)].sqrt() * (p.upper - p.lower),
        };
        let mut figures = Self {
            structure: simulator.id().to_string(),
            digest: simulator.digest().to_string(),
            parameters: simulator.space().iter().enumerate().map(parameter).collect(),
            modes: (0..simulator.modes()).map(mode).collect(),
            shape_points,
            condition: condition(&sensitivity),
            together: together(simulator, &covariance),
            notes: simulator.warnings().into_iter().chain(simulator.mesh_warning()).collect(),
            problems: Vec::new(),
        };
        figures.judge(simulator);
        Ok(figures)
    }

    /// Writes notes and problems.
    fn judge(&mut self, simulator: &Simulator) {
        let (d, m) = (self.parameters.len(), self.modes.len());
        if d > m && simulator.shape_points() == 0 {
            self.notes.push(format!(
                "{m} frequencies cannot determine {d} parameters: measure more modes or mode shapes, or let one parameter set several springs"
            ));
        }
        for p in self.parameters.iter().filter(|p| p.variance_left > LITTLE) {
            self.notes.push(format!(
                "one measurement leaves {:.0} % of the prior variance of {}: the modes say little about it",
                100.0 * p.variance_left,
                p.name
            ));
        }
        for (a, b, correlation) in &self.together {
            self.notes.push(format!("the modes cannot tell {a} and {b} apart (correlation {correlation:+.2})"));
        }
        if !simulator.is_noisy() {
            self.notes.push(
                "measurement_noise is 0: state the scatter of repeated measurements, such as { relative = 0.002 }, before you train".to_owned(),
            );
        }
        for doubt in simulator.prior_doubts() {
            if doubt.far { &mut self.problems } else { &mut self.notes }.push(doubt.message);
        }
        self.judge_measured(simulator);
    }

    /// Compares the measured frequencies with the ranges of the prior, and the lowest one with that at the medians of the priors.
    fn judge_measured(&mut self, simulator: &Simulator) {
        for mode in self.modes.iter().filter(|m| m.measured_is_possible == Some(false)) {
            let [low, high] = mode.prior_hz;
            self.problems.push(format!(
                "mode {}: {} Hz is outside the prior's range, {} to {} Hz",
                mode.mode,
                significant(mode.measured_hz.unwrap_or(f64::NAN)),
                significant(low),
                significant(high)
            ));
        }
        let Some(measured) = self.modes.first().and_then(|m| m.measured_hz) else { return };
        let middle: Vec<f64> = simulator.space().iter().map(|p| p.at_level(0.5)).collect();
        let Ok(frequencies) = simulator.frequencies_hz(&middle) else { return };
        let factor = measured / frequencies[0];
        if (1.0 / MISTAKEN..=MISTAKEN).contains(&factor) {
            return;
        }
        let factors = simulator.probable_factors();
        let cause = if factors.is_empty() {
            "a stiffness, a mass or the frequency probably has another unit".to_owned()
        } else {
            factors.join(" ")
        };
        self.problems.push(format!(
            "the measured frequency of mode 1 is {} times that in the middle of the priors, {} Hz, and stiffness goes with the square: {cause}",
            significant(factor),
            significant(frequencies[0])
        ));
    }
}

/// What a parameter sets, by name.
fn sets(simulator: &Simulator, column: usize) -> Vec<String> {
    let definition = &simulator.definition().parameters[column];
    let name = |sets: &Sets| {
        let stiffness = sets.spring.clone().or_else(|| sets.beam.clone());
        stiffness.unwrap_or_else(|| sets.in_words())
    };
    definition.sets.iter().map(name).collect()
}

/// d ln f/d ln θ, `[m, d]`. For a parameter whose prior includes 0, the relative change per share of the width of its prior.
fn sensitivities(simulator: &Simulator, theta: &[f64], frequencies: &[f64], jacobian: &DMatrix<f64>) -> DMatrix<f64> {
    let parameters = simulator.space().as_slice();
    let unit = |k: usize| if parameters[k].has_share() { theta[k] } else { parameters[k].upper - parameters[k].lower };
    DMatrix::from_fn(jacobian.nrows(), jacobian.ncols(), |mode, k| jacobian[(mode, k)] * unit(k) / frequencies[mode])
}

/// Ratio of the largest and the smallest singular value; `None` if fewer modes than parameters leave it infinite.
fn condition(sensitivity: &DMatrix<f64>) -> Option<f64> {
    if sensitivity.nrows() < sensitivity.ncols() {
        return None;
    }
    let values = sensitivity.clone().svd(false, false).singular_values;
    let (largest, smallest) = (values.max(), values.min());
    (smallest > 1e-12 * largest).then(|| largest / smallest)
}

/// Pairs of parameters that are nearly fully correlated given one measurement, and about each of which it says little.
fn together(simulator: &Simulator, covariance: &DMatrix<f64>) -> Vec<(String, String, f64)> {
    let parameters = simulator.space().as_slice();
    let mut found = Vec::new();
    for i in 0..parameters.len() {
        for j in 0..i {
            let correlation = covariance[(i, j)] / (covariance[(i, i)] * covariance[(j, j)]).sqrt();
            if correlation.abs() > TOGETHER {
                found.push((parameters[j].name.clone(), parameters[i].name.clone(), correlation));
            }
        }
    }
    found
}

/// Lowest and highest frequency of each mode within the prior, Hz. Frequencies grow with every stiffness and fall with every mass, so that their
/// least and greatest values give the ends; random points cover what is neither.
fn prior_ranges(simulator: &Simulator) -> Vec<[f64; 2]> {
    let parameters = simulator.space().as_slice();
    let middle: Vec<f64> = parameters.iter().map(|p| p.from_unit(0.5)).collect();
    let jacobian = simulator.jacobian(&middle).ok();
    let growing = |k: usize| jacobian.as_ref().is_none_or(|jacobian| jacobian.column(k).sum() >= 0.0);
    let corner = |high: bool| -> Vec<f64> {
        parameters.iter().enumerate().map(|(k, p)| if growing(k) == high { p.upper } else { p.lower }).collect()
    };
    let mut points = vec![middle.clone(), corner(false), corner(true)];
    let large =
        matches!(simulator.model(), SimulationModel::Matrices(matrices) if matrices.structure.dofs() > LARGE_DOFS);
    let mut stream = stats::stream(1, "prior range");
    let mut draw = || parameters.iter().map(|p| p.from_unit(stream.random())).collect();
    points.extend((0..if large { POINTS_OF_LARGE } else { POINTS }).map(|_| draw()));
    let mut ranges = vec![[f64::INFINITY, f64::NEG_INFINITY]; simulator.modes()];
    for point in points {
        // Inside the prior every structure that was accepted has frequencies.
        for (range, f) in ranges.iter_mut().zip(simulator.frequencies_hz(&point).unwrap_or_default()) {
            *range = [range[0].min(f), range[1].max(f)];
        }
    }
    ranges
}

/// The points of the shapes by name, and for each mode the displacement of each, the largest 1. Empty for a table.
fn shapes(simulator: &Simulator, theta: &[f64]) -> anyhow::Result<(Vec<String>, Vec<Vec<f64>>)> {
    let Some(structure) = simulator.structure() else { return Ok((Vec::new(), Vec::new())) };
    let points = structure.attachment_points();
    let dofs: Vec<usize> = points.iter().map(|p| p.dof).collect();
    let Some(shapes) = simulator.shapes_under(theta, simulator.modes(), (&[], &[]), &dofs)? else {
        return Ok((Vec::new(), Vec::new()));
    };
    let scaled = |column: usize| {
        let shape = shapes.column(column);
        let largest =
            shape.iter().copied().max_by(|a, b| a.abs().total_cmp(&b.abs())).filter(|v| *v != 0.0).unwrap_or(1.0);
        shape.iter().map(|v| v / largest).collect()
    };
    Ok((points.iter().map(|p| p.name.clone()).collect(), (0..simulator.modes()).map(scaled).collect()))
}
