//! The simulator: natural frequencies of a structure as a function of its parameters.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::{Arc, OnceLock};

use nalgebra::DMatrix;

use super::batched::BatchedRuns;
use super::check;
use super::definition::{DefinitionError, MeasurementNoise, StructureDefinition};
use super::discrepancy::input::Discrepancy;
use super::effect::{self, SimulationEffect};
use super::instrumented::Instrumented;
use super::model::{Binding, Matrices, SimulationModel, SizeBinding};
use super::settings::CorrectedParameters;
use super::table::Table;
use crate::measurement::{Covariate, CovariateValue};
use crate::parameter::ParameterSpace;
use crate::physics::batched::FrequenciesAndSlopes;
use crate::physics::effect::Target;
use crate::physics::{self, frequency_sensitivity, modes, natural_frequencies_with, Structure};
use crate::quantity::{Digest, StructureId};

/// Factor by which a frequency may leave the nominal range before it is treated as a wrong unit or a wrong column.
const FREQUENCY_MARGIN: f64 = 100.0;

/// Largest number of attempts to draw a positive noisy frequency.
pub(super) const NOISE_TRIES: usize = 100;

/// Why a simulation failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// The natural frequencies cannot be computed at these parameters.
    #[error("at the parameters {parameters:?}: {source}")]
    Physics {
        /// The parameters, in the order of the parameter space.
        parameters: Vec<f64>,
        /// The cause.
        source: physics::Error,
    },
    /// The noise is so large that no draw of a frequency is positive.
    #[error("a frequency of {frequency_hz} Hz with noise of {std_hz} Hz is not positive in any of {NOISE_TRIES} draws: reduce the noise")]
    Noise {
        /// Frequency without noise, Hz.
        frequency_hz: f64,
        /// Standard deviation of the noise, Hz.
        std_hz: f64,
    },
}

/// Computes the natural frequencies of a structure as a function of its parameters θ. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Simulator {
    parts: Arc<Parts>,
    /// Sizes of the effects: those given, or else their means over the covariate values that they were fitted to.
    sizes: Arc<[f64]>,
    /// Prepared for these sizes when it is first needed; `None` for a simulation that cannot be batched.
    batched: Arc<OnceLock<Option<BatchedRuns>>>,
}

#[derive(Debug)]
struct Parts {
    definition: StructureDefinition,
    digest: Digest,
    checked: check::Checked,
}

impl Simulator {
    /// Checks a definition and builds its simulator.
    ///
    /// # Errors
    /// [`DefinitionError`] with every mistake and its JSON pointer.
    pub fn new(definition: StructureDefinition) -> Result<Self, DefinitionError> {
        let checked = check::check(&definition).map_err(|problems| DefinitionError { problems })?;
        Ok(Self::of_checked(definition, checked))
    }

    /// The simulator of a definition that was just checked.
    pub(super) fn of_checked(definition: StructureDefinition, checked: check::Checked) -> Self {
        let digest = definition.digest();
        let sizes = effect::typical_sizes(&checked.effects).into();
        Self::assembled(Parts { definition, digest, checked }, sizes)
    }

    fn assembled(parts: Parts, sizes: Arc<[f64]>) -> Self {
        Self { parts: Arc::new(parts), sizes, batched: Arc::default() }
    }

    /// Sizes of the effects over which a measurement with missing covariates is marginalised: one entry `[sizes]` for each value
    /// that the missing covariates can have. Empty if no covariate is missing. All effects of a covariate use the same value.
    pub fn marginalised_sizes(&self, covariates: &BTreeMap<String, CovariateValue>) -> Vec<Vec<f64>> {
        effect::marginalised_sizes(self.effects(), covariates)
    }

    /// The same simulation without the effects of the structure file.
    #[must_use]
    pub fn without_effects(&self) -> Self {
        let parts = &self.parts;
        let checked = check::Checked { effects: Vec::new(), ..parts.checked.clone() };
        let (definition, digest) = (parts.definition.clone(), parts.digest.clone());
        Self::assembled(Parts { definition, digest, checked }, Arc::new([]))
    }

    /// The same simulation with another prior of its parameters.
    #[must_use]
    pub fn with_space(&self, space: ParameterSpace) -> Self {
        let parts = &self.parts;
        let checked = check::Checked { space, ..parts.checked.clone() };
        let (definition, digest) = (parts.definition.clone(), parts.digest.clone());
        Self::assembled(Parts { definition, digest, checked }, Arc::clone(&self.sizes))
    }

