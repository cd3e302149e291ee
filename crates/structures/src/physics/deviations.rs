//! Which structure can deviate in which way, in no single part; the formulas are those of [`super::deviation`].

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use super::assembly::stiffness_matrix;
use super::deviation::{Change, Deviation, DeviationKind};
use super::deviation_of_beam::{of_beam, spans};
use super::direction::Direction;
use super::structure::{Form, Mass, Node, Structure};

impl Deviation {
    /// The deviation of a structure of this kind; `None` if the structure cannot deviate in this way ([`DeviationKind::needs`]), or cannot carry a load.
    pub fn new(structure: &Structure, kind: DeviationKind) -> Option<Self> {
        let spans = spans(structure);
        let change = if spans.is_empty() { of_chain(structure, kind) } else { of_beam(structure, &spans, kind) };
        Some(Self { kind, change: change? })
    }

    /// The curve of calibration of the instrument that measures modes of these nominal frequencies, Hz, `[m]`; `None` for equal ones.
    pub fn of_instrument(nominal_hz: &[f64]) -> Option<Self> {
        let (first, last) = (nominal_hz.first()?, nominal_hz.last()?);
        let frequencies =
            nominal_hz.iter().map(|hz| (hz * hz - first * first) / (last * last - first * first) - 0.5).collect();
        let change = Change::Along(Direction { frequencies, ..Direction::default() });
        (last > first).then_some(Self { kind: DeviationKind::Calibration, change })
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
