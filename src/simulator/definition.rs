//! The structure file: one TOML file or one JSON body, read strictly, every mistake named with its place.
//!
//! `models/three-dof/structure.toml` is an example; README lists the keys.

use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;

use serde::de::{self, DeserializeOwned, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

use super::check;
use super::law::LawKind;
use super::shapes::ModeShapesDefinition;
use crate::measurement::CovariateKind;
use crate::parameter::DamageDirection;
use crate::quantity::{json_pointer, shown, Digest};

/// A structure as a file describes it; `simulator::Simulator` is the checked form.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct StructureDefinition {
    /// Name of the structure, see [`crate::quantity::StructureId`].
    pub id: String,
    /// For people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub description: Option<String>,
    /// Number of modes measured, from the lowest.
    pub modes: usize,
    /// Standard deviation of one measured frequency.
    #[serde(default)]
    pub measurement_noise: MeasurementNoise,
    /// Where mode shapes are measured, if they are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mode_shapes: Option<ModeShapesDefinition>,
    /// What kind of simulation it is.
    #[serde(default, skip_serializing_if = "is_default")]
    pub simulation: SimulationKind,
    /// Places along a beam; only of a simulation `beam`.
    #[serde(rename = "node", default, skip_serializing_if = "Vec::is_empty")]
    pub nodes: Vec<NodeDefinition>,
    /// Spans between nodes; only of a simulation `beam`.
    #[serde(rename = "beam", default, skip_serializing_if = "Vec::is_empty")]
    pub beams: Vec<BeamDefinition>,
    /// Runs of a finite-element model; only of a simulation `table`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub table: Option<TableDefinition>,
    /// Masses.
    #[serde(rename = "mass", default)]
    pub masses: Vec<MassDefinition>,
    /// Springs.
    #[serde(rename = "spring", default)]
    pub springs: Vec<SpringDefinition>,
    /// Unknown parameters.
    #[serde(rename = "parameter", default)]
    pub parameters: Vec<ParameterDefinition>,
    /// What is measured beside the frequencies.
    #[serde(rename = "covariate", default, skip_serializing_if = "Vec::is_empty")]
    pub covariates: Vec<CovariateDefinition>,
    /// What acts on the structure beside its parameters.
    #[serde(rename = "effect", default, skip_serializing_if = "Vec::is_empty")]
    pub effects: Vec<EffectDefinition>,
    /// Digest of the definition that this one extends.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parent: Option<String>,
}

/// An effect: target × law × covariate, with what is known of its numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct EffectDefinition {
    /// Unique name.
    pub name: String,
    /// For people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub description: Option<String>,
    /// What changes.
    pub target: TargetDefinition,
    /// Form of the law.
    pub law: LawKind,
    /// Under which declared covariate; none for a constant.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub covariate: Option<String>,
    /// Value of the covariate at which the effect has its `level`.
    #[serde(default)]
    pub reference: f64,
    /// Numbers of the law by name: their means. A category has one for each category that is named.
    pub numbers: BTreeMap<String, f64>,
    /// Their covariance, in the order of their names; none where they are exact.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub covariance: Vec<Vec<f64>>,
    /// Values of a numeric covariate that the effect was learnt from: quantiles at equal steps from the least to the
    /// greatest, at least two. Training draws between the ends; a measurement without the covariate is taken at all of
    /// them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub seen: Vec<f64>,
}

/// What an effect changes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum TargetDefinition {
    /// Stiffness of these springs, k(1 + g).
    Springs(Vec<String>),
    /// Mass of these bodies, m(1 + g).
    Masses(Vec<String>),
    /// This parameter, p(1 + g).
    Parameter(String),
    /// Scale of the measured frequency of this mode, from 1; of all modes for 0: f(1 + g).
    FrequencyScale(usize),
    /// Offset of the measured frequency of this mode, from 1; of all modes for 0: f + g, Hz.
    FrequencyOffset(usize),
    /// A spring of stiffness g, N/m, between two nodes.
    AddedSpring([String; 2]),
    /// A body of `size` kg on a spring tuned to `frequency_hz`, attached to this mass.
    Oscillator(String),
    /// Mode i of the data is this mode of the structure, from 1.
    ModeOrder(Vec<usize>),
}

/// What computes the frequencies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SimulationKind {
    /// Bodies on springs.
    #[default]
    SpringMass,
    /// Euler–Bernoulli beams with bodies and springs.
    Beam,
    /// An emulator of the user's own finite-element runs.
    Table,
}

/// A place along a beam.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NodeDefinition {
    /// Unique name; `ground` is taken.
    pub name: String,
    /// Position along the beam, m.
    pub x_m: f64,
    /// What holds it.
    #[serde(default, skip_serializing_if = "is_default")]
    pub support: Support,
}

