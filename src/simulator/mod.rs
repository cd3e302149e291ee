//! The bench: parameters in, natural frequencies out.
//!
//! Three kinds of simulation stand behind one face, [`Simulator`]: bodies on springs and beams, both as matrices K and M,
//! and a table of the user's own finite-element runs, as an emulator.

mod beam;
mod check;
pub mod definition;
pub mod effect;
mod expectation;
pub mod law;
mod many;
pub mod population;
pub mod shapes;
pub mod table;

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

use nalgebra::DMatrix;
use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;

use crate::measurement::{Covariate, CovariateValue};
use crate::parameter::{Parameter, ParameterSpace};
use crate::physics::effect::{measured, respond, Target};
use crate::physics::{self, frequency_sensitivity, modes, natural_frequencies_with, Structure};
use crate::quantity::{Digest, StructureId};
use crate::stats;
use definition::{DefinitionError, Law, MeasurementNoise, StructureDefinition};
use effect::Effect;
pub use shapes::Linearised;
use table::Table;

/// How far outside its simulated range a frequency may lie before it is taken for a mistake of unit or place.
const FREQUENCY_MARGIN: f64 = 100.0;

/// Margin of the training box on each side, as a share of the prior's width.
const MARGIN: f64 = 0.1;

/// Tries to draw a noisy frequency that is positive before giving up.
const NOISE_TRIES: usize = 100;

/// What computes the frequencies.
#[derive(Debug, Clone)]
pub enum Model {
    /// Matrices K and M, with parameters that set stiffnesses.
    Matrices {
        /// The structure at its nominal stiffnesses.
        structure: Structure,
        /// Which parameter sets which stiffness.
        bindings: Vec<Binding>,
    },
    /// An emulator of finite-element runs.
    Table(Table),
}

/// A parameter that sets a stiffness.
#[derive(Debug, Clone, PartialEq)]
pub struct Binding {
    /// Column of the parameter.
    pub parameter: usize,
    /// Index of the spring or span.
    pub spring: usize,
    /// How; plainly without a law.
    pub law: Option<Law>,
}

impl Binding {
    /// Stiffness at a parameter value, N/m.
    pub fn stiffness(&self, p: f64) -> f64 {
        self.law.map_or(p, |law| law.value(p))
    }

    /// Its derivative, N/m per unit of the parameter.
    pub fn slope(&self, p: f64) -> f64 {
        self.law.map_or(1.0, |law| law.slope(p))
    }
}

/// Why a simulation failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// No natural frequencies at these parameters.
    #[error("at {parameters:?}: {source}")]
    Physics {
        /// The parameters, in the order of the space.
        parameters: Vec<f64>,
        /// The cause.
        source: physics::Error,
    },
    /// Noise so large that frequencies are negative.
    #[error("a frequency of {frequency_hz} Hz with noise of {std_hz} Hz is not positive in {NOISE_TRIES} draws")]
    Noise {
        /// Frequency without noise, Hz.
        frequency_hz: f64,
        /// Standard deviation of the noise, Hz.
        std_hz: f64,
    },
}

/// A structure whose parameters can be set; a cheap handle.
#[derive(Debug, Clone)]
pub struct Simulator {
    parts: Arc<Parts>,
    /// Sizes of the effects; where nothing was said of them, their means over what they were learnt from.
    sizes: Arc<[f64]>,
}

#[derive(Debug)]
struct Parts {
    definition: StructureDefinition,
    digest: Digest,
    checked: check::Checked,
    /// Made when it is first asked for.
    side_by_side: OnceLock<Option<many::Runs>>,
}

/// Frequencies under effects and their derivatives.
#[derive(Debug, Clone)]
pub struct Response {
    /// As the data would have them, Hz, `[m]`.
    pub frequencies_hz: Vec<f64>,
    /// Hz per parameter unit, `[m, d]`.
    pub by_parameter: DMatrix<f64>,
    /// Hz per unit of each size, `[m, sizes]`.
    pub by_size: DMatrix<f64>,
}

