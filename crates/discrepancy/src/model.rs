//! The likelihood of measurements under a simulation with effects, and its posterior maximum.
//!
//! ```text
//!  ln y_j ~ t_ν( M(μ, c_j; ψ),  J_j diag(σ²) J_jᵀ + diag(s_i r_ij)² ),     J_j = ∂M/∂x at (μ, c_j)
//! ```
//!
//! y_j: frequencies of row j in Hz, `[m]`; M: logarithms of the simulated frequencies, `[m]`; μ and σ: mean and standard
//! deviation between rows of the parameters that are not set, `[d]`; ψ: numbers of the effects; c_j: covariates; r: stated
//! relative noise; s: one noise factor for each mode; ν: degrees of freedom of the t distribution, normal for ν → ∞. All
//! unknowns but ν have normal priors (σ and s in their logarithms). Fisher scoring maximises the log posterior; it neglects
//! the derivative of J in the step, not in the value.
//!
//! Mode shapes that were measured in a row are further components of ln y_j and M: a shape at P points, whose norm and sign mean
//! nothing, has P − 1 coordinates in the tangent space at the mean measured shape of its mode
//! ([`TangentSpace`](structures::physics::tangent::TangentSpace)). Their stated noise r is that of a component of a shape of unit norm,
//! and the shape of each mode has a noise factor of its own. A spread of the parameters moves frequencies and shapes together, as
//! J states. Simulated modes are paired with the mean measured modes by the modal assurance criterion and the frequency
//! ([`pair_modes`](structures::physics::shapes::pair_modes)) wherever the eigenproblem is solved, as in the fit of a measurement.
//!
//! Source: Lange, Little and Taylor (1989), JASA 84, for the t distribution; Kass and Raftery (1995), JASA 90, for Laplace's
//! approximation of the evidence.

use nalgebra::{DMatrix, DVector};

use super::effect::FittedEffect;
use super::fit::{Fit, Start};
use super::problem::{Point, Problem, ScoringStep};
use super::response::Responses;
use super::row::{best_tails, weight, Density, FIRST_TAILS};
use super::study::{part_of, Present, Study};
use structures::physics::effect::Target;

/// Greatest number of steps of a fit.
const MOST_STEPS: usize = 40;

/// From this number of rows on, a fit starts at the maximum for a subset of about [`FEW_ROWS`] rows: the many first steps are
/// cheap there, and few are needed with all rows.
const MANY_ROWS: usize = 1_200;
const FEW_ROWS: usize = 400;

/// A fit ends when the expected gain in log posterior of a step is below this, nats.
const ENOUGH_NATS: f64 = 5e-3;

/// Greatest numbers of rows and of first steps with the noise as it is stated, and the expected gain below which they end, nats.
const FIRST_ROWS: usize = 50;
const MOST_FIRST_STEPS: usize = 12;
const ENOUGH_FIRST_NATS: f64 = 1.0;

/// A fit whose log evidence lies below that of another by more than this is not continued, nats. With correlated rows, which count for
/// a tenth of independent ones, it is still 6 nats.
const HOPELESS_NATS: f64 = 60.0;

/// One row under a fit; shapes are `[present]`, the outputs measured in the row, unless said otherwise.
pub struct RowView {
    /// Index of the row.
    pub row: usize,
    /// Outputs measured: below m, ln f of a mode; from m on, coordinates of mode shapes. Ascending.
    pub present: Vec<usize>,
    /// Number of frequencies among them, which come first.
    pub frequencies: usize,
    /// Residual ln y − M, and for shapes the difference of their coordinates, rad.
    pub residual: DVector<f64>,
    /// Covariance V of the residual, `[present, present]`.
    pub covariance: DMatrix<f64>,
    /// Weight of the row relative to that under a normal distribution.
    pub weight: f64,
    /// ln p(row), nats.
    pub log_density: f64,
    /// Best estimate of each parameter in this row minus its mean, `[d]`, in the parameter's unit.
    pub deviation: Vec<f64>,
    /// ∂M/∂x, `[present, d]`.
    pub by_parameter: DMatrix<f64>,
}

/// A point above `here` along a step; `None` if there is none.
fn higher(problem: &Problem<'_>, here: &Point, step: &ScoringStep, tails: f64) -> Option<Point> {
    let along = |shortened: i32| {
        let mut trial = &here.eta + &step.by * 0.4_f64.powi(shortened);
        problem.bound(&mut trial);
        problem.point(&trial, tails).filter(|point| point.log_posterior > here.log_posterior)
    };
    (0..8).find_map(along)
}

/// The unknowns at the maximum near others, without outliers; `None` if the frequencies cannot be computed.
fn nearest(problem: &Problem<'_>, mut eta: DVector<f64>) -> Option<DVector<f64>> {
    problem.bound(&mut eta);
    let mut here = problem.point(&eta, f64::INFINITY)?;
    for _ in 0..MOST_FIRST_STEPS {
        let Some(step) = problem.step(&here).filter(|step| step.promised_nats > ENOUGH_FIRST_NATS) else { break };
        let Some(point) = higher(problem, &here, &step, f64::INFINITY) else { break };
        here = point;
    }
    Some(here.eta)
}

