//! Mode shapes at the instrumented points of a structure: their definition, simulation and derivatives.

use std::collections::BTreeSet;

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use super::check::Problems;
use super::definition::{DefinitionProblem, StructureDefinition};
use super::{chained, structure_at, Model, Simulator};
use crate::measurement::shape::InstrumentedPoints;
use crate::physics::shapes::{shape_sensitivity, shapes_at};
use crate::physics::{self, frequency_sensitivity, modes, Structure};
use crate::quantity::shown;

/// Fewest instrumented points: a shape of one point says nothing.
const FEWEST_POINTS: usize = 2;

/// Largest noise of a shape: with more, shapes of neighbouring modes cannot be told apart.
const MOST_NOISE: f64 = 0.5;

/// Points whose motion gives the mode shapes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ModeShapesDefinition {
    /// Names of masses, of nodes in a simulation `beam`, in the order of the numbers of a shape.
    pub points: Vec<String>,
    /// Standard deviation of each number of a measured shape, as a share of the shape's root mean square.
    pub noise: f64,
}

/// Instrumented points of a checked structure.
#[derive(Debug, Clone, PartialEq)]
pub struct Instrumented {
    /// Degree of freedom of each point.
    pub(super) freedoms: Vec<usize>,
    /// Standard deviation of each number of a shape of unit norm.
    pub(super) std: f64,
    /// Their names, with the shapes of the nominal structure.
    pub(super) points: InstrumentedPoints,
}

/// Frequencies and shapes at one set of parameters, and their derivatives.
#[derive(Debug, Clone)]
pub struct Linearised {
    /// Hz, ascending, `[modes]`.
    pub frequencies_hz: Vec<f64>,
    /// Hz per parameter unit, `[modes, d]`.
    pub frequency_slopes: DMatrix<f64>,
    /// Unit norm, `[points, modes]`; without columns where no shapes were asked for.
    pub shapes: DMatrix<f64>,
    /// Per parameter unit, `[points, d]` for each mode.
    pub shape_slopes: Vec<DMatrix<f64>>,
}

/// The instrumented points of a definition, with the shapes of the nominal structure.
pub(super) fn check(definition: &StructureDefinition, model: &Model, problems: &mut Problems) -> Option<Instrumented> {
    let given = definition.mode_shapes.as_ref()?;
    let mut wrong = |key: &str, message: String| {
        problems.push(DefinitionProblem::new(format!("/mode_shapes{key}"), message));
    };
    let Model::Matrices { structure, .. } = model else {
        wrong("", "a table of runs holds no mode shapes: remove it, or describe the structure by masses".to_owned());
        return None;
    };
    if !definition.effects.is_empty() {
        wrong("", "mode shapes under effects are not simulated yet: remove mode_shapes or the effects".to_owned());
    }
    let noise = given.noise;
    if !(noise.is_finite() && noise > 0.0 && noise < MOST_NOISE) {
        wrong("/noise", format!("{noise} is no share of a shape's root mean square: above 0, below {MOST_NOISE}"));
    }
    if given.points.len() < FEWEST_POINTS {
        let count = given.points.len();
        wrong("/points", format!("{count} points: a shape has at least {FEWEST_POINTS}"));
    }
    let mut seen = BTreeSet::new();
    let mut freedoms = Vec::new();
    for (index, name) in given.points.iter().enumerate() {
        let key = format!("/points/{index}");
        match structure.places().iter().find(|place| place.name == *name) {
            None => wrong(&key, format!("{} is no mass or node that moves", shown(name))),
            Some(_) if !seen.insert(name) => wrong(&key, format!("{} is there twice", shown(name))),
            Some(place) => freedoms.push(place.freedom),
        }
    }
    if freedoms.len() != given.points.len() || !problems.is_empty() {
        return None;
    }
    let nominal = match modes(structure, definition.modes) {
        Ok(modes) => shapes_at(&modes, &freedoms),
        Err(error) => {
            problems.push(DefinitionProblem::new("/mode_shapes", format!("at the nominal stiffnesses: {error}")));
            return None;
        }
    };
    let nominal = nominal.column_iter().map(|shape| shape.iter().copied().collect()).collect();
    let points = InstrumentedPoints { names: given.points.clone(), nominal };
    Some(Instrumented { std: noise / (freedoms.len() as f64).sqrt(), freedoms, points })
}

