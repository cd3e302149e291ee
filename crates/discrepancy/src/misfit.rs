//! Dependence of residuals and parameters on covariates: the misfit before any cause is added, and the remainder after the last.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use statrs::distribution::{ChiSquared, ContinuousCDF as _, FisherSnedecor};

use super::data::{Data, Origin, Values, TIME};
use super::fit::Fit;
use super::model::RowView;
use super::screen::Whitened;
use super::study::Study;
use structures::physics::effect::Target;
use structures::simulator::law::lagged;
use structures::stats;

/// Dependence of the residual of a mode, or of the best value of a parameter, on a covariate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Misfit {
    /// Mode, from 1, whose frequencies deviate.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mode: Option<usize>,
    /// Parameter whose best value varies with the covariate, because it compensates for the deviation.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub parameter: Option<String>,
    /// Covariate that the deviation depends on; `null` for a constant deviation.
    pub covariate: Option<String>,
    /// Effect range (5–95 %) of the fitted curve, per cent of the frequency or stiffness; of a constant, its mean.
    pub size_percent: f64,
    /// Probability of at least this deviation by chance, corrected for the number of tests (Holm), at most 1.
    pub p_value: f64,
}

/// A dependence that remains in the residuals of the best explanation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Remainder {
    /// Function of covariates that the residuals depend on, such as `temperature_c × humidity_percent`; `a constant` if the means of the
    /// frequencies deviate.
    pub function: String,
    /// Covariates of the function; none for a constant.
    pub covariates: Vec<String>,
    /// Effect range (5–95 %) for each mode, per cent of the frequency.
    pub size_percent: Vec<f64>,
    /// Probability of at least this dependence by chance, times the number of tests (Bonferroni), at most 1.
    pub p_value: f64,
}

impl Remainder {
    /// The constants among `misfits`, measured minus simulated, as a deviation that no cause explains; `None` if there are none.
    pub(super) fn constant(misfits: &[Misfit], modes: usize) -> Option<Self> {
        let constants = || misfits.iter().filter(|m| m.covariate.is_none());
        let p_value = constants().map(|m| m.p_value).reduce(f64::min)?;
        let mut size_percent = vec![0.0; modes];
        for misfit in constants() {
            if let Some(mode) = misfit.mode {
                size_percent[mode - 1] = misfit.size_percent;
            }
        }
        Some(Self { function: "a constant".to_owned(), covariates: Vec::new(), size_percent, p_value })
    }

    /// The finding as a clause: "the remaining residuals depend on temperature_c²".
    pub fn sentence(&self) -> String {
        if !self.covariates.is_empty() {
            return format!("the remaining residuals depend on {}", self.function);
        }
        let each = |(mode, percent): (usize, &f64)| format!("mode {} by {percent:+.2} %", mode + 1);
        let each: Vec<String> = self.size_percent.iter().enumerate().map(each).collect();
        format!(
            "the measured frequencies differ from the simulated ones by a constant ({})",
            each.join(", ").replace('-', "−")
        )
    }
}

