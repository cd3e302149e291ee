//! Causes as sentences and numbers for a reader of the diagnosis.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::data::{Data, Values, TIME};
use super::effect::FittedEffect;
use super::fit::Fit;
use super::grammar::{Candidate, Class};
use super::rank::Ranked;
use crate::physics::effect::Target;
use crate::physics::{Form, Node};
use crate::simulator::law::{Input, LawKind};
use crate::simulator::Simulator;
use crate::stats;

/// Half the width of a 90 % interval of a normal distribution, in standard deviations.
const Z90: f64 = 1.644_853_626_951_472;

/// What a cause acts on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct TargetName {
    /// `spring`, `spring_group`, `mass`, `mass_group`, `frequency_scale`, `frequency_offset`, `setting`, `added_spring`,
    /// `oscillator`, `mode_assignment`; `beam` for the bending stiffness of a span, `parameter` for one of a table.
    pub kind: String,
    /// Name of the spring, mass, beam or parameter; `all` for a group of all; `mode 2` for one mode; empty for all modes.
    pub name: String,
    /// Nodes at the ends of an added spring.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub between: Option<[String; 2]>,
    /// The category that differs.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub level: Option<String>,
}

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

/// The name of a candidate's target.
pub fn target_name(simulator: &Simulator, candidate: &Candidate) -> TargetName {
    let structure = || simulator.structure().expect("targets with parts belong to a structure");
    let spring = |index: usize| structure().springs()[index].name.clone();
    let span = |index: usize| matches!(structure().springs()[index].form, Form::Bending(_));
    let node = |node: Node| structure().node_name(node).to_owned();
    let parameter = |column: usize| simulator.space().as_slice()[column].name.clone();
    let one_mode = |mode: &Option<usize>| mode.map_or_else(String::new, |m| format!("mode {}", m + 1));
    let mut between = None;
    let (kind, name) = match &candidate.target {
        Target::Springs(indices) if indices.len() == 1 && span(indices[0]) => ("beam", spring(indices[0])),
        Target::Springs(indices) if indices.len() == 1 => ("spring", spring(indices[0])),
        Target::Springs(indices) if indices.len() == structure().springs().len() => ("spring_group", "all".to_owned()),
        Target::Springs(indices) => {
            let same = |springs: &Vec<usize>| {
                springs.len() == indices.len() && springs.iter().all(|spring| indices.contains(spring))
            };
            let group = simulator.spring_groups().into_iter().find(|(_, springs)| same(springs));
            ("spring_group", group.map_or_else(|| "several".to_owned(), |(name, _)| name))
        }
        Target::Masses(indices) if indices.len() == 1 => ("mass", structure().masses()[indices[0]].name.clone()),
        Target::Masses(_) => ("mass_group", "all".to_owned()),
        Target::FrequencyScale(mode) => ("frequency_scale", one_mode(mode)),
        Target::FrequencyOffset(mode) => ("frequency_offset", one_mode(mode)),
        Target::SettingOffset(k) | Target::SettingScale(k) => ("setting", parameter(*k)),
        Target::ParameterScale(k) => ("parameter", parameter(*k)),
        Target::AddedSpring(from, to) => {
            between = Some([node(*from), node(*to)]);
            ("added_spring", String::new())
        }
        Target::AddedMass(dof) => ("added_mass", node(Node::Dof(*dof))),
        Target::Oscillator(host) => ("oscillator", node(Node::Dof(*host))),
        Target::ModeOrder(order) => ("mode_assignment", order_name(order)),
    };
    TargetName { kind: kind.to_owned(), name, between, level: candidate.level.clone() }
}

/// Name of an order of modes: which mode was overlooked, or which modes were swapped.
fn order_name(order: &[usize]) -> String {
    if let Some(skipped) = (0..order.len()).find(|m| order[*m] == m + 1 && !order.contains(m)) {
        return format!("mode {} overlooked", skipped + 1);
    }
    let swapped: Vec<String> =
        order.iter().enumerate().filter(|(i, m)| i != *m).map(|(i, _)| (i + 1).to_string()).collect();
    format!("modes {} swapped", swapped.join(" and "))
}

/// A target as the subject of a sentence.
fn phrase(name: &TargetName) -> String {
    let of = |what: &str| format!("{what} of {}", name.name);
    match name.kind.as_str() {
        "spring" => of("the stiffness"),
        "beam" => of("the bending stiffness"),
        "parameter" => format!("the parameter {}", name.name),
        "spring_group" if name.name == "all" => "the stiffness of all springs together".to_owned(),
        "spring_group" => of("the stiffness of the springs"),
        "mass" => format!("the mass {}", name.name),
        "mass_group" => "the mass of all bodies together".to_owned(),
        "frequency_scale" if name.name.is_empty() => "the scale of all measured frequencies".to_owned(),
        "frequency_scale" => of("the scale of the measured frequency"),
        "frequency_offset" if name.name.is_empty() => "the offset of all measured frequencies".to_owned(),
        "frequency_offset" => of("the offset of the measured frequency"),
        "setting" => format!("the setting {}", name.name),
        "added_spring" => {
            let [a, b] = name.between.clone().unwrap_or_default();
            format!("the stiffness of an additional spring between {a} and {b}")
        }
        "oscillator" => format!("an additional body on a spring attached to {}", name.name),
        _ => format!("the order of the modes ({})", name.name),
    }
}

