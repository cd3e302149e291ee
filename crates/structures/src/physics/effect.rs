//! Effects: influences on a structure or on its measurement besides the parameters, such as temperature, the instrument or an
//! additional spring.
//!
//! An effect is a [`Target`], which says what changes, and a law (`simulator::law`), which gives the size of the change as a
//! function of a covariate. This file applies the targets to K, M and the frequencies, and differentiates with respect to the
//! sizes.

use std::f64::consts::TAU;
use std::sync::Arc;

use nalgebra::DMatrix;

use super::deviation::{Change, Deviation, DeviationKind, Graded};
use super::modes::{frequency_sensitivity, modes, natural_frequencies_hz, FrequencySensitivity, Modes};
use super::structure::{Error, Mass, Node, Spring, Structure};

pub use super::direction::{Direction, LEAST_FACTOR};

/// Smallest mass of an oscillator, kg: without mass it would have no frequency.
const LEAST_OSCILLATOR_KG: f64 = 1e-9;

/// What an effect of size g changes.
#[derive(Debug, Clone, PartialEq)]
pub enum Target {
    /// The stiffness of these springs, k → k(1 + g).
    Springs(Vec<usize>),
    /// The mass of these bodies, m → m(1 + g).
    Masses(Vec<usize>),
    /// The scale of the instrument, f → f(1 + g), for one mode or for all.
    FrequencyScale(Option<usize>),
    /// The offset of the instrument, f → f + g (Hz), for one mode or for all.
    FrequencyOffset(Option<usize>),
    /// A parameter that the experimenter sets, p → p + g in the unit of the parameter. It acts before stiffnesses are computed.
    SettingOffset(usize),
    /// A parameter that the experimenter sets, p → p(1 + g).
    SettingScale(usize),
    /// A parameter that the experimenter sets was given in another unit, p → factor·p where g = 1; unchanged where g = 0.
    SettingUnit {
        /// Column of the parameter.
        column: usize,
        /// Unit in which it was given, in units of the parameter; −1 for the opposite sign.
        factor: f64,
    },
    /// A parameter that the experimenter sets was measured from the other end, p → g₂ − p where g₁ = 1; unchanged where g₁ = 0.
    SettingMirror(usize),
    /// Two parameters that the experimenter sets were exchanged where g = 1.
    SettingExchange(usize, usize),
    /// Any parameter, p → p(1 + g). An emulator, which has no springs, uses this target.
    ParameterScale(usize),
    /// Any parameter, p → p + g in the unit of the parameter.
    ParameterOffset(usize),
    /// A target on a setting that acts on the frequency of one mode only.
    InMode(usize, Box<Target>),
    /// The response of one mode to a parameter: ln f(p) → ln f(r) + (1 + g₁)(ln f(p) − ln f(r)) + g₂, with r the reference.
    ModeGain {
        /// The mode.
        mode: usize,
        /// Column of the parameter.
        column: usize,
        /// Value r of the parameter at which the gain changes nothing, in its unit.
        reference: f64,
    },
    /// An additional spring of stiffness g, N/m, between two nodes.
    AddedSpring(Node, Node),
    /// An additional body of g₁ kg on a spring tuned to g₂ Hz, attached to a degree of freedom.
    Oscillator(usize),
    /// A rigid body of g kg, fixed to a degree of freedom.
    AddedMass(usize),
    /// Mode i of the data is mode `order[i]` of the structure. This target has no size.
    ModeOrder(Vec<usize>),
    /// A deviation that is in no single part, of this size (see [`super::deviation`]).
    Deviation(Arc<Deviation>),
    /// All parts together, each by a factor of its own: ln k → ln k + Σ g_q a_q, with one size g_q for each direction.
    Everywhere(Vec<Direction>),
}

impl Target {
    /// Number of sizes: 2 for an oscillator, a mirrored setting and the gain of a mode, 0 for an order of modes, one for each direction
    /// of a change of all parts, otherwise 1.
    pub fn sizes(&self) -> usize {
        match self {
            Self::Oscillator(_) | Self::SettingMirror(_) | Self::ModeGain { .. } => 2,
            Self::ModeOrder(_) => 0,
            Self::Everywhere(directions) => directions.len(),
            Self::InMode(_, target) => target.sizes(),
            _ => 1,
        }
    }

    /// Whether the first size is a switch: 1 in the rows in which the target acts, 0 in the others.
    pub fn is_switch(&self) -> bool {
        match self {
            Self::SettingUnit { .. } | Self::SettingMirror(_) | Self::SettingExchange(..) => true,
            Self::InMode(_, target) => target.is_switch(),
            _ => false,
        }
    }

