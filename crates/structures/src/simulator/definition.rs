//! The definition of a structure, a TOML or JSON file such as `models/three-dof/structure.toml`. Unknown keys are rejected.

use std::fmt;

use serde::de::{self, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

use super::discrepancy::definition::DiscrepancyDefinition;
pub use super::prior::Prior;
use crate::measurement::CovariateKind;
use crate::parameter::{DamageDirection, PriorForm};
use crate::physics::deviation::DeviationKind;
use crate::quantity::Digest;

pub use super::effect_definition::{EffectDefinition, TargetDefinition};

/// A structure as its file describes it; [`crate::simulator::Simulator`] is the checked form.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct StructureDefinition {
    /// Name of the structure, see [`crate::quantity::StructureId`].
    pub id: String,
    /// Free text for human readers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub description: Option<String>,
    /// Number of measured modes, counted from the lowest.
    pub modes: usize,
    /// Standard deviation of one measured frequency.
    #[serde(default)]
    pub measurement_noise: MeasurementNoise,
    /// Instrumented points, if mode shapes are measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mode_shapes: Option<ModeShapesDefinition>,
    /// Kind of simulation.
    #[serde(default, skip_serializing_if = "is_default")]
    pub simulation: SimulationKind,
    /// Nodes along a beam; only in a simulation `beam`.
    #[serde(rename = "node", default, skip_serializing_if = "Vec::is_empty")]
    pub nodes: Vec<NodeDefinition>,
    /// Beam spans between nodes; only in a simulation `beam`.
    #[serde(rename = "beam", default, skip_serializing_if = "Vec::is_empty")]
    pub beams: Vec<BeamDefinition>,
    /// Runs of a finite-element model; only in a simulation `table`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub table: Option<TableDefinition>,
    /// Rigid bodies.
    #[serde(rename = "mass", default)]
    pub masses: Vec<MassDefinition>,
    /// Springs.
    #[serde(rename = "spring", default)]
    pub springs: Vec<SpringDefinition>,
    /// Unknown parameters.
    #[serde(rename = "parameter", default)]
    pub parameters: Vec<ParameterDefinition>,
    /// Quantities measured in addition to the frequencies.
    #[serde(rename = "covariate", default, skip_serializing_if = "Vec::is_empty")]
    pub covariates: Vec<CovariateDefinition>,
    /// Influences on the structure or the instrument besides the parameters.
    #[serde(rename = "effect", default, skip_serializing_if = "Vec::is_empty")]
    pub effects: Vec<EffectDefinition>,
    /// Deviation of the simulation that was learned from data, because no effect explains it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub discrepancy: Option<DiscrepancyDefinition>,
    /// Digest of the definition that this definition extends.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parent: Option<String>,
}

/// The instrumented points, at which mode shapes are measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ModeShapesDefinition {
    /// Names of masses, or of nodes in a simulation `beam`, in the order of the components of a shape.
    pub points: Vec<String>,
    /// Standard deviation of each component of a measured shape, as a share of the root mean square of the shape.
    pub noise: f64,
}

/// Kind of simulation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SimulationKind {
    /// Rigid bodies on springs.
    #[default]
    SpringMass,
    /// Euler–Bernoulli beams with rigid bodies and springs.
    Beam,
    /// An emulator of the user's own finite-element runs.
    Table,
}

/// A node of a beam.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NodeDefinition {
    /// Unique name; `ground` is reserved.
    pub name: String,
    /// Position along the beam, m.
    pub x_m: f64,
    /// Support at the node.
    #[serde(default, skip_serializing_if = "is_default")]
    pub support: Support,
}

/// Degrees of freedom of a node that its support fixes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Support {
    /// None.
    #[default]
    Free,
    /// The deflection.
    Pinned,
    /// The rotation.
    Guided,
    /// The deflection and the rotation.
    Clamped,
}

/// A beam span of constant cross-section between two nodes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct BeamDefinition {
    /// Unique name.
    pub name: String,
    /// Name of the node at one end.
    pub from: String,
    /// Name of the node at the other end.
    pub to: String,
    /// Nominal bending stiffness EI, N·m². If a parameter sets it, the default is its value at the median of the prior.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bending_stiffness_n_m2: Option<f64>,
    /// Mass per length, kg/m.
    pub mass_kg_per_m: f64,
    /// Number of finite elements of equal length; the error of frequencies falls with its fourth power.
    #[serde(default = "default_elements")]
    pub elements: usize,
}

fn default_elements() -> usize {
    10
}

/// Runs of a finite-element model, one per line, with a column for every parameter by its name and columns `f1_hz`, `f2_hz`, ….
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct TableDefinition {
    /// Path of a CSV file, relative to the structure file. It is replaced by the text of the file on reading.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub file: Option<String>,
    /// The text of the CSV.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub csv: Option<String>,
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// Standard deviation of one measured frequency.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum MeasurementNoise {
    /// As a share of the frequency (–).
    Relative(f64),
    /// In Hz, the same for all modes.
    Hz(f64),
}

