//! The hypothesis that the simulation is off by a little everywhere, and in no single place.
//!
//! ```text
//!  ln k_e → ln k_e + κ_e,   ln m_a → ln m_a + μ_a,      κ, μ ~ N(0, σ² C),   C = a exp(−distance/ℓ) + (1 − a) I
//!  outputs:  d ≈ S κ + T μ,   S = ∂M/∂ln k,   T = ∂M/∂ln m,      d ~ N(0, σ² (S C Sᵀ + T C Tᵀ))
//! ```
//!
//! κ `[springs]`, μ `[masses]`: relative deviations of every stiffness and mass from the structure file; distance: number of parts
//! between two parts; M: the outputs (ln f of each mode, coordinates of shapes). The prior of σ, ℓ and a is uniform over a grid. A table
//! has no parts: each ln f deviates by itself, with standard deviation σ/2. That is a further field of a beam, whose spans cannot represent
//! what its supports do.
//!
//! The outputs see only as many combinations of parts as there are outputs. These combinations are the directions of one target,
//! [`Target::Everywhere`], and their sizes are fitted together with everything else, with a wide prior (see `mixture`).
//!
//! The evidence of a fit with such an effect is the mean over the grid, so that any other cause competes with a deviation of the size
//! that suits it and not with the size that the deviation would have without that cause.
//!
//! Source: Kennedy and O'Hagan (2001), JRSS B 63, for a discrepancy with a prior of its own; Brynjarsdóttir and O'Hagan (2014), Inverse
//! Problems 30, for what parameters absorb where it is left out.

use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use super::effect::{is_factor, FittedEffect, Number};
use super::fit::Fit;
use super::mixture::Mixture;
use super::study::Study;
use structures::physics::effect::{Direction, Target};
use structures::physics::{Form, Structure};
use structures::simulator::law::{Law, LawKind};

/// Standard deviations σ of the logarithm of every stiffness and mass.
const STDS: [f64; 6] = [0.005, 0.01, 0.02, 0.04, 0.08, 0.16];

/// Lengths ℓ over which the deviations are alike, as shares of the largest distance in the structure, and the share of the variance that
/// is alike at a distance of 0.
const FIELDS: [(f64, f64); 4] = [(1.0, 0.0), (0.25, 0.5), (1.0, 0.5), (1.0, 0.95)];

/// Greatest number of directions: those that move the outputs most.
const MOST_DIRECTIONS: usize = 24;

/// Directions that move the outputs by less than this share of the greatest, as a share of the variance, are left out.
const LEAST_SHARE: f64 = 1e-6;

/// Greatest size of a direction in a fit, in standard deviations of its prior.
const MOST_STDS: f64 = 8.0;

/// The deviation of all parts as an effect, near a fit; `None` if no part moves an output.
pub(super) fn effect(study: &Study<'_>, rows: &[usize], fit: &Fit) -> Option<FittedEffect> {
    let (directions, of_fields) = Parts::new(study, rows, fit)?.directions()?;
    let prior_std = STDS[STDS.len() - 1];
    let bounds = (-MOST_STDS * prior_std, MOST_STDS * prior_std);
    let number = |q: usize| Number {
        name: format!("direction_{}", q + 1),
        prior_mean: 0.0,
        prior_std,
        bounds,
        of_factor: false,
    };
    let numbers = (0..directions.len()).map(number).collect();
    let law = Law { kind: LawKind::Constant, covariate: None, reference: 0.0, with_level: false, levels: Vec::new() };
    let priors = of_fields.iter().flat_map(|prior| STDS.map(|std| prior * std.powi(2))).collect();
    let mixture = Some(Arc::new(Mixture { std: prior_std, least_std: STDS[0], priors }));
    Some(FittedEffect { target: Target::Everywhere(directions), law, numbers, mixture, onset90: None })
}

/// What is added to the evidence of a deviation of all parts before it is compared with further constant effects, nats: by how much the largest log
/// likelihood of such an effect among `fits` exceeds that of the deviation; 0 if no fit has the deviation.
///
/// The deviation explains the mean frequencies at least as well as any other constant. A constant effect can only be more likely by how
/// the modes follow the parameters, which a simulation that is off everywhere has wrong by an unknown amount. Where parameters were set,
/// or known masses were hung, the rows differ by what is known, and the constant effect may explain these differences: nothing is then added.
pub(super) fn credit_nats<'a>(study: &Study<'_>, fits: impl Iterator<Item = &'a Fit>) -> f64 {
    let set = study.data.settings.iter().flatten().any(Option::is_some);
    if set || !study.data.hung.is_empty() {
        return 0.0;
    }
    let (mut own, mut others) = (f64::INFINITY, f64::NEG_INFINITY);
    for fit in fits {
        match fit.effects.last() {
            Some(effect) if effect.mixture.is_some() => own = fit.log_likelihood,
            Some(effect) if effect.law.kind == LawKind::Constant => others = others.max(fit.log_likelihood),
            _ => {}
        }
    }
    (others - own).max(0.0)
}

