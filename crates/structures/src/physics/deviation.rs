//! Deviations that are in no single part of a structure.
//!
//! **Of a chain**: it bends, its base rotates, its masses are spread, or its stiffness or mass changes along it. A chain is a row of bodies,
//! each joined by springs to the one before it and the first to the ground, such as the floors of a building. Its bodies are at the distances
//! from the ground that the structure states, or else at equal ones; h: that of a body as a share of that of the last.
//!
//! ```text
//!  base rotation:       K⁻¹ → K⁻¹ + g F₁₁ h hᵀ                                  F₁₁: deflection of the last body under a unit force there,
//!  bending:             K⁻¹ → K⁻¹ + g F₁₁ B,   B_ij = ½ h_i² (3 h_j − h_i), h_i ≤ h_j     of the chain without the deviation
//!  spread mass:         M → M + g Σ m (C − e eᵀ)                                 C: mass matrix of a rod of 1 kg from a body to the one before
//!  stiffness gradient:  ln k → ln k + g (z − ½)                                  z: 0 for the first, 1 for the last part
//!  mass gradient:       ln m → ln m + g (z − ½)
//! ```
//!
//! **Of a beam**: the hinges at its ends hold the rotation, a force acts along it, its cross-sections resist rotation, or its bending stiffness
//! or mass changes along it.
//!
//! ```text
//!  end restraint:       K → K + g c Σ e eᵀ         e: rotation of a hinge on a support at an end of the beam
//!  axial force:         K → K + g c ∫ w'²          a tension if g > 0
//!  rotary inertia:      M → M + g c ∫ ρA w'²       ρA: mass per length of each span
//! ```
//!
//! g has no unit: the deflection of the last body by the deviation as a share of that by the springs; the share of each mass that is
//! spread evenly over the distance to the body before it; the logarithm of the ratio of the last to the first part. c is such that g is the
//! share by which the stiffness, or the mass, of the first mode of the beam grows.
//!
//! Source: Clough and Penzien (2003), Dynamics of Structures, chapter 10, for the geometric stiffness of a beam.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::assembly::stiffness_matrix;
use super::beam::Span;
use super::direction::{Direction, LEAST_FACTOR};
use super::modes::modes;
use super::structure::{Form, Mass, Node, Spring, Structure};

/// What deviates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DeviationKind {
    /// The chain bends as a cantilever of constant bending stiffness, besides the deformation of its springs.
    Bending,
    /// The base rotates on an elastic ground.
    BaseRotation,
    /// A share of each mass is spread evenly over the distance to the body before it.
    SpreadMass,
    /// The stiffness changes evenly from the first spring or span to the last.
    StiffnessGradient,
    /// The mass changes evenly from the first body or span to the last.
    MassGradient,
    /// The hinges at the ends of a beam hold the rotation elastically.
    EndRestraint,
    /// A force acts along a beam.
    AxialForce,
    /// The cross-sections of a beam resist rotation by their mass.
    RotaryInertia,
}

impl DeviationKind {
    /// All kinds.
    pub const ALL: [Self; 8] = [
        Self::Bending,
        Self::BaseRotation,
        Self::SpreadMass,
        Self::StiffnessGradient,
        Self::MassGradient,
        Self::EndRestraint,
        Self::AxialForce,
        Self::RotaryInertia,
    ];

    /// Its name in a structure file and in results.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bending => "bending",
            Self::BaseRotation => "base_rotation",
            Self::SpreadMass => "spread_mass",
            Self::StiffnessGradient => "stiffness_gradient",
            Self::MassGradient => "mass_gradient",
            Self::EndRestraint => "end_restraint",
            Self::AxialForce => "axial_force",
            Self::RotaryInertia => "rotary_inertia",
        }
    }

    /// The structure that can deviate in this way, as the object of "needs".
    pub const fn needs(self) -> &'static str {
        match self {
            Self::Bending | Self::BaseRotation | Self::SpreadMass => {
                "a chain: two or more masses, each joined by springs to the one before it, the first to the ground, and by no others; their \
                 at_m, if given, must ascend"
            }
            Self::StiffnessGradient | Self::MassGradient => {
                "a chain of masses, each joined by springs to the one before it, the first to the ground, and by no others; or a beam of two or \
                 more spans"
            }
            Self::EndRestraint => "a beam with a pinned support at an end",
            Self::AxialForce | Self::RotaryInertia => "a beam",
        }
    }
}

/// A deviation: what a size of 1 changes.
#[derive(Debug, Clone, PartialEq)]
pub struct Deviation {
    /// What deviates.
    pub kind: DeviationKind,
    pub(super) change: Change,
}

/// What a size of 1 changes.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Change {
    /// K⁻¹ grows by this matrix, `[n, n]`.
    Flexibility(Arc<DMatrix<f64>>),
    /// K grows by these springs.
    Stiffness(Vec<Spring>),
    /// M grows by these masses.
    Inertia(Vec<Mass>),
    /// The logarithms of all stiffnesses and masses change.
    Along(Direction),
}