/// What holds a node of a beam.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Support {
    /// Nothing.
    #[default]
    Free,
    /// Its deflection.
    Pinned,
    /// Its rotation.
    Guided,
    /// Both.
    Clamped,
}

/// A span of constant cross-section between two nodes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct BeamDefinition {
    /// Unique name.
    pub name: String,
    /// Name of the node at one end.
    pub from: String,
    /// Name of the node at the other end.
    pub to: String,
    /// Nominal bending stiffness EI, N·m²; may be left out where a parameter sets it, whose middle then counts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bending_stiffness_n_m2: Option<f64>,
    /// Mass per length, kg/m.
    pub mass_kg_per_m: f64,
    /// Finite elements of equal length; frequencies converge with the fourth power of their number.
    #[serde(default = "usual_elements")]
    pub elements: usize,
}

fn usual_elements() -> usize {
    10
}

/// Runs of a finite-element model, one line each: a column for every parameter by its name, and `f1_hz`, `f2_hz`, ….
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct TableDefinition {
    /// A CSV file, relative to the structure file; its text takes its place as soon as the file is read.
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
    /// As a share of the frequency.
    Relative(f64),
    /// In Hz, the same for each mode.
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

/// A mass.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct MassDefinition {
    /// Unique name; `ground` is taken.
    pub name: String,
    /// Mass, kg.
    pub kg: f64,
    /// Node of a beam that it sits on.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub at: Option<String>,
}

/// A spring between two masses or nodes, or one of them and the ground.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SpringDefinition {
    /// Unique name.
    pub name: String,
    /// `ground` or the name of a mass, of a node in a simulation `beam`.
    pub from: String,
    /// `ground` or the name of a mass, of a node in a simulation `beam`.
    pub to: String,
    /// Nominal stiffness, N/m; may be left out where a parameter sets it, whose middle then counts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub n_per_m: Option<f64>,
    /// Nominal stiffness of a spring that holds the rotation of nodes of a beam, N·m/rad.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub n_m_per_rad: Option<f64>,
}

/// An unknown parameter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ParameterDefinition {
    /// Unique name.
    pub name: String,
    /// Unit, for people; N/m where it sets springs plainly.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit: Option<String>,
    /// What is known before measuring.
    pub prior: Prior,
    /// The stiffnesses it sets: one table or a list of them; none in a simulation `table`.
    #[serde(default, deserialize_with = "one_or_many", skip_serializing_if = "Vec::is_empty")]
    pub sets: Vec<Sets>,
    /// Which change is damage.
    #[serde(default)]
    pub damage: DamageDirection,
}

/// What is known of a parameter before measuring.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Prior {
    /// Equally probable between the two values.
    Uniform([f64; 2]),
}

/// A stiffness that a parameter sets: a spring or a span.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Sets {
    /// Name of the spring.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub spring: Option<String>,
    /// Or name of the span of a beam, whose bending stiffness it sets.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub beam: Option<String>,
    /// How; without a law the parameter is the stiffness itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub law: Option<Law>,
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
    /// Stiffness at a parameter value, N/m.
    pub fn value(&self, p: f64) -> f64 {
        let Self::Exponential(e) = self;
        e.a * (e.b * p).exp() + e.c
    }

    /// Its derivative, N/m per unit of the parameter.
    pub fn slope(&self, p: f64) -> f64 {
        let Self::Exponential(e) = self;
        e.a * e.b * (e.b * p).exp()
    }
}

/// Something measured beside the frequencies.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct CovariateDefinition {
    /// Unique name with its unit, such as `temperature_c`.
    pub name: String,
    /// Kind of its values.
    #[serde(default)]
    pub kind: CovariateKind,
}

/// One mistake in a structure file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DefinitionProblem {
    /// JSON pointer, such as `/spring/3/from`; empty for the whole file.
    pub pointer: String,
    /// Line of a text file, from 1.
    pub line: Option<usize>,
    /// What is wrong and what would be right.
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