    /// The directions in which it changes the logarithms of stiffnesses, masses and frequencies, one for each of its sizes.
    pub(super) fn directions(&self) -> &[Direction] {
        match self {
            Self::Everywhere(directions) => directions,
            Self::Deviation(deviation) => deviation.direction().map_or(&[], std::slice::from_ref),
            _ => &[],
        }
    }

    /// Change of the logarithm of the frequency of a mode by the first size, besides that of stiffnesses and masses.
    pub fn by_log_frequency(&self, mode: usize) -> f64 {
        self.directions().first().and_then(|direction| direction.frequencies.get(mode)).copied().unwrap_or(0.0)
    }

    /// Whether it is an error of the instrument: the scale, an offset or the curve of its calibration.
    pub fn is_of_instrument(&self) -> bool {
        match self {
            Self::FrequencyScale(_) | Self::FrequencyOffset(_) => true,
            Self::Deviation(deviation) => deviation.kind == DeviationKind::Calibration,
            _ => false,
        }
    }

    /// Whether the target changes parameters, or the response to them, instead of the structure or the instrument.
    pub fn acts_on_parameters(&self) -> bool {
        let others = matches!(self, Self::ParameterScale(_) | Self::ParameterOffset(_) | Self::ModeGain { .. });
        others || !self.settings().is_empty()
    }

    /// The masses that it changes by one factor; empty for other targets.
    pub fn masses(&self) -> &[usize] {
        match self {
            Self::Masses(indices) => indices,
            _ => &[],
        }
    }

    /// Columns of the settings that the target corrects; empty for other targets.
    pub fn settings(&self) -> Vec<usize> {
        match self {
            Self::SettingOffset(column)
            | Self::SettingScale(column)
            | Self::SettingUnit { column, .. }
            | Self::SettingMirror(column) => vec![*column],
            Self::SettingExchange(one, other) => vec![*one, *other],
            Self::InMode(_, target) => target.settings(),
            _ => Vec::new(),
        }
    }
}

/// Frequencies of a structure under effects, and their derivatives.
#[derive(Debug, Clone)]
pub struct Response {
    /// Frequencies as the instrument reports them, Hz, `[m]`; ascending unless an order of modes changes that.
    pub frequencies_hz: Vec<f64>,
    /// Derivatives with respect to the stiffness of each spring of the structure without effects, Hz per N/m, `[m, springs]`.
    pub by_spring: DMatrix<f64>,
    /// Derivatives with respect to the size of each effect, Hz per unit of the size, `[m, sizes]`.
    pub by_size: DMatrix<f64>,
}

/// The lowest `count` frequencies of a structure under effects, Hz, `[count]`, and their derivatives. `sizes` holds the size g of
/// each effect in the unit of its target, `[sizes]`: all sizes of the first target, then those of the next.
///
/// ```text
///  ∂f/∂g:   k(1 + g):  Σ k ∂f/∂k      m(1 + g):  Σ m ∂f/∂m      f(1 + g):  f      f + g:  1      added spring:  ∂f/∂k
///  added mass:  ∂f/∂m
///  oscillator (m, ν), k = (2πν)² m:   ∂f/∂m + (2πν)² ∂f/∂k,   8π² ν m ∂f/∂k
///  all parts:  Σ a k ∂f/∂k + Σ a m ∂f/∂m      spread mass:  Σ m ∂f/∂m      flexibility in series:  see `frequency_sensitivity`
/// ```
///
/// # Errors
/// [`Error::Effect`] for a size that leaves less than 2 % of a stiffness, mass or frequency; otherwise as [`modes()`].
///
/// # Panics
/// If the number of sizes is not that of the targets.
pub fn respond(structure: &Structure, count: usize, targets: &[Target], sizes: &[f64]) -> Result<Response, Error> {
    let columns = columns(targets);
    let changed = Changed::new(structure, count, &columns, sizes)?;
    let modes = modes(&changed.structure, changed.needed(count))?;
    let sensitivity = frequency_sensitivity(&changed.structure, &modes);
    Ok(changed.response(&columns, sizes, &modes.frequencies_hz, &sensitivity))
}