/// Simulated pairs of parameters and exact frequencies.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingSet {
    /// `[n, d]`, uniform in the prior box, in parameter units.
    pub theta: DMatrix<f64>,
    /// `[n, m]`, Hz, without noise.
    pub frequencies_hz: DMatrix<f64>,
    /// Mode shapes at the instrumented points of each row, unit norm, `[points, m]`; empty where there are no such points.
    pub shapes: Vec<DMatrix<f64>>,
    /// Sizes of the structure's effects under the covariates of each row, as their laws' mean numbers give them, `[n]`; the
    /// frequencies have sizes by numbers drawn from what is known of them.
    pub effect_sizes: Vec<Vec<f64>>,
    /// Seed of the draws.
    pub seed: u64,
}

/// The stiffness of a spring that a parameter sets through a law.
#[derive(Debug, Clone, PartialEq)]
pub struct DerivedStiffness {
    /// `spring:` and the spring's name.
    pub name: String,
    /// Column of the parameter.
    pub parameter: usize,
    /// The law.
    pub law: Law,
}

impl DerivedStiffness {
    /// Stiffness at a parameter value, N/m.
    pub fn value(&self, p: f64) -> f64 {
        self.law.value(p)
    }
}

impl Simulator {
    /// The simulator of a definition.
    ///
    /// # Errors
    /// [`DefinitionError`] with every mistake and its place.
    pub fn new(definition: StructureDefinition) -> Result<Self, DefinitionError> {
        let checked = check::check(&definition).map_err(|problems| DefinitionError { problems })?;
        let digest = definition.digest();
        let sizes = effect::typical_sizes(&checked.effects).into();
        Ok(Self { parts: Arc::new(Parts { definition, digest, checked, side_by_side: OnceLock::new() }), sizes })
    }

    /// Sizes of the effects at all values that covariates which are missing may have; those of several effects go through
    /// their values together, so that effects of one covariate agree.
    pub fn possible_sizes(&self, covariates: &BTreeMap<String, CovariateValue>) -> Vec<Vec<f64>> {
        effect::possible_sizes(self.effects(), covariates)
    }

    /// The structure without its effects.
    #[must_use]
    pub fn without_effects(&self) -> Self {
        let parts = &self.parts;
        let checked = check::Checked { effects: Vec::new(), ..parts.checked.clone() };
        let (definition, digest) = (parts.definition.clone(), parts.digest.clone());
        Self {
            parts: Arc::new(Parts { definition, digest, checked, side_by_side: OnceLock::new() }),
            sizes: Arc::new([]),
        }
    }

    /// Effects of the structure file.
    pub fn effects(&self) -> &[Effect] {
        &self.parts.checked.effects
    }

    /// The simulation under effects of these sizes (all sizes of the first effect first); under their means for none.
    ///
    /// # Panics
    /// When there are sizes, but not one for each.
    #[must_use]
    pub fn under(&self, sizes: &[f64]) -> Self {
        if sizes.is_empty() {
            return Self { sizes: effect::typical_sizes(self.effects()).into(), ..self.clone() };
        }
        assert_eq!(sizes.len(), self.sizes.len(), "one size for each of the structure's effects");
        Self { sizes: sizes.into(), ..self.clone() }
    }

    /// Sizes of the effects under the covariates of a measurement.
    pub fn effect_sizes(&self, covariates: &BTreeMap<String, CovariateValue>) -> effect::Sizes {
        effect::sizes(self.effects(), covariates)
    }

    /// Id of the structure.
    pub fn id(&self) -> &StructureId {
        &self.parts.checked.id
    }

    /// The definition it was made of.
    pub fn definition(&self) -> &StructureDefinition {
        &self.parts.definition
    }

    /// Digest of the definition.
    pub fn digest(&self) -> &Digest {
        &self.parts.digest
    }

    /// What computes the frequencies.
    pub fn model(&self) -> &Model {
        &self.parts.checked.model
    }

    /// The structure at its nominal stiffnesses; a table has none.
    pub fn structure(&self) -> Option<&Structure> {
        match self.model() {
            Model::Matrices { structure, .. } => Some(structure),
            Model::Table(_) => None,
        }
    }

    /// The emulated runs, where the simulation is a table.
    pub fn table(&self) -> Option<&Table> {
        match self.model() {
            Model::Table(table) => Some(table),
            Model::Matrices { .. } => None,
        }
    }

    /// Modes that the simulation has, of which the first [`Self::modes`] are measured.
    pub fn available_modes(&self) -> usize {
        match self.model() {
            Model::Matrices { structure, .. } => structure.freedoms(),
            Model::Table(table) => table.emulator().modes(),
        }
    }