/// All mistakes found in a structure file; never empty.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub struct DefinitionError {
    /// The mistakes, in the order of the file's sections.
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
    /// Reads and checks a TOML file.
    ///
    /// # Errors
    /// [`DefinitionError`] with line and pointer of each mistake.
    pub fn parse_toml(text: &str) -> Result<Self, DefinitionError> {
        Self::from_toml(text)?.check(Some(text))
    }

    fn from_toml(text: &str) -> Result<Self, DefinitionError> {
        let syntax = |error: &toml::de::Error, pointer: String| {
            let line = error.span().map(|span| line_at(text, span.start));
            DefinitionError { problems: vec![DefinitionProblem { pointer, line, message: one_line(error.message()) }] }
        };
        let document = toml::Deserializer::parse(text).map_err(|e| syntax(&e, String::new()))?;
        serde_path_to_error::deserialize(document).map_err(|e| syntax(e.inner(), json_pointer(e.path())))
    }

    /// Reads and checks a TOML file whose table of runs is a file of its own, which `read` reads by its name.
    ///
    /// # Errors
    /// [`DefinitionError`], as [`Self::parse_toml`].
    pub fn parse_toml_beside(
        text: &str,
        read: impl Fn(&str) -> std::io::Result<String>,
    ) -> Result<Self, DefinitionError> {
        let mut definition = Self::from_toml(text)?;
        definition.take_table(read)?;
        definition.check(Some(text))
    }

    /// Reads and checks JSON.
    ///
    /// # Errors
    /// [`DefinitionError`] with the pointer of each mistake.
    pub fn parse_json(text: &str) -> Result<Self, DefinitionError> {
        from_json::<Self>(text)?.check(None)
    }

    /// Reads and checks JSON whose table of runs is a file of its own, which `read` reads by its name.
    ///
    /// # Errors
    /// [`DefinitionError`], as [`Self::parse_json`].
    pub fn parse_json_beside(
        text: &str,
        read: impl Fn(&str) -> std::io::Result<String>,
    ) -> Result<Self, DefinitionError> {
        let mut definition: Self = from_json(text)?;
        definition.take_table(read)?;
        definition.check(None)
    }

    fn take_table(&mut self, read: impl Fn(&str) -> std::io::Result<String>) -> Result<(), DefinitionError> {
        let Some(table) = &mut self.table else { return Ok(()) };
        if let Some(file) = table.file.take_if(|_| table.csv.is_none()) {
            let failed = |error: std::io::Error| DefinitionError {
                problems: vec![DefinitionProblem::new(
                    "/table/file",
                    format!("{} cannot be read: {error}", shown(&file)),
                )],
            };
            table.csv = Some(read(&file).map_err(failed)?);
        }
        Ok(())
    }

    /// The definition as JSON with its keys in a fixed order: equal definitions give equal text.
    pub fn canonical_json(&self) -> String {
        serde_json::to_string(self).expect("a definition is plain data")
    }

    /// Digest of [`Self::canonical_json`]: the version of the structure.
    pub fn digest(&self) -> Digest {
        Digest::of(&[self.canonical_json().as_bytes()])
    }

    /// With the line of each mistake where the text is TOML.
    fn check(self, toml: Option<&str>) -> Result<Self, DefinitionError> {
        match check::check(&self) {
            Ok(_) => Ok(self),
            Err(mut problems) => {
                for problem in &mut problems {
                    problem.line = toml.and_then(|text| toml_line(text, &problem.pointer));
                }
                Err(DefinitionError { problems })
            }
        }
    }
}

fn from_json<T: DeserializeOwned>(text: &str) -> Result<T, DefinitionError> {
    let mut deserializer = serde_json::Deserializer::from_str(text);
    let failed = |pointer: String, error: &serde_json::Error| DefinitionError {
        problems: vec![DefinitionProblem { pointer, line: Some(error.line()), message: error.to_string() }],
    };
    let value =
        serde_path_to_error::deserialize(&mut deserializer).map_err(|e| failed(json_pointer(e.path()), e.inner()))?;
    deserializer.end().map_err(|e| failed(String::new(), &e))?;
    Ok(value)
}

fn one_line(message: &str) -> String {
    message.split_whitespace().collect::<Vec<_>>().join(" ")
}

fn line_at(text: &str, offset: usize) -> usize {
    text.as_bytes()[..offset.min(text.len())].split(|b| *b == b'\n').count()
}

/// Line of a pointer in a TOML text, or of the nearest thing above it that is there.
fn toml_line(text: &str, pointer: &str) -> Option<usize> {
    use toml::de::{DeTable, DeValue};
    let document = DeTable::parse(text).ok()?;
    let mut value = DeValue::Table(document.get_ref().clone());
    let mut span: Range<usize> = document.span();
    for segment in pointer.split('/').skip(1) {
        let next = match &value {
            DeValue::Table(table) => {
                table.iter().find(|(key, _)| key.get_ref() == segment).map(|(key, value)| (key.span(), value.clone()))
            }
            DeValue::Array(items) => {
                segment.parse::<usize>().ok().and_then(|i| items.get(i)).map(|item| (item.span(), item.clone()))
            }
            _ => None,
        };
        let Some((next_span, next_value)) = next else { break };
        span = next_span;
        value = next_value.into_inner();
    }
    Some(line_at(text, span.start))
}

/// One table or a list of tables, without losing the messages of either.
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
