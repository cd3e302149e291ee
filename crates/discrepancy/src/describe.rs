//! Causes as sentences and numbers for a reader of the diagnosis.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::cycle::Cycle;
use super::data::{Data, Values};
use super::effect::FittedEffect;
use super::fit::Fit;
use super::grammar::{Candidate, Class};
use super::mixture::Mixture;
use super::onset::in_words;
use super::rank::Ranked;
use super::target_name::{phrase, target_name, varying_phrase, TargetName};
use super::units::{covariate_unit, shown_unit, unit_of_number};
use structures::physics::deviation::DeviationKind;
use structures::physics::effect::Target;
use structures::simulator::law::{Input, LawKind};
use structures::simulator::Simulator;
use structures::stats;

/// Half the width of a 90 % interval of a normal distribution, in standard deviations.
const Z90: f64 = 1.644_853_626_951_472;

/// A number of a cause.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct NamedNumber {
    /// First `swing`, the effect range (the effect at the 95 % quantile of the covariate minus that at the 5 % quantile), or
    /// `size`; then the numbers of the law.
    pub name: String,
    /// Its unit; `share` for a fraction of the target.
    pub unit: String,
    /// Most probable value.
    pub value: f64,
    /// Ends of the 90 % interval.
    pub interval90: [f64; 2],
}

/// A cause as it is reported.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Cause {
    /// What changes.
    pub target: TargetName,
    /// Form of the law.
    pub law: LawKind,
    /// The covariate that it depends on; `null` for a constant.
    pub covariate: Option<String>,
    /// The cause in one sentence without capital and full stop.
    pub sentence: String,
    /// Posterior probability among all candidates and no further cause.
    pub probability: f64,
    /// Kind of cause.
    pub class: Class,
    /// Its numbers.
    pub parameters: Vec<NamedNumber>,
}

/// The class of a cause with these numbers: a change with time towards a stiffer structure is a rise.
fn class(candidate: &Candidate, numbers: &[NamedNumber]) -> Class {
    let change = |number: &&NamedNumber| ["size", "slope_per_unit"].contains(&number.name.as_str());
    let size = numbers.iter().find(change).map_or(0.0, |number| number.value);
    let softens =
        matches!(&candidate.target, Target::Deviation(deviation) if deviation.kind == DeviationKind::BaseRotation);
    match candidate.class {
        Class::PossibleDamage if (size > 0.0) != softens => Class::Rise,
        class => class,
    }
}

/// The effect range of an effect of a numeric covariate, otherwise its size, with its standard deviation.
///
/// ```text
///  R = g(c₉₅; ψ) − g(c₅; ψ),    std(R)² = aᵀ C a,    a = ∂R/∂ψ
/// ```
///
/// c₅, c₉₅: quantiles of the covariate; C: covariance of ψ, `[ψ, ψ]`. Units are those of the target.
fn effect_range(data: &Data, effect: &FittedEffect, psi: &[f64], covariance: &DMatrix<f64>) -> (f64, f64) {
    if psi.is_empty() {
        return (0.0, 0.0);
    }
    if matches!(effect.law.kind, LawKind::Product | LawKind::Cycle) {
        return range_over_rows(data, effect, psi, covariance);
    }
    let column = effect.law.covariate.as_deref().and_then(|name| data.column(name));
    let values = column.filter(|_| effect.law.kind != LawKind::Step).map(|c| &c.values);
    let Some(Values::Numbers(values)) = values else {
        return (psi[0], covariance[(0, 0)].max(0.0).sqrt());
    };
    let known: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    let at = |level: f64| {
        let mut slopes = vec![0.0; psi.len()];
        let value = effect.law.size(Input::Number(stats::quantile(&known, level)), psi, &mut slopes);
        (value, DVector::from_vec(slopes))
    };
    let ((low, low_slopes), (high, high_slopes)) = (at(0.05), at(0.95));
    let slopes = high_slopes - low_slopes;
    (high - low, (slopes.dot(&(covariance * &slopes))).max(0.0).sqrt())
}

