//! Causes in words and numbers that people understand.

use nalgebra::DVector;
use serde::{Deserialize, Serialize};

use super::data::{Data, Values, TIME};
use super::grammar::{Candidate, Class};
use super::model::{Effect, Fit};
use super::select::Ranked;
use crate::physics::effect::Target;
use crate::physics::{Form, Node};
use crate::simulator::law::{Input, LawKind};
use crate::simulator::Simulator;
use crate::stats;

/// Standard deviations to the edge of a 90 % interval.
const Z90: f64 = 1.644_853_626_951_472;

/// What a cause acts on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct TargetName {
    /// `spring`, `spring_group`, `mass`, `mass_group`, `frequency_scale`, `frequency_offset`, `setting`, `added_spring`,
    /// `oscillator`, `mode_assignment`; `beam` for the bending stiffness of a span, `parameter` for one of a table.
    pub kind: String,
    /// Spring, mass, beam, parameter; `all` for a group of all; `mode 2` for one mode; empty for all modes.
    pub name: String,
    /// Nodes of an added spring.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub between: Option<[String; 2]>,
    /// Category that differs.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub level: Option<String>,
}

/// A number of a cause.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct NamedNumber {
    /// `swing` over the middle 90 % of the covariate or `size`, then the numbers of the law.
    pub name: String,
    /// Its unit; `share` of the target where it is relative.
    pub unit: String,
    /// Most probable value.
    pub value: f64,
    /// 90 % interval.
    pub interval90: [f64; 2],
}

/// A cause, as the report gives it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Cause {
    /// What changes.
    pub target: TargetName,
    /// Form of the law.
    pub law: LawKind,
    /// Under which covariate; `null` for a constant.
    pub covariate: Option<String>,
    /// For people.
    pub sentence: String,
    /// Probability among all candidates and none.
    pub probability: f64,
    /// Kind of cause.
    pub class: Class,
    /// Its numbers.
    pub parameters: Vec<NamedNumber>,
}

/// Name of a target.
pub fn target_name(simulator: &Simulator, candidate: &Candidate) -> TargetName {
    let structure = || simulator.structure().expect("only a structure has parts to name");
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
        Target::Oscillator(host) => ("oscillator", node(Node::Dof(*host))),
        Target::ModeOrder(order) => ("mode_assignment", order_name(order)),
    };
    TargetName { kind: kind.to_owned(), name, between, level: candidate.level.clone() }
}

fn order_name(order: &[usize]) -> String {
    if let Some(skipped) = (0..order.len()).find(|m| order[*m] == m + 1 && !order.contains(m)) {
        return format!("mode {} overlooked", skipped + 1);
    }
    let swapped: Vec<String> =
        order.iter().enumerate().filter(|(i, m)| i != *m).map(|(i, _)| (i + 1).to_string()).collect();
    format!("modes {} swapped", swapped.join(" and "))
}

/// What a person calls a target.
pub fn phrase(name: &TargetName) -> String {
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
        "frequency_offset" if name.name.is_empty() => "an offset of all measured frequencies".to_owned(),
        "frequency_offset" => of("an offset of the measured frequency"),
        "setting" => format!("the setting {}", name.name),
        "added_spring" => {
            let [a, b] = name.between.clone().unwrap_or_default();
            format!("a spring between {a} and {b} that the simulation does not have")
        }
        "oscillator" => format!("a body on a spring attached to {} that the simulation does not have", name.name),
        _ => format!("the order of the modes ({})", name.name),
    }
}

/// Unit of the size of a target, and the factor and unit in which people read it.
fn unit(simulator: &Simulator, target: &Target) -> (String, f64, String) {
    let relative = || ("share".to_owned(), 100.0, "%".to_owned());
    let plain = |unit: &str| (unit.to_owned(), 1.0, unit.to_owned());
    match target {
        Target::FrequencyOffset(_) => plain("Hz"),
        Target::SettingOffset(k) => plain(&simulator.space().as_slice()[*k].unit),
        Target::AddedSpring(..) => plain("N/m"),
        Target::Oscillator(_) => plain("kg"),
        Target::ModeOrder(_) => plain(""),
        _ => relative(),
    }
}

