//! Kalman filter of a process.
//!
//! A covariate that a batch lacks is integrated over what the reference has seen of it, as a slow part that lasts from batch to batch and a
//! part of its own in each batch:
//!
//! ```text
//!  c_j = u_j + w,    u_j: a further state with variance 1 that lasts a month,    w ~ N(0, 1)
//! ```
//!
//! Both have the whole variance over the reference, because how it divides depends on the rhythm of the batches: the prediction is rather too
//! wide. Where the covariate is measured, its state is 0.

use nalgebra::{DMatrix, DVector};

use super::coverage::Coverage;
use super::estimate::{Observation, Scale};
use super::model::{Numbers, Process};

/// Time after which the slow part of a covariate that is not measured is forgotten, s.
const MISSING_LASTS_S: f64 = 30.0 * 86_400.0;

/// What is known about the states after some observations: normal with this mean and covariance.
#[derive(Debug, Clone, PartialEq)]
pub struct Known {
    /// `[q + d]`
    pub mean: DVector<f64>,
    /// `[q + d, q + d]`
    pub covariance: DMatrix<f64>,
}

/// What an observation adds to the prediction from those before it.
#[derive(Debug, Clone)]
pub struct Innovation {
    /// Indices of the quantities that are informed, `[o]`.
    pub informed: Vec<usize>,
    /// Difference ν of observation and prediction, `[o]`.
    pub difference: DVector<f64>,
    /// Inverse of its covariance S, `[o, o]`.
    pub precision: DMatrix<f64>,
    /// ln det S.
    pub log_det: f64,
    /// Gain K, `[q + d, o]`.
    pub gain: DMatrix<f64>,
    /// Factor by which each state decayed since the observation before, `[q + d]`.
    pub decay: DVector<f64>,
    /// Time since the observation before, in steps of the process.
    pub steps: f64,
    /// The prediction of all quantities in standardised units, `[d]`.
    pub predicted: DVector<f64>,
}

/// The filter of a process.
pub struct Filter {
    numbers: Numbers,
    contributions: DMatrix<f64>,
    /// The part of the state of a covariate that is left after a step in which it is not measured, if covariates have states.
    missing_persists: Option<f64>,
    /// What the reference leaves unknown; `None` if the numbers are taken as known exactly.
    unknown: Option<Unknown>,
}

/// What a reference leaves unknown.
struct Unknown {
    /// Covariances of the columns of Λ.
    loading_covariances: Vec<DMatrix<f64>>,
    /// The conditions that were seen, beyond which relations may bend.
    coverage: Option<Coverage>,
    /// Scales of the covariates.
    covariate_scales: Vec<Scale>,
}

impl Known {
    /// Mean, then covariance by columns.
    pub fn to_numbers(&self) -> Vec<f64> {
        self.mean.iter().chain(self.covariance.iter()).copied().collect()
    }

    /// The inverse of [`Self::to_numbers`]; `None` if the number of values does not fit.
    pub fn from_numbers(numbers: &[f64]) -> Option<Self> {
        let n = (1..=numbers.len()).find(|n| n + n * n >= numbers.len()).filter(|n| n + n * n == numbers.len())?;
        let (mean, covariance) = numbers.split_at(n);
        Some(Self { mean: DVector::from_column_slice(mean), covariance: DMatrix::from_column_slice(n, n, covariance) })
    }
}

impl Filter {
    /// The filter with numbers that are taken as known exactly, as in the likelihood.
    pub fn exact(numbers: Numbers) -> Self {
        let contributions = numbers.contributions();
        Self { numbers, contributions, missing_persists: None, unknown: None }
    }

    /// The filter of a fitted process. What its reference leaves unknown about the common factors widens the predictions, and so do
    /// conditions that it has not seen or that are not measured. The states of the covariates follow those of [`Process::in_operation`].
    pub fn of(process: &Process) -> Self {
        let unknown = Unknown {
            loading_covariances: process.loading_covariances(),
            coverage: process.coverage.clone(),
            covariate_scales: process.covariate_scales.clone(),
        };
        let mut filter = Self::exact(process.in_operation());
        let (d, n) = filter.contributions.shape();
        let m = filter.numbers.slopes.ncols();
        filter.contributions = filter.contributions.resize_horizontally(n + m, 0.0);
        filter.contributions.view_mut((0, n), (d, m)).copy_from(&filter.numbers.slopes);
        Self { unknown: Some(unknown), missing_persists: Some((-process.step_s / MISSING_LASTS_S).exp()), ..filter }
    }

    /// The numbers of the process.
    pub fn numbers(&self) -> &Numbers {
        &self.numbers
    }

    /// H, `[d, q + d]`.
    pub fn contributions(&self) -> &DMatrix<f64> {
        &self.contributions
    }

    /// Before any observation: the stationary distribution.
    pub fn start(&self) -> Known {
        let n = self.numbers.variance.len();
        self.with_covariates(Known {
            mean: DVector::zeros(n),
            covariance: DMatrix::from_diagonal(&self.numbers.variance),
        })
    }