/// Tests in the rows with the indices `rows` whether the residual of each mode and the best value of each free parameter depend
/// on each covariate, and whether the mean residual of each mode differs from 0; the most significant first. `None` if the
/// frequencies cannot be computed in some row.
pub fn misfits(study: &Study<'_>, rows: &[usize], fit: &Fit) -> Option<Vec<Misfit>> {
    let views = study.view(rows, fit)?;
    let space = study.simulator.space();
    let mut series: Vec<(Option<usize>, Option<String>, Vec<f64>)> = Vec::new();
    for mode in 0..study.simulator.modes() {
        let value = |v: &RowView| v.present.iter().position(|m| *m == mode).map_or(f64::NAN, |i| v.residual[i]);
        series.push((Some(mode + 1), None, views.iter().map(value).collect()));
    }
    for &k in study.free() {
        let of_stiffness = study.simulator.stiffness_share(k, fit.mean[k]);
        let values = views.iter().map(|v| v.deviation[k] * of_stiffness).collect();
        series.push((None, Some(space.as_slice()[k].name.clone()), values));
    }
    let mut found = Vec::new();
    for (mode, parameter, values) in &series {
        for column in &study.data.columns {
            let basis = match (&column.values, column.origin.cycle()) {
                (Values::Numbers(times), Some(cycle)) => cycle.waves(rows.iter().map(|row| times[*row])).to_vec(),
                (values, _) => regressors(values, rows),
            };
            if basis.is_empty() {
                continue;
            }
            if let Some((size, p)) = regression(values, &basis) {
                let (mode, parameter) = (*mode, parameter.clone());
                let covariate = Some(column.name.clone());
                found.push(Misfit { mode, parameter, covariate, size_percent: 100.0 * size, p_value: p });
            }
        }
        if let (Some(mode), Some((mean, p))) = (mode, constant(values)) {
            let size_percent = 100.0 * mean;
            found.push(Misfit { mode: Some(*mode), parameter: None, covariate: None, size_percent, p_value: p });
        }
    }
    found.sort_by(|a, b| a.p_value.total_cmp(&b.p_value).then(b.size_percent.abs().total_cmp(&a.size_percent.abs())));
    correct_for_tests(&mut found);
    Some(found)
}

/// Holm's correction of ascending p-values for their number: the i-th of n, from 0, is multiplied by n − i, and none is smaller than
/// the one before it.
///
/// Source: Holm (1979), Scand. J. Statist. 6.
fn correct_for_tests(sorted: &mut [Misfit]) {
    let tests = sorted.len();
    let mut least: f64 = 0.0;
    for (index, misfit) in sorted.iter_mut().enumerate() {
        least = least.max((misfit.p_value * (tests - index) as f64).min(1.0));
        misfit.p_value = least;
    }
}

/// Regressors of a covariate in addition to the constant, `[q][rows]`: the standardised covariate u and u², or an indicator of
/// each category but one. Empty for a constant covariate.
fn regressors(values: &Values, rows: &[usize]) -> Vec<Vec<f64>> {
    match values {
        Values::Numbers(values) => {
            let numbers: Vec<f64> = rows.iter().map(|r| values[*r]).collect();
            let unit = standardised(&numbers);
            if unit.is_empty() {
                return Vec::new();
            }
            let mut different: Vec<u64> = unit.iter().map(|u| u.to_bits()).collect();
            different.sort_unstable();
            different.dedup();
            // With two values only, the square is linear in the value.
            let square = (different.len() > 2).then(|| unit.iter().map(|u| u * u).collect());
            [unit].into_iter().chain(square).collect()
        }
        Values::Categories(names, indices) => {
            let indicator =
                |level: usize| rows.iter().map(|r| f64::from(u8::from(indices[*r] == Some(level)))).collect();
            let all: Vec<Vec<f64>> = (0..names.len()).map(indicator).collect();
            let mut used: Vec<Vec<f64>> = all.into_iter().filter(|c| c.iter().sum::<f64>() >= 2.0).collect();
            used.pop();
            used
        }
    }
}

/// (c − mean)/std; missing values become 0. Empty for a constant.
fn standardised(values: &[f64]) -> Vec<f64> {
    let known: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    let (mean, std) = (stats::mean(&known), stats::sample_std(&known).unwrap_or(0.0));
    let size = known.iter().fold(0.0, |a: f64, v| a.max(v.abs()));
    if std <= 1e-9 * size || std == 0.0 {
        return Vec::new();
    }
    values.iter().map(|v| if v.is_finite() { (v - mean) / std } else { 0.0 }).collect()
}