/// The frequencies of [`respond`] without the derivatives, Hz, `[count]`.
///
/// # Errors
/// As [`respond`].
///
/// # Panics
/// As [`respond`].
pub fn frequencies_under(
    structure: &Structure,
    count: usize,
    targets: &[Target],
    sizes: &[f64],
) -> Result<Vec<f64>, Error> {
    let columns = columns(targets);
    let changed = Changed::new(structure, count, &columns, sizes)?;
    let structural_hz = natural_frequencies_hz(&changed.structure, changed.needed(count))?;
    let (scale, offset_hz) = instrument(&columns, sizes, changed.order.len());
    let reported_hz = |(row, mode): (usize, &usize)| structural_hz[*mode] * scale[row] + offset_hz[row];
    Ok(changed.order.iter().enumerate().map(reported_hz).collect())
}

/// A structure with effects applied to its springs and masses, and the factor on each spring of the structure without them. Springs that
/// effects add follow those of the structure.
///
/// # Errors
/// [`Error::Effect`] as [`respond`].
pub fn structure_under(
    structure: &Structure,
    targets: &[Target],
    sizes: &[f64],
) -> Result<(Structure, Vec<f64>), Error> {
    let changed = Changed::new(structure, 0, &columns(targets), sizes)?;
    Ok((changed.structure, changed.spring_factor))
}

/// Product of the scales and sum of the offsets (Hz) of the instrument for each of `count` modes under effects: f → scale·f + offset.
pub fn instrument_under(count: usize, targets: &[Target], sizes: &[f64]) -> (Vec<f64>, Vec<f64>) {
    instrument(&columns(targets), sizes, count)
}

/// The modes of a structure under effects, and for each of `count` modes of the data the index of the mode of the structure.
/// Effects of the instrument do not change them.
///
/// # Errors
/// As [`respond`].
pub fn modes_under(
    structure: &Structure,
    count: usize,
    targets: &[Target],
    sizes: &[f64],
) -> Result<(Modes, Vec<usize>), Error> {
    let changed = Changed::new(structure, count, &columns(targets), sizes)?;
    Ok((modes(&changed.structure, changed.needed(count))?, changed.order))
}

/// A structure with effects applied to its springs and masses.
pub(super) struct Changed {
    pub(super) structure: Structure,
    /// Factor on each spring of the structure without effects.
    pub(super) spring_factor: Vec<f64>,
    /// Index of the spring or flexibility, and of the first mass, that each target adds.
    added: Vec<(usize, usize)>,
    /// Mode of the structure behind each mode of the data.
    pub(super) order: Vec<usize>,
}

impl Changed {
    /// Applies the targets to the springs and masses of a structure. `count`: number of modes wanted; `columns`: each target with
    /// the column of its first size in `sizes`.
    pub(super) fn new(
        structure: &Structure,
        count: usize,
        columns: &[(usize, &Target)],
        sizes: &[f64],
    ) -> Result<Self, Error> {
        let total = columns.last().map_or(0, |(first, target)| first + target.sizes());
        assert_eq!(sizes.len(), total, "one size for each target, two for an oscillator");
        let mut spring_factor = vec![1.0; structure.springs().len()];
        let mut mass_factor = vec![1.0; structure.masses().len()];
        let mut changed = structure.clone();
        let mut added: Vec<(usize, usize)> = vec![(0, 0); columns.len()];
        let mut order: Vec<usize> = (0..count).collect();
        // Degree of freedom of each oscillator, and that of its host.
        let mut hosts: Vec<(usize, usize)> = Vec::new();
        for (number, (first, target)) in columns.iter().enumerate() {
            let size = sizes.get(*first).copied().unwrap_or(0.0);
            let factor = || {
                let enough = size.is_finite() && 1.0 + size >= LEAST_FACTOR;
                enough.then_some(1.0 + size).ok_or(Error::Effect { number, size })
            };
            match target {
                Target::Springs(indices) => {
                    let factor = factor()?;
                    for i in indices {
                        spring_factor[*i] *= factor;
                    }
                }
                Target::Masses(indices) => {
                    let factor = factor()?;
                    for i in indices {
                        mass_factor[*i] *= factor;
                    }
                }
                Target::AddedSpring(from, to) => {
                    added[number].0 = changed.springs.len();
                    changed.springs.push(Spring::between("", *from, *to, size));
                }
                Target::Oscillator(host) => {
                    let (kg, frequency_hz) = (size.max(LEAST_OSCILLATOR_KG), sizes[first + 1]);
                    added[number] = (changed.springs.len(), changed.masses.len());
                    let n_per_m = angular(frequency_hz).powi(2) * kg;
                    hosts.push((changed.dofs, *host));
                    let (host, own) = (Node::Dof(*host), Node::Dof(changed.dofs));
                    changed.springs.push(Spring::between("", host, own, n_per_m));
                    changed.masses.push(Mass::at("", changed.dofs, kg));
                    changed.dofs += 1;
                }
                Target::AddedMass(dof) => {
                    added[number].1 = changed.masses.len();
                    changed.masses.push(Mass::at("", *dof, size));
                }
                Target::ModeOrder(modes) => order.clone_from(modes),
                Target::FrequencyScale(_) | Target::SettingScale(_) | Target::ParameterScale(_) => {
                    factor()?;
                }
                Target::Deviation(deviation) => {
                    let place = deviation.apply(size, &mut changed, (&mut spring_factor, &mut mass_factor));
                    let place = place.ok_or(Error::Effect { number, size })?;
                    added[number] = (place, place);
                }
                Target::Everywhere(directions) => {
                    for (direction, size) in directions.iter().zip(&sizes[*first..]) {
                        if !direction.scale(*size, &mut spring_factor, &mut mass_factor) {
                            return Err(Error::Effect { number, size: *size });
                        }
                    }
                }
                // The simulator applies these to the parameters, or to the frequencies of single modes.
                _ => {}
            }
        }
        // Springs and masses that targets added follow those of the structure and have no factor. The sizes were checked above,
        // and an added spring of negative stiffness shows in the eigenvalues, so that the structure need not be checked again.
        changed.springs.iter_mut().zip(&spring_factor).for_each(|(spring, factor)| spring.n_per_m *= factor);
        changed.masses.iter_mut().zip(&mass_factor).for_each(|(mass, factor)| mass.kg *= factor);
        move_with_hosts(&mut changed, &hosts);
        Ok(Self { structure: changed, spring_factor, added, order })
    }

