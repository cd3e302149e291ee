//! Showing: where residuals, and what free parameters absorbed, go with a covariate; and what is left when nothing more
//! can be named.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use statrs::distribution::{ChiSquared, ContinuousCDF as _, FisherSnedecor};

use super::data::{Data, Values, TIME};
use super::model::{Fit, Study};
use super::screen::Whitened;
use crate::physics::effect::Target;
use crate::simulator::law::lagged;
use crate::stats;

/// Shape of one misfit: a mode's residual, or a parameter's drift, over a covariate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Misfit {
    /// Mode, from 1, whose frequencies deviate.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mode: Option<usize>,
    /// Parameter that took up the deviation.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub parameter: Option<String>,
    /// Covariate it goes with; `null` for a constant deviation.
    pub covariate: Option<String>,
    /// Range of the fitted curve over the covariate, per cent of the frequency or stiffness.
    pub size_percent: f64,
    /// Probability of as much by chance, times the number of looks, at most 1.
    pub p_value: f64,
}

/// What the best explanation leaves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Remainder {
    /// Function of the covariates that it goes with, such as `temperature_c × humidity_percent`.
    pub function: String,
    /// Covariates of the function.
    pub covariates: Vec<String>,
    /// Range of the remainder along the function by mode, per cent of the frequency.
    pub size_percent: Vec<f64>,
    /// Probability of as much by chance, times the number of looks, at most 1.
    pub p_value: f64,
}