/// Unit of the size of a target, and the factor and unit in which a sentence gives it.
fn unit(simulator: &Simulator, target: &Target) -> (String, f64, String) {
    let relative = || ("share".to_owned(), 100.0, "%".to_owned());
    let plain = |unit: &str| (unit.to_owned(), 1.0, unit.to_owned());
    match target {
        Target::FrequencyOffset(_) => plain("Hz"),
        Target::SettingOffset(k) => plain(&simulator.space().as_slice()[*k].unit),
        Target::AddedSpring(..) => plain("N/m"),
        Target::Oscillator(_) | Target::AddedMass(_) => plain("kg"),
        Target::ModeOrder(_) => plain(""),
        _ => relative(),
    }
}

/// Unit of a covariate, from the end of its name.
fn covariate_unit(name: &str, unit_of_time: &str) -> String {
    let last = name.rsplit('_').next().unwrap_or_default();
    match last {
        _ if name == TIME => unit_of_time,
        "c" | "degc" => "°C",
        "percent" => "%",
        "um" => "µm",
        "mm" => "mm",
        "m" => "m",
        "k" => "K",
        "kn" => "kN",
        "kg" => "kg",
        _ => "unit",
    }
    .to_owned()
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
    let (unit, factor, shown_unit) = unit(simulator, &effect.target);
    let (value, std) = effect_range(data, effect, psi, &covariance);
    let number = |name: String, unit: String, value: f64, std: f64| NamedNumber {
        name,
        unit,
        value,
        interval90: [value - Z90 * std, value + Z90 * std],
    };
    let over = effect.law.covariate.as_deref().map(|name| covariate_unit(name, data.time_unit)).unwrap_or_default();
    let numeric = matches!(
        effect.law.covariate.as_deref().and_then(|c| data.column(c)).map(|c| &c.values),
        Some(Values::Numbers(_))
    ) && effect.law.kind != LawKind::Step;
    let mut parameters = Vec::new();
    if !psi.is_empty() {
        let first = if numeric { "swing" } else { "size" };
        parameters.push(number(first.to_owned(), unit.clone(), value, std));
    }
    for (place, n) in effect.numbers.iter().enumerate() {
        let unit = match n.name.as_str() {
            "slope_per_unit" | "slope_below_per_unit" | "slope_above_per_unit" => format!("{unit} per {over}"),
            "curvature_per_unit2" => format!("{unit} per {over}²"),
            "rate_per_unit" => format!("1/{over}"),
            "knee" => over.clone(),
            "lag_days" => data.time_unit.to_owned(),
            "frequency_hz" => "Hz".to_owned(),
            "size" => continue,
            _ => unit.clone(),
        };
        parameters.push(number(n.name.clone(), unit, psi[place], covariance[(place, place)].max(0.0).sqrt()));
    }
    if effect.law.kind == LawKind::Step {
        let at = effect.law.reference;
        parameters.push(NamedNumber {
            name: "time_days".to_owned(),
            unit: format!("{}s since the first", data.time_unit),
            value: at,
            interval90: [at, at],
        });
    }
    let wording = Wording {
        name: &name,
        effect,
        psi,
        covariance: &covariance,
        factor,
        unit: &shown_unit,
        time_unit: data.time_unit,
    };
    let sentence = wording.sentence((value, std));
    Cause {
        sentence,
        target: name,
        law: effect.law.kind,
        covariate: effect.law.covariate.clone(),
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
    time_unit: &'a str,
}

impl Wording<'_> {
    /// The sentence that describes the effect, given its size or effect range and the standard deviation of that value.
    fn sentence(&self, (value, std): (f64, f64)) -> String {
        let what = phrase(self.name);
        let covariate = self.effect.law.covariate.as_deref().unwrap_or_default();
        let size = || self.plus_minus(value, std, self.unit);
        let changes = self.changes(value);
        match self.effect.law.kind {
            _ if self.name.kind == "mode_assignment" => format!("{what} differs from that of the data"),
            LawKind::Constant => self.constant(&what, value, &size()),
            LawKind::Step => {
                let (unit, at) = (self.time_unit, self.effect.law.reference);
                format!("{what} {} {} from {unit} {at:.0} of the data on", self.verb(changes), size())
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
        let more = if value < 0.0 { "lower" } else { "higher" };
        format!("{what} is {size} {more} than in the simulation")
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
        let per = format!("{} per {}", self.unit, covariate_unit(covariate, self.time_unit));
        format!("{what} {} {} of {covariate}{later}", self.changes(slope), self.plus_minus(slope, std, &per))
    }

    /// The sentence of a bilinear effect.
    fn two_slopes(&self, what: &str, covariate: &str) -> String {
        let first = self.effect.numbers.len() - 3;
        let (below, above, knee) = (self.psi[first], self.psi[first + 1], self.psi[first + 2]);
        let (unit, over) = (self.unit, covariate_unit(covariate, self.time_unit));
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