/// The most that an effect, number `index` of the fit `with`, can have added to the evidence of the fit `without` it, nats, if the
/// simulation is off everywhere besides. Unlimited otherwise.
///
/// The frequencies of such a simulation are free to differ, but how they follow the parameters is that of the simulation, which is off as
/// well. An effect may improve that by chance, and is no cause. What counts is, for the constant part of an effect, by how much more
/// probable the deviation becomes that is left besides; for the part g that varies, half of its squared distance from 0:
///
/// ```text
///  ½ gᵀ C⁻¹ g,     C: posterior covariance of g
/// ```
pub(super) fn supported_nats(with: &Fit, index: usize, without: &Fit) -> f64 {
    let effect = &with.effects[index];
    if effect.mixture.is_some() {
        return f64::INFINITY;
    }
    let (Some(left), Some(before)) = (deviation(with), deviation(without)) else { return f64::INFINITY };
    if effect.law.covariate.is_none() {
        return left - before;
    }
    let level = effect.numbers.iter().position(|number| number.name == "level");
    let constant = if level.is_some() { (left - before).max(0.0) } else { 0.0 };
    let varies = |place: &usize| effect.numbers[*place].prior_mean == 0.0 && Some(*place) != level;
    let sizes: Vec<usize> = (0..effect.numbers.len()).filter(varies).collect();
    let (psi, all) = (&with.psi[index], with.psi_covariance(index));
    // Of a factor 1 + level + g, only g/(1 + level) varies: the parameters may take over the level.
    let level = level.filter(|_| is_factor(&effect.target));
    let base = level.map_or(1.0, |level| 1.0 + psi[level]);
    let size = DVector::from_iterator(sizes.len(), sizes.iter().map(|place| psi[*place] / base));
    let slopes = DMatrix::from_fn(sizes.len(), psi.len(), |row, column| {
        let own = if sizes[row] == column { 1.0 } else { 0.0 };
        (own - if Some(column) == level { size[row] } else { 0.0 }) / base
    });
    let covariance = &slopes * all * slopes.transpose();
    constant + covariance.cholesky().map_or(0.0, |factor| 0.5 * size.dot(&factor.solve(&size)))
}

/// Log density of the deviation of all parts in a fit; `None` if the fit has none.
fn deviation(fit: &Fit) -> Option<f64> {
    let index = fit.effects.iter().position(|e| e.mixture.is_some())?;
    fit.effects[index].mixture.as_ref()?.log_density(&fit.psi[index], &fit.psi_covariance(index))
}

/// The parts of a simulation, and how the outputs depend on them.
struct Parts {
    /// Number of springs, which come first among the parts.
    springs: usize,
    /// Number of masses, which come next. The rest are modes, each of which is off by itself: those of a table, which has no other parts, and
    /// those of a beam, whose spans cannot represent what its supports do.
    masses: usize,
    /// ∂M/∂ln of each part, `[outputs, parts]`.
    by_part: DMatrix<f64>,
    /// C of each field, `[parts, parts]`.
    correlations: Vec<DMatrix<f64>>,
}

impl Parts {
    /// The parts at the mean parameters of a fit, in the row in the middle of `rows`.
    fn new(study: &Study<'_>, rows: &[usize], fit: &Fit) -> Option<Self> {
        let modes = study.simulator.modes();
        // As a stiffness: a frequency changes by half of its logarithm.
        let by_mode = |outputs: usize| DMatrix::<f64>::identity(outputs, modes) * 0.5;
        let Some(structure) = study.simulator.structure() else {
            let correlations = vec![DMatrix::identity(modes, modes)];
            return Some(Self { springs: 0, masses: 0, by_part: by_mode(modes), correlations });
        };
        let (springs, masses) = (structure.springs().len(), structure.masses().len());
        let each = (0..springs).map(|s| Target::Springs(vec![s])).chain((0..masses).map(|m| Target::Masses(vec![m])));
        let middle = rows.len() / 2;
        let mut by_part = study.directions(&rows[middle..=middle], fit, &each.collect::<Vec<_>>())?.pop()?;
        let mut correlations = correlations(structure);
        if structure.springs().iter().any(|spring| matches!(spring.form, Form::Bending(_))) {
            let (outputs, parts) = by_part.shape();
            by_part = by_part.resize_horizontally(parts + modes, 0.0);
            by_part.columns_mut(parts, modes).copy_from(&by_mode(outputs));
            correlations = correlations.into_iter().map(|c| c.resize(parts + modes, parts + modes, 0.0)).collect();
            let own = |i: usize, j: usize| f64::from(u8::from(i == j && i >= parts));
            correlations.push(DMatrix::from_fn(parts + modes, parts + modes, own));
        }
        Some(Self { springs, masses, by_part, correlations })
    }