impl Deviation {
    /// The deviation of this kind; `None` if the structure cannot deviate in this way ([`DeviationKind::needs`]), or cannot carry a load.
    pub fn new(structure: &Structure, kind: DeviationKind) -> Option<Self> {
        let spans = spans(structure);
        let change = if spans.is_empty() { of_chain(structure, kind) } else { of_beam(structure, &spans, kind) };
        Some(Self { kind, change: change? })
    }

    /// Whether its size is the logarithm of the ratio of the last to the first part.
    pub fn is_gradient(&self) -> bool {
        matches!(self.change, Change::Along(_))
    }

    /// Applies the deviation of a size to a structure, or to the factors on the stiffnesses and masses that it gets afterwards. Returns the
    /// index of the flexibility, or of the first spring or mass, that it adds; `None` if the size leaves too little.
    pub(super) fn apply(
        &self,
        size: f64,
        structure: &mut Structure,
        (springs, masses): (&mut [f64], &mut [f64]),
    ) -> Option<usize> {
        let enough = size.is_finite() && 1.0 + size >= LEAST_FACTOR;
        match &self.change {
            Change::Flexibility(further) => {
                structure.flexibilities.push((size, Arc::clone(further)));
                enough.then_some(structure.flexibilities.len() - 1)
            }
            Change::Stiffness(further) => {
                let first = structure.springs.len();
                let grown = further.iter().cloned().map(|spring| Spring { n_per_m: size * spring.n_per_m, ..spring });
                structure.springs.extend(grown);
                enough.then_some(first)
            }
            Change::Inertia(further) => {
                let first = structure.masses.len();
                let spread = further.iter().cloned().map(|mass| Mass { kg: size * mass.kg, ..mass });
                structure.masses.extend(spread);
                enough.then_some(first)
            }
            Change::Along(direction) => direction.scale(size, springs, masses).then_some(0),
        }
    }
}

/// What a deviation of a chain changes; `None` for another kind, or if the structure is no chain of at least two bodies whose distances from
/// the ground ascend.
fn of_chain(structure: &Structure, kind: DeviationKind) -> Option<Change> {
    let order = order(structure)?;
    let n = order.len();
    let heights = heights(structure, &order)?;
    let place = |dof: usize| order.iter().position(|other| *other == dof).expect("every body has a place");
    let change = match kind {
        DeviationKind::BaseRotation | DeviationKind::Bending => {
            let roof = last_flexibility(structure, &order)?;
            // Deflection at one height under a force at another, as a share of that of the last body under a force there.
            let share = |low: f64, high: f64| match kind {
                DeviationKind::BaseRotation => low * high,
                _ => low * low * (3.0 * high - low) / 2.0,
            };
            Change::Flexibility(Arc::new(DMatrix::from_fn(n, n, |a, b| {
                let (a, b) = (heights[place(a)], heights[place(b)]);
                roof * share(a.min(b), a.max(b))
            })))
        }
        DeviationKind::SpreadMass => {
            let spread = |mass: &Mass| {
                let dof = *mass.form.dofs().first()?;
                let before = place(dof).checked_sub(1).map_or(Node::Ground, |place| Node::Dof(order[place]));
                Some(Mass { name: String::new(), kg: mass.kg, form: Form::Spread(before, dof) })
            };
            Change::Inertia(structure.masses().iter().map(spread).collect::<Option<_>>()?)
        }
        DeviationKind::StiffnessGradient | DeviationKind::MassGradient => {
            let along = |place: usize| place as f64 / (n - 1) as f64 - 0.5;
            let last = |form: &Form| form.dofs().iter().map(|dof| place(*dof)).max().unwrap_or(0);
            let mut direction = Direction::default();
            if kind == DeviationKind::StiffnessGradient {
                direction.springs = structure.springs().iter().map(|s| along(last(&s.form))).collect();
            } else {
                direction.masses = structure.masses().iter().map(|m| along(last(&m.form))).collect();
            }
            Change::Along(direction)
        }
        _ => return None,
    };
    Some(change)
}

/// The spans of a beam with their bending stiffness, from left to right; empty for any other structure.
fn spans(structure: &Structure) -> Vec<Arc<Span>> {
    let span = |spring: &Spring| match &spring.form {
        Form::Bending(span) => Some(Arc::clone(span)),
        _ => None,
    };
    let mut all: Vec<Arc<Span>> = structure.springs().iter().filter_map(span).collect();
    all.sort_by(|a, b| a.start_m.total_cmp(&b.start_m));
    all
}

