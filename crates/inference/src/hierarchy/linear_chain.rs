//! The sampler of [`super::linear`]: draws of the mean and the covariance of a population behind measurements that are linear in the
//! parameters.
//!
//! It runs thousands of times on matrices of a few rows, so that their size is a type: those of up to four parameters are held without
//! allocation.

use nalgebra::allocator::Allocator;
use nalgebra::{Cholesky, Const, DMatrix, DVector, DefaultAllocator, Dim, Dyn, OMatrix, OVector};
use rand::Rng as _;
use rand_distr::{Gamma, StandardNormal};

use super::population::DRAWS;
use super::problem::WIDEST;
use structures::stats::{self, Stream};

/// How often the sampler runs. Sweeps for an independent draw of a standard deviation (integrated autocorrelation time; two parameters, 2 to
/// 500 measurements of which none to half lack a mode, noise of 0.05 to 10 %): a known spread needs 1 to 6, or 4 to 20 for 500 measurements
/// if the Metropolis steps follow every fourth sweep; an unknown one 1 to 40 if they follow each. Means need 1 to 6.
struct Pace {
    burn_in: usize,
    sweeps_per_draw: usize,
    metropolis_every: usize,
}

impl Pace {
    fn of(batch: &LinearBatch) -> Self {
        let count: usize = batch.alike.iter().map(|alike| alike.gradients.ncols()).sum();
        // With more groups, Metropolis steps follow as often as keeps their work.
        let rarest = batch.alike.len().div_ceil(GROUPS);
        match batch.spread {
            Spread::Unknown => Self { burn_in: 400, sweeps_per_draw: 8, metropolis_every: rarest },
            Spread::Usual { .. } if count < MANY => {
                Self { burn_in: 64, sweeps_per_draw: 4, metropolis_every: rarest.max(4) }
            }
            Spread::Usual { .. } => Self { burn_in: 64, sweeps_per_draw: 4, metropolis_every: rarest },
        }
    }
}

/// Fewest measurements whose sum hardly leaves Σ room to move, so that the Metropolis steps follow more often.
const MANY: usize = 200;

/// Sizes of the Metropolis steps, from which one is chosen at random.
const STEPS: [f64; 3] = [0.1, 0.3, 1.0];

/// Most groups of measurements for which the Metropolis steps follow each sweep.
const GROUPS: usize = 32;

/// Degrees of freedom of the half-t distributions of unknown standard deviations.
const HALF_T: f64 = 2.0;

/// Smallest standard deviation that a known spread has, as a share of the prior's width: Σ must be positive definite.
const LEAST_SPREAD: f64 = 1e-4;

/// How often a mean outside the prior is drawn again before it is moved to its bounds.
const ATTEMPTS: usize = 20;

type Vector<D> = OVector<f64, D>;
type Matrix<D> = OMatrix<f64, D, D>;

/// Measurements with the same modes, noise and effects, in the unit box of the prior.
#[derive(Debug, Clone)]
pub struct LinearMeasurements {
    /// I_n, `[d, d]`.
    pub information: DMatrix<f64>,
    /// g_n of each, `[d, measurements]`.
    pub gradients: DMatrix<f64>,
}

/// What is known of Σ beside the measurements.
#[derive(Debug, Clone)]
pub enum Spread {
    /// Nothing.
    Unknown,
    /// It is likely to be that of a healthy structure.
    Usual {
        /// Its covariance in the unit box, `[d, d]`.
        covariance: DMatrix<f64>,
        /// Number of measurements that this knowledge is worth.
        degrees: f64,
    },
}

/// A batch of measurements, linearised about a point.
#[derive(Debug, Clone)]
pub struct LinearBatch {
    /// The measurements; at least one.
    pub alike: Vec<LinearMeasurements>,
    /// c in the unit box, `[d]`.
    pub about: DVector<f64>,
    /// m, counted from c, `[d]`.
    pub prior_mean: DVector<f64>,
    /// Diagonal of Λ, `[d]`.
    pub prior_precision: DVector<f64>,
    /// What is known of Σ.
    pub spread: Spread,
}

/// μ and Σ of one sweep.
pub(super) struct Swept {
    pub mean: DVector<f64>,
    pub covariance: DMatrix<f64>,
}

/// Draws of the population behind a batch; `None` where the matrices are not finite.
pub(super) fn draws(batch: &LinearBatch, seed: u64) -> Option<Vec<Swept>> {
    match batch.about.len() {
        1 => draws_of(batch, Const::<1>, seed),
        2 => draws_of(batch, Const::<2>, seed),
        3 => draws_of(batch, Const::<3>, seed),
        4 => draws_of(batch, Const::<4>, seed),
        many => draws_of(batch, Dyn(many), seed),
    }
}

