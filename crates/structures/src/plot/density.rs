//! Densities of samples: histograms and kernel estimates, both of area one.

use std::f64::consts::PI;

use crate::stats;

/// Smallest and greatest number of bars of a histogram.
const BARS: [usize; 2] = [6, 60];

/// Number of points of a curve.
const POINTS: usize = 161;

/// Bars of a histogram of `values`, `[n]`: lower edge, upper edge and density (one over the unit of the values) of each bar.
///
/// ```text
///  width = 2·IQR/∛n
/// ```
///
/// Empty without two different values. Source: Freedman and Diaconis (1981).
pub fn histogram(values: &[f64]) -> Vec<(f64, f64, f64)> {
    let Some(Spread { values, low, high, quartiles, .. }) = Spread::of(values) else { return Vec::new() };
    let wanted = 2.0 * quartiles / (values.len() as f64).cbrt();
    let count = if wanted > 0.0 { ((high - low) / wanted).ceil().min(1e3) as usize } else { BARS[1] };
    let count = count.clamp(BARS[0], BARS[1]);
    let width = (high - low) / count as f64;
    let mut counts = vec![0_usize; count];
    for value in &values {
        counts[(((value - low) / width) as usize).min(count - 1)] += 1;
    }
    let bar = |(i, n): (usize, &usize)| {
        let edge = low + width * i as f64;
        (edge, edge + width, *n as f64 / (values.len() as f64 * width))
    };
    counts.iter().enumerate().map(bar).collect()
}

/// Histogram of `values`, `[n]`, that take only a few different values: one bar around each of these, with edges halfway to the
/// next. Returns lower edge, upper edge and density of each bar; empty if all values are equal.
pub fn columns(values: &[f64]) -> Vec<(f64, f64, f64)> {
    let mut places: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    let total = places.len() as f64;
    places.sort_by(f64::total_cmp);
    let least = 1e-9 * places.last().zip(places.first()).map_or(0.0, |(high, low)| high - low);
    let mut counted: Vec<(f64, f64)> = Vec::new();
    for place in places {
        match counted.last_mut() {
            Some((same, count)) if place - *same <= least => *count += 1.0,
            _ => counted.push((place, 1.0)),
        }
    }
    let half = |i: usize| 0.5 * (counted[i + 1].0 - counted[i].0);
    let last = counted.len().saturating_sub(1);
    let bar = |(i, (place, count)): (usize, &(f64, f64))| {
        let (below, above) = (half(i.saturating_sub(1)), half(i.min(last - 1)));
        (place - below, place + above, count / (total * (below + above)))
    };
    if last == 0 {
        return Vec::new();
    }
    counted.iter().enumerate().map(bar).collect()
}

/// Kernel estimate of the density with Gaussian kernels, from three bandwidths below to three above the samples: `[161]` points
/// (x, p), p in one over the unit of x.
///
/// ```text
///  p(x) = 1/(n·h) Σ φ((x − xᵢ)/h),    h = 0.9·min(s, IQR/1.34)·n^(−1/5)
/// ```
///
/// Empty without two different values. Source: Silverman (1986), Density Estimation, Eq. 3.31.
pub fn kernel(values: &[f64]) -> Vec<(f64, f64)> {
    let Some(spread) = Spread::of(values) else { return Vec::new() };
    let (h, low, high) = (spread.bandwidth(), spread.low, spread.high);
    let density = kernel_density(spread);
    grid(low - 3.0 * h, high + 3.0 * h).map(|x| (x, density(x))).collect()
}

/// The density of [`kernel`] at given positions, `[places]`; `None` without two different values.
pub fn kernel_at(values: &[f64], places: &[f64]) -> Option<Vec<f64>> {
    let density = kernel_density(Spread::of(values)?);
    Some(places.iter().map(|x| density(*x)).collect())
}

/// The kernel density estimate as a function of x.
fn kernel_density(mut spread: Spread) -> impl Fn(f64) -> f64 {
    let h = spread.bandwidth();
    spread.values.sort_by(f64::total_cmp);
    let values = spread.values;
    move |x| {
        // A kernel is below 1e-17 of its height beyond nine bandwidths.
        let near = values.partition_point(|v| *v < x - 9.0 * h)..values.partition_point(|v| *v <= x + 9.0 * h);
        values[near].iter().map(|v| normal(x, *v, h)).sum::<f64>() / values.len() as f64
    }
}