    /// Effects of the structure file.
    pub fn effects(&self) -> &[SimulationEffect] {
        &self.parts.checked.effects
    }

    /// The learned discrepancy of the structure file.
    pub fn discrepancy(&self) -> Option<&Discrepancy> {
        self.parts.checked.discrepancy.as_ref()
    }

    /// The simulation under effects of the sizes `sizes`, `[sizes]`, in the order of the effects and in the units of their
    /// targets; if `sizes` is empty, under effects of their mean sizes.
    ///
    /// # Panics
    /// If `sizes` is neither empty nor as long as the sizes of all effects.
    #[must_use]
    pub fn under(&self, sizes: &[f64]) -> Self {
        let sizes: Arc<[f64]> =
            if sizes.is_empty() { effect::typical_sizes(self.effects()).into() } else { sizes.into() };
        assert_eq!(sizes.len(), self.sizes.len(), "one size for each of the structure's effects");
        if sizes == self.sizes {
            return self.clone();
        }
        Self { parts: Arc::clone(&self.parts), sizes, batched: Arc::default() }
    }

    /// Sizes of the effects under the covariates of a measurement, in the units of their targets, `[sizes]`.
    pub fn effect_sizes(&self, covariates: &BTreeMap<String, CovariateValue>) -> effect::Sizes {
        effect::sizes(self.effects(), covariates)
    }

    /// Sizes of the effects of the structure file, `[sizes]`, in the units of their targets.
    pub(super) fn sizes(&self) -> &[f64] {
        &self.sizes
    }

    /// Id of the structure.
    pub fn id(&self) -> &StructureId {
        &self.parts.checked.id
    }

    /// The definition that the simulator was built from.
    pub fn definition(&self) -> &StructureDefinition {
        &self.parts.definition
    }

    /// Digest of the definition.
    pub fn digest(&self) -> &Digest {
        &self.parts.digest
    }

    /// What computes the frequencies.
    pub fn model(&self) -> &SimulationModel {
        &self.parts.checked.model
    }

    /// The structure at its nominal stiffnesses; `None` for a table.
    pub fn structure(&self) -> Option<&Structure> {
        match self.model() {
            SimulationModel::Matrices(matrices) => Some(&matrices.structure),
            SimulationModel::Table(_) => None,
        }
    }

    /// The emulated runs, if the simulation is a table.
    pub fn table(&self) -> Option<&Table> {
        match self.model() {
            SimulationModel::Table(table) => Some(table),
            SimulationModel::Matrices(_) => None,
        }
    }

    /// Number of modes that the simulation has, of which the lowest [`Self::modes`] are measured.
    pub fn available_modes(&self) -> usize {
        self.model().available_modes()
    }

    /// Warnings about the accuracy of the simulation.
    pub fn warnings(&self) -> Vec<String> {
        self.table().map_or_else(Vec::new, |table| table.warnings(self.modes()))
    }

    /// Whether the simulation is an emulator that extrapolates at the parameters `theta` (`[d]`) under the effects, because the
    /// table has no runs near them.
    pub fn is_extrapolated(&self, theta: &[f64]) -> bool {
        let Some(table) = self.table() else { return false };
        let targets: Vec<Target> = self.effects().iter().map(|e| e.target.clone()).collect();
        table.is_outside(&CorrectedParameters::new(theta, &targets, &self.sizes, 0).theta)
    }

    /// The stiffnesses that parameters set; empty for a table.
    pub(super) fn bindings(&self) -> &[Binding] {
        self.matrices().map_or(&[], |matrices| &matrices.bindings)
    }

    /// The masses and deviations that parameters set.
    pub(super) fn size_bindings(&self) -> &[SizeBinding] {
        self.matrices().map_or(&[], |matrices| &matrices.sizes)
    }

    fn matrices(&self) -> Option<&Matrices> {
        match self.model() {
            SimulationModel::Matrices(matrices) => Some(matrices),
            SimulationModel::Table(_) => None,
        }
    }

    /// Whether nothing but stiffnesses and the columns of a table changes: no effect acts, and no parameter sets a mass or a deviation.
    fn is_plain(&self) -> bool {
        self.effects().is_empty() && self.size_bindings().is_empty()
    }