impl Default for MeasurementNoise {
    fn default() -> Self {
        Self::Relative(0.0)
    }
}

impl MeasurementNoise {
    /// Standard deviation of a frequency, Hz.
    pub fn std_hz(self, frequency_hz: f64) -> f64 {
        match self {
            Self::Relative(share) => share * frequency_hz,
            Self::Hz(std_hz) => std_hz,
        }
    }
}

/// A rigid body.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct MassDefinition {
    /// Unique name; `ground` is reserved.
    pub name: String,
    /// Mass, kg.
    pub kg: f64,
    /// Node of a beam to which it is attached.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub at: Option<String>,
    /// Distance from the ground along the structure, m; for masses on springs, of all masses or of none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub at_m: Option<f64>,
}

/// A spring between two masses or nodes, or between one of them and the ground.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SpringDefinition {
    /// Unique name.
    pub name: String,
    /// `ground` or the name of a mass (of a node in a simulation `beam`).
    pub from: String,
    /// `ground` or the name of a mass (of a node in a simulation `beam`).
    pub to: String,
    /// Nominal stiffness, N/m. If a parameter sets it, the default is its value at the median of the prior.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub n_per_m: Option<f64>,
    /// Nominal stiffness of a rotational spring at nodes of a beam, N·m/rad, instead of `n_per_m`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub n_m_per_rad: Option<f64>,
}

/// An unknown parameter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ParameterDefinition {
    /// Unique name.
    pub name: String,
    /// Unit, for display; by default that of the stiffness that the parameter sets without a law.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit: Option<String>,
    /// Whether the parameter is a factor p of the nominal stiffness of everything that it sets, k = p·k_nominal. Its prior is then
    /// given in factors, such as 0.5 to 1.5. Everywhere else its values are per cent of the nominal stiffness: 92 for p = 0.92.
    #[serde(default, skip_serializing_if = "is_default")]
    pub scale: bool,
    /// Prior distribution.
    pub prior: Prior,
    /// What the parameter sets: one table or a list of tables; none in a simulation `table`.
    #[serde(default, deserialize_with = "one_or_many", skip_serializing_if = "Vec::is_empty")]
    pub sets: Vec<Sets>,
    /// Direction of change that is damage.
    #[serde(default)]
    pub damage: DamageDirection,
}

/// Unit of the values of a parameter that is a factor of the nominal stiffness.
pub const PERCENT_OF_NOMINAL: &str = "% of nominal";

impl ParameterDefinition {
    /// Factor from the numbers of the prior in the file to the parameter's values: 100 for `scale`, because the values of such a
    /// parameter are per cent of the nominal stiffness.
    fn unit_factor(&self) -> f64 {
        if self.scale {
            100.0
        } else {
            1.0
        }
    }

    /// Bounds of the prior in the unit of the parameter's values.
    pub fn bounds(&self) -> [f64; 2] {
        self.prior.bounds().map(|value| self.unit_factor() * value)
    }

    /// Median of the prior in the unit of the parameter's values.
    pub fn median(&self) -> f64 {
        let [low, high] = self.bounds();
        match self.form() {
            PriorForm::Uniform => f64::midpoint(low, high),
            PriorForm::Normal { mean: median, .. } | PriorForm::LogNormal { median, .. } => median,
        }
    }

    /// Form of the prior between these bounds.
    pub fn form(&self) -> PriorForm {
        self.prior.form(self.unit_factor())
    }
}

/// What a parameter sets: the stiffness of a spring or of a beam span, a mass, or a deviation that is in no single part.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Sets {
    /// Name of the spring.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub spring: Option<String>,
    /// Name of the beam span whose bending stiffness it sets, instead of `spring`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub beam: Option<String>,
    /// Name of the mass, or of the beam span whose mass it sets, instead of `spring`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mass: Option<String>,
    /// The deviation whose size it is, instead of `spring`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub deviation: Option<DeviationKind>,
    /// Stiffness as a function of the parameter; without a law the parameter is the stiffness itself, or a factor of it for `scale`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub law: Option<Law>,
}

impl Sets {
    /// What it sets in words, such as "spring k1"; without a name for one that names nothing.
    pub fn in_words(&self) -> String {
        match (&self.spring, &self.beam, &self.mass, self.deviation) {
            (Some(spring), ..) => format!("spring {spring}"),
            (None, Some(beam), ..) => format!("beam {beam}"),
            (None, None, Some(mass), _) => format!("mass {mass}"),
            (None, None, None, Some(deviation)) => format!("the deviation {}", deviation.name()),
            (None, None, None, None) => "nothing".to_owned(),
        }
    }

    /// Whether it sets a mass or a deviation, and not a stiffness.
    pub fn is_size(&self) -> bool {
        self.mass.is_some() || self.deviation.is_some()
    }
}