/// Unit of a covariate, from the end of its name.
pub fn covariate_unit(name: &str, unit_of_time: &str) -> String {
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

/// The swing or size of an effect and its standard deviation.
pub fn headline(data: &Data, effect: &Effect, psi: &[f64], covariance: &nalgebra::DMatrix<f64>) -> (f64, f64) {
    if psi.is_empty() {
        return (0.0, 0.0);
    }
    let column = effect.law.covariate.as_deref().and_then(|name| data.column(name));
    let swings = column.filter(|_| effect.law.kind != LawKind::Step).map(|c| &c.values);
    let Some(Values::Numbers(values)) = swings else {
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

/// A ranked candidate in words and numbers; `fit` has its effect at `index`.
pub fn cause(
    simulator: &Simulator,
    data: &Data,
    ranked: &Ranked,
    fit: &Fit,
    index: usize,
    independent_share: f64,
) -> Cause {
    let (effect, psi) = (&fit.effects[index], &fit.psi[index]);
    // Rows that follow one another are worth fewer.
    let covariance = fit.psi_covariance(index) / independent_share;
    let name = target_name(simulator, &ranked.candidate);
    let (unit, factor, shown_unit) = unit(simulator, &effect.target);
    let (value, std) = headline(data, effect, psi, &covariance);
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
    let sentence = sentence(&name, effect, psi, &covariance, (value, std), (factor, &shown_unit, data.time_unit));
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

fn sentence(
    name: &TargetName,
    effect: &Effect,
    psi: &[f64],
    covariance: &nalgebra::DMatrix<f64>,
    (value, std): (f64, f64),
    (factor, unit, time_unit): (f64, &str, &str),
) -> String {
    let what = phrase(name);
    let plus_minus = |value: f64, std: f64, unit: &str| {
        // "Falls by" has the sign already; an added spring has none to change.
        let size = if name.kind == "added_spring" { value } else { value.abs() };
        let (value, std) = rounded(factor * size, factor * std);
        format!("{value} ± {std} {unit}")
    };
    let changes = |value: f64| match (name.kind.as_str(), value < 0.0) {
        ("added_spring", _) => "acts with",
        (_, true) => "falls by",
        (_, false) => "rises by",
    };
    let covariate = effect.law.covariate.clone().unwrap_or_default();
    let over = covariate_unit(&covariate, time_unit);
    let slope = || effect.numbers.iter().position(|n| n.name == "slope_per_unit");
    match effect.law.kind {
        _ if name.kind == "mode_assignment" => format!("{what} is not the one the data have"),
        LawKind::Constant if name.kind == "oscillator" => {
            let hz = covariance[(1, 1)].max(0.0).sqrt();
            let (f, f_std) = rounded(psi[1], hz);
            format!("{what} has {}, tuned to {f} ± {f_std} Hz", plus_minus(value, std, unit))
        }
        LawKind::Constant if name.kind == "added_spring" => format!("{what} has {}", plus_minus(value, std, unit)),
        LawKind::Constant => {
            let more = if value < 0.0 { "less" } else { "more" };
            format!("{what} is {} {more} than the simulation has", plus_minus(value, std, unit))
        }
        LawKind::Step => format!(
            "{what} {} {} from {time_unit} {:.0} of the data on",
            changes(value),
            plus_minus(value, std, unit),
            effect.law.reference
        ),
        LawKind::Category => {
            if let Some(level) = &name.level {
                let size = plus_minus(value, std, unit);
                return format!("{what} {} {size} where {covariate} is {level}", changes(value));
            }
            let each = |(i, level): (usize, &String)| {
                let std = covariance[(i, i)].max(0.0).sqrt();
                format!("{level}: {} {}", if psi[i] < 0.0 { "−" } else { "+" }, plus_minus(psi[i], std, unit))
            };
            let each: Vec<String> = effect.law.levels.iter().enumerate().map(each).collect();
            format!("{what} differs with {covariate} ({})", each.join(", "))
        }
        LawKind::Linear | LawKind::Lagged => {
            let place = slope().unwrap_or_default();
            let (slope, slope_std) = (psi[place], covariance[(place, place)].max(0.0).sqrt());
            let later = match effect.lag() {
                Some(lag) => format!(", following it with a lag of {:.1} {time_unit}s", psi[lag]),
                None => String::new(),
            };
            let per = format!("{unit} per {over}");
            format!("{what} {} {} of {covariate}{later}", changes(slope), plus_minus(slope, slope_std, &per))
        }
        LawKind::Bilinear => {
            let first = effect.numbers.len() - 3;
            let (below, above, knee) = (psi[first], psi[first + 1], psi[first + 2]);
            format!(
                "{what} changes by {:.3} {unit} per {over} of {covariate} below {knee:.1} {over} and by {:.3} above",
                factor * below,
                factor * above
            )
        }
        LawKind::Quadratic | LawKind::Exponential => {
            let shape = if effect.law.kind == LawKind::Quadratic { "quadratically" } else { "exponentially" };
            let size = plus_minus(value, std, unit);
            format!("{what} {} {size} from low to high {covariate}, {shape}", changes(value))
        }
    }
}

/// A value and its standard deviation with two digits of the latter.
pub fn rounded(value: f64, std: f64) -> (String, String) {
    if !(std > 0.0 && std.is_finite()) {
        return (format!("{value:.4}"), "0".to_owned());
    }
    let digits = (1.0 - std.log10().floor()).clamp(0.0, 9.0) as usize;
    (format!("{value:.digits$}"), format!("{std:.digits$}"))
}