fn draws_of<D: Dim>(batch: &LinearBatch, d: D, seed: u64) -> Option<Vec<Swept>>
where
    DefaultAllocator: Allocator<D> + Allocator<D, D>,
{
    let mut chain = Chain::of(batch, d, seed)?;
    let mut kept = Vec::with_capacity(DRAWS);
    let pace = Pace::of(batch);
    for sweep in 1..=pace.burn_in + pace.sweeps_per_draw * DRAWS {
        let mean = chain.sweep()?;
        if sweep.is_multiple_of(pace.metropolis_every) {
            chain.metropolis(&mean)?;
        }
        if sweep > pace.burn_in && (sweep - pace.burn_in).is_multiple_of(pace.sweeps_per_draw) {
            let covariance = chain.precision.clone().cholesky()?.inverse();
            let (rows, entries) = (mean.len(), covariance.as_slice());
            kept.push(Swept {
                covariance: DMatrix::from_column_slice(rows, rows, entries),
                mean: DVector::from_column_slice(mean.as_slice()),
            });
        }
    }
    Some(kept)
}

/// The sum of a group of measurements over what the sampler needs of each: its work does not grow with their number.
///
/// With an orthogonal matrix Q that takes the rows of (g_1 … g_n) and (1 … 1) to their first d + 1 columns, (γ_i, w_i), the deviations
/// δ_n = x_n − μ of all measurements have the distribution of
///
/// ```text
///  δ_i Q  =  P⁻¹ (γ_i + w_i Σ⁻¹ μ) − w_i μ + N(0, P⁻¹),    i ≤ d + 1,        N(0, P⁻¹) for all others
/// ```
///
/// and Σ_n δ_n δ_nᵀ is the same for both. The sum of the others is drawn as one matrix.
struct Group<D: Dim>
where
    DefaultAllocator: Allocator<D> + Allocator<D, D>,
{
    /// I_n.
    information: Matrix<D>,
    count: f64,
    /// Σ g_n.
    sum: Vector<D>,
    /// Σ g_n g_nᵀ.
    products: Matrix<D>,
    /// γ_i and w_i.
    turned: Vec<(Vector<D>, f64)>,
    /// Number of the others.
    others: usize,
}

impl<D: Dim> Group<D>
where
    DefaultAllocator: Allocator<D> + Allocator<D, D>,
{
    fn of(alike: &LinearMeasurements, d: D) -> Self {
        let (gradients, size) = (&alike.gradients, d.value());
        let count = gradients.ncols();
        let both = DMatrix::from_fn(count, size + 1, |n, k| if k < size { gradients[(k, n)] } else { 1.0 });
        let turned = both.qr().r();
        let products = gradients * gradients.transpose();
        let one = |row: usize| (Vector::from_fn_generic(d, Const::<1>, |k, _| turned[(row, k)]), turned[(row, size)]);
        Self {
            information: Matrix::from_column_slice_generic(d, d, alike.information.as_slice()),
            count: count as f64,
            sum: Vector::from_column_slice_generic(d, Const::<1>, gradients.column_sum().as_slice()),
            products: Matrix::from_column_slice_generic(d, d, products.as_slice()),
            others: count - turned.nrows(),
            turned: (0..turned.nrows()).map(one).collect(),
        }
    }
}

/// V_0 and ν_0 of the inverse Wishart distribution of Σ, with the scales of an unknown spread.
struct SpreadPrior<D: Dim>
where
    DefaultAllocator: Allocator<D, D>,
{
    degrees: f64,
    scale: Matrix<D>,
    unknown: bool,
}