    /// What a user should know of the simulation before relying on it.
    pub fn warnings(&self) -> Vec<String> {
        self.table().map_or_else(Vec::new, |table| table.warnings(self.modes()))
    }

    /// Whether `theta`, as effects on parameters move it, lies where an emulator has no runs.
    pub fn is_extrapolated(&self, theta: &[f64]) -> bool {
        let Some(table) = self.table() else { return false };
        let mut moved = theta.to_vec();
        let mut first = 0;
        for effect in self.effects() {
            if let Target::ParameterScale(column) = effect.target {
                moved[column] *= 1.0 + self.sizes[first];
            }
            first += effect.target.sizes();
        }
        table.is_outside(&moved)
    }

    fn bindings(&self) -> &[Binding] {
        match self.model() {
            Model::Matrices { bindings, .. } => bindings,
            Model::Table(_) => &[],
        }
    }

    /// The parameters.
    pub fn space(&self) -> &ParameterSpace {
        &self.parts.checked.space
    }

    /// Number of modes measured m.
    pub fn modes(&self) -> usize {
        self.parts.definition.modes
    }

    /// Declared covariates.
    pub fn covariates(&self) -> &[Covariate] {
        &self.parts.checked.covariates
    }

    /// Standard deviation of one measured frequency, as the structure file states it.
    pub fn noise(&self) -> MeasurementNoise {
        self.parts.definition.measurement_noise
    }

    /// Standard deviation of a measured frequency about the simulated one, Hz: the noise that the structure file states,
    /// and the error of an emulator.
    pub fn std_hz(&self, mode: usize, frequency_hz: f64) -> f64 {
        self.with_emulator_error(mode, frequency_hz, self.noise().std_hz(frequency_hz))
    }

    /// A measurement's own standard deviation with the error of an emulator, Hz.
    ///
    /// ```text
    ///  √(s² + (ε f)²),    ε: the relative error of the mode on runs left out, 0 without an emulator
    /// ```
    pub fn with_emulator_error(&self, mode: usize, frequency_hz: f64, measured_std_hz: f64) -> f64 {
        let relative = self.table().map_or(0.0, |table| table.emulator().relative_error(mode));
        if relative > 0.0 {
            measured_std_hz.hypot(relative * frequency_hz)
        } else {
            measured_std_hz
        }
    }

    /// Whether measured frequencies scatter about the simulated ones at all.
    pub fn is_noisy(&self) -> bool {
        (0..self.modes()).any(|mode| self.std_hz(mode, 1.0) > 0.0)
    }

    /// Natural frequencies, Hz, ascending, at parameters `theta` (`[d]`, parameter units), without noise.
    ///
    /// # Errors
    /// [`physics::Error`] for parameters that give a negative stiffness or a mechanism.
    pub fn frequencies_hz(&self, theta: &[f64]) -> Result<Vec<f64>, physics::Error> {
        if !self.effects().is_empty() {
            return self.respond(theta, self.modes(), &[], &[]).map(|response| response.frequencies_hz);
        }
        match self.model() {
            Model::Matrices { structure, bindings } => {
                natural_frequencies_with(structure, &changes(bindings, theta), self.modes())
            }
            Model::Table(table) => {
                let mut frequencies = table.frequencies_hz(theta);
                frequencies.truncate(self.modes());
                Ok(frequencies)
            }
        }
    }

    /// Derivatives of the frequencies at `theta`, Hz per parameter unit, `[m, d]`.
    ///
    /// ```text
    ///  ∂f_i/∂p = Σ over springs that p sets:  ∂f_i/∂k · dk/dp
    /// ```
    ///
    /// Where eigenvalues repeat, see [`frequency_sensitivity`]: sums over several springs are then not derivatives.
    ///
    /// # Errors
    /// As [`Self::frequencies_hz`].
    pub fn jacobian(&self, theta: &[f64]) -> Result<DMatrix<f64>, physics::Error> {
        if !self.effects().is_empty() {
            return self.respond(theta, self.modes(), &[], &[]).map(|response| response.by_parameter);
        }
        self.frequencies_and_jacobian(theta).map(|(_, jacobian)| jacobian)
    }

