//! The test of one quantity for a step in time.
//!
//! Successive rows are correlated. The variance that counts for the mean of many rows,
//!
//! ```text
//!  ω² = max( Σ_b (Σ_{j∈b} v_j)²/(n − trace),    c₀(1 + ρ)/(1 − ρ),    c₀ + 2c₁/(1 − φ) ),    φ = (c₂ + c₃ + c₄)/(c₁ + c₂ + c₃)
//!  ν = (n − trace)/L
//! ```
//!
//! is estimated from the sums of the residuals v in 20 successive blocks of L = n/20 rows, whose expectation the regressors reduce by a
//! trace that is known; from the correlation ρ = c₁/c₀ of successive residuals; and for a persistent part with white noise, from the
//! covariances c_k of residuals k rows apart, corrected for what the fitted numbers take of them. The largest is used. The step that is tested is
//! among the regressors, so that a true step does not become a part of ω².
//!
//! Source: W. K. Newey, K. D. West (1987), Econometrica 55, for variances of correlated residuals; B. E. Hansen (1992),
//! Journal of Policy Modeling 14, for the distribution of the time of a step.

use crate::most_probable::most_probable;

/// Number of blocks.
const BLOCKS: usize = 20;

/// Number of times of a step that are tested.
const PLACES: usize = 40;

/// Smallest number of rows before and after a step that is tested, and that an onset may leave.
const FEWEST: usize = 8;
const FEWEST_AT_ONSET: usize = 3;

/// A quantity is not tested with fewer rows than this for each competitor.
const ROWS_PER_COMPETITOR: usize = 4;

/// Share of the information about a step that the competitors must leave.
const IDENTIFIABLE: f64 = 0.05;

/// Share of a competitor that the others must leave.
const INDEPENDENT: f64 = 1e-6;

/// Smallest number of degrees of freedom of a test.
const FEWEST_DEGREES: f64 = 5.0;

/// Greatest correlation of successive residuals that is counted.
const MOST_CORRELATION: f64 = 0.97;

/// A quantity from which the competitors have been projected out.
pub struct Tested {
    /// Bins in which the quantity is known, ascending, `[n]`.
    known: Vec<usize>,
    /// M y, `[n]`.
    left: Vec<f64>,
    /// Orthonormal competitors with the constant, `[q][n]`.
    competitors: Vec<Vec<f64>>,
    /// Sums of `left` from each place on, `[n + 1]`.
    sums: Vec<f64>,
    /// Sums of each competitor from each place on, `[q][n + 1]`.
    competitor_sums: Vec<Vec<f64>>,
}

/// A step at a place among the known bins.
#[derive(Debug, Clone, Copy)]
pub struct Stepped {
    /// The first place after the step.
    pub place: usize,
    /// Its size, in the unit of the quantity.
    pub size: f64,
    /// Standard error of its size.
    pub standard_error: f64,
    /// Size over standard error.
    pub t: f64,
    /// ν.
    pub degrees_of_freedom: f64,
    /// ω².
    pub variance: f64,
}

/// Onset of a step.
pub struct Onset {
    /// The most probable first place.
    pub place: usize,
    /// 5 % and 95 % quantiles.
    pub interval: [usize; 2],
}

impl Tested {
    /// Projects `columns`, each `[bins]`, and the constant out of a quantity; NaN where it is missing. `None` if it has too few values.
    pub fn new(values: &[f64], columns: &[Vec<f64>]) -> Option<Self> {
        let known: Vec<usize> = (0..values.len()).filter(|bin| values[*bin].is_finite()).collect();
        let n = known.len();
        let mut competitors: Vec<Vec<f64>> = Vec::new();
        let constant = vec![1.0; values.len()];
        for column in [&constant].into_iter().chain(columns) {
            let mut own: Vec<f64> =
                known.iter().map(|bin| if column[*bin].is_finite() { column[*bin] } else { 0.0 }).collect();
            let size = dot(&own, &own);
            // Twice, because one pass loses digits where columns are nearly parallel.
            for _ in 0..2 {
                for other in &competitors {
                    let share = dot(&own, other);
                    subtract(&mut own, share, other);
                }
            }
            let left = dot(&own, &own);
            if left > INDEPENDENT * size {
                let scale = left.sqrt().recip();
                for value in &mut own {
                    *value *= scale;
                }
                competitors.push(own);
            }
        }
        if n < 2 * FEWEST + BLOCKS || n < ROWS_PER_COMPETITOR * competitors.len() {
            return None;
        }
        let mut left: Vec<f64> = known.iter().map(|bin| values[*bin]).collect();
        for competitor in &competitors {
            let share = dot(&left, competitor);
            subtract(&mut left, share, competitor);
        }
        let sums = sums_from(&left);
        let competitor_sums = competitors.iter().map(|c| sums_from(c)).collect();
        Some(Self { known, left, competitors, sums, competitor_sums })
    }