    /// Number of modes of the structure that `count` modes of the data need.
    fn needed(&self, count: usize) -> usize {
        self.order.iter().max().map_or(count, |highest| highest + 1)
    }

    /// Frequencies as the instrument reports them and their derivatives, from all frequencies of the structure, Hz, and their
    /// derivatives.
    pub(super) fn response(
        &self,
        columns: &[(usize, &Target)],
        sizes: &[f64],
        frequencies_hz: &[f64],
        sensitivity: &FrequencySensitivity,
    ) -> Response {
        let structural: Vec<f64> = self.order.iter().map(|mode| frequencies_hz[*mode]).collect();
        let rows = structural.len();
        let (scale, offset_hz) = instrument(columns, sizes, rows);
        let mut by_size = DMatrix::zeros(rows, sizes.len());
        for (number, (first, target)) in columns.iter().enumerate() {
            let own = &sizes[*first..first + target.sizes()];
            for row in 0..rows {
                for which in 0..own.len() {
                    by_size[(row, first + which)] = match target {
                        Target::FrequencyScale(mode) if mode.is_none_or(|mode| mode == row) => {
                            structural[row] * scale[row] / (1.0 + own[0])
                        }
                        Target::FrequencyOffset(mode) if mode.is_none_or(|mode| mode == row) => 1.0,
                        _ => {
                            let of_parts = self.slope((number, target), own, which, self.order[row], sensitivity);
                            let by_log = target.directions().get(which).and_then(|d| d.frequencies.get(row));
                            scale[row] * (of_parts + structural[row] * by_log.unwrap_or(&0.0))
                        }
                    };
                }
            }
        }
        let slope = |row: usize, spring: usize| {
            scale[row] * sensitivity.by_spring[(self.order[row], spring)] * self.spring_factor[spring]
        };
        let by_spring = DMatrix::from_fn(rows, self.spring_factor.len(), slope);
        let frequencies_hz = (0..rows).map(|row| structural[row] * scale[row] + offset_hz[row]).collect();
        Response { frequencies_hz, by_spring, by_size }
    }

