//! Effects: what acts on a structure beside its parameters, such as temperature, an instrument, a forgotten spring.
//!
//! An effect is a [`Target`], which says what changes, and a law (`simulator::effect`), which says by how much under
//! which covariate. Here are the targets: written into K, M and the frequencies, with derivatives by the size of each.

use nalgebra::DMatrix;

use super::{frequency_sensitivity, modes, Error, Mass, Node, Spring, Structure};

/// Least share of a stiffness or mass that an effect may leave.
const LEAST_FACTOR: f64 = 0.02;

/// Least mass of an oscillator, kg: without any mass it has no frequency.
const LEAST_OSCILLATOR_KG: f64 = 1e-9;

/// What an effect of size g acts on.
#[derive(Debug, Clone, PartialEq)]
pub enum Target {
    /// Stiffness of these springs, k → k(1 + g).
    Springs(Vec<usize>),
    /// Mass of these bodies, m → m(1 + g).
    Masses(Vec<usize>),
    /// The instrument's scale, f → f(1 + g), of one mode or of all.
    FrequencyScale(Option<usize>),
    /// The instrument's offset, f → f + g (Hz), of one mode or of all.
    FrequencyOffset(Option<usize>),
    /// A parameter that the experimenter set, p → p + g (the parameter's unit); acts before there are stiffnesses.
    SettingOffset(usize),
    /// A parameter that the experimenter set, p → p(1 + g).
    SettingScale(usize),
    /// A parameter, p → p(1 + g), whoever set it: what an emulator has in place of springs.
    ParameterScale(usize),
    /// A further spring of stiffness g, N/m, between two nodes.
    AddedSpring(Node, Node),
    /// A further body of g₁ kg on a spring tuned to g₂ Hz, attached to a degree of freedom.
    Oscillator(usize),
    /// Mode i of the data is mode `order[i]` of the structure; has no size.
    ModeOrder(Vec<usize>),
}

impl Target {
    /// Number of sizes it has: 1, for an oscillator 2, for an order of modes 0.
    pub fn sizes(&self) -> usize {
        match self {
            Self::Oscillator(_) => 2,
            Self::ModeOrder(_) => 0,
            _ => 1,
        }
    }
}

/// Frequencies of a structure under effects, and their derivatives.
#[derive(Debug, Clone)]
pub struct Response {
    /// As the data would have them, Hz, `[m]`; ascending unless an order of modes says otherwise.
    pub frequencies_hz: Vec<f64>,
    /// By the stiffness of each spring of the structure without effects, Hz per N/m, `[m, springs]`.
    pub by_spring: DMatrix<f64>,
    /// By the size of each effect, Hz per unit of the size, `[m, sizes]`.
    pub by_size: DMatrix<f64>,
}