/// Effect range (5–95 %) of a linear regression on `basis`, and the p-value of its F test; `None` for too few rows.
///
/// ```text
///  F = (r·SS_fit / q) / (r·SS_residual / ν),    ν = max(r·n − q − 1, 1),    r = (1 − ρ)/(1 + ρ)
/// ```
///
/// q: number of regressors; n: number of rows; ρ ≥ 0: correlation of successive residuals, which reduces the effective number of
/// rows.
fn regression(values: &[f64], basis: &[Vec<f64>]) -> Option<(f64, f64)> {
    let known: Vec<usize> = (0..values.len()).filter(|i| values[*i].is_finite()).collect();
    let (n, q) = (known.len(), basis.len());
    if n < 5 * (q + 1) {
        return None;
    }
    // Gross outliers would dominate the sum of squares: values are limited to five robust standard deviations.
    let clipped = clip(&known.iter().map(|i| values[*i]).collect::<Vec<f64>>());
    let design =
        DMatrix::from_fn(n, q + 1, |row, column| if column == 0 { 1.0 } else { basis[column - 1][known[row]] });
    let y = DVector::from_vec(clipped.clone());
    let normal = design.transpose() * &design;
    let coefficients = normal.cholesky()?.solve(&design.tr_mul(&y));
    let fitted = &design * &coefficients;
    let residual: Vec<f64> = (0..n).map(|i| y[i] - fitted[i]).collect();
    let within: f64 = residual.iter().map(|r| r * r).sum();
    let mean = stats::mean(&clipped);
    let explained: f64 = fitted.iter().map(|f| (f - mean).powi(2)).sum();
    let correlation = lag_one(&residual).max(0.0);
    let share = (1.0 - correlation) / (1.0 + correlation);
    let dof = (n as f64 * share - q as f64 - 1.0).max(1.0);
    let statistic = (explained * share / q as f64) / (within * share / dof).max(f64::MIN_POSITIVE);
    let p = FisherSnedecor::new(q as f64, dof).ok()?.sf(statistic);
    let fitted: Vec<f64> = fitted.iter().copied().collect();
    Some((stats::quantile(&fitted, 0.95) - stats::quantile(&fitted, 0.05), p))
}

/// Mean of the known values, and the two-sided p-value of a test that it is 0.
fn constant(values: &[f64]) -> Option<(f64, f64)> {
    let known = clip(&values.iter().copied().filter(|v| v.is_finite()).collect::<Vec<f64>>());
    let (mean, std) = (stats::mean(&known), stats::sample_std(&known)?);
    let z = mean / (std / (known.len() as f64).sqrt()).max(f64::MIN_POSITIVE);
    Some((mean, 2.0 * stats::normal_cdf(-z.abs())))
}

/// Values clamped to five robust standard deviations from the median; the robust standard deviation is 1.4826 times the median
/// absolute deviation.
fn clip(values: &[f64]) -> Vec<f64> {
    let middle = stats::quantile(values, 0.5);
    let off: Vec<f64> = values.iter().map(|v| (v - middle).abs()).collect();
    let limit = 5.0 * 1.4826 * stats::quantile(&off, 0.5);
    if limit > 0.0 {
        values.iter().map(|v| v.clamp(middle - limit, middle + limit)).collect()
    } else {
        values.to_vec()
    }
}

/// Correlation of successive values.
fn lag_one(values: &[f64]) -> f64 {
    let squares: f64 = values.iter().map(|v| v * v).sum();
    values.windows(2).map(|w| w[0] * w[1]).sum::<f64>() / squares.max(f64::MIN_POSITIVE)
}

