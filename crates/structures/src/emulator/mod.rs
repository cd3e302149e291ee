//! A polynomial chaos emulator: approximates a table of finite-element runs by a smooth function with derivatives and an
//! estimate of its error.
//!
//! Each ln f_i is expanded in products of orthonormal Legendre polynomials of the parameters, scaled to [−1, 1] by the runs:
//!
//! ```text
//!  ln f_i(θ) ≈ Σ_α c_iα Π_j √(2α_j + 1) P_(α_j)(x_j),    x_j = (2θ_j − lower_j − upper_j)/(upper_j − lower_j)
//! ```
//!
//! The terms α are either all up to a degree or a selection, whichever has the smaller error at runs left out.
//!
//! Neighbouring modes that veer or cross have sharp bends or kinks, which polynomials approximate poorly. For such a pair the
//! mean of the two ln f and the square of their difference are expanded instead, if that has a smaller error.
//!
//! Source: Blatman & Sudret (2011), doi:10.1016/j.jcp.2010.12.021; Le Gratiet, Marelli & Sudret (2017),
//! doi:10.1007/978-3-319-12385-1_38.

mod basis;
mod crossing;
mod expansion;
mod hull;
mod pair;
mod path;
mod regression;
mod runs;
mod search;
mod select;

use nalgebra::DMatrix;
use rayon::prelude::*;

use crate::stats;
use basis::Candidates;
use expansion::Expansion;
use hull::Hull;
use pair::{Pair, PairFit};
use search::Search;
use select::Fit;

pub use crossing::Crossing;
pub use runs::{FitError, Runs};

/// Natural frequencies as a smooth function of the parameters.
#[derive(Debug, Clone)]
pub struct Emulator {
    /// Parameter values at x = −1 and x = 1, `[d]`.
    lower: Vec<f64>,
    upper: Vec<f64>,
    /// ln f of each mode; for a pair of modes the mean and the squared gap instead.
    expansion: Expansion,
    pairs: Vec<Pair>,
    hull: Hull,
    /// ln f of each run minus its prediction without the run, `[m][n]`.
    held_out: Vec<Vec<f64>>,
    /// Estimated root mean square error of ln f, `[m]`.
    relative_error: Vec<f64>,
    r_squared: Vec<f64>,
    crossings: Vec<Crossing>,
}

impl Emulator {
    /// Fits an emulator to runs. The same runs give the same emulator on any number of threads.
    ///
    /// # Errors
    /// [`FitError`] for a table that is too short or has invalid values.
    pub fn fit(runs: &Runs) -> Result<Self, FitError> {
        runs.check()?;
        let lower: Vec<f64> = runs.parameters.column_iter().map(|column| column.min()).collect();
        let upper: Vec<f64> = runs.parameters.column_iter().map(|column| column.max()).collect();
        let (n, d) = runs.parameters.shape();
        let x = DMatrix::from_fn(n, d, |run, j| scaled(runs.parameters[(run, j)], lower[j], upper[j]));
        let ln_frequencies: Vec<Vec<f64>> =
            runs.frequencies_hz.column_iter().map(|column| column.iter().map(|f| f.ln()).collect()).collect();
        let candidates = Candidates::new(d, n);
        let search = Search::new(&candidates, &x);
        let gaps = crossing::near(&ln_frequencies);
        let mut fits: Vec<Fit> = ln_frequencies.par_iter().map(|y| search.fit(y)).collect();
        let pairs = pair::fit_pairs(&search, &gaps, &ln_frequencies);
        let crossings = crossing::crossings(&candidates, &x, &gaps, pairs.iter().map(|pair| &pair.squared_gap));
        let pairs = pair::choose(pairs, &fits);
        let mut errors: Vec<f64> = fits.iter().map(|fit| fit.error).collect();
        let mut held_out: Vec<Vec<f64>> = fits.iter().map(|fit| fit.held_out.clone()).collect();
        let mut kept = Vec::new();
        for PairFit { pair, mean, squared_gap, held_out: [lower, upper], errors: pair_errors } in pairs {
            let modes = pair.lower..pair.lower + 2;
            errors[modes.clone()].copy_from_slice(&pair_errors);
            held_out.splice(modes.clone(), [lower, upper]);
            fits.splice(modes, [mean, squared_gap]);
            kept.push(pair);
        }
        Ok(Self {
            expansion: Expansion::new(&candidates, d, fits.iter()),
            pairs: kept,
            hull: Hull::new(&x),
            crossings,
            relative_error: errors.iter().map(|error| error.sqrt()).collect(),
            r_squared: errors.iter().zip(&ln_frequencies).map(|(error, y)| r_squared(y, *error)).collect(),
            held_out,
            lower,
            upper,
        })
    }

    /// ln f of each mode (f in Hz), `[m]`, at parameters `theta` (`[d]`, parameter units).
    pub fn ln_frequencies(&self, theta: &[f64]) -> Vec<f64> {
        let mut values = self.expansion.values(|j| scaled(theta[j], self.lower[j], self.upper[j]));
        for pair in &self.pairs {
            pair.separate(&mut values);
        }
        values
    }