/// The effect range of an effect of two covariates: its value at the 95 % quantile of its values over the rows minus that at the
/// 5 % quantile, with its standard deviation.
fn range_over_rows(data: &Data, effect: &FittedEffect, psi: &[f64], covariance: &DMatrix<f64>) -> (f64, f64) {
    let at = |input: &Input| {
        let mut slopes = vec![0.0; psi.len()];
        let value = effect.law.size(*input, psi, &mut slopes);
        (value, DVector::from_vec(slopes))
    };
    let inputs = data.inputs(&effect.law, None);
    let mut values: Vec<(f64, DVector<f64>)> = inputs.iter().filter(|i| **i != Input::Missing).map(at).collect();
    values.sort_by(|a, b| a.0.total_cmp(&b.0));
    let last = values.len().saturating_sub(1);
    let quantile = |level: f64| values.get((level * last as f64).round() as usize);
    let Some(((low, low_slopes), (high, high_slopes))) =
        quantile(0.05).zip(quantile(0.95)).map(|(a, b)| (a.clone(), b.clone()))
    else {
        return (0.0, 0.0);
    };
    let slopes = high_slopes - low_slopes;
    (high - low, slopes.dot(&(covariance * &slopes)).max(0.0).sqrt())
}

/// A ranked candidate in words and numbers; its effect is number `index` of `fit`. Covariances are divided by the share of
/// independent rows.
pub fn cause(
    simulator: &Simulator,
    data: &Data,
    ranked: &Ranked,
    fit: &Fit,
    index: usize,
    independent_share: f64,
) -> Cause {
    let (effect, psi) = (&fit.effects[index], &fit.psi[index]);
    // Correlated rows carry less information than the fit assumes.
    let covariance = fit.psi_covariance(index) / independent_share;
    let name = target_name(simulator, &ranked.candidate);
    if let Some(mixture) = &effect.mixture {
        return everywhere(simulator, ranked, (fit, index), mixture, independent_share, name);
    }
    let (unit, factor, shown_unit) = shown_unit(simulator, (effect, &name), &fit.mean);
    let (value, std) = effect_range(data, effect, psi, &covariance);
    let number = |name: String, unit: String, value: f64, std: f64| NamedNumber {
        name,
        unit,
        value,
        interval90: [value - Z90 * std, value + Z90 * std],
    };
    let over =
        effect.law.covariate.as_deref().map(|name| covariate_unit(simulator, name, data.time_unit)).unwrap_or_default();
    let numeric = matches!(
        effect.law.covariate.as_deref().and_then(|c| data.column(c)).map(|c| &c.values),
        Some(Values::Numbers(_))
    ) && effect.law.kind != LawKind::Step;
    let mut parameters = Vec::new();
    if !psi.is_empty() && !effect.target.is_switch() {
        let first = if numeric { "swing" } else { "size" };
        parameters.push(number(first.to_owned(), unit.clone(), value, std));
    }
    for (place, n) in effect.numbers.iter().enumerate() {
        if n.name == "size" {
            continue;
        }
        let unit = unit_of_number(&n.name, &effect.target, &unit, &over, data.time_unit);
        parameters.push(number(n.name.clone(), unit, psi[place], covariance[(place, place)].max(0.0).sqrt()));
    }
    if effect.law.kind == LawKind::Step {
        let at = effect.law.reference;
        parameters.push(NamedNumber {
            name: "time_days".to_owned(),
            unit: format!("{}s since the first", data.time_unit),
            value: at,
            interval90: effect.onset90.unwrap_or([at, at]),
        });
    }
    let wording = Wording {
        name: &name,
        effect,
        psi,
        covariance: &covariance,
        factor,
        unit: &shown_unit,
        over: &over,
        time_unit: data.time_unit,
        cycle: effect.law.covariate.as_deref().and_then(|name| data.column(name)?.origin.cycle()),
    };
    let sentence = wording.sentence((value, std));
    Cause {
        sentence,
        target: name,
        law: effect.law.kind,
        covariate: effect.law.covariate.clone(),
        probability: ranked.probability,
        class: class(&ranked.candidate, &parameters),
        parameters,
    }
}