impl Simulator {
    /// Number of points whose motion gives the mode shapes; 0 where none are measured.
    pub fn shape_points(&self) -> usize {
        self.instrumented().map_or(0, |i| i.freedoms.len())
    }

    /// The points whose motion gives the mode shapes, if they are measured.
    pub fn instrumented_points(&self) -> Option<&InstrumentedPoints> {
        self.instrumented().map(|i| &i.points)
    }

    /// Standard deviation of each number of a measured shape of unit norm.
    pub fn shape_std(&self) -> f64 {
        self.instrumented().map_or(0.0, |i| i.std)
    }

    fn instrumented(&self) -> Option<&Instrumented> {
        self.parts.checked.instrumented.as_ref()
    }

    /// Frequencies, Hz, and shapes `[points, modes]` of unit norm at `theta`, without noise.
    ///
    /// # Errors
    /// As [`Self::frequencies_hz`].
    pub fn frequencies_and_shapes(&self, theta: &[f64]) -> Result<(Vec<f64>, DMatrix<f64>), physics::Error> {
        match (self.model(), self.instrumented()) {
            (Model::Matrices { structure, bindings }, Some(instrumented)) => {
                let modes = modes(&structure_at(structure, bindings, theta)?, self.modes())?;
                let shapes = shapes_at(&modes, &instrumented.freedoms);
                Ok((modes.frequencies_hz, shapes))
            }
            _ => Ok((self.frequencies_hz(theta)?, DMatrix::zeros(0, 0))),
        }
    }

    /// The lowest `count` modes at `theta` and their derivatives; with shapes where the structure has instrumented points and
    /// `with_shapes` asks for them. Without shapes, or under effects, `count` is the number of modes measured.
    ///
    /// # Errors
    /// As [`Self::frequencies_hz`].
    pub fn linearise(&self, theta: &[f64], count: usize, with_shapes: bool) -> Result<Linearised, physics::Error> {
        match (self.model(), self.instrumented()) {
            (Model::Matrices { structure, bindings }, Some(instrumented)) if with_shapes => {
                let structure = structure_at(structure, bindings, theta)?;
                let modes = modes(&structure, count)?;
                let frequency_slopes = chained(&frequency_sensitivity(&structure, &modes).by_spring, bindings, theta);
                let springs: Vec<usize> = bindings.iter().map(|b| b.spring).collect();
                let by_spring = shape_sensitivity(&structure, &modes, &instrumented.freedoms, &springs);
                let by_parameter = |of_mode: DMatrix<f64>| {
                    let mut slopes = DMatrix::zeros(of_mode.nrows(), theta.len());
                    for (binding, column) in bindings.iter().zip(of_mode.column_iter()) {
                        let slope = binding.slope(theta[binding.parameter]);
                        slopes.column_mut(binding.parameter).axpy(slope, &column, 1.0);
                    }
                    slopes
                };
                let shapes = shapes_at(&modes, &instrumented.freedoms);
                let shape_slopes = by_spring.into_iter().map(by_parameter).collect();
                Ok(Linearised { frequencies_hz: modes.frequencies_hz, frequency_slopes, shapes, shape_slopes })
            }
            _ => {
                let (frequencies_hz, frequency_slopes) = self.frequencies_and_jacobian(theta)?;
                let (shapes, shape_slopes) = (DMatrix::zeros(0, 0), Vec::new());
                Ok(Linearised { frequencies_hz, frequency_slopes, shapes, shape_slopes })
            }
        }
    }

    /// Modes to look for a measured one among: those measured and a few above, which may change places with them.
    pub fn modes_to_pair(&self) -> usize {
        const ABOVE: usize = 3;
        (self.modes() + ABOVE).min(self.structure().map_or(self.modes(), Structure::freedoms))
    }
}
