//! The mean of the population behind a batch, straight from its frequencies.
//!
//! Where the population is narrow against the curvature of the simulation, the frequencies of a measurement are normal about those of the
//! mean m of the population, and all measurements of a batch together inform m, whichever modes each of them has:
//!
//! ```text
//!  y_n ~ N(f_n(m), J_n S J_nᵀ + R_n),    J_n = ∂f_n/∂m
//! ```
//!
//! y_n: frequencies of the modes that measurement n has; R_n: variances of their noise; S: covariance of the parameters of single
//! measurements about m; f_n: the simulation with the effects at the time of the measurement. S is that of the healthy structure: a few
//! measurements hardly show how far they scatter, and one not at all.
//!
//! A batch in which a mode is missing confines m to a curve. Its estimate is the point of the curve that lies nearest to the centre of a
//! normal distribution with the variances of the prior, and its covariance is as long in the direction of the curve as that distribution:
//! what is informed is known as well as it is, and the rest is not.
//!
//! Source: A. Gelman et al. (2014), Bayesian Data Analysis, 3rd ed., ch. 4.1 and 15, for the normal approximation of a posterior and for
//! hierarchical linear models.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use crate::baseline::observation::Observation;
use crate::baseline::Baseline;
use crate::process::misfit::MisfitBasis;
use structures::parameter::ParameterSpace;
use structures::simulator::Simulator;

/// Most Gauss–Newton steps, and how often a step that leads uphill is halved.
const STEPS: usize = 12;
const HALVINGS: usize = 6;

/// A step that is shorter than this, in standard deviations of the result, is the last one.
const ARRIVED: f64 = 1e-3;

/// Smallest distance from the bounds of the prior, as a share of its width.
const MARGIN: f64 = 1e-6;

/// The population of a healthy structure, about which batches are linearised.
#[derive(Debug, Clone)]
pub(super) struct Healthy {
    /// Mean of the parameters, `[d]`.
    pub centre: Vec<f64>,
    /// Covariance S of single measurements about the mean of their batch, without their noise, `[d, d]`.
    pub scatter: DMatrix<f64>,
}

/// Measurements with the same effects, each with its place in the batch, by their modes and noise.
type ByModes<'a> = BTreeMap<Vec<Option<u64>>, Vec<(usize, &'a Observation)>>;

/// The mean of the population of a batch in normal approximation, in parameter units.
#[derive(Debug, Clone)]
pub(super) struct BatchMean {
    /// `[d]`
    pub mean: DVector<f64>,
    /// `[d, d]`
    pub covariance: DMatrix<f64>,
    /// Mean square of the distances of the frequencies from those at the mean, in standard deviations of the healthy structure.
    pub scatter: f64,
}

/// Share of the variance of the prior that is left of a parameter that measurements inform.
const WELL_INFORMED: f64 = 0.1;

/// Distance from the bounds of the box at which a search ends that would cross them.
const AT_BOUND: f64 = 1e-3;

/// Variance of a coordinate of the misfit, in units of the variance of one complete measurement, from which on a batch does not determine it.
const MOST_MISFIT_VARIANCE: f64 = 4.0;

/// Frequencies that the scatter of the healthy structure counts for beside the distances of a batch.
const HEALTHY_FREQUENCIES: f64 = 60.0;

/// Whether the mean of a batch can be computed from its frequencies alone: all that is known of its measurements are frequencies, and the
/// simulation is exact and quick.
pub(super) fn is_computed(baseline: &Baseline, observations: &[Observation]) -> bool {
    let of_frequencies = |o: &Observation| !o.is_marginalised() && !o.has_shapes();
    baseline.is_resampled() && observations.iter().all(of_frequencies)
}

/// The mean of the population behind some measurements, at least one; `None` where [`is_computed`] is false, and where the simulation
/// fails.
///
/// The slopes of the simulation, and with them the covariance, depend on the point. Those at the mean that was found would be the steeper,
/// the more the noise happens to soften the structure, so that batches with such an error would count for more than others. The covariance
/// is therefore that at the mean as far as it is known to differ from the healthy structure (James, Stein 1961):
///
/// ```text
///  θ = θ_h + max(0, 1 − d/D²) (m − θ_h),    D² = (m − θ_h)ᵀ C⁻¹ (m − θ_h)
/// ```
///
/// How far the frequencies scatter, beside a healthy structure whose scatter counts for ν of them:
///
/// ```text
///  s² = (ν + Σ_n r_nᵀ (J S Jᵀ + R)_n⁻¹ r_n)/(ν + N − p),    r_n = y_n − f_n(m)
/// ```
///
/// N frequencies, and p parameters that they inform, of d − Σ_k C_kk/prior variance_k.
pub(super) fn batch_mean(baseline: &Baseline, observations: &[Observation], healthy: &Healthy) -> Option<BatchMean> {
    let problem = Problem::new(baseline, observations, healthy)?;
    problem.mean(&problem.solved()?)
}

