//! Square matrices of few rows without allocation: thousands are computed for each batch.

/// Most rows of a matrix, and with it most parameters whose covariance is estimated.
pub(super) const MOST: usize = 8;

/// A vector of up to [`MOST`] numbers; the others are 0.
pub(super) type SmallVector = [f64; MOST];

/// A square matrix of `size` rows; the other entries are 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SmallMatrix {
    pub size: usize,
    pub rows: [[f64; MOST]; MOST],
}

impl SmallMatrix {
    pub fn from_fn(size: usize, entry: impl Fn(usize, usize) -> f64) -> Self {
        let mut rows = [[0.0; MOST]; MOST];
        for (i, row) in rows.iter_mut().enumerate().take(size) {
            row.iter_mut().enumerate().take(size).for_each(|(j, own)| *own = entry(i, j));
        }
        Self { size, rows }
    }

    /// A B.
    pub fn times(&self, other: &Self) -> Self {
        let mut product = Self { size: self.size, rows: [[0.0; MOST]; MOST] };
        for (own, row) in product.rows.iter_mut().zip(&self.rows).take(self.size) {
            for (factor, other) in row.iter().zip(&other.rows).take(self.size) {
                own.iter_mut().zip(other).for_each(|(own, other)| *own += factor * other);
            }
        }
        product
    }

    /// Aᵀ.
    pub fn transposed(&self) -> Self {
        Self::from_fn(self.size, |i, j| self.rows[j][i])
    }

    /// A Aᵀ.
    pub fn squared(&self) -> Self {
        self.times(&self.transposed())
    }

    /// A x.
    pub fn apply(&self, x: &SmallVector) -> SmallVector {
        std::array::from_fn(|i| self.rows[i].iter().zip(x).map(|(a, x)| a * x).sum())
    }

    /// The lower triangular L with A = L Lᵀ; `None` where A is not positive definite.
    pub fn cholesky(&self) -> Option<Self> {
        let mut factor = Self { size: self.size, rows: [[0.0; MOST]; MOST] };
        for i in 0..self.size {
            for j in 0..=i {
                let dot: f64 = (0..j).map(|k| factor.rows[i][k] * factor.rows[j][k]).sum();
                let rest = self.rows[i][j] - dot;
                if i == j {
                    if rest.is_nan() || rest <= 1e-12 * self.rows[i][i] {
                        return None;
                    }
                    factor.rows[i][i] = rest.sqrt();
                } else {
                    factor.rows[i][j] = rest / factor.rows[j][j];
                }
            }
        }
        Some(factor)
    }

    /// L⁻¹ of a lower triangular L.
    pub fn lower_inverse(&self) -> Self {
        let mut inverse = Self { size: self.size, rows: [[0.0; MOST]; MOST] };
        for i in 0..self.size {
            inverse.rows[i][i] = 1.0 / self.rows[i][i];
            for j in 0..i {
                let dot: f64 = (j..i).map(|k| self.rows[i][k] * inverse.rows[k][j]).sum();
                inverse.rows[i][j] = -dot / self.rows[i][i];
            }
        }
        inverse
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn factors_and_inverses_recompose() {
        for size in 1..=MOST {
            let lower = SmallMatrix::from_fn(size, |i, j| match i.cmp(&j) {
                std::cmp::Ordering::Less => 0.0,
                std::cmp::Ordering::Equal => 1.0 + 0.1 * i as f64,
                std::cmp::Ordering::Greater => ((3 * i + j) as f64).sin(),
            });
            let product = lower.squared();
            let (factor, unit) = (product.cholesky().unwrap(), lower.times(&lower.lower_inverse()));
            let image = lower.apply(&[1.0; MOST]);
            for (i, image) in image.iter().enumerate().take(size) {
                assert!((image - lower.rows[i].iter().sum::<f64>()).abs() < 1e-12);
                for j in 0..size {
                    assert!((factor.rows[i][j] - lower.rows[i][j]).abs() < 1e-10, "{size}: {i}, {j}");
                    assert!((unit.rows[i][j] - f64::from(u8::from(i == j))).abs() < 1e-10, "{size}: {i}, {j}");
                }
            }
        }
        assert!(SmallMatrix::from_fn(2, |_, _| 1.0).cholesky().is_none(), "a singular matrix");
    }
}