/// A deviation of all parts in words, and as the change of the frequency of each mode under the most probable prior of the deviation.
///
/// ```text
///  Δ = aᵀ ẑ,    std(Δ)² = aᵀ P a / (share of independent rows),    a = ∂ ln f/∂z
/// ```
fn everywhere(
    simulator: &Simulator,
    ranked: &Ranked,
    (fit, index): (&Fit, usize),
    mixture: &Mixture,
    independent_share: f64,
    name: TargetName,
) -> Cause {
    let (effect, psi) = (&fit.effects[index], &fit.psi[index]);
    let targets = std::slice::from_ref(&effect.target);
    // The covariance is divided by the share afterwards: before, it would exceed that of the prior, and no information would be left.
    let posterior = mixture.posterior(psi, &fit.psi_covariance(index));
    let response = simulator.respond(&fit.mean, simulator.modes(), targets, psi);
    let mut parameters = Vec::new();
    if let (Some((sizes, covariance)), Ok(response)) = (posterior, response) {
        for (mode, hz) in response.frequencies_hz.iter().enumerate() {
            let slope = response.by_size.row(mode).transpose() / *hz;
            let (value, std) =
                (slope.dot(&sizes), (slope.dot(&(&covariance * &slope)) / independent_share).max(0.0).sqrt());
            let interval90 = [value - Z90 * std, value + Z90 * std];
            parameters.push(NamedNumber {
                name: format!("mode_{}", mode + 1),
                unit: "share".to_owned(),
                value,
                interval90,
            });
        }
    }
    let percent = |n: &NamedNumber| format!("mode {} by {:+.2} %", n.name.replace("mode_", ""), 100.0 * n.value);
    let modes: Vec<String> = parameters.iter().map(percent).map(|text| text.replace('-', "\u{2212}")).collect();
    Cause {
        sentence: format!("{}; its frequencies would have to change: {}", phrase(&name), modes.join(", ")),
        target: name,
        law: effect.law.kind,
        covariate: None,
        probability: ranked.probability,
        class: ranked.candidate.class,
        parameters,
    }
}

/// An effect with everything that its sentence needs.
struct Wording<'a> {
    name: &'a TargetName,
    effect: &'a FittedEffect,
    psi: &'a [f64],
    covariance: &'a DMatrix<f64>,
    /// From the unit of the target to `unit`.
    factor: f64,
    unit: &'a str,
    /// Unit of the covariate.
    over: &'a str,
    time_unit: &'a str,
    /// The cycle of the time that the effect follows.
    cycle: Option<Cycle>,
}