/// The coordinates of a misfit.
pub(super) struct Coordinates {
    /// `[r]`
    pub mean: DVector<f64>,
    /// Covariance of their errors, `[r, r]`.
    pub covariance: DMatrix<f64>,
    /// Squared distance of the measurements from the frequencies with this misfit, in standard deviations, and its degrees of freedom.
    pub left_over: f64,
    pub degrees_of_freedom: f64,
}

/// Measurements with the same effects, for which one simulation is enough.
#[derive(Clone)]
pub(super) struct Alike<'a> {
    pub simulator: Simulator,
    /// Those with the same modes and noise together, for which one covariance is enough; each with its place in the batch. None is empty.
    pub groups: Vec<Vec<(usize, &'a Observation)>>,
}

/// A batch in the unit box of the prior.
#[derive(Clone)]
pub(super) struct Problem<'a> {
    pub space: &'a ParameterSpace,
    pub alike: Vec<Alike<'a>>,
    /// Mean of the healthy structure, `[d]`.
    pub centre: DVector<f64>,
    /// Precision of the prior about it, `[d]`.
    pub prior: DVector<f64>,
    /// S.
    pub scatter: DMatrix<f64>,
}

/// The most probable mean of a batch, `[d]` in the unit box, and the density about it.
pub(super) struct Solved {
    pub at: DVector<f64>,
    here: Linearised,
}

/// Simulated frequencies of all modes in Hz, `[m]`, and their derivatives by the position in the unit box, `[m, d]`.
pub(super) struct Slopes {
    pub frequencies_hz: Vec<f64>,
    pub slopes: DMatrix<f64>,
}

/// Measurements with the same effects, modes and noise beside the simulation at a point.
pub(super) struct Rows {
    /// Their places in the batch, `[n]`.
    pub places: Vec<usize>,
    /// The modes that they have.
    pub modes: Vec<usize>,
    /// Measured less simulated frequencies of these modes, Hz, `[modes present, n]`.
    pub residuals: DMatrix<f64>,
    /// The covariance J S Jᵀ + R of those of each measurement, Hz².
    pub covariance: DMatrix<f64>,
    /// Derivatives of the simulated frequencies of these modes by the position in the unit box, `[modes present, d]`.
    slopes: DMatrix<f64>,
    /// Simulated frequencies of all modes, Hz.
    pub simulated_hz: Vec<f64>,
}

impl Solved {
    /// Minus twice the logarithm of the density, but for a constant.
    pub fn deviance(&self) -> f64 {
        self.here.misfit
    }
}

/// The density of a batch about a point.
struct Linearised {
    /// Squared distance from the measurements and from the centre, in standard deviations.
    misfit: f64,
    gradient: DVector<f64>,
    information: DMatrix<f64>,
}

impl<'a> Problem<'a> {
    /// `None` where [`is_computed`] is false.
    pub fn new(baseline: &'a Baseline, observations: &'a [Observation], healthy: &Healthy) -> Option<Self> {
        if is_computed(baseline, observations) {
            Self::of(baseline.simulator(), observations, healthy)
        } else {
            None
        }
    }