impl StructureDefinition {
    /// Nominal value that the file states for what an entry of `sets` sets, in the unit of that (N/m, N·m/rad, N·m² or kg); none for a
    /// deviation.
    pub fn stated_value(&self, sets: &Sets) -> Option<f64> {
        match (&sets.spring, &sets.beam, &sets.mass) {
            (Some(name), ..) => self.springs.iter().find(|s| s.name == *name)?.stiffness(),
            (None, Some(name), _) => self.beams.iter().find(|b| b.name == *name)?.bending_stiffness_n_m2,
            (None, None, Some(name)) => self.masses.iter().find(|m| m.name == *name).map(|m| m.kg),
            (None, None, None) => None,
        }
    }

    /// Unit of what an entry of `sets` sets.
    pub fn unit_of(&self, sets: &Sets) -> &'static str {
        let rotational = |name: &String| self.springs.iter().any(|s| s.name == *name && s.n_m_per_rad.is_some());
        match &sets.spring {
            Some(name) if rotational(name) => "N·m/rad",
            Some(_) => "N/m",
            None if sets.mass.is_some() => "kg",
            None if sets.deviation.is_some() => "–",
            None => "N·m²",
        }
    }
}

impl SpringDefinition {
    /// Stated nominal stiffness, N/m, or N·m/rad for a rotational spring.
    pub fn stiffness(&self) -> Option<f64> {
        self.n_per_m.or(self.n_m_per_rad)
    }
}

/// Stiffness as a function of a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Law {
    /// k = a·exp(b·p) + c.
    Exponential(Exponential),
}

/// Constants of k = a·exp(b·p) + c (paper Eq. 25).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Exponential {
    /// N/m.
    pub a: f64,
    /// One over the parameter's unit.
    pub b: f64,
    /// N/m.
    pub c: f64,
}

impl Law {
    /// Stiffness k(p) at a parameter value, N/m.
    pub fn value(&self, p: f64) -> f64 {
        let Self::Exponential(e) = self;
        e.a * (e.b * p).exp() + e.c
    }

    /// Derivative dk/dp at a parameter value, N/m per unit of the parameter.
    pub fn slope(&self, p: f64) -> f64 {
        let Self::Exponential(e) = self;
        e.a * e.b * (e.b * p).exp()
    }
}

/// A quantity measured in addition to the frequencies.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct CovariateDefinition {
    /// Unique name, such as `temperature_c`.
    pub name: String,
    /// Kind of its values.
    #[serde(default)]
    pub kind: CovariateKind,
    /// Unit of a number, such as `°C`; by default the one that the name ends with, if it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit: Option<String>,
    /// Least and largest possible number; a value outside counts as missing. By default −60 to 150 °C for a temperature.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub range: Option<[f64; 2]>,
}

/// One mistake in a structure file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DefinitionProblem {
    /// JSON pointer, such as `/spring/3/from`; empty for the whole file.
    pub pointer: String,
    /// Line of a text file, counted from 1.
    pub line: Option<usize>,
    /// What is wrong, and what would be right.
    pub message: String,
}

impl DefinitionProblem {
    pub(super) fn new(pointer: impl Into<String>, message: impl Into<String>) -> Self {
        Self { pointer: pointer.into(), line: None, message: message.into() }
    }
}

impl fmt::Display for DefinitionProblem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(line) = self.line {
            write!(f, "line {line}, ")?;
        }
        if !self.pointer.is_empty() {
            write!(f, "{}: ", self.pointer)?;
        }
        f.write_str(&self.message)
    }
}

/// All mistakes found in a structure file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub struct DefinitionError {
    /// The mistakes in the order of the sections of the file; never empty.
    pub problems: Vec<DefinitionProblem>,
}

impl fmt::Display for DefinitionError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, problem) in self.problems.iter().enumerate() {
            write!(f, "{}{problem}", if index > 0 { "; " } else { "" })?;
        }
        Ok(())
    }
}

impl StructureDefinition {
    /// The definition as JSON with its keys in a fixed order, so that equal definitions give equal texts.
    pub fn canonical_json(&self) -> String {
        serde_json::to_string(self).expect("a definition is plain data")
    }

    /// Digest of [`Self::canonical_json`], which identifies the version of the structure.
    pub fn digest(&self) -> Digest {
        Digest::of(&[self.canonical_json().as_bytes()])
    }
}

/// Reads one table or a list of tables. Unlike an untagged enum, this keeps the error messages of both.
fn one_or_many<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Sets>, D::Error> {
    struct OneOrMany;
    impl<'de> Visitor<'de> for OneOrMany {
        type Value = Vec<Sets>;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("{ spring = \"…\" } or a list of such tables")
        }

        fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<Vec<Sets>, A::Error> {
            Sets::deserialize(de::value::MapAccessDeserializer::new(map)).map(|one| vec![one])
        }

        fn visit_seq<A: SeqAccess<'de>>(self, seq: A) -> Result<Vec<Sets>, A::Error> {
            Vec::deserialize(de::value::SeqAccessDeserializer::new(seq))
        }
    }
    deserializer.deserialize_any(OneOrMany)
}
