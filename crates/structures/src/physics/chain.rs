//! Deviations of a chain that are in no single part: it bends, its base rotates, its masses are spread, or its stiffness or mass
//! changes along it.
//!
//! A chain is a row of bodies, each joined by springs to the one before it and the first to the ground, such as the floors of a building.
//! Its bodies are at the distances from the ground that the structure states, or else at equal ones; h: that of a body as a share of that of
//! the last.
//!
//! ```text
//!  base rotation:       K⁻¹ → K⁻¹ + g F₁₁ h hᵀ                                  F₁₁: deflection of the last body under a unit force there,
//!  bending:             K⁻¹ → K⁻¹ + g F₁₁ B,   B_ij = ½ h_i² (3 h_j − h_i), h_i ≤ h_j     of the chain without the deviation
//!  spread mass:         M → M + g Σ m (C − e eᵀ)                                 C: mass matrix of a rod of 1 kg from a body to the one before
//!  stiffness gradient:  ln k → ln k + g (z − ½)                                  z: 0 for the first, 1 for the last spring
//!  mass gradient:       ln m → ln m + g (z − ½)
//! ```
//!
//! g has no unit: the deflection of the last body by the deviation as a share of that by the springs; the share of each mass that is
//! spread evenly over the distance to the body before it; the logarithm of the ratio of the last to the first part.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::assembly::stiffness_matrix;
use super::direction::{Direction, LEAST_FACTOR};
use super::structure::{Form, Mass, Node, Structure};

/// What deviates along a chain.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ChainKind {
    /// The chain bends as a cantilever of constant bending stiffness, besides the deformation of its springs.
    Bending,
    /// The base rotates on an elastic ground.
    BaseRotation,
    /// A share of each mass is spread evenly over the distance to the body before it.
    SpreadMass,
    /// The stiffness changes evenly from the first spring to the last.
    StiffnessGradient,
    /// The mass changes evenly from the first body to the last.
    MassGradient,
}

impl ChainKind {
    /// All kinds.
    pub const ALL: [Self; 5] =
        [Self::Bending, Self::BaseRotation, Self::SpreadMass, Self::StiffnessGradient, Self::MassGradient];

    /// Its name in a structure file and in results.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bending => "bending",
            Self::BaseRotation => "base_rotation",
            Self::SpreadMass => "spread_mass",
            Self::StiffnessGradient => "stiffness_gradient",
            Self::MassGradient => "mass_gradient",
        }
    }
}

/// A deviation of a chain: what a size of 1 changes.
#[derive(Debug, Clone, PartialEq)]
pub struct ChainDeviation {
    /// What deviates.
    pub kind: ChainKind,
    pub(super) change: Change,
}

/// What a size of 1 changes.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Change {
    /// K⁻¹ grows by this matrix, `[n, n]`.
    Flexibility(Arc<DMatrix<f64>>),
    /// M grows by these masses.
    Inertia(Vec<Mass>),
    /// The logarithms of all stiffnesses and masses change.
    Along(Direction),
}

impl ChainDeviation {
    /// The deviation of this kind; `None` if the structure is no chain of at least two bodies, if the distances of its bodies from the ground
    /// do not ascend, or if it cannot carry a load.
    pub fn new(structure: &Structure, kind: ChainKind) -> Option<Self> {
        let order = order(structure)?;
        let n = order.len();
        let heights = heights(structure, &order)?;
        let place = |dof: usize| order.iter().position(|other| *other == dof).expect("every body has a place");
        let change = match kind {
            ChainKind::BaseRotation | ChainKind::Bending => {
                let roof = last_flexibility(structure, &order)?;
                // Deflection at one height under a force at another, as a share of that of the last body under a force there.
                let share = |low: f64, high: f64| match kind {
                    ChainKind::BaseRotation => low * high,
                    _ => low * low * (3.0 * high - low) / 2.0,
                };
                Change::Flexibility(Arc::new(DMatrix::from_fn(n, n, |a, b| {
                    let (a, b) = (heights[place(a)], heights[place(b)]);
                    roof * share(a.min(b), a.max(b))
                })))
            }
            ChainKind::SpreadMass => {
                let spread = |mass: &Mass| {
                    let dof = *mass.form.dofs().first()?;
                    let before = place(dof).checked_sub(1).map_or(Node::Ground, |place| Node::Dof(order[place]));
                    Some(Mass { name: String::new(), kg: mass.kg, form: Form::Spread(before, dof) })
                };
                Change::Inertia(structure.masses().iter().map(spread).collect::<Option<_>>()?)
            }
            ChainKind::StiffnessGradient | ChainKind::MassGradient => {
                let along = |place: usize| place as f64 / (n - 1) as f64 - 0.5;
                let last = |form: &Form| form.dofs().iter().map(|dof| place(*dof)).max().unwrap_or(0);
                let mut direction = Direction::default();
                if kind == ChainKind::StiffnessGradient {
                    direction.springs = structure.springs().iter().map(|s| along(last(&s.form))).collect();
                } else {
                    direction.masses = structure.masses().iter().map(|m| along(last(&m.form))).collect();
                }
                Change::Along(direction)
            }
        };
        Some(Self { kind, change })
    }

    /// Whether its size is the logarithm of the ratio of the last to the first part.
    pub fn is_gradient(&self) -> bool {
        matches!(self.change, Change::Along(_))
    }

    /// Applies the deviation of a size to a structure, or to the factors on the stiffnesses and masses that it gets afterwards. Returns the
    /// index of the flexibility, or of the first mass, that it adds; `None` if the size leaves too little.
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
