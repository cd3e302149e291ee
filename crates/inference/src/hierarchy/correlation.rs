//! Correlations of the parameters over the measurements of a batch.

use super::normal::Normal;
use super::population::interval;
use structures::stats;

/// Correlations of all pairs of parameters of a population.
#[derive(Debug, Clone, PartialEq)]
pub struct Correlations {
    /// Number of parameters d.
    size: usize,
    /// Correlations of each pair (k, l) with l < k, k by k; `[d (d − 1)/2]`.
    point: Vec<f64>,
    /// Posterior draws, paired with those of the means and standard deviations; `[draws·pairs]`, empty for a point estimate alone.
    draws: Vec<f64>,
}

/// Index of the pair of parameters k and l, k ≠ l.
fn pair(k: usize, l: usize) -> usize {
    let (k, l) = (k.max(l), k.min(l));
    k * (k - 1) / 2 + l
}

fn of_normal(normal: &Normal) -> impl Iterator<Item = f64> + '_ {
    let pairs = (0..normal.size()).flat_map(|k| (0..k).map(move |l| (k, l)));
    pairs.map(|(k, l)| normal.correlation(k, l).clamp(-1.0, 1.0))
}

impl Correlations {
    /// Those of a point estimate, without draws.
    pub(super) fn of_point(normal: &Normal) -> Self {
        Self { size: normal.size(), point: of_normal(normal).collect(), draws: Vec::new() }
    }

    /// Those of draws; the point estimate is the median of each.
    pub(super) fn of_draws(draws: &[Normal]) -> Self {
        Self::from_draws(draws.first().map_or(0, Normal::size), draws.iter().flat_map(of_normal).collect())
    }

    /// Those of draws, `[draws·pairs]`, of the correlations of `size` parameters, as [`Self::all_draws`] returns them.
    /// An incomplete draw at the end is left out.
    pub fn from_draws(size: usize, mut draws: Vec<f64>) -> Self {
        let pairs = size * size.saturating_sub(1) / 2;
        draws.truncate(draws.len() / pairs.max(1) * pairs);
        let mut own = Self { size, point: Vec::new(), draws };
        own.point = (0..pairs).map(|pair| stats::quantile(&own.of_pair(pair), 0.5)).collect();
        own
    }

    /// All draws, `[draws·pairs]`: for each draw the correlations of each pair (k, l) with l < k, k by k.
    pub fn all_draws(&self) -> &[f64] {
        &self.draws
    }

    /// Number of parameters.
    pub fn size(&self) -> usize {
        self.size
    }

    fn pairs(&self) -> usize {
        self.size * self.size.saturating_sub(1) / 2
    }

    fn of_pair(&self, pair: usize) -> Vec<f64> {
        self.draws.iter().skip(pair).step_by(self.pairs()).copied().collect()
    }

    /// Point estimate of the correlation of parameters k and l, in [−1, 1]: the posterior median, or the most probable value where
    /// there are no draws.
    pub fn point(&self, k: usize, l: usize) -> f64 {
        if k == l {
            1.0
        } else {
            self.point[pair(k, l)]
        }
    }

    /// Central credible interval of the correlation of parameters k and l ≠ k with probability [`super::INTERVAL`]; `None` where
    /// there are no draws.
    pub fn interval(&self, k: usize, l: usize) -> Option<[f64; 2]> {
        (!self.draws.is_empty()).then(|| interval(&self.of_pair(pair(k, l))))
    }

    /// Number of draws.
    pub fn draws(&self) -> usize {
        self.draws.len() / self.pairs().max(1)
    }

    /// A draw of the correlation of parameters k and l.
    pub fn drawn(&self, draw: usize, k: usize, l: usize) -> f64 {
        if k == l {
            1.0
        } else {
            self.draws[draw * self.pairs() + pair(k, l)]
        }
    }
}