/// The lowest `count` frequencies of a structure under effects of the sizes `sizes` (all sizes of the first target, then
/// those of the next).
///
/// ```text
///  ∂f/∂g:   k(1 + g):  Σ k ∂f/∂k      m(1 + g):  Σ m ∂f/∂m      f(1 + g):  f      f + g:  1      added spring:  ∂f/∂k
///  oscillator (m, ν), k = (2πν)² m:   ∂f/∂m + (2πν)² ∂f/∂k,   8π² ν m ∂f/∂k
/// ```
///
/// # Errors
/// [`Error::Effect`] for sizes that leave hardly any stiffness or mass; as [`modes()`].
pub fn respond(structure: &Structure, count: usize, targets: &[Target], sizes: &[f64]) -> Result<Response, Error> {
    let places = places(targets);
    let total = places.last().map_or(0, |(first, target)| first + target.sizes());
    assert_eq!(sizes.len(), total, "one size for each target, two for an oscillator");
    let (originals, bodies) = (structure.springs().len(), structure.masses().len());

    let mut spring_factor = vec![1.0; originals];
    let mut mass_factor = vec![1.0; bodies];
    let mut springs: Vec<Spring> = structure.springs().to_vec();
    let mut masses: Vec<Mass> = structure.masses().to_vec();
    // Index of the spring, and of the mass of an oscillator, that an effect adds.
    let mut added: Vec<(usize, usize)> = vec![(0, 0); targets.len()];
    let (mut freedoms, mut order) = (structure.freedoms(), (0..count).collect::<Vec<usize>>());
    for (number, (first, target)) in places.iter().enumerate() {
        let size = sizes.get(*first).copied().unwrap_or(0.0);
        let factor = |index: usize| {
            let enough = size.is_finite() && 1.0 + size >= LEAST_FACTOR;
            enough.then_some(1.0 + size).ok_or(Error::Effect { number: index, size })
        };
        match target {
            Target::Springs(indices) => {
                let factor = factor(number)?;
                for i in indices {
                    spring_factor[*i] *= factor;
                }
            }
            Target::Masses(indices) => {
                let factor = factor(number)?;
                for i in indices {
                    mass_factor[*i] *= factor;
                }
            }
            Target::AddedSpring(from, to) => {
                added[number].0 = springs.len();
                springs.push(Spring::between("", *from, *to, size));
            }
            Target::Oscillator(host) => {
                let (kg, frequency_hz) = (size.max(LEAST_OSCILLATOR_KG), sizes[first + 1]);
                added[number] = (springs.len(), masses.len());
                let n_per_m = angular(frequency_hz).powi(2) * kg;
                springs.push(Spring::between("", Node::Freedom(*host), Node::Freedom(freedoms), n_per_m));
                masses.push(Mass::at("", freedoms, kg));
                freedoms += 1;
            }
            Target::ModeOrder(modes) => order.clone_from(modes),
            Target::FrequencyScale(_) | Target::SettingScale(_) | Target::ParameterScale(_) => {
                factor(number)?;
            }
            Target::FrequencyOffset(_) | Target::SettingOffset(_) => {}
        }
    }
    for (spring, factor) in springs.iter_mut().zip(&spring_factor) {
        spring.n_per_m *= factor;
    }
    for (mass, factor) in masses.iter_mut().zip(&mass_factor) {
        mass.kg *= factor;
    }
    // The parts were checked before, and what effects did to them above; a stiffness below zero shows in the eigenvalues.
    let changed = Structure { freedoms, places: structure.places.clone(), masses, springs };
    let needed = order.iter().max().map_or(count, |highest| highest + 1);
    let modes = modes(&changed, needed)?;
    let sensitivity = frequency_sensitivity(&changed, &modes);

    let structural: Vec<f64> = order.iter().map(|mode| modes.frequencies_hz[*mode]).collect();
    let rows = structural.len();
    let spring_slope = |row: usize, spring: usize| sensitivity.by_spring[(order[row], spring)];
    let mass_slope = |row: usize, mass: usize| sensitivity.by_mass[(order[row], mass)];

    let (scale, offset_hz) = instrument(&places, sizes, rows);
    let mut by_size = DMatrix::zeros(rows, total);
    for (number, (first, target)) in places.iter().enumerate() {
        for row in 0..rows {
            let slopes = match target {
                Target::Springs(indices) => {
                    let sum: f64 = indices.iter().map(|i| spring_slope(row, *i) * changed.springs[*i].n_per_m).sum();
                    [scale[row] * sum / (1.0 + sizes[*first]), 0.0]
                }
                Target::Masses(indices) => {
                    let sum: f64 = indices.iter().map(|i| mass_slope(row, *i) * changed.masses[*i].kg).sum();
                    [scale[row] * sum / (1.0 + sizes[*first]), 0.0]
                }
                Target::AddedSpring(..) => [scale[row] * spring_slope(row, added[number].0), 0.0],
                Target::Oscillator(_) => {
                    let (spring, mass) = added[number];
                    let (frequency_hz, kg) = (sizes[first + 1], changed.masses[mass].kg);
                    let (by_k, by_m) = (spring_slope(row, spring), mass_slope(row, mass));
                    let by_tuning = 2.0 * angular(frequency_hz) * std::f64::consts::TAU * kg * by_k;
                    [scale[row] * (by_m + angular(frequency_hz).powi(2) * by_k), scale[row] * by_tuning]
                }
                Target::FrequencyScale(mode) if mode.is_none_or(|mode| mode == row) => {
                    [structural[row] * scale[row] / (1.0 + sizes[*first]), 0.0]
                }
                Target::FrequencyOffset(mode) if mode.is_none_or(|mode| mode == row) => [1.0, 0.0],
                _ => [0.0, 0.0],
            };
            for which in 0..target.sizes() {
                by_size[(row, first + which)] = slopes[which];
            }
        }
    }
    let by_spring = DMatrix::from_fn(rows, originals, |row, s| scale[row] * spring_slope(row, s) * spring_factor[s]);
    let frequencies_hz = (0..rows).map(|row| structural[row] * scale[row] + offset_hz[row]).collect();
    Ok(Response { frequencies_hz, by_spring, by_size })
}