    /// [`Self::new`] for a simulation that is exact and quick, in the unit box of its prior; `None` if the healthy structure has other
    /// parameters.
    pub fn of(simulator: &'a Simulator, observations: &'a [Observation], healthy: &Healthy) -> Option<Self> {
        let space = simulator.space();
        let parameters = space.as_slice();
        let width = |k: usize| parameters[k].upper - parameters[k].lower;
        let d = parameters.len();
        let mut by_effects: BTreeMap<Vec<u64>, ByModes<'a>> = BTreeMap::new();
        for (place, measurement) in observations.iter().enumerate() {
            let effects = measurement.effect_sizes.iter().map(|size| size.to_bits()).collect();
            let modes = measurement.frequencies_hz.iter().zip(&measurement.noise_multiple);
            let modes = modes.map(|(f, multiple)| f.map(|_| multiple.to_bits())).collect();
            by_effects.entry(effects).or_default().entry(modes).or_default().push((place, measurement));
        }
        let alike = |by_modes: ByModes<'a>| {
            let groups: Vec<Vec<_>> = by_modes.into_values().collect();
            Alike { simulator: groups[0][0].1.simulator(simulator), groups }
        };
        let alike = by_effects.into_values().map(alike).collect();
        (healthy.centre.len() == d && healthy.scatter.nrows() == d).then(|| Self {
            space,
            alike,
            centre: DVector::from_fn(d, |k, _| parameters[k].to_unit(healthy.centre[k])),
            prior: DVector::from_fn(d, |k, _| width(k).powi(2) / parameters[k].prior_variance()),
            scatter: DMatrix::from_fn(d, d, |i, j| healthy.scatter[(i, j)] / (width(i) * width(j))),
        })
    }

    /// The most probable mean; `None` where the simulation fails.
    pub fn solved(&self) -> Option<Solved> {
        self.solved_from(&self.centre)
    }

    /// [`Self::solved`] by a search that begins at some point.
    pub fn solved_from(&self, start: &DVector<f64>) -> Option<Solved> {
        let mut at = start.map(|u| u.clamp(MARGIN, 1.0 - MARGIN));
        let mut here = self.about(&at)?;
        for _ in 0..STEPS {
            let step = here.information.clone().cholesky()?.solve(&here.gradient);
            if step.dot(&(&here.information * &step)) < ARRIVED * ARRIVED {
                break;
            }
            let shorter = |halvings: usize| {
                let next = (&at + &step * 0.5_f64.powi(halvings as i32)).map(|u| u.clamp(MARGIN, 1.0 - MARGIN));
                let there = self.about(&next).filter(|there| there.misfit <= here.misfit)?;
                Some((next, there))
            };
            let Some(found) = (0..=HALVINGS).find_map(shorter) else { break };
            (at, here) = found;
        }
        Some(Solved { at, here })
    }

    /// Whether a mean lies at the bounds of the box, or single measurements about it reach them in a parameter that they inform, within some
    /// standard deviations of their scatter and of its error; `None` where the covariance is not positive.
    pub fn is_near_bound(&self, found: &Solved, deviations: f64) -> Option<bool> {
        let covariance = found.here.information.clone().cholesky()?.inverse();
        let near = |k: usize| {
            let informs = covariance[(k, k)] * self.prior[k] < WELL_INFORMED;
            let std = (covariance[(k, k)] + self.scatter[(k, k)]).sqrt();
            let off = if informs { deviations * std } else { AT_BOUND };
            found.at[k] - off < 0.0 || found.at[k] + off > 1.0
        };
        Some((0..found.at.len()).any(near))
    }

    /// The coordinates of a [`MisfitBasis`] about the most probable mean; `None` where the modes of the
    /// batch do not determine all of them beside the parameters.
    ///
    /// ```text
    ///  I = Σ_n Aᵀ C_n⁻¹ A,    A = (J, F B),    v = V (g_v − I_vθ I_θθ⁻¹ g_θ),    V = (I_vv − I_vθ I_θθ⁻¹ I_θv)⁻¹
    /// ```
    ///
    /// J, C: as for the mean; F B: the effect of v on the frequencies in Hz, F = diag(f(θ)); g = Σ_n Aᵀ C_n⁻¹ (y_n − f(θ)). Where the
    /// measurements scatter about such frequencies further than the healthy structure, the covariance is larger by as much.
    pub fn misfit_coordinates(&self, found: &Solved, misfit: &MisfitBasis) -> Option<Coordinates> {
        let (d, r) = (found.at.len(), misfit.count());
        let mut information = DMatrix::zeros(d + r, d + r);
        let mut gradient = DVector::zeros(d + r);
        for rows in self.rows(&found.at)? {
            let effect = |row: usize, column: usize| match column.checked_sub(d) {
                None => rows.slopes[(row, column)],
                Some(j) => misfit.effects[j * misfit.modes + rows.modes[row]] * rows.simulated_hz[rows.modes[row]],
            };
            let effects = DMatrix::from_fn(rows.modes.len(), d + r, effect);
            let factored = rows.covariance.cholesky()?;
            gradient += effects.tr_mul(&factored.solve(&rows.residuals.column_sum()));
            information += effects.tr_mul(&factored.solve(&effects)) * rows.places.len() as f64;
        }
        let of_parameters = information.view((0, 0), (d, d)) + DMatrix::from_diagonal(&self.prior);
        let with = information.view((0, d), (d, r)).into_owned();
        let solved = of_parameters.cholesky()?.solve(&with);
        let left = information.view((d, d), (r, r)) - with.tr_mul(&solved);
        let score = gradient.rows(d, r) - solved.tr_mul(&gradient.rows(0, d));
        let covariance = left.cholesky()?.inverse();
        let is_determined = covariance.diagonal().iter().all(|variance| *variance < MOST_MISFIT_VARIANCE);
        let coordinates = &covariance * &score;
        // What the measurements scatter beside the misfit of their mean.
        let informed = self.informed(&found.here.information.clone().cholesky()?.inverse()) + r as f64;
        let left_over = (self.misfit(found) - coordinates.dot(&score)).max(0.0);
        let scatter = self.scatter_of(left_over, informed).max(1.0);
        is_determined.then(|| Coordinates {
            mean: coordinates,
            covariance: covariance * scatter,
            left_over,
            degrees_of_freedom: (self.frequencies() as f64 - informed).max(0.0),
        })
    }

    /// Squared distance of the measurements from the most probable mean, in standard deviations.
    pub fn misfit(&self, solved: &Solved) -> f64 {
        solved.here.misfit - self.of_prior(&solved.at)
    }

    /// The most probable mean with its covariance, in parameter units; `None` where the simulation fails.
    pub fn mean(&self, found: &Solved) -> Option<BatchMean> {
        let off = &found.at - &self.centre;
        let distance = off.dot(&(&found.here.information * &off));
        let known = (1.0 - off.len() as f64 / distance.max(f64::MIN_POSITIVE)).max(0.0);
        let between = (&self.centre + off * known).map(|u| u.clamp(MARGIN, 1.0 - MARGIN));
        let covariance = self.about(&between)?.information.cholesky()?.inverse();
        let informed = self.informed(&found.here.information.clone().cholesky()?.inverse());
        Some(self.in_units(&found.at, &covariance, self.scatter_of(self.misfit(found), informed)))
    }

    /// The mean by the simulation linearised about a point: by one Gauss–Newton step from there. Estimates about the same point are linear in
    /// the frequencies, so that their errors average out over batches where the simulation is strongly curved. `None` where the simulation
    /// fails.
    pub fn mean_linearised(&self, about: &DVector<f64>) -> Option<BatchMean> {
        let here = self.about(about)?;
        let covariance = here.information.cholesky()?.inverse();
        let step = &covariance * &here.gradient;
        let at = about + &step;
        let misfit = here.misfit - here.gradient.dot(&step) - self.of_prior(&at);
        let at = at.map(|u| u.clamp(MARGIN, 1.0 - MARGIN));
        Some(self.in_units(&at, &covariance, self.scatter_of(misfit, self.informed(&covariance))))
    }

    /// Number of parameters that the measurements inform, from the covariance of the mean.
    fn informed(&self, covariance: &DMatrix<f64>) -> f64 {
        self.centre.len() as f64 - covariance.diagonal().dot(&self.prior)
    }

    fn scatter_of(&self, misfit: f64, informed: f64) -> f64 {
        (HEALTHY_FREQUENCIES + misfit) / (HEALTHY_FREQUENCIES + self.frequencies() as f64 - informed)
    }

    /// Number of measured frequencies.
    fn frequencies(&self) -> usize {
        let measurements = self.alike.iter().flat_map(|alike| alike.groups.iter().flatten());
        measurements.map(|(_, measurement)| measurement.modes_present()).sum()
    }

    fn in_units(&self, at: &DVector<f64>, covariance: &DMatrix<f64>, scatter: f64) -> BatchMean {
        let space = self.space.as_slice();
        let width = |k: usize| space[k].upper - space[k].lower;
        let d = space.len();
        BatchMean {
            mean: DVector::from_fn(d, |k, _| space[k].from_unit(at[k])),
            covariance: DMatrix::from_fn(d, d, |i, j| covariance[(i, j)] * width(i) * width(j)),
            scatter,
        }
    }

    /// Squared distance of a point of the unit box from the centre, in standard deviations of the prior.
    fn of_prior(&self, at: &DVector<f64>) -> f64 {
        at.iter()
            .zip(&self.centre)
            .zip(&self.prior)
            .map(|((at, centre), precision)| precision * (at - centre).powi(2))
            .sum()
    }

    /// The density about a point of the unit box; `None` where the simulation fails.
    fn about(&self, at: &DVector<f64>) -> Option<Linearised> {
        let off = &self.centre - at;
        let start = Linearised {
            misfit: self.of_prior(at),
            gradient: off.component_mul(&self.prior),
            information: DMatrix::from_diagonal(&self.prior),
        };
        let parts: Vec<Option<Linearised>> = self.alike.par_iter().map(|alike| self.of_alike(alike, at)).collect();
        parts.into_iter().try_fold(start, |sum, part| {
            let part = part?;
            Some(Linearised {
                misfit: sum.misfit + part.misfit,
                gradient: sum.gradient + part.gradient,
                information: sum.information + part.information,
            })
        })
    }

    /// The simulation of some measurements at a point of the unit box; `None` where it fails.
    pub fn slopes(&self, alike: &Alike<'_>, at: &DVector<f64>) -> Option<Slopes> {
        let (d, parameters) = (at.len(), self.space.as_slice());
        let theta = DMatrix::from_fn(1, d, |_, k| parameters[k].from_unit(at[k]));
        let found = alike.simulator.slopes_near(&theta, 0..1, &alike.groups[0][0].1.frequencies_hz);
        let finite = found.frequencies_hz.iter().chain(&found.slopes).all(|value| value.is_finite());
        let slope = |mode: usize, k: usize| found.slopes[mode * d + k] * (parameters[k].upper - parameters[k].lower);
        finite.then(|| Slopes {
            slopes: DMatrix::from_fn(found.frequencies_hz.len(), d, slope),
            frequencies_hz: found.frequencies_hz.clone(),
        })
    }

    /// The measurements beside the simulation at a point of the unit box; `None` where the simulation fails.
    pub fn rows(&self, at: &DVector<f64>) -> Option<Vec<Rows>> {
        let mut rows = Vec::new();
        for alike in &self.alike {
            let simulated = self.slopes(alike, at)?;
            rows.extend(alike.groups.iter().map(|group| self.rows_of(alike, group, &simulated)));
        }
        Some(rows)
    }

    fn rows_of(&self, alike: &Alike<'_>, group: &[(usize, &Observation)], simulated: &Slopes) -> Rows {
        let first = group[0].1;
        let modes: Vec<usize> =
            (0..first.frequencies_hz.len()).filter(|mode| first.frequencies_hz[*mode].is_some()).collect();
        let slopes = simulated.slopes.select_rows(&modes);
        let residual = |row: usize, n: usize| {
            let measured_hz = group[n].1.frequencies_hz[modes[row]];
            measured_hz.map_or(0.0, |measured_hz| measured_hz - simulated.frequencies_hz[modes[row]])
        };
        let mut covariance = &slopes * &self.scatter * slopes.transpose();
        for (row, mode) in modes.iter().enumerate() {
            let std_hz = alike.simulator.std_hz(*mode, simulated.frequencies_hz[*mode]);
            covariance[(row, row)] += (std_hz * first.noise_multiple[*mode]).powi(2);
        }
        Rows {
            places: group.iter().map(|(place, _)| *place).collect(),
            residuals: DMatrix::from_fn(modes.len(), group.len(), residual),
            modes,
            covariance,
            slopes,
            simulated_hz: simulated.frequencies_hz.clone(),
        }
    }

    fn of_alike(&self, alike: &Alike<'_>, at: &DVector<f64>) -> Option<Linearised> {
        let (d, simulated) = (at.len(), self.slopes(alike, at)?);
        let mut sum = Linearised { misfit: 0.0, gradient: DVector::zeros(d), information: DMatrix::zeros(d, d) };
        for group in &alike.groups {
            let Rows { residuals, covariance, slopes, .. } = self.rows_of(alike, group, &simulated);
            let factored = covariance.cholesky()?;
            let weighted = factored.solve(&residuals);
            sum.misfit += residuals.dot(&weighted);
            sum.gradient.gemv_tr(1.0, &slopes, &weighted.column_sum(), 1.0);
            sum.information.gemm_tr(group.len() as f64, &slopes, &factored.solve(&slopes), 1.0);
        }
        Some(sum)
    }
}