impl Study<'_> {
    /// The posterior maximum for the rows with the indices `rows` and with `effects`, by Fisher scoring from `start` if it is
    /// given.
    ///
    /// `None` if the frequencies cannot be computed at the start, or if the information at the maximum is singular.
    pub fn fit(&self, rows: &[usize], effects: &[FittedEffect], start: Option<&Start<'_>>) -> Option<Fit> {
        self.fit_above(f64::NEG_INFINITY, rows, effects, start)
    }

    /// As [`Self::fit`]; `None` also if the log evidence cannot come near `floor`, nats. Such a fit ends early, when its log
    /// posterior and ten times the gain that the next step promises lie below `floor` by [`HOPELESS_NATS`]: the log evidence is at
    /// most the log posterior at the maximum, because the information of the data adds to that of the priors.
    pub(super) fn fit_above(
        &self,
        floor: f64,
        rows: &[usize],
        effects: &[FittedEffect],
        start: Option<&Start<'_>>,
    ) -> Option<Fit> {
        let problem = Problem::new(self, rows, effects);
        let (mut here, mut tails) = self.first_point(&problem, start)?;
        if start.is_some_and(|start| start.noise_as_stated) {
            let part = part_of(rows, FIRST_ROWS);
            let mut first = Problem::new(self, &part, effects);
            first.noise_is_stated = true;
            here = problem.point(&nearest(&first, here.eta)?, tails)?;
        }
        let of_mixtures: f64 = effects.iter().filter_map(|e| e.mixture.as_ref()).map(|m| m.most_nats()).sum();
        let hopeless = floor - HOPELESS_NATS - of_mixtures;
        for number in 0..MOST_STEPS {
            let Some(step) = problem.step(&here) else { break };
            if number > 0 && here.log_posterior + 10.0 * step.promised_nats < hopeless {
                return None;
            }
            let higher = higher(&problem, &here, &step, tails);
            let moved = higher.is_some();
            here = higher.unwrap_or(here);
            let better = best_tails(&here.distances);
            #[allow(clippy::float_cmp, reason = "both values are taken from the same list")]
            let other_tails = better != tails;
            if other_tails {
                tails = better;
                here = problem.point(&here.eta.clone(), tails)?;
            } else if !moved || step.promised_nats < ENOUGH_NATS {
                break;
            }
        }
        problem.fit_at(&here, tails)
    }

    /// First point of a fit and its tails: the maximum for a subset if the rows are many, otherwise `start`.
    fn first_point(&self, problem: &Problem<'_>, start: Option<&Start<'_>>) -> Option<(Point, f64)> {
        let rows = problem.rows;
        if rows.len() >= MANY_ROWS {
            let part: Vec<usize> = rows.iter().step_by(rows.len() / FEW_ROWS).copied().collect();
            if let Some(fit) = self.fit(&part, problem.effects, start) {
                let mut eta = problem.origin();
                problem.set_out(&mut eta, &Start::at(&fit));
                if let Some(point) = problem.point(&eta, fit.tails) {
                    return Some((point, fit.tails));
                }
            }
        }
        let mut eta = problem.origin();
        let Some(start) = start else { return Some((problem.point(&eta, FIRST_TAILS)?, FIRST_TAILS)) };
        problem.set_out(&mut eta, start);
        let tails = start.fit.tails;
        // The first guess of a new effect may leave no stiffness in some row; it is then shrunk towards zero. Without an effect that the
        // start had, its parameters may leave none either: the fit then starts at the priors.
        let shares = [1.0, 0.5, 0.2, 0.05, 0.0].into_iter();
        let mut near = { shares }.map(|share| problem.towards_prior(&eta, start, share)).chain([problem.origin()]);
        Some((near.find_map(|eta| problem.point(&eta, tails))?, tails))
    }

    /// The parameters of each row after the corrections of its settings under a fit, `[rows][d]`; empty if nothing was set.
    pub fn corrected_settings(&self, rows: &[usize], fit: &Fit) -> Vec<Vec<f64>> {
        let problem = Problem::new(self, rows, &fit.effects);
        problem.corrected_settings(&fit.mean, &problem.sizes(&fit.psi).values)
    }

    /// Residual, covariance and density of each of the rows with the indices `rows` under a fit, `[rows]`; `None` if the
    /// frequencies cannot be computed there.
    pub fn view(&self, rows: &[usize], fit: &Fit) -> Option<Vec<RowView>> {
        let problem = Problem::new(self, rows, &fit.effects);
        let responses = problem.responses(&fit.mean, &problem.sizes(&fit.psi).values, &[])?;
        let density = Density::new(fit.tails, responses.outputs());
        let view = |(place, row): (usize, &usize)| self.row_view(*row, fit, &density, &responses, place);
        Some(rows.iter().enumerate().map(view).collect())
    }

    /// Derivatives of the outputs by the sizes of further `targets`, at size 0 and with the effects of the fit in place:
    /// `[outputs, sizes]` for each of `rows`.
    pub fn directions(&self, rows: &[usize], fit: &Fit, targets: &[Target]) -> Option<Vec<DMatrix<f64>>> {
        let problem = Problem::new(self, rows, &fit.effects);
        let further: usize = targets.iter().map(Target::sizes).sum();
        let sizes = problem.sizes(&fit.psi).values;
        let first = sizes.nrows();
        let sizes = sizes.resize_vertically(first + further, 0.0);
        let responses = problem.responses(&fit.mean, &sizes, targets)?;
        let slopes = |place: usize| {
            DMatrix::from_fn(responses.outputs(), further, |output, column| {
                responses.by_size(place, output)[first + column]
            })
        };
        Some((0..rows.len()).map(slopes).collect())
    }

    /// Derivatives of M by the free means and all ψ, `[outputs, free + ψ]` for each of `rows`, per unit of each number.
    pub fn nuisance(&self, rows: &[usize], fit: &Fit) -> Option<Vec<DMatrix<f64>>> {
        let problem = Problem::new(self, rows, &fit.effects);
        let sizes = problem.sizes(&fit.psi);
        let responses = problem.responses(&fit.mean, &sizes.values, &[])?;
        let free = self.free.len();
        let columns = free + fit.psi.iter().map(Vec::len).sum::<usize>();
        let by = |(place, row): (usize, &usize)| {
            let mut by = DMatrix::zeros(responses.outputs(), columns);
            for output in 0..responses.outputs() {
                for (column, k) in self.free.iter().enumerate() {
                    if self.data.settings[*row][*k].is_none() {
                        by[(output, column)] = responses.by_parameter(place, output)[*k];
                    }
                }
                let by_size = responses.by_size(place, output);
                for (number, (moved, slope)) in sizes.moved.iter().zip(sizes.slopes.column(place).iter()).enumerate() {
                    by[(output, free + number)] = by_size[*moved] * slope;
                }
            }
            by
        };
        Some(rows.iter().enumerate().map(by).collect())
    }

    /// Inverse prior variance of each free mean and all ψ, `[free + ψ]`.
    pub fn prior_information(&self, fit: &Fit) -> Vec<f64> {
        let mean = |k: &usize| self.simulator.space().as_slice()[*k].as_normal().1.powi(-2);
        let numbers = fit.effects.iter().flat_map(|e| &e.numbers);
        let numbers = numbers.zip(fit.psi.iter().flatten()).map(|(n, psi)| n.by_score(*psi).powi(-2));
        self.free.iter().map(mean).chain(numbers).collect()
    }

    /// [`Self::view`] of one row, which has the index `place` in `responses`.
    fn row_view(&self, row: usize, fit: &Fit, density: &Density, responses: &Responses, place: usize) -> RowView {
        let Present { outputs: present, groups, .. } = &self.present[row];
        let noise_factor = |group: usize| {
            let modes = fit.noise_factor.len();
            if group < modes {
                fit.noise_factor[group]
            } else {
                fit.shape_noise_factor[group - modes]
            }
        };
        let d = fit.mean.len();
        let spread = |k: usize| if self.data.settings[row][k].is_some() { 0.0 } else { fit.spread[k] };
        let residual = DVector::from_iterator(
            present.len(),
            present.iter().map(|output| self.observed(row, *output) - responses.value(place, *output)),
        );
        let by_parameter = DMatrix::from_fn(present.len(), d, |i, k| responses.by_parameter(place, present[i])[k]);
        let mut covariance = DMatrix::zeros(present.len(), present.len());
        for i in 0..present.len() {
            for j in 0..=i {
                let sum: f64 = (0..d).map(|k| by_parameter[(i, k)] * by_parameter[(j, k)] * spread(k).powi(2)).sum();
                covariance[(i, j)] = sum;
                covariance[(j, i)] = sum;
            }
            covariance[(i, i)] += (noise_factor(groups[i]) * self.noise(row, present[i])).powi(2);
        }
        let factor = covariance.clone().cholesky().expect("the noise of a row is never 0");
        let solved = factor.solve(&residual);
        let distance = residual.dot(&solved);
        let half_log_det: f64 = factor.l_dirty().diagonal().iter().map(|l| l.ln()).sum();
        let deviation = (0..d).map(|k| spread(k).powi(2) * by_parameter.column(k).dot(&solved)).collect();
        RowView {
            row,
            log_density: density.log(distance, present.len(), half_log_det),
            weight: weight(distance, present.len(), fit.tails),
            frequencies: present.iter().filter(|output| **output < responses.modes()).count(),
            present: present.clone(),
            residual,
            covariance,
            deviation,
            by_parameter,
        }
    }
}