    /// Natural frequencies, Hz, `[m]`, at parameters `theta` (`[d]`, parameter units).
    ///
    /// Where modes that were not emulated as a pair come closer than their errors, they may not be in ascending order.
    pub fn frequencies_hz(&self, theta: &[f64]) -> Vec<f64> {
        let mut frequencies = self.ln_frequencies(theta);
        for f in &mut frequencies {
            *f = f.exp();
        }
        frequencies
    }

    /// Natural frequencies, Hz, `[m]`, and their derivatives, Hz per parameter unit, `[m, d]`, at parameters `theta` (`[d]`).
    ///
    /// ```text
    ///  ∂f_i/∂θ_j = f_i · ∂ln f_i/∂x_j · 2/(upper_j − lower_j)
    /// ```
    pub fn frequencies_and_jacobian(&self, theta: &[f64]) -> (Vec<f64>, DMatrix<f64>) {
        let (mut frequencies, mut jacobian) =
            self.expansion.values_and_gradients(|j| scaled(theta[j], self.lower[j], self.upper[j]));
        for pair in &self.pairs {
            pair.separate_gradients(&frequencies, &mut jacobian);
            pair.separate(&mut frequencies);
        }
        for f in &mut frequencies {
            *f = f.exp();
        }
        for (j, mut column) in jacobian.column_iter_mut().enumerate() {
            let rate = 2.0 / (self.upper[j] - self.lower[j]);
            column.iter_mut().zip(&frequencies).for_each(|(slope, f)| *slope *= f * rate);
        }
        (frequencies, jacobian)
    }

    /// Smallest and largest value of each parameter in the runs, `[d]`.
    pub fn ranges(&self) -> impl Iterator<Item = [f64; 2]> + '_ {
        self.lower.iter().zip(&self.upper).map(|(lower, upper)| [*lower, *upper])
    }

    /// Number of modes, m.
    pub fn modes(&self) -> usize {
        self.relative_error.len()
    }

    /// Number of parameters, d.
    pub fn parameters(&self) -> usize {
        self.lower.len()
    }

    /// Number of terms of the expansion of a mode (counted from 0).
    pub fn terms(&self, mode: usize) -> usize {
        let pair = self.pairs.iter().find(|pair| pair.lower == mode || pair.lower + 1 == mode);
        pair.map_or(self.expansion.terms(mode), |p| self.expansion.terms(p.lower) + self.expansion.terms(p.lower + 1))
    }

    /// Expected root mean square error of ln f of a mode (counted from 0) at a new point, which is the relative error of its
    /// frequency.
    ///
    /// This is the corrected leave-one-out error of an expansion with all terms up to a degree, and the cross-validation error of
    /// one with selected terms. It is valid for points that have the same distribution as the runs and are not outside. Noise in
    /// the table is included.
    pub fn relative_error(&self, mode: usize) -> f64 {
        self.relative_error[mode]
    }

    /// ln f of each run minus its prediction without the run, `[m][n]`.
    ///
    /// For an expansion with all terms up to a degree, the prediction is fitted to all other runs, which gives e_i/(1 − h_i). For
    /// selected terms it is fitted without the whole fold of the run, which is a tenth or a fifth of all runs.
    pub fn held_out_residuals(&self) -> &[Vec<f64>] {
        &self.held_out
    }

    /// Share of the variance of ln f over the runs that the expansion of a mode (counted from 0) explains in cross-validation.
    ///
    /// ```text
    ///  R² = 1 − ε / var(ln f)
    /// ```
    ///
    /// ε is the squared [`Self::relative_error`]. For a frequency that is the same in all runs, R² is 1.
    pub fn r_squared(&self, mode: usize) -> f64 {
        self.r_squared[mode]
    }

    /// Whether the emulator extrapolates at parameters `theta` (`[d]`): outside the range of the runs in any parameter, or in a
    /// corner of that range without runs, which the leverage shows. No run itself is outside.
    pub fn is_outside(&self, theta: &[f64]) -> bool {
        let x: Vec<f64> = theta
            .iter()
            .zip(self.lower.iter().zip(&self.upper))
            .map(|(theta, (l, u))| scaled(*theta, *l, *u))
            .collect();
        self.hull.is_outside(&x)
    }

    /// Neighbouring modes that probably cross or veer sharply between the runs: at most one entry for each pair of neighbouring
    /// modes, by ascending mode.
    pub fn crossings(&self) -> &[Crossing] {
        &self.crossings
    }
}

/// A parameter scaled to [−1, 1]. The form of the formula keeps the digits of a narrow range far from 0.
fn scaled(theta: f64, lower: f64, upper: f64) -> f64 {
    ((theta - lower) - (upper - theta)) / (upper - lower)
}

/// Coefficient of determination of a prediction of `y`, `[n]`, with the mean square error `error`: 1 − error/var(y).
fn r_squared(y: &[f64], error: f64) -> f64 {
    let centre = stats::mean(y);
    let variance = y.iter().map(|y| (y - centre).powi(2)).sum::<f64>() / y.len() as f64;
    // A variance of the size of rounding errors is treated as zero.
    if variance.sqrt() <= f64::EPSILON * centre.abs() {
        return 1.0;
    }
    1.0 - error / variance
}