    /// The instrumented points, if mode shapes are measured.
    pub(super) fn instrumented(&self) -> Option<&Instrumented> {
        self.parts.checked.instrumented.as_ref()
    }

    /// The parameters.
    pub fn space(&self) -> &ParameterSpace {
        &self.parts.checked.space
    }

    /// Number of measured modes m.
    pub fn modes(&self) -> usize {
        self.parts.definition.modes
    }

    /// The declared covariates.
    pub fn covariates(&self) -> &[Covariate] {
        &self.parts.checked.covariates
    }

    /// Standard deviation of one measured frequency, as given in the structure file.
    pub fn noise(&self) -> MeasurementNoise {
        self.parts.definition.measurement_noise
    }

    /// Standard deviation of a measured frequency about the simulated one, Hz: the noise given in the structure file, combined
    /// with the error of an emulator.
    pub fn std_hz(&self, mode: usize, frequency_hz: f64) -> f64 {
        self.with_emulator_error(mode, frequency_hz, self.noise().std_hz(frequency_hz))
    }

    /// Standard deviation of a measurement combined with the error of an emulator, Hz.
    ///
    /// ```text
    ///  √(s² + (ε f)²),    ε: relative cross-validation error of the emulator for the mode, 0 without an emulator
    /// ```
    pub fn with_emulator_error(&self, mode: usize, frequency_hz: f64, measured_std_hz: f64) -> f64 {
        let relative = self.table().map_or(0.0, |table| table.emulator().relative_error(mode));
        if relative > 0.0 {
            measured_std_hz.hypot(relative * frequency_hz)
        } else {
            measured_std_hz
        }
    }

    /// Whether measured frequencies scatter about the simulated ones, by noise or by the error of an emulator.
    pub fn is_noisy(&self) -> bool {
        (0..self.modes()).any(|mode| self.std_hz(mode, 1.0) > 0.0)
    }

    /// Natural frequencies without noise, Hz, `[m]`, at parameters `theta` (`[d]`, parameter units). They ascend unless an effect
    /// changes the order of modes.
    ///
    /// # Errors
    /// [`physics::Error`] for parameters that give a negative stiffness or a mechanism.
    pub fn frequencies_hz(&self, theta: &[f64]) -> Result<Vec<f64>, physics::Error> {
        if !self.is_plain() {
            return self.frequencies_under_effects(theta);
        }
        match self.model() {
            SimulationModel::Matrices(matrices) => {
                natural_frequencies_with(&matrices.structure, &matrices.changes(theta), self.modes())
            }
            SimulationModel::Table(table) => {
                let mut frequencies = table.frequencies_hz(theta);
                frequencies.truncate(self.modes());
                Ok(frequencies)
            }
        }
    }

    /// [`Self::frequencies_hz`] at some rows of `theta` (`[n, d]`, parameter units): Hz, row-major `[rows, m]`. NaN for a row
    /// whose frequencies cannot be computed.
    pub fn frequencies_of_rows_hz(&self, theta: &DMatrix<f64>, rows: Range<usize>) -> Vec<f64> {
        if let Some(runs) = self.batched() {
            return runs.frequencies_hz(theta, rows);
        }
        let mut of_row = vec![0.0; theta.ncols()];
        let mut frequencies = Vec::with_capacity(rows.len() * self.modes());
        for row in rows {
            of_row.iter_mut().zip(theta.row(row).iter()).for_each(|(own, value)| *own = *value);
            match self.frequencies_hz(&of_row) {
                Ok(found) => frequencies.extend(found),
                Err(_) => frequencies.resize(frequencies.len() + self.modes(), f64::NAN),
            }
        }
        frequencies
    }

    fn batched(&self) -> Option<&BatchedRuns> {
        let prepare = || {
            let targets: Vec<Target> = self.effects().iter().map(|effect| effect.target.clone()).collect();
            BatchedRuns::new(self.model(), (&targets, &self.sizes), self.modes())
        };
        self.batched.get_or_init(prepare).as_ref()
    }

    /// [`Self::frequencies_of_rows_hz`] for the modes whose measured frequency, Hz, `near_hz` gives, `[m]`; the others may be NaN. For rows
    /// that could explain the measurement, this is several times as fast for a structure of many degrees of freedom.
    pub fn frequencies_near_hz(&self, theta: &DMatrix<f64>, rows: Range<usize>, near_hz: &[Option<f64>]) -> Vec<f64> {
        match self.batched() {
            Some(runs) => runs.frequencies_near_hz(theta, rows, near_hz),
            None => self.frequencies_of_rows_hz(theta, rows),
        }
    }