    /// Directions that move the outputs independently, for the mean of C over the fields: size 1 of each is one standard deviation for
    /// σ = 1. And the prior covariance of their sizes for σ = 1 and each field.
    fn directions(&self) -> Option<(Vec<Direction>, Vec<DMatrix<f64>>)> {
        let parts = self.by_part.ncols();
        let sum = self.correlations.iter().fold(DMatrix::zeros(parts, parts), |sum, c| sum + c);
        let mean = sum / self.correlations.len() as f64;
        let eigen = (&self.by_part * &mean * self.by_part.transpose()).symmetric_eigen();
        let largest = eigen.eigenvalues.max();
        let mut order: Vec<usize> = (0..eigen.eigenvalues.len()).collect();
        order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
        order.retain(|q| eigen.eigenvalues[*q] > LEAST_SHARE * largest.max(f64::MIN_POSITIVE));
        order.truncate(MOST_DIRECTIONS);
        if order.is_empty() {
            return None;
        }
        // Outputs in units of the directions: z = Λ^(-1/2) Vᵀ d.
        let whiten = DMatrix::from_fn(order.len(), self.by_part.nrows(), |q, output| {
            eigen.eigenvectors[(output, order[q])] / eigen.eigenvalues[order[q]].sqrt()
        });
        let by_size = &whiten * &self.by_part;
        // The most probable deviation of the parts for given outputs.
        let weights = &mean * by_size.transpose();
        let direction = |q: usize| {
            let all: Vec<f64> = weights.column(q).iter().copied().collect();
            let (springs, rest) = all.split_at(self.springs);
            let (masses, modes) = rest.split_at(self.masses);
            let frequencies = modes.iter().map(|log| 0.5 * log).collect();
            Direction { springs: springs.to_vec(), masses: masses.to_vec(), frequencies }
        };
        let prior = |correlation: &DMatrix<f64>| &by_size * correlation * by_size.transpose();
        Some(((0..order.len()).map(direction).collect(), self.correlations.iter().map(prior).collect()))
    }
}

/// C of springs and masses for each field, `[springs + masses, springs + masses]`. Stiffnesses and masses deviate independently.
fn correlations(structure: &Structure) -> Vec<DMatrix<f64>> {
    let springs: Vec<BTreeSet<usize>> = structure.springs().iter().map(|s| s.form.dofs()).collect();
    let masses: Vec<BTreeSet<usize>> = structure.masses().iter().map(|m| m.form.dofs()).collect();
    let steps = steps(structure.dofs(), &springs);
    let count = springs.len() + masses.len();
    let distance = |a: &BTreeSet<usize>, b: &BTreeSet<usize>| {
        a.iter().flat_map(|a| b.iter().map(|b| steps[*a][*b])).fold(f64::INFINITY, f64::min)
    };
    let mut distances = DMatrix::from_element(count, count, f64::INFINITY);
    let mut largest: f64 = 1.0;
    for (first, parts) in [(0, &springs), (springs.len(), &masses)] {
        for (i, a) in parts.iter().enumerate() {
            for (j, b) in parts.iter().enumerate() {
                let apart = if i == j { 0.0 } else { 1.0 + distance(a, b) };
                distances[(first + i, first + j)] = apart;
                if apart.is_finite() {
                    largest = largest.max(apart);
                }
            }
        }
    }
    let correlation = |(length, alike): &(f64, f64)| {
        DMatrix::from_fn(count, count, |i, j| {
            let own = f64::from(u8::from(i == j));
            alike * (-distances[(i, j)] / (length * largest)).exp() + (1.0 - alike) * own
        })
    };
    FIELDS.iter().map(correlation).collect()
}

/// Smallest number of springs between each two degrees of freedom, `[dofs][dofs]`; infinite if no springs join them.
fn steps(dofs: usize, springs: &[BTreeSet<usize>]) -> Vec<Vec<f64>> {
    let mut neighbours = vec![BTreeSet::new(); dofs];
    for ends in springs {
        for dof in ends {
            neighbours[*dof].extend(ends.iter().copied().filter(|other| other != dof));
        }
    }
    let from = |start: usize| {
        let mut steps = vec![f64::INFINITY; dofs];
        let mut next = VecDeque::from([start]);
        steps[start] = 0.0;
        while let Some(dof) = next.pop_front() {
            for other in &neighbours[dof] {
                if steps[*other].is_infinite() {
                    steps[*other] = steps[dof] + 1.0;
                    next.push_back(*other);
                }
            }
        }
        steps
    };
    (0..dofs).map(from).collect()
}