    /// The steps at the places that are tested.
    pub fn steps(&self) -> impl Iterator<Item = Stepped> + '_ {
        let n = self.known.len();
        let place = move |i: usize| FEWEST + (n - 2 * FEWEST) * i / (PLACES - 1);
        let mut places: Vec<usize> = (0..PLACES).map(place).collect();
        places.dedup();
        places.into_iter().filter_map(|place| self.step_at(place))
    }

    /// The step at a place; `None` if the competitors explain it as well, or if one side has too few rows.
    pub fn step_at(&self, place: usize) -> Option<Stepped> {
        let n = self.known.len();
        let information =
            self.information(place).filter(|_| place >= FEWEST_AT_ONSET && place + FEWEST_AT_ONSET <= n)?;
        let size = self.sums[place] / information;
        let residual = self.residual(place, size);
        let (variance, degrees_of_freedom) = self.variance(&residual, place, information);
        if degrees_of_freedom < FEWEST_DEGREES || variance <= 0.0 {
            return None;
        }
        let standard_error = (variance / information).sqrt();
        Some(Stepped { place, size, standard_error, t: size / standard_error, degrees_of_freedom, variance })
    }

    /// sᵀM s of the step at a place; `None` if the competitors leave too little of it.
    fn information(&self, place: usize) -> Option<f64> {
        let (n, after) = (self.known.len() as f64, (self.known.len() - place) as f64);
        let alone = after - after * after / n;
        let information = after - self.competitor_sums.iter().map(|c| c[place] * c[place]).sum::<f64>();
        (information > IDENTIFIABLE * alone && alone > 0.0).then_some(information)
    }

    /// v of each place: what a step of this size leaves.
    pub fn residual(&self, place: usize, size: f64) -> Vec<f64> {
        let mut residual = self.left.clone();
        residual[place..].iter_mut().for_each(|v| *v -= size);
        for (competitor, sums) in self.competitors.iter().zip(&self.competitor_sums) {
            subtract(&mut residual, -size * sums[place], competitor);
        }
        residual
    }

    /// ω² and ν.
    fn variance(&self, residual: &[f64], place: usize, information: f64) -> (f64, f64) {
        let n = residual.len();
        let edges: Vec<usize> = (0..=BLOCKS).map(|b| b * n / BLOCKS).collect();
        let (mut squares, mut trace) = (0.0, 0.0);
        for edge in edges.windows(2) {
            squares += residual[edge[0]..edge[1]].iter().sum::<f64>().powi(2);
            let mut step = (edge[1].max(place) - edge[0].max(place)) as f64;
            for sums in &self.competitor_sums {
                let own = sums[edge[0]] - sums[edge[1]];
                trace += own * own;
                step -= own * sums[place];
            }
            trace += step * step / information;
        }
        let left = n as f64 - trace;
        let degrees = left / (n as f64 / BLOCKS as f64);
        let of_blocks = squares / left.max(f64::MIN_POSITIVE);
        let numbers = self.competitors.len() as f64 + 1.0;
        (of_blocks.max(process_variance(residual, numbers, of_blocks)), degrees)
    }

    /// The onset of the step that was found, with ω² from there:
    ///
    /// ```text
    ///  p(τ) ∝ exp( (s_τᵀM y)²/(2 ω² s_τᵀM s_τ) )/√(s_τᵀM s_τ)
    /// ```
    pub fn onset(&self, found: &Stepped) -> Onset {
        let n = self.known.len();
        let places = FEWEST_AT_ONSET..=n - FEWEST_AT_ONSET;
        let log = |place: usize| {
            let information = self.information(place)?;
            Some((place, 0.5 * self.sums[place].powi(2) / (found.variance * information) - 0.5 * information.ln()))
        };
        let logs: Vec<(usize, f64)> = places.filter_map(log).collect();
        most_probable(&logs).map_or(Onset { place: found.place, interval: [found.place; 2] }, |best| Onset {
            place: best.value,
            interval: best.interval,
        })
    }

    /// The bin of a place.
    pub fn bin(&self, place: usize) -> usize {
        self.known[place.min(self.known.len() - 1)]
    }

    /// The first place from a bin on.
    pub fn place_of(&self, bin: usize) -> usize {
        self.known.partition_point(|known| *known < bin)
    }
}

/// ω² of a process with a persistent part and white noise, from the covariances c of successive residuals. `numbers`: fitted numbers, which
/// reduce each covariance by about ω²/n; `least`: another estimate of ω².
fn process_variance(residual: &[f64], numbers: f64, least: f64) -> f64 {
    let n = residual.len() as f64;
    let covariance = |lag: usize| dot(&residual[lag..], &residual[..residual.len() - lag]) / (n - numbers).max(1.0);
    let c: [f64; 5] = std::array::from_fn(covariance);
    let correlation = (c[1] / c[0].max(f64::MIN_POSITIVE)).clamp(0.0, MOST_CORRELATION);
    let of_pairs = c[0] * (1.0 + correlation) / (1.0 - correlation);
    let persistent = |c: &[f64; 5]| {
        if c[1] < 2.0 / n.sqrt() * c[0] {
            return c[0];
        }
        let decay = ((c[2] + c[3] + c[4]) / (c[1] + c[2] + c[3])).clamp(0.0, MOST_CORRELATION);
        c[0] + 2.0 * c[1] / (1.0 - decay)
    };
    let largest = least.max(of_pairs).max(persistent(&c));
    largest.max(persistent(&c.map(|c| c + numbers / n * largest)))
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// a −= share·b
fn subtract(a: &mut [f64], share: f64, b: &[f64]) {
    a.iter_mut().zip(b).for_each(|(a, b)| *a -= share * b);
}

/// Sums of the values from each place on, `[n + 1]`.
fn sums_from(values: &[f64]) -> Vec<f64> {
    let mut sums = vec![0.0; values.len() + 1];
    for place in (0..values.len()).rev() {
        sums[place] = sums[place + 1] + values[place];
    }
    sums
}