    /// [`Self::frequencies_near_hz`] with the derivatives with respect to the parameters, row-major `[rows, m, d]`, Hz per parameter unit.
    /// Those of equal frequencies are not unique where the structure is batched; see [`Self::jacobian`] for the others.
    pub fn slopes_near(
        &self,
        theta: &DMatrix<f64>,
        rows: Range<usize>,
        near_hz: &[Option<f64>],
    ) -> FrequenciesAndSlopes {
        if let Some(runs) = self.batched() {
            return runs.slopes_near(theta, rows, near_hz);
        }
        let mut found = FrequenciesAndSlopes::default();
        for row in rows {
            let of_row: Vec<f64> = theta.row(row).iter().copied().collect();
            if let Ok((frequencies_hz, jacobian)) = self.frequencies_and_jacobian(&of_row) {
                found.frequencies_hz.extend(frequencies_hz);
                found.slopes.extend(jacobian.row_iter().flat_map(|row| row.iter().copied().collect::<Vec<f64>>()));
            } else {
                found.frequencies_hz.resize(found.frequencies_hz.len() + self.modes(), f64::NAN);
                found.slopes.resize(found.slopes.len() + self.modes() * theta.ncols(), f64::NAN);
            }
        }
        found
    }

    /// Derivatives of the frequencies at parameters `theta` (`[d]`), Hz per parameter unit, `[m, d]`.
    ///
    /// ```text
    ///  ∂f_i/∂p = Σ_k ∂f_i/∂k · dk/dp      over the stiffnesses k, or the sizes of masses and deviations, that p sets
    /// ```
    ///
    /// For repeated eigenvalues see [`frequency_sensitivity`]: sums over several stiffnesses are then not derivatives.
    ///
    /// # Errors
    /// As [`Self::frequencies_hz`].
    pub fn jacobian(&self, theta: &[f64]) -> Result<DMatrix<f64>, physics::Error> {
        self.frequencies_and_jacobian(theta).map(|(_, jacobian)| jacobian)
    }

    /// [`Self::frequencies_hz`], `[m]`, and [`Self::jacobian`], `[m, d]`, from a single eigenproblem.
    ///
    /// # Errors
    /// As [`Self::frequencies_hz`].
    pub fn frequencies_and_jacobian(&self, theta: &[f64]) -> Result<(Vec<f64>, DMatrix<f64>), physics::Error> {
        if !self.is_plain() {
            let response = self.respond(theta, self.modes(), &[], &[])?;
            return Ok((response.frequencies_hz, response.by_parameter));
        }
        match self.model() {
            SimulationModel::Matrices(matrices) => {
                let structure = matrices.at(theta)?;
                let modes = modes(&structure, self.modes())?;
                let by_spring = frequency_sensitivity(&structure, &modes).by_spring;
                let jacobian = matrices.by_parameter(&by_spring, &DMatrix::zeros(by_spring.nrows(), 0), theta);
                Ok((modes.frequencies_hz, jacobian))
            }
            SimulationModel::Table(table) => {
                let (mut frequencies, jacobian) = table.frequencies_and_jacobian(theta);
                frequencies.truncate(self.modes());
                Ok((frequencies, jacobian.rows(0, self.modes()).into_owned()))
            }
        }
    }

    /// Natural frequencies at the nominal stiffnesses, or at the medians of the priors of a table, Hz, `[m]`.
    pub fn nominal_frequencies_hz(&self) -> Vec<f64> {
        self.parts.checked.nominal_frequencies_hz.clone()
    }

    /// Smallest and largest plausible measured frequency, Hz: the nominal range, widened by a factor of 100 on both sides. A
    /// value outside it has a wrong unit or is from a wrong column.
    ///
    /// Frequencies given in rad/s instead of Hz are within these limits; they are recognised later from the posterior.
    pub fn frequency_limits_hz(&self) -> (f64, f64) {
        let nominal = self.nominal_frequencies_hz();
        let first = nominal.first().copied().unwrap_or(f64::MIN_POSITIVE);
        let last = nominal.last().copied().unwrap_or(f64::MAX);
        (first / FREQUENCY_MARGIN, last * FREQUENCY_MARGIN)
    }
}