impl<D: Dim> SpreadPrior<D>
where
    DefaultAllocator: Allocator<D> + Allocator<D, D>,
{
    fn of(spread: &Spread, d: D) -> Self {
        let (size, identity) = (d.value() as f64, Matrix::identity_generic(d, d));
        match spread {
            Spread::Unknown => {
                Self { degrees: HALF_T + size - 1.0, scale: identity * (2.0 * HALF_T * WIDEST * WIDEST), unknown: true }
            }
            // Of this distribution the mean is the covariance itself.
            Spread::Usual { covariance, degrees } => Self {
                degrees: degrees + size + 1.0,
                scale: (Matrix::from_column_slice_generic(d, d, covariance.as_slice())
                    + identity * LEAST_SPREAD.powi(2))
                    * *degrees,
                unknown: false,
            },
        }
    }

    /// Draws Σ⁻¹ given Σ_n (x_n − μ)(x_n − μ)ᵀ of n measurements; `None` where the sum is not finite.
    fn precision(&mut self, squares: &Matrix<D>, n: f64, stream: &mut Stream) -> Option<Matrix<D>> {
        let d = squares.shape_generic().0;
        // L⁻¹ of V = L Lᵀ: with A A' of a Wishart distribution of scale 1, L⁻ᵀ A Aᵀ L⁻¹ has one of scale V⁻¹.
        let factor = (&self.scale + squares).cholesky()?;
        let triangle = bartlett(d, self.degrees + n, stream);
        let root = factor.l_dirty().tr_solve_lower_triangular(&triangle)?;
        Some(&root * root.transpose())
    }

    /// Draws the scales of an unknown spread given Σ⁻¹.
    fn draw_scales(&mut self, precision: &Matrix<D>, stream: &mut Stream) {
        let d = precision.nrows();
        for k in (0..d).filter(|_| self.unknown) {
            let rate = HALF_T * precision[(k, k)] + WIDEST.powi(-2);
            self.scale[(k, k)] = 2.0 * HALF_T * gamma(0.5 * (HALF_T + d as f64), 1.0 / rate, stream);
        }
    }

    /// ln of the prior's density of Σ without a power of |Σ|; for an unknown spread without its scales.
    fn log_density(&self, precision: &Matrix<D>) -> f64 {
        if !self.unknown {
            return -0.5 * self.scale.component_mul(precision).sum();
        }
        let d = precision.nrows();
        let rates: f64 = (0..d).map(|k| HALF_T * precision[(k, k)] + WIDEST.powi(-2)).product();
        -0.5 * (HALF_T + d as f64) * rates.ln()
    }
}

/// A, lower triangular, for which A Aᵀ has a Wishart distribution of scale 1 with some degrees of freedom, `[d, d]`: the sum of as many
/// squares of standard normal vectors. Fewer than d must be a whole number, and fill as many columns. (Bartlett's decomposition.)
fn bartlett<D: Dim>(d: D, degrees: f64, stream: &mut Stream) -> Matrix<D>
where
    DefaultAllocator: Allocator<D, D>,
{
    let mut triangle = Matrix::zeros_generic(d, d);
    for column in (0..d.value()).take_while(|column| degrees > *column as f64) {
        triangle[(column, column)] = gamma(0.5 * (degrees - column as f64), 2.0, stream).sqrt();
        (column + 1..d.value()).for_each(|row| triangle[(row, column)] = stream.sample(StandardNormal));
    }
    triangle
}

fn gamma(shape: f64, scale: f64, stream: &mut Stream) -> f64 {
    Gamma::new(shape, scale).map_or(f64::NAN, |gamma| stream.sample(gamma))
}

/// A normal deviate with the covariance of the inverse of L Lᵀ.
fn deviate<D: Dim>(factor: &Cholesky<f64, D>, stream: &mut Stream) -> Option<Vector<D>>
where
    DefaultAllocator: Allocator<D> + Allocator<D, D>,
{
    let d = factor.l_dirty().shape_generic().0;
    let normal = Vector::from_fn_generic(d, Const::<1>, |_, _| stream.sample(StandardNormal));
    factor.l_dirty().tr_solve_lower_triangular(&normal)
}

/// The state of the sampler.
struct Chain<D: Dim>
where
    DefaultAllocator: Allocator<D> + Allocator<D, D>,
{
    groups: Vec<Group<D>>,
    about: Vector<D>,
    /// Λ and Λ m.
    prior_precision: Matrix<D>,
    prior_pull: Vector<D>,
    spread: SpreadPrior<D>,
    /// Σ⁻¹.
    precision: Matrix<D>,
    stream: Stream,
}