/// Misfit of a fit by mode and covariate and by parameter and covariate, the clearest first.
pub fn misfits(study: &Study<'_>, rows: &[usize], fit: &Fit) -> Option<Vec<Misfit>> {
    let views = study.view(rows, fit)?;
    let space = study.simulator.space();
    let mut series: Vec<(Option<usize>, Option<String>, Vec<f64>)> = Vec::new();
    for mode in 0..study.simulator.modes() {
        let value =
            |v: &super::model::RowView| v.present.iter().position(|m| *m == mode).map_or(f64::NAN, |i| v.residual[i]);
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
            let basis = regressors(&column.values, rows);
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
    let looks = found.len() as f64;
    for misfit in &mut found {
        misfit.p_value = (misfit.p_value * looks).min(1.0);
    }
    found.sort_by(|a, b| a.p_value.total_cmp(&b.p_value).then(b.size_percent.abs().total_cmp(&a.size_percent.abs())));
    Some(found)
}

/// Functions of one covariate that a residual is regressed on, beside a constant: u and u², or a column for each category.
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
            // Of two values only, the square says nothing new.
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

/// Values minus their mean over their standard deviation, missing ones 0; empty for a constant.
fn standardised(values: &[f64]) -> Vec<f64> {
    let known: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    let (mean, std) = (stats::mean(&known), stats::sample_std(&known).unwrap_or(0.0));
    let size = known.iter().fold(0.0, |a: f64, v| a.max(v.abs()));
    if std <= 1e-9 * size || std == 0.0 {
        return Vec::new();
    }
    values.iter().map(|v| if v.is_finite() { (v - mean) / std } else { 0.0 }).collect()
}

/// Range of the fitted curve and the p-value of an F test, for as many rows as the residual's correlation in time is worth.
fn regression(values: &[f64], basis: &[Vec<f64>]) -> Option<(f64, f64)> {
    let known: Vec<usize> = (0..values.len()).filter(|i| values[*i].is_finite()).collect();
    let (n, q) = (known.len(), basis.len());
    if n < 5 * (q + 1) {
        return None;
    }
    // Gross outliers would rule the sum of squares: everything beyond five robust deviations counts as that.
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

fn constant(values: &[f64]) -> Option<(f64, f64)> {
    let known = clip(&values.iter().copied().filter(|v| v.is_finite()).collect::<Vec<f64>>());
    let (mean, std) = (stats::mean(&known), stats::sample_std(&known)?);
    let z = mean / (std / (known.len() as f64).sqrt()).max(f64::MIN_POSITIVE);
    Some((mean, 2.0 * stats::normal_cdf(-z.abs())))
}

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

fn lag_one(values: &[f64]) -> f64 {
    let squares: f64 = values.iter().map(|v| v * v).sum();
    values.windows(2).map(|w| w[0] * w[1]).sum::<f64>() / squares.max(f64::MIN_POSITIVE)
}

/// What the residuals of a fit still go with, over functions of all covariates that no candidate of the grammar need have,
/// with an arbitrary response of each mode; the clearest.
pub fn remainder(study: &Study<'_>, rows: &[usize], fit: &Fit, independent_share: f64) -> Option<Option<Remainder>> {
    let views = study.view(rows, fit)?;
    let whitened = Whitened::new(study, rows, fit, &views)?;
    let modes = study.simulator.modes();
    // Along the targets of the causes found, where a wrong law shows first; an oscillator has no such direction.
    let mut targets: Vec<Target> = fit.effects.iter().map(|e| e.target.clone()).collect();
    targets.retain(|t| t.sizes() == 1);
    let directions = study.directions(rows, fit, &targets)?;
    let sums = |column: usize| whitened.sums(|place, mode| directions[place][(mode, column)]);
    let along: Vec<_> = (0..targets.len()).map(sums).collect();
    let of_modes = whitened.mode_sums(modes);
    let functions = functions(study.data, rows);
    let looks = (functions.len() * (1 + targets.len())) as f64;
    let mut best: Option<(Remainder, f64)> = None;
    for (function, covariates, values) in functions {
        let range = stats::quantile(&values, 0.95) - stats::quantile(&values, 0.05);
        let values = DVector::from_vec(values);
        let free = whitened.free_score(&of_modes, &values);
        let mut tests: Vec<(f64, usize, Vec<f64>)> =
            vec![(free.nats, free.numbers, free.psi.iter().map(|s| 100.0 * s * range).collect())];
        for (column, sums) in along.iter().enumerate() {
            let score = whitened.score(sums, &[&values]);
            let mean =
                |mode: usize| directions.iter().map(|d| d[(mode, column)]).sum::<f64>() / directions.len() as f64;
            let sizes = (0..modes).map(|mode| 100.0 * score.psi[0] * range * mean(mode)).collect();
            tests.push((score.nats, score.numbers, sizes));
        }
        for (nats, numbers, size_percent) in tests.into_iter().filter(|t| t.1 > 0) {
            let chi = ChiSquared::new(numbers as f64).ok()?;
            let p_value = (chi.sf(2.0 * nats * independent_share) * looks).min(1.0);
            // Probabilities below 1e-308 are all 0: the statistic goes on.
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

/// What follows a covariate with play: it stays until the covariate has moved by `width` from where it turned.
fn play(values: &[f64], width: f64) -> Vec<f64> {
    let mut state = values.first().copied().unwrap_or(0.0);
    let follow = |value: &f64| {
        state = state.clamp(value - width, value + width);
        state
    };
    values.iter().map(follow).collect()
}

/// Functions of the covariates: powers, kinks, products of two, differences to a lag, categories and their products.
fn functions(data: &Data, rows: &[usize]) -> Vec<(String, Vec<String>, Vec<f64>)> {
    let mut numeric: Vec<(String, Vec<f64>)> = Vec::new();
    let mut categories: Vec<(String, String, Vec<f64>)> = Vec::new();
    let mut found: Vec<(String, Vec<String>, Vec<f64>)> = Vec::new();
    for column in &data.columns {
        match &column.values {
            Values::Numbers(values) => {
                let unit = standardised(&rows.iter().map(|r| values[*r]).collect::<Vec<f64>>());
                if unit.is_empty() {
                    continue;
                }
                let name = &column.name;
                let mut add = |label: String, values: Vec<f64>| found.push((label, vec![name.clone()], values));
                add(name.clone(), unit.clone());
                add(format!("{name}²"), unit.iter().map(|u| u * u - 1.0).collect());
                add(format!("{name}³"), unit.iter().map(|u| u.powi(3) - 3.0 * u).collect());
                for level in [0.15, 0.85] {
                    let knee = stats::quantile(&unit, level);
                    let beyond = |u: &f64| if level < 0.5 { (knee - u).max(0.0) } else { (u - knee).max(0.0) };
                    add(
                        format!("{name} beyond its {:.0} % quantile", 100.0 * level),
                        unit.iter().map(beyond).collect(),
                    );
                }
                if *name != TIME {
                    for width in [0.3, 0.6, 1.0] {
                        let play = standardised(&play(&unit, width));
                        if !play.is_empty() {
                            add(format!("play of {name} (hysteresis)"), play);
                        }
                    }
                    let span = data.times_days.last().copied().unwrap_or(0.0).max(1e-6);
                    for divisor in [300.0, 60.0, 15.0] {
                        let followed = lagged(&data.times_days, values, span / divisor);
                        let difference: Vec<f64> = rows.iter().map(|r| values[*r] - followed[*r].0).collect();
                        let difference = standardised(&difference);
                        if !difference.is_empty() {
                            let days = span / divisor;
                            let signed = difference.iter().map(|d| d.signum()).collect();
                            add(format!("rise or fall of {name} within {days:.1} days"), difference);
                            add(format!("direction of {name} over {days:.1} days"), signed);
                        }
                    }
                }
                numeric.push((name.clone(), unit));
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
