//! Deviations of a beam that are in no single part; their formulas are those of [`super::deviation`].

use std::sync::Arc;

use nalgebra::DVector;

use super::assembly::stiffness_matrix;
use super::beam::Span;
use super::deviation::{Change, DeviationKind, Graded};
use super::modes::modes;
use super::structure::{Form, Mass, Node, Spring, Structure};

/// The spans of a beam with their bending stiffness, from left to right; empty for any other structure.
pub(super) fn spans(structure: &Structure) -> Vec<Arc<Span>> {
    let span = |spring: &Spring| match &spring.form {
        Form::Bending(span) => Some(Arc::clone(span)),
        _ => None,
    };
    let mut all: Vec<Arc<Span>> = structure.springs().iter().filter_map(span).collect();
    all.sort_by(|a, b| a.start_m.total_cmp(&b.start_m));
    all
}

/// What a deviation of a beam changes; `None` for another kind, for one that needs a hinge at an end, or for a beam that cannot carry a load.
pub(super) fn of_beam(structure: &Structure, spans: &[Arc<Span>], kind: DeviationKind) -> Option<Change> {
    let first_span = spans.first()?;
    let last_span = spans.last()?;
    let spring = |form: Form| Spring { name: String::new(), form, n_per_m: 1.0 };
    let length_m = last_span.start_m + last_span.length_m() - first_span.start_m;
    let graded = |(part, form): (usize, &Form)| match form {
        Form::Bending(span) | Form::Inertia(span) => {
            let by_log = span.middles_m().map(|at_m| (at_m - first_span.start_m) / length_m - 0.5).collect();
            Some(Graded { part, by_log })
        }
        _ => None,
    };
    match kind {
        DeviationKind::BaseRotation => {
            let (clamped_m, free) = cantilever(structure, spans)?;
            let mut force = DVector::zeros(structure.dofs());
            force[free] = 1.0;
            let deflection = stiffness_matrix(structure).cholesky()?.solve(&force)[free];
            let mut turn = DVector::zeros(structure.dofs());
            for (at_m, [deflection, rotation]) in spans.iter().flat_map(|span| span.nodes()) {
                if let Some(dof) = deflection {
                    turn[dof] = (at_m - clamped_m) / length_m;
                }
                if let Some(dof) = rotation {
                    turn[dof] = 1.0 / length_m;
                }
            }
            (deflection > 0.0).then(|| Change::Flexibility(Arc::new(&turn * turn.transpose() * deflection)))
        }
        DeviationKind::EndRestraint => {
            // A support between two spans is a hinge of both.
            let supports: Vec<(f64, Option<usize>)> = spans.iter().flat_map(|span| span.supports()).collect();
            let single = |dof: &usize| supports.iter().filter(|(_, other)| *other == Some(*dof)).count() == 1;
            let bay_m = |at_m: f64| {
                let others = supports.iter().map(|(other, _)| (other - at_m).abs()).filter(|apart| *apart > 0.0);
                others.fold(length_m, f64::min)
            };
            let at_ends = |part: &Spring| -> Vec<Spring> {
                let Form::Bending(span) = &part.form else { return Vec::new() };
                let hinges = span.supports().filter_map(|(at_m, rotation)| Some((at_m, rotation.filter(single)?)));
                let hold = |(at_m, dof)| Spring {
                    n_per_m: part.n_per_m / bay_m(at_m),
                    ..spring(Form::Spring(Node::Ground, Node::Dof(dof)))
                };
                hinges.map(hold).collect()
            };
            of_first_mode(structure, structure.springs().iter().flat_map(at_ends).collect())
        }
        DeviationKind::AxialForce => {
            of_first_mode(structure, spans.iter().map(|span| spring(Form::Slope(Arc::clone(span)))).collect())
        }
        DeviationKind::RotaryInertia => {
            let per_length = |mass: &Mass| match &mass.form {
                Form::Inertia(span) => Some(Mass {
                    name: String::new(),
                    kg: mass.kg / span.length_m(),
                    form: Form::Slope(Arc::clone(span)),
                }),
                _ => None,
            };
            let masses: Vec<Mass> = structure.masses().iter().filter_map(per_length).collect();
            let (shape, _) = first_mode(structure)?;
            let scale = 1.0 / masses.iter().map(|mass| mass.kg * energy(&mass.form, &shape)).sum::<f64>();
            let scaled = masses.into_iter().map(|mass| Mass { kg: scale * mass.kg, ..mass }).collect();
            scale.is_finite().then_some(Change::Inertia(scaled))
        }
        DeviationKind::StiffnessGradient => {
            let parts = structure.springs().iter().map(|spring| &spring.form).enumerate();
            Some(Change::AlongStiffness(parts.filter_map(graded).collect()))
        }
        DeviationKind::MassGradient => {
            let parts = structure.masses().iter().map(|mass| &mass.form).enumerate();
            Some(Change::AlongInertia(parts.filter_map(graded).collect()))
        }
        _ => None,
    }
}

/// Position of the clamped end of a cantilever, m, and the deflection of its free end; `None` for another beam.
fn cantilever(structure: &Structure, spans: &[Arc<Span>]) -> Option<(f64, usize)> {
    if structure.springs().iter().any(|spring| !matches!(spring.form, Form::Bending(_))) {
        return None;
    }
    let (mut held, mut ends) = (Vec::new(), Vec::new());
    for (at_m, dofs) in spans.iter().flat_map(|span| span.nodes()) {
        match dofs {
            [None, None] => held.push(at_m),
            [Some(deflection), Some(_)] => ends.push((at_m, deflection)),
            _ => return None,
        }
    }
    let [clamped_m] = held.as_slice() else { return None };
    let apart = |at_m: f64| (at_m - clamped_m).abs();
    let (_, free) = ends.into_iter().max_by(|a, b| apart(a.0).total_cmp(&apart(b.0)))?;
    Some((*clamped_m, free))
}

/// The springs, all by one factor, with stiffnesses by which that of the first mode doubles; `None` if they do not act in it.
fn of_first_mode(structure: &Structure, springs: Vec<Spring>) -> Option<Change> {
    let (shape, stiffness) = first_mode(structure)?;
    let scale = stiffness / springs.iter().map(|spring| spring.n_per_m * energy(&spring.form, &shape)).sum::<f64>();
    let scaled = springs.into_iter().map(|spring| Spring { n_per_m: scale * spring.n_per_m, ..spring }).collect();
    scale.is_finite().then_some(Change::Stiffness(scaled))
}

/// The first mode shape φ, with φᵀ M φ = 1, and its stiffness φᵀ K φ = λ, rad²/s².
fn first_mode(structure: &Structure) -> Option<(DVector<f64>, f64)> {
    let modes = modes(structure, 1).ok()?;
    let angular = std::f64::consts::TAU * modes.frequencies_hz[0];
    Some((modes.shapes().column(0).into_owned(), angular * angular))
}

/// φᵀ A φ of the matrix of a form.
fn energy(form: &Form, shape: &DVector<f64>) -> f64 {
    let mut sum = 0.0;
    form.entries(|row, column, value| sum += shape[row] * value * shape[column]);
    sum
}
