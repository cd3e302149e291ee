//! The residuals of a fit by mode, and the precision of each row, in the form that a learned discrepancy needs.

use nalgebra::{DMatrix, DVector};

use crate::fit::Fit;
use crate::study::Study;

/// Values of m modes at n rows, `[m]` vectors of `[n]`; 0 where a mode is missing.
pub type ByMode = Vec<DVector<f64>>;

/// Residuals r of n rows, with V⁻¹ of each row times its weight.
pub struct Rows {
    /// Number of modes m.
    pub modes: usize,
    /// Standardised inputs of each row, `[n]`; `None` where they are not known.
    pub u: Vec<Option<Vec<f64>>>,
    /// Residual ln y − M.
    pub residual: ByMode,
    /// Derivatives of M by each free parameter, per unit of the parameter, `[free]`; 0 where the parameter is set.
    pub slopes: Vec<ByMode>,
    /// V/w of each row, `[present, present]`.
    covariances: Vec<DMatrix<f64>>,
    /// Modes present in each row.
    present: Vec<Vec<usize>>,
}

/// V⁻¹ of all rows, as one vector over the rows for each pair of modes: `[m][m]` vectors of `[n]`, 0 where a mode is missing.
pub struct Precision(Vec<ByMode>);

impl Rows {
    /// The rows with the indices `rows` under a fit; `u`: inputs of all rows of the data; `weights`: weight of each row relative to
    /// that under a normal distribution, `[n]`. `None` if the frequencies cannot be computed in some row.
    pub fn new(study: &Study<'_>, rows: &[usize], fit: &Fit, u: &[Option<Vec<f64>>], weights: &[f64]) -> Option<Self> {
        let views = study.view(rows, fit)?;
        let modes = study.simulator.modes();
        let empty = || vec![DVector::zeros(rows.len()); modes];
        let mut found = Self {
            modes,
            u: rows.iter().map(|row| u[*row].clone()).collect(),
            residual: empty(),
            slopes: vec![empty(); study.free().len()],
            covariances: Vec::with_capacity(rows.len()),
            present: Vec::with_capacity(rows.len()),
        };
        for (place, view) in views.into_iter().enumerate() {
            // Shapes have no discrepancy: only the frequencies are learned from.
            let frequencies = view.frequencies;
            for (i, mode) in view.present[..frequencies].iter().enumerate() {
                found.residual[*mode][place] = view.residual[i];
                for (slopes, k) in found.slopes.iter_mut().zip(study.free()) {
                    if study.data.settings[view.row][*k].is_none() {
                        slopes[*mode][place] = view.by_parameter[(i, *k)];
                    }
                }
            }
            let covariance = view.covariance.view((0, 0), (frequencies, frequencies)).into_owned();
            found.covariances.push(covariance / weights[place]);
            found.present.push(view.present[..frequencies].to_vec());
        }
        Some(found)
    }

    /// Number of rows n.
    pub fn len(&self) -> usize {
        self.u.len()
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.u.is_empty()
    }

    /// Places of the rows in which a mode is present and the inputs are known, and the variance of its residual there.
    pub fn of_mode(&self, mode: usize) -> (Vec<usize>, DVector<f64>) {
        let own = |place: &usize| self.present[*place].iter().position(|m| *m == mode);
        let places: Vec<usize> = (0..self.len()).filter(|p| self.u[*p].is_some() && own(p).is_some()).collect();
        let variance = |place: &usize| own(place).map_or(0.0, |i| self.covariances[*place][(i, i)]);
        let variances = DVector::from_iterator(places.len(), places.iter().map(variance));
        (places, variances)
    }

    /// (V + diag(extra))⁻¹ of each row; `extra`: a further variance of each mode. `None` if a covariance is singular.
    pub fn precision(&self, extra: &[DVector<f64>]) -> Option<Precision> {
        let mut found = vec![vec![DVector::zeros(self.len()); self.modes]; self.modes];
        for (place, (covariance, present)) in self.covariances.iter().zip(&self.present).enumerate() {
            let mut whole = covariance.clone();
            for (i, mode) in present.iter().enumerate() {
                whole[(i, i)] += extra[*mode][place];
            }
            let inverse = whole.cholesky()?.inverse();
            for (i, a) in present.iter().enumerate() {
                for (k, b) in present.iter().enumerate() {
                    found[*a][*b][place] = inverse[(i, k)];
                }
            }
        }
        Some(Precision(found))
    }
}

impl Precision {
    /// Entry of two modes at all rows, `[n]`.
    pub fn of(&self, a: usize, b: usize) -> &DVector<f64> {
        &self.0[a][b]
    }

    /// V⁻¹x at all rows.
    pub fn times(&self, x: &ByMode) -> ByMode {
        let one = |entries: &ByMode| {
            let mut sum = DVector::zeros(x[0].len());
            for (entry, x) in entries.iter().zip(x) {
                sum += entry.component_mul(x);
            }
            sum
        };
        self.0.iter().map(one).collect()
    }
}

/// Σ_i a_i b_i at each row, `[n]`.
pub fn along(a: &ByMode, b: &ByMode) -> DVector<f64> {
    let mut sum = DVector::zeros(a[0].len());
    for (a, b) in a.iter().zip(b) {
        sum += a.component_mul(b);
    }
    sum
}