    /// [`Self::frequencies_hz`] and [`Self::jacobian`] by one eigenproblem.
    ///
    /// # Errors
    /// As [`Self::frequencies_hz`].
    pub fn frequencies_and_jacobian(&self, theta: &[f64]) -> Result<(Vec<f64>, DMatrix<f64>), physics::Error> {
        if !self.effects().is_empty() {
            let response = self.respond(theta, self.modes(), &[], &[])?;
            return Ok((response.frequencies_hz, response.by_parameter));
        }
        match self.model() {
            Model::Matrices { structure, bindings } => {
                let structure = structure_at(structure, bindings, theta)?;
                let modes = modes(&structure, self.modes())?;
                let sensitivity = frequency_sensitivity(&structure, &modes);
                let jacobian = chained(&sensitivity.by_spring, bindings, theta);
                Ok((modes.frequencies_hz, jacobian))
            }
            Model::Table(table) => {
                let (mut frequencies, jacobian) = table.frequencies_and_jacobian(theta);
                frequencies.truncate(self.modes());
                Ok((frequencies, jacobian.rows(0, self.modes()).into_owned()))
            }
        }
    }

    /// The lowest `modes` frequencies at `theta` under the structure's effects and further ones, and their derivatives; `sizes` as in [`respond`].
    ///
    /// # Errors
    /// As [`Self::frequencies_hz`] and [`respond`].
    pub fn respond(
        &self,
        theta: &[f64],
        modes: usize,
        targets: &[Target],
        sizes: &[f64],
    ) -> Result<Response, physics::Error> {
        let own: usize = self.sizes.len();
        let targets: Vec<Target> = self.effects().iter().map(|e| &e.target).chain(targets).cloned().collect();
        let sizes: Vec<f64> = self.sizes.iter().chain(sizes).copied().collect();
        let (targets, sizes) = (targets.as_slice(), sizes.as_slice());
        let mut theta = theta.to_vec();
        let mut set_scale = vec![1.0; theta.len()];
        let mut first = 0;
        for target in targets {
            match target {
                Target::SettingOffset(column) => theta[*column] += sizes[first],
                Target::SettingScale(column) | Target::ParameterScale(column) => {
                    theta[*column] *= 1.0 + sizes[first];
                    set_scale[*column] *= 1.0 + sizes[first];
                }
                _ => {}
            }
            first += target.sizes();
        }
        let (frequencies_hz, mut by_parameter, mut by_size) = match self.model() {
            Model::Matrices { structure, bindings } => {
                let response = respond(&structure_at(structure, bindings, &theta)?, modes, targets, sizes)?;
                let by_parameter = chained(&response.by_spring, bindings, &theta);
                (response.frequencies_hz, by_parameter, response.by_size)
            }
            Model::Table(table) => {
                let (frequencies, jacobian) = table.frequencies_and_jacobian(&theta);
                let measured = measured(&frequencies, &jacobian, modes, targets, sizes)?;
                (measured.frequencies_hz, measured.by_parameter, measured.by_size)
            }
        };
        first = 0;
        for target in targets {
            for mode in 0..modes {
                match target {
                    Target::SettingOffset(column) => by_size[(mode, first)] = by_parameter[(mode, *column)],
                    Target::SettingScale(column) | Target::ParameterScale(column) => {
                        by_size[(mode, first)] = by_parameter[(mode, *column)] * theta[*column] / (1.0 + sizes[first]);
                    }
                    _ => {}
                }
            }
            first += target.sizes();
        }
        for (column, scale) in set_scale.iter().enumerate() {
            by_parameter.column_mut(column).scale_mut(*scale);
        }
        let by_size = by_size.columns(own, sizes.len() - own).into_owned();
        Ok(Response { frequencies_hz, by_parameter, by_size })
    }

    /// Natural frequencies at the nominal stiffnesses, Hz.
    pub fn nominal_frequencies_hz(&self) -> Vec<f64> {
        self.parts.checked.nominal_frequencies_hz.clone()
    }

    /// Smallest and largest frequency that a measurement can have without being a mistake of unit or place, Hz.
    ///
    /// The nominal range, widened a hundredfold on both sides: rad/s for Hz still passes (and is judged later, with the
    /// posterior), minutes for seconds or MHz for Hz do not.
    pub fn frequency_limits_hz(&self) -> (f64, f64) {
        let nominal = self.nominal_frequencies_hz();
        let first = nominal.first().copied().unwrap_or(f64::MIN_POSITIVE);
        let last = nominal.last().copied().unwrap_or(f64::MAX);
        (first / FREQUENCY_MARGIN, last * FREQUENCY_MARGIN)
    }