impl<D: Dim> Chain<D>
where
    DefaultAllocator: Allocator<D> + Allocator<D, D>,
{
    fn of(batch: &LinearBatch, d: D, seed: u64) -> Option<Self> {
        let vector = |own: &DVector<f64>| Vector::from_column_slice_generic(d, Const::<1>, own.as_slice());
        let prior_precision = vector(&batch.prior_precision);
        let spread = SpreadPrior::of(&batch.spread, d);
        // The mean of the prior of Σ⁻¹ for a known spread; a twentieth of the prior's width for an unknown one.
        let precision = match &batch.spread {
            Spread::Unknown => Matrix::identity_generic(d, d) * 400.0,
            Spread::Usual { degrees, .. } => (spread.scale.clone() / *degrees).cholesky()?.inverse(),
        };
        Some(Self {
            groups: batch.alike.iter().map(|alike| Group::of(alike, d)).collect(),
            about: vector(&batch.about),
            prior_pull: prior_precision.component_mul(&vector(&batch.prior_mean)),
            prior_precision: Matrix::from_diagonal(&prior_precision),
            spread,
            precision,
            stream: stats::stream(seed, "population of linear measurements"),
        })
    }

    /// One sweep of the Gibbs sampler, which replaces Σ⁻¹ and returns μ.
    fn sweep(&mut self) -> Option<Vector<D>> {
        self.spread.draw_scales(&self.precision, &mut self.stream);
        let (mut information, mut pull) = (self.prior_precision.clone(), self.prior_pull.clone());
        let mut factors = Vec::with_capacity(self.groups.len());
        for group in &self.groups {
            let factor = (&self.precision + &group.information).cholesky()?;
            // Σ⁻¹ P_n⁻¹, transposed.
            let shrunk = factor.solve(&self.precision);
            information += (&self.precision - self.precision.tr_mul(&shrunk)) * group.count;
            pull += shrunk.tr_mul(&group.sum);
            factors.push(factor);
        }
        let of_mean = information.cholesky()?;
        let mean = self.mean(&of_mean, &of_mean.solve(&pull))?;
        let pulled = &self.precision * &mean;
        let d = mean.shape_generic().0;
        let (mut squares, mut count) = (Matrix::zeros_generic(d, d), 0.0);
        for (group, factor) in self.groups.iter().zip(&factors) {
            for (gradient, weight) in &group.turned {
                let off = factor.solve(&(gradient + &pulled * *weight)) - &mean * *weight;
                let off = off + deviate(factor, &mut self.stream)?;
                squares.ger(1.0, &off, &off, 1.0);
            }
            if group.others > 0 {
                let triangle = bartlett(d, group.others as f64, &mut self.stream);
                let root = factor.l_dirty().tr_solve_lower_triangular(&triangle)?;
                squares += &root * root.transpose();
            }
            count += group.count;
        }
        self.precision = self.spread.precision(&squares, count, &mut self.stream)?;
        Some(mean)
    }

    /// Draws μ within the prior.
    fn mean(&mut self, of_mean: &Cholesky<f64, D>, centre: &Vector<D>) -> Option<Vector<D>> {
        let mut mean = centre.clone();
        for _ in 0..ATTEMPTS {
            mean = centre + deviate(of_mean, &mut self.stream)?;
            if mean.iter().zip(&self.about).all(|(mean, about)| (0.0..=1.0).contains(&(about + mean))) {
                return Some(mean);
            }
        }
        Some(mean.zip_map(&self.about, |mean, about| (about + mean).clamp(0.0, 1.0) - about))
    }

    /// ln L of the spread Σ without the x_n, and the density of its prior.
    fn log_density(&self, mean: &Vector<D>, precision: &Matrix<D>) -> Option<f64> {
        let pulled = precision * mean;
        let own = precision.clone().cholesky()?.ln_determinant() - mean.dot(&pulled);
        let mut total = 2.0 * self.spread.log_density(precision);
        for group in &self.groups {
            let factor = (precision + &group.information).cholesky()?;
            // Σ_n (g_n + p)ᵀ P⁻¹ (g_n + p) = tr P⁻¹ Σ_n g_n g_nᵀ + pᵀ P⁻¹ (2 Σ_n g_n + n p).
            let with_pulled = factor.solve(&pulled).dot(&(&group.sum * 2.0 + &pulled * group.count));
            total += factor.solve(&group.products).trace() + with_pulled;
            total += group.count * (own - factor.ln_determinant());
        }
        Some(0.5 * total)
    }

    /// A Metropolis step for the scale of each parameter, and one for its correlation with another one.
    fn metropolis(&mut self, mean: &Vector<D>) -> Option<()> {
        let d = mean.shape_generic().0;
        let mut here = self.log_density(mean, &self.precision)?;
        for k in 0..d.value() {
            for other in [k, self.stream.random_range(0..d.value())] {
                let size = STEPS[self.stream.random_range(0..STEPS.len())];
                let step = size * self.stream.sample::<f64, _>(StandardNormal);
                // Σ⁻¹ changes by A⁻¹. The volume of the space of Σ changes by |A| to the power d + 1, and its density by |Σ| to the power
                // −(ν + d + 1)/2: ν ε is left of both.
                let mut inverse = Matrix::identity_generic(d, d);
                inverse[(k, other)] = if other == k { (-step).exp() } else { -step };
                let next = inverse.tr_mul(&self.precision) * &inverse;
                let threshold: f64 = self.stream.random();
                let Some(there) = self.log_density(mean, &next) else { continue };
                let volume = if other == k { -self.spread.degrees * step } else { 0.0 };
                if threshold.ln() < there - here + volume {
                    (self.precision, here) = (next, there);
                }
            }
        }
        Some(())
    }
}