impl Wording<'_> {
    /// The sentence that describes the effect, given its size or effect range and the standard deviation of that value.
    fn sentence(&self, (value, std): (f64, f64)) -> String {
        let what =
            if self.effect.law.kind == LawKind::Constant { phrase(self.name) } else { varying_phrase(self.name) };
        let covariate = self.effect.law.covariate.as_deref().unwrap_or_default();
        let size = || self.plus_minus(value, std, self.unit);
        let changes = self.changes(value);
        match self.effect.law.kind {
            _ if self.name.kind == "mode_assignment" => format!("{what} differs from that of the data"),
            _ if self.name.kind == "mode_gain" => self.gain(&what),
            _ if self.effect.target.is_switch() => self.correction(&what),
            LawKind::Constant => self.constant(&what, value, &size()),
            LawKind::Step => {
                format!("{what} {} {} {}", self.verb(changes), size(), in_words(self.effect, self.time_unit))
            }
            LawKind::Category => match &self.name.level {
                Some(level) => format!("{what} {} {} where {covariate} is {level}", self.verb(changes), size()),
                None => format!("{what} differs with {covariate} ({})", self.each_category()),
            },
            LawKind::Linear | LawKind::Lagged => self.slope(&what, covariate),
            LawKind::Bilinear => self.two_slopes(&what, covariate),
            LawKind::Quadratic | LawKind::Exponential => {
                let shape = if self.effect.law.kind == LawKind::Quadratic { "quadratically" } else { "exponentially" };
                format!("{what} {changes} {} from the 5 % to the 95 % quantile of {covariate}, {shape}", size())
            }
            LawKind::Cycle => format!(
                "{what} swings with the {covariate}, by {} from the 5 % to the 95 % quantile of the effect, and is highest {}",
                size(),
                self.cycle.map_or_else(String::new, |cycle| cycle.highest_in_words(self.psi))
            ),
            LawKind::Product => {
                let on = if self.has_product() {
                    format!("two covariates together, {covariate}")
                } else {
                    format!("two covariates, {}, each for itself", covariate.replace(" × ", " and "))
                };
                format!(
                    "{what} depends on {on}: from the 5 % to the 95 % quantile of the effect it {changes} {}",
                    size()
                )
            }
        }
    }

    /// Whether the 90 % interval of the coefficient of a product excludes 0.
    fn has_product(&self) -> bool {
        let place = self.effect.numbers.iter().position(|n| n.name == "product_per_unit2");
        place.is_some_and(|place| self.psi[place].abs() > Z90 * self.covariance[(place, place)].max(0.0).sqrt())
    }

    /// The sentence of the gain of a mode.
    fn gain(&self, what: &str) -> String {
        let (gain, std) = rounded(1.0 + self.psi[0], self.covariance[(0, 0)].max(0.0).sqrt());
        format!("{what} is {gain} ± {std} times that of the simulation")
    }

    /// The sentence of a unit, a direction or an exchange of settings.
    fn correction(&self, what: &str) -> String {
        let finding = match (self.name.kind.as_str(), self.name.factor) {
            ("setting_unit", Some(factor)) if factor < 0.0 => {
                format!("{what} is wrong in its sign: the values must be multiplied by −1")
            }
            ("setting_unit", factor) => {
                let factor = factor.unwrap_or(1.0);
                format!("{what} is not that of the parameter: the values must be multiplied by {factor}")
            }
            ("setting_direction", _) => {
                let (sum, std) = rounded(self.psi[0], self.covariance[(0, 0)].max(0.0).sqrt());
                format!("{what} is opposite: it was measured from the other end, and the parameter is {sum} ± {std} {} minus the setting", self.unit)
            }
            _ => format!("{what} is exchanged"),
        };
        let law = &self.effect.law;
        let covariate = law.covariate.as_deref().unwrap_or_default();
        match (law.kind, &self.name.level) {
            (LawKind::Step, _) => format!("{finding} {}", in_words(self.effect, self.time_unit)),
            (_, Some(level)) => format!("{finding} where {covariate} is {level}"),
            _ => finding,
        }
    }

    /// `value ± std unit`; the verb of the sentence gives the sign, except for an added spring.
    fn plus_minus(&self, value: f64, std: f64, unit: &str) -> String {
        let size = if self.adds_spring() { value } else { value.abs() };
        let (value, std) = rounded(self.factor * size, self.factor * std);
        format!("{value} ± {std} {unit}")
    }

    fn adds_spring(&self) -> bool {
        self.name.kind == "added_spring"
    }

    /// The verb for a change of this sign.
    fn changes(&self, value: f64) -> &'static str {
        match value {
            _ if self.adds_spring() => "changes by",
            v if v < 0.0 => "falls by",
            _ => "rises by",
        }
    }

    /// The verb before a size; the size of an added spring is its stiffness, not a change.
    fn verb(&self, changes: &'static str) -> &'static str {
        if self.adds_spring() {
            "is"
        } else {
            changes
        }
    }

    /// The sentence of a constant effect.
    fn constant(&self, what: &str, value: f64, size: &str) -> String {
        if self.name.kind == "oscillator" {
            let (f, std) = rounded(self.psi[1], self.covariance[(1, 1)].max(0.0).sqrt());
            return format!("{what} has a mass of {size} and is tuned to {f} ± {std} Hz");
        }
        if self.adds_spring() {
            return format!("{what} is {size}");
        }
        if let Target::Deviation(deviation) = &self.effect.target {
            let std = self.covariance[(0, 0)].max(0.0).sqrt();
            // The size of a gradient is the logarithm of a ratio.
            let (percent, percent_std) = rounded(100.0 * value.exp_m1(), 100.0 * value.exp() * std);
            let percent = percent.replace('-', "\u{2212}");
            return match deviation.kind {
                DeviationKind::Bending | DeviationKind::BaseRotation => {
                    format!("{what} adds {size} to the deflection that a force at the last body causes there")
                }
                DeviationKind::SpreadMass => {
                    format!("{what}: {size} of each mass is spread evenly over the distance to the body before it")
                }
                DeviationKind::EndRestraint => format!("{what} add {size} to the stiffness of the first mode"),
                DeviationKind::AxialForce if value < 0.0 => {
                    format!("{what}, a compression, takes {size} from the stiffness of the first mode")
                }
                DeviationKind::AxialForce => {
                    format!("{what}, a tension, adds {size} to the stiffness of the first mode")
                }
                DeviationKind::Calibration => {
                    format!("{what}, from the first mode to the last by {percent} ± {percent_std} %")
                }
                DeviationKind::RotaryInertia => format!("{what} adds {size} to the mass of the first mode"),
                DeviationKind::StiffnessGradient | DeviationKind::MassGradient => {
                    format!("{what}, from the first part to the last by {percent} ± {percent_std} %, beside what the simulation has")
                }
            };
        }
        let more = if value < 0.0 { "lower" } else { "higher" };
        let reference = if self.name.kind == "setting" { "than the values given" } else { "than in the simulation" };
        format!("{what} is {size} {more} {reference}")
    }

    /// The size of the effect for each category.
    fn each_category(&self) -> String {
        let each = |(i, level): (usize, &String)| {
            let std = self.covariance[(i, i)].max(0.0).sqrt();
            let sign = if self.psi[i] < 0.0 { "−" } else { "+" };
            format!("{level}: {sign} {}", self.plus_minus(self.psi[i].abs(), std, self.unit))
        };
        self.effect.law.levels.iter().enumerate().map(each).collect::<Vec<_>>().join(", ")
    }

    /// The sentence of a linear effect, with or without a lag.
    fn slope(&self, what: &str, covariate: &str) -> String {
        let place = self.effect.numbers.iter().position(|n| n.name == "slope_per_unit").unwrap_or_default();
        let (slope, std) = (self.psi[place], self.covariance[(place, place)].max(0.0).sqrt());
        let later = match self.effect.lag() {
            Some(lag) => format!(", which it follows with a lag of {:.1} {}s", self.psi[lag], self.time_unit),
            None => String::new(),
        };
        let per = format!("{} per {}", self.unit, self.over);
        format!("{what} {} {} of {covariate}{later}", self.changes(slope), self.plus_minus(slope, std, &per))
    }

    /// The sentence of a bilinear effect.
    fn two_slopes(&self, what: &str, covariate: &str) -> String {
        let first = self.effect.numbers.len() - 3;
        let (below, above, knee) = (self.psi[first], self.psi[first + 1], self.psi[first + 2]);
        let (unit, over) = (self.unit, self.over);
        format!(
            "{what} changes by {:.3} {unit} per {over} of {covariate} below {knee:.1} {over} and by {:.3} {unit} per {over} above",
            self.factor * below,
            self.factor * above
        )
    }
}

/// A value and its standard deviation, rounded to two significant digits of the latter.
pub fn rounded(value: f64, std: f64) -> (String, String) {
    if !(std > 0.0 && std.is_finite()) {
        return (format!("{value:.4}"), "0".to_owned());
    }
    let digits = (1.0 - std.log10().floor()).clamp(0.0, 9.0) as usize;
    (format!("{value:.digits$}"), format!("{std:.digits$}"))
}