    /// The springs set through a law, whose stiffness is monitored beside the parameter.
    pub fn derived_stiffnesses(&self) -> Vec<DerivedStiffness> {
        let derived = |binding: &Binding| {
            let name = format!("spring:{}", self.structure()?.springs()[binding.spring].name);
            Some(DerivedStiffness { name, parameter: binding.parameter, law: binding.law? })
        };
        self.bindings().iter().filter_map(derived).collect()
    }

    /// d ln k/dp of the first spring that a parameter sets: what a small change of the parameter is as a share of stiffness.
    pub fn stiffness_share(&self, column: usize, p: f64) -> f64 {
        let binding = self.bindings().iter().find(|b| b.parameter == column);
        let parameter = &self.space().as_slice()[column];
        // A parameter of a table need be no stiffness: one that passes 0 has no share, and counts by the width of its prior.
        let of_itself = if parameter.has_share() { 1.0 / p } else { 1.0 / (parameter.upper - parameter.lower) };
        binding.map_or(of_itself, |b| b.slope(p) / b.stiffness(p))
    }

    /// Springs that one parameter sets together, with the parameter's name.
    pub fn spring_groups(&self) -> Vec<(String, Vec<usize>)> {
        let group = |(column, parameter): (usize, &Parameter)| {
            let bindings = self.bindings().iter().filter(|b| b.parameter == column);
            let springs: Vec<usize> = bindings.map(|b| b.spring).collect();
            (springs.len() > 1).then(|| (parameter.name.clone(), springs))
        };
        self.space().iter().enumerate().filter_map(group).collect()
    }

    /// The prior box with a margin on each side, which a flow is trained in: a density is hardest to learn at an edge, and
    /// with a margin the edges of the prior are no edges of what was learnt.
    ///
    /// A tenth of the prior's width, less where a stiffness would fall below half the least of the prior; none for a table,
    /// which ends where its runs do.
    pub fn training_space(&self) -> ParameterSpace {
        if self.table().is_some() {
            return self.space().clone();
        }
        let padded = |(column, parameter): (usize, &Parameter)| {
            let width = parameter.upper - parameter.lower;
            let bindings = || self.bindings().iter().filter(move |b| b.parameter == column);
            let margin = |edge: f64, outwards: f64| {
                let stiff = |value: f64, b: &Binding| {
                    let least = b.stiffness(parameter.lower).min(b.stiffness(parameter.upper));
                    least > 0.0 && b.stiffness(value) >= 0.5 * least && b.stiffness(value).is_finite()
                };
                let tries = (0..12).map(|halvings| MARGIN * width * 0.5_f64.powi(halvings));
                let fits = |margin: &f64| bindings().all(|b| stiff(edge + outwards * margin, b));
                { tries }.find(fits).unwrap_or(0.0)
            };
            let (below, above) = (margin(parameter.lower, -1.0), margin(parameter.upper, 1.0));
            Parameter { lower: parameter.lower - below, upper: parameter.upper + above, ..parameter.clone() }
        };
        ParameterSpace::new(self.space().iter().enumerate().map(padded).collect())
    }

    /// `samples` pairs from the prior; the same seed gives the same bits on any number of threads.
    ///
    /// # Errors
    /// As [`Self::pairs`].
    pub fn training_set(&self, samples: usize, seed: u64) -> Result<TrainingSet, Error> {
        self.pairs(self.space(), samples, seed)
    }

