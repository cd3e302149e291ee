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
//! **Of a beam**: the clamped end of a cantilever rotates, the hinges at its ends hold the rotation, a force acts along it, its cross-sections
//! resist rotation, or its bending stiffness or mass changes along it, from element to element.
//!
//! ```text
//!  base rotation:       K⁻¹ → K⁻¹ + g F₁₁ h hᵀ      h: rotation about the clamped end, 1 m at the free end; F₁₁: its deflection under a unit force
//!  end restraint:       K → K + g c Σ EI/L e eᵀ    e: rotation of a hinge on a support at an end of the beam; L: distance to the next support
//!  axial force:         K → K + g c ∫ w'²          a tension if g > 0
//!  rotary inertia:      M → M + g c ∫ ρA w'²       ρA: mass per length of each span
//!  stiffness gradient:  ln EI → ln EI + g (x/L − ½)     x: position of the middle of an element, L: length of the beam
//!  mass gradient:       ln ρA → ln ρA + g (x/L − ½)
//! ```
//!
//! **Of the instrument**: the relative error of a measured frequency changes with the square of the frequency, as that of any scheme that
//! replaces time by samples does to first order (bilinear transform: f → atan(π f T)/(π T) ≈ f (1 − (π f T)²/3)).
//!
//! ```text
//!  calibration:         ln f → ln f + g (z − ½)     z: 0 for the first, 1 for the last measured mode, by the squares of the nominal frequencies
//! ```
//!
//! g has no unit: the deflection of the last body by the deviation as a share of that by the springs; the share of each mass that is
//! spread evenly over the distance to the body before it; the logarithm of the ratio of the last to the first part, end or mode. c is such that g is the
//! share by which the stiffness, or the mass, of the first mode of the beam grows.
//!
//! Sources: Clough and Penzien (2003), Dynamics of Structures, chapter 10, for the geometric stiffness of a beam; Monforton and Wu (1963),
//! Journal of the Structural Division 89, 13–42, for one fixity of all ends, whose stiffnesses are in proportion to EI/L; Oppenheim and Schafer
//! (2010), Discrete-Time Signal Processing, section 7.2, for the bilinear transform.

use std::sync::Arc;

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use super::beam::Span;
use super::direction::{Direction, LEAST_FACTOR};
use super::structure::{Form, Mass, Spring, Structure};

/// What deviates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DeviationKind {
    /// The chain bends as a cantilever of constant bending stiffness, besides the deformation of its springs.
    Bending,
    /// The base of a chain, or the clamped end of a cantilever, rotates on an elastic ground.
    BaseRotation,
    /// A share of each mass is spread evenly over the distance to the body before it.
    SpreadMass,
    /// The stiffness changes evenly from the first spring to the last, or along a beam.
    StiffnessGradient,
    /// The mass changes evenly from the first body to the last, or along a beam.
    MassGradient,
    /// The hinges at the ends of a beam hold the rotation elastically.
    EndRestraint,
    /// A force acts along a beam.
    AxialForce,
    /// The cross-sections of a beam resist rotation by their mass.
    RotaryInertia,
    /// The relative error of the instrument changes with the square of the frequency.
    Calibration,
}