    /// What is known about the states, with those of measured covariates behind them where they are absent: earlier versions of the program
    /// had none.
    pub fn with_covariates(&self, known: Known) -> Known {
        let n = self.contributions.ncols();
        Known { mean: known.mean.resize_vertically(n, 0.0), covariance: known.covariance.resize(n, n, 0.0) }
    }

    /// What is known about the states at the time of an observation, and the factors by which they decayed.
    pub fn predict(&self, known: &Known, observation: &Observation) -> (Known, DVector<f64>) {
        let (n, all) = (self.numbers.variance.len(), self.contributions.ncols());
        let is_missing = |i: usize| observation.missing.contains(&(i - n));
        let decay = DVector::from_fn(all, |i, _| match self.missing_persists {
            Some(persists) if i >= n && is_missing(i) && known.covariance[(i, i)] > 0.0 => {
                persists.powf(observation.steps)
            }
            _ if i >= n => 0.0,
            _ => self.numbers.persistence[i].powf(observation.steps),
        });
        let variance = |i: usize| if i < n { self.numbers.variance[i] } else { f64::from(u8::from(is_missing(i))) };
        let mut covariance = known.covariance.clone();
        for ((i, j), element) in indices(all).zip(covariance.iter_mut()) {
            *element *= decay[i] * decay[j];
            if i == j {
                *element += variance(i) * (1.0 - decay[i] * decay[i]);
            }
        }
        (Known { mean: known.mean.component_mul(&decay), covariance }, decay)
    }

    /// Takes an observation into account. `predicted`: what is known before it, at its time; `decay` as [`Self::predict`] gives it.
    /// `None` if the covariance of the innovation is not positive definite.
    ///
    /// ```text
    ///  ν = x̂ − μ − B c − H a,    S = H P Hᵀ + κ V + Σ_j h_j² C_j + W + Σ_j B_j B_jᵀ,    K = P Hᵀ S⁻¹
    ///  a ← a + K ν,    P ← P − K H P
    /// ```
    ///
    /// a, P: mean and covariance of the states; C_j: covariance of column j of Λ, with the h_j that the observation itself shows; W:
    /// diagonal, see [`Coverage`], 0 within the conditions that were seen; B_j: column of a covariate that is not measured.
    pub fn update(
        &self,
        (predicted, decay): (&Known, DVector<f64>),
        observation: &Observation,
    ) -> Option<(Known, Innovation)> {
        let numbers = &self.numbers;
        let all = &numbers.mean + &numbers.slopes * &observation.covariates + &self.contributions * &predicted.mean;
        let informed = &observation.informed;
        let h = self.contributions.select_rows(informed);
        let difference = &observation.mean - all.select_rows(informed);
        let cross = &predicted.covariance * h.transpose();
        let mut errors = &h * &cross + numbers.noise * &observation.covariance;
        for j in observation.missing.iter().filter(|_| self.missing_persists.is_some()) {
            let slopes = numbers.slopes.column(*j).select_rows(informed);
            errors.ger(1.0, &slopes, &slopes, 1.0);
        }
        let mut factored = errors.clone().cholesky()?;
        if let Some(unknown) = self.unknown.as_ref().filter(|_| !informed.is_empty()) {
            let seen = &predicted.mean + &cross * factored.solve(&difference);
            let wider = unknown.covariance(&numbers.slopes, &seen, &observation.covariates);
            factored = (errors + wider.select_rows(informed).select_columns(informed)).cholesky()?;
        }
        let gain = factored.solve(&cross.transpose()).transpose();
        let mean = &predicted.mean + &gain * &difference;
        let mut covariance = &predicted.covariance - &gain * cross.transpose();
        // Rounding makes the difference slightly asymmetric.
        covariance = (&covariance + covariance.transpose()) * 0.5;
        let log_det = 2.0 * factored.l_dirty().diagonal().iter().map(|l| l.ln()).sum::<f64>();
        let innovation = Innovation {
            informed: informed.clone(),
            difference,
            precision: factored.inverse(),
            log_det,
            gain,
            decay,
            steps: observation.steps,
            predicted: all,
        };
        Some((Known { mean, covariance }, innovation))
    }

    /// Predicts to the time of an observation and takes it into account.
    pub fn step(&self, known: &Known, observation: &Observation) -> Option<(Known, Innovation)> {
        let (predicted, decay) = self.predict(known, observation);
        self.update((&predicted, decay), observation)
    }
}

impl Unknown {
    /// Covariance of the prediction of all quantities that it adds, `[d, d]`, at the states `seen` and with standardised covariates. `slopes`: B.
    fn covariance(&self, slopes: &DMatrix<f64>, seen: &DVector<f64>, covariates: &DVector<f64>) -> DMatrix<f64> {
        let d = slopes.nrows();
        let mut sum = DMatrix::zeros(d, d);
        for (factor, covariance) in self.loading_covariances.iter().enumerate() {
            sum += seen[factor].powi(2) * covariance;
        }
        if let Some(coverage) = &self.coverage {
            let wider = coverage.widening(slopes, &self.covariate_scales, covariates);
            sum += DMatrix::from_diagonal(&wider);
        }
        sum
    }
}

/// Rows and columns of the elements of a square matrix in the order of its memory.
fn indices(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..n).flat_map(move |j| (0..n).map(move |i| (i, j)))
}