    /// `samples` pairs, uniform in the box `space`; the same seed gives the same bits on any number of threads.
    ///
    /// # Errors
    /// [`Error`]; a checked definition has no mechanism in its prior, so only stiffnesses of a prior that differ by twelve
    /// orders of magnitude can fail.
    pub fn pairs(&self, space: &ParameterSpace, samples: usize, seed: u64) -> Result<TrainingSet, Error> {
        let mut stream = stats::stream(seed, "prior");
        // Row by row, so that a longer set begins with the shorter one.
        let rows: Vec<Vec<f64>> =
            (0..samples).map(|_| space.iter().map(|p| p.from_unit(stream.random::<f64>())).collect()).collect();
        let theta = DMatrix::from_fn(samples, space.len(), |row, column| rows[row][column]);
        let mut stream = stats::stream(seed, "covariates");
        let mut effect_sizes = vec![Vec::new(); samples];
        let mut shapes = Vec::new();
        let exact = if self.shape_points() > 0 {
            let simulate = |theta: &Vec<f64>| {
                let failed = |source| Error::Physics { parameters: theta.clone(), source };
                self.frequencies_and_shapes(theta).map_err(failed)
            };
            let both = rows.par_iter().map(simulate).collect::<Result<Vec<_>, _>>()?;
            let (frequencies, of_rows): (Vec<_>, _) = both.into_iter().unzip();
            shapes = of_rows;
            frequencies
        } else if self.effects().is_empty() {
            self.exact(&rows)?
        } else {
            let mut drawn = Vec::with_capacity(samples);
            for known in &mut effect_sizes {
                let covariates = effect::draw_covariates(self.effects(), &mut stream);
                *known = self.effect_sizes(&covariates).values;
                drawn.push(effect::draw_sizes(self.effects(), &covariates, &mut stream));
            }
            let simulate = |(theta, sizes): (&Vec<f64>, &Vec<f64>)| {
                let failed = |source| Error::Physics { parameters: theta.clone(), source };
                self.under(sizes).frequencies_hz(theta).map_err(failed)
            };
            rows.par_iter().zip(&drawn).map(simulate).collect::<Result<Vec<_>, _>>()?
        };
        let frequencies_hz = DMatrix::from_fn(samples, self.modes(), |row, mode| exact[row][mode]);
        Ok(TrainingSet { theta, frequencies_hz, shapes, effect_sizes, seed })
    }

    /// Exact frequencies of each row of parameters, Hz.
    fn exact(&self, rows: &[Vec<f64>]) -> Result<Vec<Vec<f64>>, Error> {
        let simulate = |theta: &Vec<f64>| {
            self.frequencies_hz(theta).map_err(|source| Error::Physics { parameters: theta.clone(), source })
        };
        rows.par_iter().map(simulate).collect()
    }

    /// Frequencies at each row of parameters, with the structure's measurement noise, `[n, m]`, Hz.
    ///
    /// # Errors
    /// [`Error`] for a negative stiffness or a mechanism.
    pub fn measured(&self, rows: &[Vec<f64>], seed: u64) -> Result<DMatrix<f64>, Error> {
        self.measure(rows, 1.0, seed)
    }

    /// Frequencies of each row of parameters with measurement noise, `[n, m]`, Hz.
    fn measure(&self, rows: &[Vec<f64>], noise_multiple: f64, seed: u64) -> Result<DMatrix<f64>, Error> {
        let exact = self.exact(rows)?;
        let mut stream = stats::stream(seed, "measurement noise");
        let mut noisy = DMatrix::zeros(rows.len(), self.modes());
        for (row, frequencies) in exact.iter().enumerate() {
            for (mode, &frequency_hz) in frequencies.iter().enumerate() {
                let std_hz = noise_multiple * self.std_hz(mode, frequency_hz);
                let mut draw = || frequency_hz + std_hz * stream.sample::<f64, _>(StandardNormal);
                let value = (0..NOISE_TRIES).map(|_| draw()).find(|f| *f > 0.0);
                noisy[(row, mode)] = value.ok_or(Error::Noise { frequency_hz, std_hz })?;
            }
        }
        Ok(noisy)
    }
}

fn structure_at(structure: &Structure, bindings: &[Binding], theta: &[f64]) -> Result<Structure, physics::Error> {
    structure.with_stiffness(&changes(bindings, theta))
}

/// Stiffness of each spring that a parameter sets.
fn changes(bindings: &[Binding], theta: &[f64]) -> Vec<(usize, f64)> {
    bindings.iter().map(|b| (b.spring, b.stiffness(theta[b.parameter]))).collect()
}

/// Derivatives by parameters from those by stiffnesses, `[m, d]`.
fn chained(by_spring: &DMatrix<f64>, bindings: &[Binding], theta: &[f64]) -> DMatrix<f64> {
    let mut by_parameter = DMatrix::zeros(by_spring.nrows(), theta.len());
    for binding in bindings {
        let slope = binding.slope(theta[binding.parameter]);
        for mode in 0..by_spring.nrows() {
            by_parameter[(mode, binding.parameter)] += by_spring[(mode, binding.spring)] * slope;
        }
    }
    by_parameter
}