/// The most significant dependence of the residuals of a fit on a function of the covariates, including functions that no
/// candidate has. The inner `None` means that there are no functions, the outer one that the frequencies cannot be computed.
///
/// Each function is tested with an arbitrary response of each frequency and each coordinate of a mode shape, and along the target
/// of each cause found, since a cause with the wrong law leaves a residual there. Twice the estimated gain of the score test, times
/// the share of independent rows, is compared with a χ² distribution.
///
/// Source: Rao (1948), for score tests.
pub fn remainder(study: &Study<'_>, rows: &[usize], fit: &Fit, independent_share: f64) -> Option<Option<Remainder>> {
    let views = study.view(rows, fit)?;
    let whitened = Whitened::new(study, rows, fit, &views)?;
    let modes = study.simulator.modes();
    // Only targets with one size have one direction: an oscillator has two, an order of modes none.
    let mut targets: Vec<Target> = fit.effects.iter().map(|e| e.target.clone()).collect();
    targets.retain(|t| t.sizes() == 1);
    let directions = study.directions(rows, fit, &targets)?;
    let sums = |column: usize| whitened.sums(|place, output| directions[place][(output, column)]);
    let along: Vec<_> = (0..targets.len()).map(sums).collect();
    let of_outputs = whitened.output_sums(study.outputs());
    let functions = functions(study.data, rows);
    let tests = (functions.len() * (1 + targets.len())) as f64;
    let mut best: Option<(Remainder, f64)> = None;
    for (function, covariates, values) in functions {
        let range = stats::quantile(&values, 0.95) - stats::quantile(&values, 0.05);
        let values = DVector::from_vec(values);
        let free = whitened.free_score(&of_outputs, &values);
        let of_frequencies = free.psi[..modes].iter().map(|s| 100.0 * s * range).collect();
        let mut scores: Vec<(f64, usize, Vec<f64>)> = vec![(free.nats, free.numbers, of_frequencies)];
        for (column, sums) in along.iter().enumerate() {
            let score = whitened.score(sums, &[&values]);
            let mean =
                |mode: usize| directions.iter().map(|d| d[(mode, column)]).sum::<f64>() / directions.len() as f64;
            let sizes = (0..modes).map(|mode| 100.0 * score.psi[0] * range * mean(mode)).collect();
            scores.push((score.nats, score.numbers, sizes));
        }
        for (nats, numbers, size_percent) in scores.into_iter().filter(|t| t.1 > 0) {
            let chi = ChiSquared::new(numbers as f64).ok()?;
            let p_value = (chi.sf(2.0 * nats * independent_share) * tests).min(1.0);
            // p-values below 1e-308 are all 0: the statistic then decides.
            let strength = nats - 0.5 * numbers as f64 * nats.max(1.0).ln();
            let clearer = |(b, other): &(Remainder, f64)| {
                p_value < b.p_value
                    || (p_value <= f64::MIN_POSITIVE && b.p_value <= f64::MIN_POSITIVE && strength > *other)
            };
            if best.as_ref().is_none_or(clearer) {
                let (function, covariates) = (function.clone(), covariates.clone());
                best = Some((Remainder { function, covariates, size_percent, p_value }, strength));
            }
        }
    }
    Some(best.map(|(remainder, _)| remainder))
}

/// The play operator of hysteresis: the result stays constant while the covariate remains within `width` of it.
fn play(values: &[f64], width: f64) -> Vec<f64> {
    let mut state = values.first().copied().unwrap_or(0.0);
    let follow = |value: &f64| {
        state = state.clamp(value - width, value + width);
        state
    };
    values.iter().map(follow).collect()
}

/// A function of covariates at each row.
type CovariateFunction = (String, Vec<String>, Vec<f64>);

/// Name, covariates and values, `[rows]`, of the functions that a remainder is sought in: powers, kinks, hysteresis and rates
/// of a number, indicators of categories, and products of two.
fn functions(data: &Data, rows: &[usize]) -> Vec<CovariateFunction> {
    let mut numeric: Vec<(String, Vec<f64>)> = Vec::new();
    let mut categories: Vec<(String, String, Vec<f64>)> = Vec::new();
    let mut found: Vec<CovariateFunction> = Vec::new();
    // The products are formed below, from all pairs of columns.
    for column in data.columns.iter().filter(|column| !matches!(column.origin, Origin::Product(..))) {
        if let (Values::Numbers(times), Some(cycle)) = (&column.values, column.origin.cycle()) {
            let own = |wave| (column.name.clone(), vec![column.name.clone()], wave);
            found.extend(cycle.waves(rows.iter().map(|row| times[*row])).map(own));
            continue;
        }
        match &column.values {
            Values::Numbers(values) => {
                let unit = standardised(&rows.iter().map(|r| values[*r]).collect::<Vec<f64>>());
                if unit.is_empty() {
                    continue;
                }
                let of_one = shapes(&column.name, &unit).into_iter().chain(if column.name == TIME {
                    Vec::new()
                } else {
                    histories(data, rows, &column.name, values, &unit)
                });
                found.extend(of_one.map(|(label, values)| (label, vec![column.name.clone()], values)));
                numeric.push((column.name.clone(), unit));
            }
            Values::Categories(names, indices) => {
                for (level, name) in names.iter().enumerate() {
                    let is: Vec<f64> = rows.iter().map(|r| f64::from(u8::from(indices[*r] == Some(level)))).collect();
                    if is.iter().sum::<f64>() >= 5.0 {
                        let label = format!("{} = {name}", column.name);
                        found.push((label.clone(), vec![column.name.clone()], is.clone()));
                        categories.push((column.name.clone(), label, is));
                    }
                }
            }
        }
    }
    for (i, (first, a)) in numeric.iter().enumerate() {
        for (second, b) in &numeric[i + 1..] {
            let product = a.iter().zip(b).map(|(a, b)| a * b).collect();
            found.push((format!("{first} × {second}"), vec![first.clone(), second.clone()], product));
        }
        for (column, label, is) in &categories {
            let product = a.iter().zip(is).map(|(a, b)| a * b).collect();
            found.push((format!("{first} where {label}"), vec![first.clone(), column.clone()], product));
        }
    }
    found
}