/// The density of a normal distribution within four standard deviations of its mean, `[161]` points; empty without a positive
/// standard deviation.
pub fn normal_curve(mean: f64, std: f64) -> Vec<(f64, f64)> {
    if !(mean.is_finite() && std.is_finite() && std > 0.0) {
        return Vec::new();
    }
    grid(mean - 4.0 * std, mean + 4.0 * std).map(|x| (x, normal(x, mean, std))).collect()
}

/// Density of a normal distribution at `x`, exp(−½((x − mean)/std)²)/(std·√(2π)).
pub fn normal(x: f64, mean: f64, std: f64) -> f64 {
    (-0.5 * ((x - mean) / std).powi(2)).exp() / (std * (2.0 * PI).sqrt())
}

/// Evenly spaced points from `low` to `high`, `[161]`.
pub fn grid(low: f64, high: f64) -> impl Iterator<Item = f64> {
    (0..POINTS).map(move |i| low + (high - low) * i as f64 / (POINTS - 1) as f64)
}

/// The finite values with their range, interquartile range and standard deviation.
struct Spread {
    values: Vec<f64>,
    low: f64,
    high: f64,
    quartiles: f64,
    std: f64,
}

impl Spread {
    /// Bandwidth h of Gaussian kernels.
    fn bandwidth(&self) -> f64 {
        // If half of the values are equal, the interquartile range is 0 and cannot give the width.
        let scale = if self.quartiles > 0.0 { self.std.min(self.quartiles / 1.34) } else { self.std };
        0.9 * scale * (self.values.len() as f64).powf(-0.2)
    }

    /// `None` if there are no two different finite values.
    fn of(values: &[f64]) -> Option<Self> {
        let values: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
        let std = stats::sample_std(&values)?;
        let (low, high) = (stats::quantile(&values, 0.0), stats::quantile(&values, 1.0));
        // Values that differ by rounding only are equal.
        let different = high - low > 1e-12 * low.abs().max(high.abs());
        let quartiles = stats::quantile(&values, 0.75) - stats::quantile(&values, 0.25);
        different.then_some(Self { values, low, high, quartiles, std })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 400 evenly spaced quantiles of a standard normal distribution.
    fn sample() -> Vec<f64> {
        (0..400).map(|i| stats::normal_quantile((f64::from(i) + 0.5) / 400.0)).collect()
    }

    #[test]
    fn a_histogram_has_area_one() {
        let area: f64 = histogram(&sample()).iter().map(|(low, high, p)| (high - low) * p).sum();
        assert!((area - 1.0).abs() < 1e-9, "{area}");
    }

    #[test]
    fn kernels_have_area_one_and_come_near_the_distribution_of_the_samples() {
        let curve = kernel(&sample());
        let area: f64 = curve.windows(2).map(|w| (w[1].0 - w[0].0) * 0.5 * (w[0].1 + w[1].1)).sum();
        assert!((area - 1.0).abs() < 1e-3, "{area}");
        // h = 0.9·400^(−1/5) = 0.27 lowers the peak by 1 − 1/√(1 + h²) = 3.5 %.
        let peak = curve.iter().map(|p| p.1).fold(0.0, f64::max);
        assert!((peak / normal(0.0, 0.0, 1.0) - 0.965).abs() < 0.01, "{peak}");
    }

    #[test]
    fn columns_surround_the_values_and_have_area_one() {
        let columns = columns(&[0.2, 0.1, 0.1 + 1e-15, 0.4]);
        let edges: Vec<f64> = columns.iter().map(|c| c.0).collect();
        assert!(edges.iter().zip([0.05, 0.15, 0.3]).all(|(a, b)| (a - b).abs() < 1e-9), "{edges:?}");
        let area: f64 = columns.iter().map(|(low, high, p)| (high - low) * p).sum();
        assert!((area - 1.0).abs() < 1e-9, "{area}");
    }

    #[test]
    fn constant_values_have_no_histogram_and_no_density() {
        for values in [vec![], vec![1.0], vec![2.0; 9], vec![f64::NAN; 5]] {
            assert!(
                columns(&values).is_empty() && histogram(&values).is_empty() && kernel(&values).is_empty(),
                "{values:?}"
            );
        }
        assert!(normal_curve(1.0, 0.0).is_empty());
    }
}