impl DeviationKind {
    /// Those of a structure.
    pub const OF_A_STRUCTURE: [Self; 8] = [
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
            Self::Calibration => "calibration",
        }
    }

    /// Smallest and largest possible size.
    pub const fn possible_sizes(self) -> (f64, f64) {
        match self {
            Self::SpreadMass => (0.0, 1.0),
            Self::Bending | Self::BaseRotation | Self::EndRestraint | Self::RotaryInertia => (0.0, f64::INFINITY),
            Self::StiffnessGradient | Self::MassGradient | Self::AxialForce | Self::Calibration => {
                (f64::NEG_INFINITY, f64::INFINITY)
            }
        }
    }

    /// Whether a decrease can be damage: a restraint or a tension that is lost.
    pub const fn may_be_lost(self) -> bool {
        matches!(self, Self::EndRestraint | Self::AxialForce)
    }

    /// Whether it can vary while a structure stands: with the temperature of a beam that is held, or of the ground and the bearings.
    pub const fn can_vary(self) -> bool {
        matches!(self, Self::EndRestraint | Self::AxialForce | Self::BaseRotation)
    }

    /// The structure that can deviate in this way, as the object of "needs".
    pub const fn needs(self) -> &'static str {
        match self {
            Self::BaseRotation => {
                "a chain: two or more masses, each joined by springs to the one before it, the first to the ground, and by no others, whose \
                 at_m, if given, ascend; or a beam that is clamped at one end and held nowhere else, without springs"
            }
            Self::Bending | Self::SpreadMass => {
                "a chain: two or more masses, each joined by springs to the one before it, the first to the ground, and by no others; their \
                 at_m, if given, must ascend"
            }
            Self::StiffnessGradient | Self::MassGradient => {
                "a chain of masses, each joined by springs to the one before it, the first to the ground, and by no others; or a beam"
            }
            Self::EndRestraint => "a beam with a pinned support at an end",
            Self::AxialForce | Self::RotaryInertia => "a beam",
            Self::Calibration => "two or more measured modes of different frequencies",
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
    /// The logarithms of all stiffnesses and masses, or of the measured frequencies, change.
    Along(Direction),
    /// The logarithms of the bending stiffnesses of the elements of spans change.
    AlongStiffness(Vec<Graded>),
    /// The logarithms of the masses of the elements of spans change.
    AlongInertia(Vec<Graded>),
}

/// A span whose elements change.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Graded {
    /// Index of the spring or mass that is the span.
    pub(super) part: usize,
    /// Change of the logarithm of each element for a size of 1.
    pub(super) by_log: Vec<f64>,
}

impl Graded {
    /// The span at a size, and its derivative by the size, in the place of a form.
    fn at(&self, size: f64, form: &Form) -> [Arc<Span>; 2] {
        let (Form::Bending(span) | Form::Inertia(span)) = form else { unreachable!("it was a span when it was found") };
        let changed = span.times(self.by_log.iter().map(|by| (size * by).exp()));
        let slope = changed.times(self.by_log.iter().copied());
        [Arc::new(changed), Arc::new(slope)]
    }
}

impl Deviation {
    /// Its direction, if it changes logarithms.
    pub(super) fn direction(&self) -> Option<&Direction> {
        match &self.change {
            Change::Along(direction) => Some(direction),
            _ => None,
        }
    }

    /// The springs by which K grows, for a deviation that does nothing else.
    pub fn springs(&self) -> Option<&[Spring]> {
        match &self.change {
            Change::Stiffness(springs) => Some(springs),
            _ => None,
        }
    }

    /// Whether its size is the logarithm of the ratio of the last to the first part.
    pub fn is_gradient(&self) -> bool {
        matches!(self.change, Change::Along(_) | Change::AlongStiffness(_) | Change::AlongInertia(_))
    }

    /// Applies the deviation of a size to a structure, or to the factors on the stiffnesses and masses that it gets afterwards. Returns the
    /// index of the flexibility, or of the first spring or mass, that it adds; `None` if the size leaves too little. A change from element to
    /// element adds springs or masses of 0, in the form of the derivative by the size.
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
            Change::AlongStiffness(spans) => {
                let first = structure.springs.len();
                for graded in spans {
                    let [changed, slope] = graded.at(size, &structure.springs[graded.part].form);
                    structure.springs[graded.part].form = Form::Bending(changed);
                    let form = Form::Bending(slope);
                    structure.springs.push(Spring { name: String::new(), form, n_per_m: 0.0 });
                }
                enough_along(size).then_some(first)
            }
            Change::AlongInertia(spans) => {
                let first = structure.masses.len();
                for graded in spans {
                    let [changed, slope] = graded.at(size, &structure.masses[graded.part].form);
                    structure.masses[graded.part].form = Form::Inertia(changed);
                    structure.masses.push(Mass { name: String::new(), kg: 0.0, form: Form::Inertia(slope) });
                }
                enough_along(size).then_some(first)
            }
        }
    }
}

/// Whether a change of a logarithm by half of this size leaves enough.
fn enough_along(size: f64) -> bool {
    (-0.5 * size.abs()).exp() >= LEAST_FACTOR
}