    /// Derivative of the quantity in row `row` of `sensitivity` with respect to size `which` of a target, given with its number and
    /// all its sizes, that acts on springs or masses; 0 for other targets.
    pub(super) fn slope(
        &self,
        (number, target): (usize, &Target),
        sizes: &[f64],
        which: usize,
        row: usize,
        sensitivity: &FrequencySensitivity,
    ) -> f64 {
        let by_spring = |spring: usize| sensitivity.by_spring[(row, spring)];
        let by_mass = |mass: usize| sensitivity.by_mass[(row, mass)];
        // By the logarithm of the stiffness, and of the mass.
        let by_log_spring = |spring: usize| by_spring(spring) * self.structure.springs[spring].n_per_m;
        let by_log_mass = |mass: usize| by_mass(mass) * self.structure.masses[mass].kg;
        let along = |direction: &Direction| {
            let springs = direction.springs.iter().enumerate().map(|(spring, by)| by * by_log_spring(spring));
            let masses = direction.masses.iter().enumerate().map(|(mass, by)| by * by_log_mass(mass));
            springs.chain(masses).sum()
        };
        match target {
            Target::Springs(indices) => indices.iter().map(|i| by_log_spring(*i)).sum::<f64>() / (1.0 + sizes[0]),
            Target::Masses(indices) => indices.iter().map(|i| by_log_mass(*i)).sum::<f64>() / (1.0 + sizes[0]),
            Target::AddedSpring(..) => by_spring(self.added[number].0),
            Target::AddedMass(_) => by_mass(self.added[number].1),
            Target::Oscillator(_) => {
                let (spring, mass) = self.added[number];
                let (frequency_hz, kg) = (sizes[1], self.structure.masses[mass].kg);
                if which == 0 {
                    by_mass(mass) + angular(frequency_hz).powi(2) * by_spring(spring)
                } else {
                    2.0 * angular(frequency_hz) * TAU * kg * by_spring(spring)
                }
            }
            Target::Deviation(deviation) => match &deviation.change {
                Change::Flexibility(_) => sensitivity.by_flexibility[(row, self.added[number].0)],
                Change::Stiffness(springs) => {
                    let each = springs.iter().enumerate();
                    each.map(|(place, spring)| spring.n_per_m * by_spring(self.added[number].0 + place)).sum()
                }
                Change::Inertia(masses) => {
                    let each = masses.iter().enumerate();
                    each.map(|(place, mass)| mass.kg * by_mass(self.added[number].1 + place)).sum()
                }
                Change::Along(direction) => along(direction),
                Change::AlongStiffness(spans) => {
                    let kept = |(place, graded): (usize, &Graded)| {
                        self.structure.springs[graded.part].n_per_m * by_spring(self.added[number].0 + place)
                    };
                    spans.iter().enumerate().map(kept).sum()
                }
                Change::AlongInertia(spans) => {
                    let kept = |(place, graded): (usize, &Graded)| {
                        self.structure.masses[graded.part].kg * by_mass(self.added[number].1 + place)
                    };
                    spans.iter().enumerate().map(kept).sum()
                }
            },
            Target::Everywhere(directions) => along(&directions[which]),
            _ => 0.0,
        }
    }
}

/// Lets the body of each oscillator, given with its host as degrees of freedom, move with its host where flexibilities in series with the
/// springs move the structure, because its own spring does not deform then.
fn move_with_hosts(structure: &mut Structure, hosts: &[(usize, usize)]) {
    if hosts.is_empty() {
        return;
    }
    let row = |dof: usize| hosts.iter().find(|(own, _)| *own == dof).map_or(dof, |(_, host)| *host);
    let rows: Vec<usize> = (0..structure.dofs).map(row).collect();
    for (_, further) in &mut structure.flexibilities {
        *further = Arc::new(further.select_rows(&rows).select_columns(&rows));
    }
}

/// Product of the scales and sum of the offsets (Hz) of the instrument for each mode: f → scale·f + offset. Both `[m]`.
pub(super) fn instrument(columns: &[(usize, &Target)], sizes: &[f64], rows: usize) -> (Vec<f64>, Vec<f64>) {
    let (mut scale, mut offset_hz) = (vec![1.0; rows], vec![0.0; rows]);
    for (first, target) in columns {
        for row in 0..rows {
            let here = |mode: &Option<usize>| mode.is_none_or(|mode| mode == row);
            match target {
                Target::FrequencyScale(mode) if here(mode) => scale[row] *= 1.0 + sizes[*first],
                Target::FrequencyOffset(mode) if here(mode) => offset_hz[row] += sizes[*first],
                _ => {
                    let along = target.directions().iter().zip(&sizes[*first..]);
                    let log: f64 = along.map(|(d, size)| size * d.frequencies.get(row).unwrap_or(&0.0)).sum();
                    scale[row] *= log.exp();
                }
            }
        }
    }
    (scale, offset_hz)
}

/// Each target with the column of its first size.
pub(super) fn columns(targets: &[Target]) -> Vec<(usize, &Target)> {
    let mut first = 0;
    let column = |target| {
        let column = (first, target);
        first += Target::sizes(target);
        column
    };
    targets.iter().map(column).collect()
}

/// Angular frequency 2πf, rad/s.
fn angular(frequency_hz: f64) -> f64 {
    TAU * frequency_hz
}