/// Frequencies of another simulation under effects, and their derivatives.
#[derive(Debug, Clone)]
pub struct Measured {
    /// As the data would have them, Hz, `[m]`.
    pub frequencies_hz: Vec<f64>,
    /// Hz per parameter unit, `[m, d]`.
    pub by_parameter: DMatrix<f64>,
    /// By the size of each effect, Hz per unit of the size, `[m, sizes]`.
    pub by_size: DMatrix<f64>,
}

/// Frequencies that another simulation gives, all of its modes, as `count` modes of the data have them, with derivatives by
/// parameters and by the sizes of effects. Only an instrument and an order of modes can act here; the slopes of parameters'
/// own effects are left at 0.
///
/// # Errors
/// [`Error::TooFewModes`]; [`Error::Effect`] for an effect on parts that such a simulation does not have.
pub fn measured(
    frequencies_hz: &[f64],
    by_parameter: &DMatrix<f64>,
    count: usize,
    targets: &[Target],
    sizes: &[f64],
) -> Result<Measured, Error> {
    let places = places(targets);
    let mut order: Vec<usize> = (0..count).collect();
    for (number, (first, target)) in places.iter().enumerate() {
        let size = sizes.get(*first).copied().unwrap_or(0.0);
        match target {
            Target::ModeOrder(modes) => order.clone_from(modes),
            Target::FrequencyScale(_) | Target::ParameterScale(_) | Target::SettingScale(_) => {
                // Compared by what holds: NaN must fail too.
                let enough = 1.0 + size >= LEAST_FACTOR;
                if !enough {
                    return Err(Error::Effect { number, size });
                }
            }
            Target::FrequencyOffset(_) | Target::SettingOffset(_) => {}
            _ => return Err(Error::Effect { number, size }),
        }
    }
    let needed = order.iter().max().map_or(count, |highest| highest + 1);
    if needed > frequencies_hz.len() {
        return Err(Error::TooFewModes { asked: needed, available: frequencies_hz.len() });
    }
    let rows = order.len();
    let (scale, offset_hz) = instrument(&places, sizes, rows);
    let structural: Vec<f64> = order.iter().map(|mode| frequencies_hz[*mode]).collect();
    let by_parameter =
        DMatrix::from_fn(rows, by_parameter.ncols(), |row, k| scale[row] * by_parameter[(order[row], k)]);
    let mut by_size = DMatrix::zeros(rows, sizes.len());
    for (first, target) in &places {
        for row in 0..rows {
            let slope = match target {
                Target::FrequencyScale(mode) if mode.is_none_or(|mode| mode == row) => {
                    structural[row] * scale[row] / (1.0 + sizes[*first])
                }
                Target::FrequencyOffset(mode) if mode.is_none_or(|mode| mode == row) => 1.0,
                _ => continue,
            };
            by_size[(row, *first)] = slope;
        }
    }
    let frequencies_hz = (0..rows).map(|row| structural[row] * scale[row] + offset_hz[row]).collect();
    Ok(Measured { frequencies_hz, by_parameter, by_size })
}

/// Product of the scales and sum of the offsets, Hz, of each mode: f → scale·f + offset.
fn instrument(places: &[(usize, &Target)], sizes: &[f64], rows: usize) -> (Vec<f64>, Vec<f64>) {
    let (mut scale, mut offset_hz) = (vec![1.0; rows], vec![0.0; rows]);
    for (first, target) in places {
        for row in 0..rows {
            let here = |mode: &Option<usize>| mode.is_none_or(|mode| mode == row);
            match target {
                Target::FrequencyScale(mode) if here(mode) => scale[row] *= 1.0 + sizes[*first],
                Target::FrequencyOffset(mode) if here(mode) => offset_hz[row] += sizes[*first],
                _ => {}
            }
        }
    }
    (scale, offset_hz)
}

/// Column of the first size of each target.
fn places(targets: &[Target]) -> Vec<(usize, &Target)> {
    let mut first = 0;
    let place = |target| {
        let place = (first, target);
        first += Target::sizes(target);
        place
    };
    targets.iter().map(place).collect()
}

fn angular(frequency_hz: f64) -> f64 {
    std::f64::consts::TAU * frequency_hz
}