/// What a deviation of a beam changes; `None` for another kind, for one that needs a hinge at an end, or for a beam that cannot carry a load.
fn of_beam(structure: &Structure, spans: &[Arc<Span>], kind: DeviationKind) -> Option<Change> {
    let first_span = spans.first()?;
    let last_span = spans.last()?;
    let spring = |form: Form| Spring { name: String::new(), form, n_per_m: 1.0 };
    match kind {
        DeviationKind::EndRestraint => {
            // A support between two spans is a hinge of both.
            let mut hinges: Vec<usize> = spans.iter().flat_map(|span| span.hinges()).collect();
            hinges.sort_unstable();
            let single = |dof: &&usize| hinges.iter().filter(|other| other == dof).count() == 1;
            let springs = hinges.iter().filter(single).map(|dof| spring(Form::Spring(Node::Ground, Node::Dof(*dof))));
            of_first_mode(structure, springs.collect())
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
        DeviationKind::StiffnessGradient | DeviationKind::MassGradient if spans.len() > 1 => {
            let middle = |span: &Span| span.start_m + 0.5 * span.length_m();
            let (first, last) = (middle(first_span), middle(last_span));
            let along = |form: &Form| match form {
                Form::Bending(span) | Form::Inertia(span) => (middle(span) - first) / (last - first) - 0.5,
                _ => 0.0,
            };
            let mut direction = Direction::default();
            if kind == DeviationKind::StiffnessGradient {
                direction.springs = structure.springs().iter().map(|s| along(&s.form)).collect();
            } else {
                direction.masses = structure.masses().iter().map(|m| along(&m.form)).collect();
            }
            Some(Change::Along(direction))
        }
        _ => None,
    }
}

/// The springs with a stiffness by which that of the first mode doubles; `None` if they do not act in it.
fn of_first_mode(structure: &Structure, springs: Vec<Spring>) -> Option<Change> {
    let (shape, stiffness) = first_mode(structure)?;
    let scale = stiffness / springs.iter().map(|spring| energy(&spring.form, &shape)).sum::<f64>();
    let scaled = springs.into_iter().map(|spring| Spring { n_per_m: scale, ..spring }).collect();
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

/// Degrees of freedom of the bodies of a chain from the ground on; `None` if the structure is none.
fn order(structure: &Structure) -> Option<Vec<usize>> {
    let n = structure.dofs();
    let rigid = |mass: &Mass| matches!(mass.form, Form::Spring(Node::Ground, Node::Dof(_)));
    if n < 2 || !structure.masses().iter().all(rigid) {
        return None;
    }
    let ends = |form: &Form| match form {
        Form::Spring(a, b) => Some((*a, *b)),
        _ => None,
    };
    let springs: Vec<(Node, Node)> = structure.springs().iter().map(|s| ends(&s.form)).collect::<Option<_>>()?;
    let mut order: Vec<usize> = Vec::with_capacity(n);
    let mut last = Node::Ground;
    while order.len() < n {
        // Of the neighbours of the last body, exactly one is not in the chain yet.
        let beyond = |(a, b): &(Node, Node)| match (*a == last, *b == last) {
            (true, false) => Some(*b),
            (false, true) => Some(*a),
            _ => None,
        };
        let known = |node: &Node| match node {
            Node::Ground => true,
            Node::Dof(dof) => order.contains(dof),
        };
        let mut next = springs.iter().filter_map(beyond).filter(|node| !known(node));
        let Node::Dof(first) = next.next()? else { return None };
        if next.any(|node| node != Node::Dof(first)) {
            return None;
        }
        order.push(first);
        last = Node::Dof(first);
    }
    // No spring joins two bodies that are not neighbours.
    let place = |node: Node| match node {
        Node::Ground => Some(0),
        Node::Dof(dof) => order.iter().position(|other| *other == dof).map(|place| place + 1),
    };
    let neighbours = springs.iter().all(|(a, b)| place(*a).zip(place(*b)).is_some_and(|(a, b)| a.abs_diff(b) == 1));
    neighbours.then_some(order)
}

/// Distance of each body of a chain from the ground, in their order, as a share of that of the last; `None` if they do not ascend.
fn heights(structure: &Structure, order: &[usize]) -> Option<Vec<f64>> {
    let at = |(place, dof): (usize, &usize)| structure.positions_m.as_ref().map_or((place + 1) as f64, |all| all[*dof]);
    let positions: Vec<f64> = order.iter().enumerate().map(at).collect();
    let last = *positions.last()?;
    let ascend = positions[0] > 0.0 && positions.windows(2).all(|pair| pair[0] < pair[1]);
    ascend.then(|| positions.iter().map(|position| position / last).collect())
}

/// Deflection of the last body under a unit force there, m/N.
fn last_flexibility(structure: &Structure, order: &[usize]) -> Option<f64> {
    let last = *order.last()?;
    let mut force = DVector::zeros(structure.dofs());
    force[last] = 1.0;
    let deflection = stiffness_matrix(structure).cholesky()?.solve(&force)[last];
    (deflection > 0.0 && deflection.is_finite()).then_some(deflection)
}
