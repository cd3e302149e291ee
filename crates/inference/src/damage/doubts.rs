//! Doubts about the batches of an undamaged reference: correlated measurements, a drift, a step or two states within a batch.

use statrs::distribution::{ContinuousCDF as _, FisherSnedecor};

use super::pool::{Informed, QuantitySamples};
use structures::stats;

/// Share of references of independent healthy measurements in which drift and step raise a doubt, at most, for each of the two.
const LEVEL: f64 = 0.001;

/// Fewest measurements of a batch from which a drift or a step is judged.
const FEWEST: usize = 8;

/// Two states are seen where two groups leave less than this share of the variance of a batch; a normal distribution keeps 0.36, a
/// uniform one 0.25, a sine 0.19. Less for few measurements, which form groups by chance: fewer than 1 in 10,000 normal batches do.
fn least_share(n: usize) -> f64 {
    0.14 - 1.6 / n as f64
}

/// The doubts, as sentences with the name of their quantity.
pub(super) fn doubts(samples: &[QuantitySamples], sizes: &[usize]) -> Vec<String> {
    let judged: Vec<&QuantitySamples> = samples.iter().filter(|sample| sample.is_judged()).collect();
    let batches = sizes.iter().filter(|size| **size >= FEWEST).count();
    let level = LEVEL / (judged.len() * batches).max(1) as f64;
    let of_one = |sample: &&QuantitySamples| {
        let (Informed { means, sizes, .. }, mut start) = (sample.informed(sizes), 0);
        let mut patterns = Vec::new();
        for (batch, size) in sizes.iter().enumerate() {
            patterns.extend(Pattern::of(&means[start..start + size], level).map(|pattern| (batch, pattern)));
            start += size;
        }
        let others = patterns.len().saturating_sub(1);
        let worst = patterns.into_iter().max_by(|a, b| a.1.size().total_cmp(&b.1.size()));
        let place = |batch: usize| match (sizes.len(), others) {
            (1, _) => "within its batch".to_owned(),
            (_, 0) => format!("within batch {}", batch + 1),
            _ => format!("within batch {}, and similarly in {others} others", batch + 1),
        };
        let pattern = worst.map(|(batch, pattern)| format!("{}: {}", sample.name, pattern.sentence(&place(batch))));
        let correlated = sample.serial.map(|serial| {
            let (n, effective) = (means.len(), sample.effective(&sizes).of_mean);
            format!(
                "{}: successive measurements are correlated ({:.2}), so that its {n} measurements are worth {effective:.0} independent \
                 ones, and limits and intervals are wider",
                sample.name,
                serial.correlation * serial.share
            )
        });
        [pattern, correlated].into_iter().flatten().collect::<Vec<_>>()
    };
    judged.iter().flat_map(of_one).collect()
}

/// What is not a random scatter within a batch.
enum Pattern {
    /// From one value to another, steadily.
    Drift(f64, f64),
    /// From one value to another after some measurement.
    Step(f64, f64, usize),
    /// Two values in turns.
    States(f64, f64),
}

impl Pattern {
    /// The pattern in the values of a batch in the order of time. `level`: share of random batches that show one, for each test.
    fn of(values: &[f64], level: f64) -> Option<Self> {
        let n = values.len();
        let count = n as f64;
        let centre = stats::mean(values);
        let total: f64 = values.iter().map(|y| (y - centre).powi(2)).sum();
        if n < FEWEST || total <= 0.0 {
            return None;
        }
        let p_value = |left: f64, places: f64| {
            let f = (total - left) / left.max(1e-12 * total) * (count - 2.0);
            FisherSnedecor::new(1.0, count - 2.0).map_or(1.0, |distribution| places * distribution.sf(f))
        };
        let middle = 0.5 * (count - 1.0);
        let slope = values.iter().enumerate().map(|(t, y)| (t as f64 - middle) * (y - centre)).sum::<f64>()
            / values.iter().enumerate().map(|(t, _)| (t as f64 - middle).powi(2)).sum::<f64>();
        let left_by_line: f64 =
            values.iter().enumerate().map(|(t, y)| (y - centre - slope * (t as f64 - middle)).powi(2)).sum();
        let (place, left_by_step) = split(values, total);
        let (of_line, of_step) = (p_value(left_by_line, 1.0), p_value(left_by_step, count));
        if of_line.min(of_step) < level {
            return Some(if left_by_step < left_by_line {
                Self::Step(stats::mean(&values[..place]), stats::mean(&values[place..]), place)
            } else {
                Self::Drift(centre - slope * middle, centre + slope * middle)
            });
        }
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let (place, left) = split(&sorted, total);
        (left < least_share(n) * total)
            .then(|| Self::States(stats::mean(&sorted[..place]), stats::mean(&sorted[place..])))
    }

    /// Difference of its two values.
    fn size(&self) -> f64 {
        let (Self::Drift(a, b) | Self::Step(a, b, _) | Self::States(a, b)) = self;
        (a - b).abs()
    }

    fn sentence(&self, place: &str) -> String {
        match self {
            Self::Drift(from, to) => format!(
                "it drifts from {from:.4} to {to:.4} {place}: a reference must not contain a change that later batches are to show"
            ),
            Self::Step(before, after, at) => format!(
                "it changes from {before:.4} to {after:.4} after measurement {at} {place}: two states of the structure seem to be in it"
            ),
            Self::States(low, high) => format!(
                "its measurements lie about {low:.4} and about {high:.4} {place}: two states of the structure seem to be in it"
            ),
        }
    }
}

/// Where two parts, each with a tenth of the values and at least two, leave the least sum of squares: index of the first value of the
/// second part, and the sum. `total`: sum of squares of the whole.
fn split(values: &[f64], total: f64) -> (usize, f64) {
    let (n, centre) = (values.len(), stats::mean(values));
    let least = n.div_ceil(10).max(2);
    let (mut sum, mut found) = (0.0, (least, total));
    for (index, value) in values.iter().enumerate() {
        let first = index + 1;
        sum += value - centre;
        if first >= least && n - first >= least {
            let left = total - sum * sum * n as f64 / (first * (n - first)) as f64;
            if left < found.1 {
                found = (first, left);
            }
        }
    }
    found
}