/// Powers and kinks of a standardised covariate.
fn shapes(name: &str, unit: &[f64]) -> Vec<(String, Vec<f64>)> {
    let mut all = vec![
        (name.to_owned(), unit.to_vec()),
        (format!("{name}²"), unit.iter().map(|u| u * u - 1.0).collect()),
        (format!("{name}³"), unit.iter().map(|u| u.powi(3) - 3.0 * u).collect()),
    ];
    for level in [0.15, 0.85] {
        let knee = stats::quantile(unit, level);
        let beyond = |u: &f64| if level < 0.5 { (knee - u).max(0.0) } else { (u - knee).max(0.0) };
        let side = if level < 0.5 { "below" } else { "above" };
        let label = format!("{name} {side} its {:.0} % quantile", 100.0 * level);
        all.push((label, unit.iter().map(beyond).collect()));
    }
    all
}

/// Functions of a covariate that depend on its past: hysteresis, and differences to the lagged covariate.
fn histories(data: &Data, rows: &[usize], name: &str, values: &[f64], unit: &[f64]) -> Vec<(String, Vec<f64>)> {
    let mut all = Vec::new();
    for width in [0.3, 0.6, 1.0] {
        let play = standardised(&play(unit, width));
        if !play.is_empty() {
            all.push((format!("hysteresis of {name}"), play));
        }
    }
    let span = data.times_days.last().copied().unwrap_or(0.0).max(1e-6);
    for divisor in [300.0, 60.0, 15.0] {
        let days = span / divisor;
        let followed = lagged(&data.times_days, values, days);
        let difference: Vec<f64> = rows.iter().map(|r| values[*r] - followed[*r].0).collect();
        let difference = standardised(&difference);
        if !difference.is_empty() {
            let signed = difference.iter().map(|d| d.signum()).collect();
            all.push((format!("rise or fall of {name} within {days:.1} days"), difference));
            all.push((format!("direction of change of {name} over {days:.1} days"), signed));
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_constant_that_no_cause_explains_is_measured_minus_simulated_in_every_mode() {
        let misfit = |mode, covariate: Option<&str>, size_percent, p_value| {
            let covariate = covariate.map(str::to_owned);
            Misfit { mode: Some(mode), parameter: None, covariate, size_percent, p_value }
        };
        assert_eq!(Remainder::constant(&[misfit(1, Some("wind_m_per_s"), 0.5, 1e-9)], 2), None);
        let all = [misfit(2, None, 0.3, 1e-6), misfit(1, Some("wind_m_per_s"), 0.5, 1e-5), misfit(1, None, -0.02, 0.4)];
        let left = Remainder::constant(&all, 2).unwrap();
        assert_eq!((left.p_value, left.size_percent.as_slice()), (1e-6, &[-0.02, 0.3][..]));
        assert!(
            left.sentence().ends_with("by a constant (mode 1 by −0.02 %, mode 2 by +0.30 %)"),
            "{}",
            left.sentence()
        );
    }
}
