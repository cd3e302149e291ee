//! The unknown parameters θ of a structure: names, units, priors, and the column order of every θ matrix.

use std::f64::consts::PI;
use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::stats::{normal_cdf, normal_quantile};

/// Where a normal prior ends, in standard deviations from its mean; a log-normal one in those of the logarithm from the median. It
/// leaves out 6 of 100,000 values.
pub const PRIOR_REACH: f64 = 4.0;

/// Level of a prior with tails below which, and above one minus which, a value is far out in the tail: that of three standard
/// deviations of a normal distribution.
const TAIL_LEVEL: f64 = 0.00135;

/// Share of the width of a uniform prior within which a value lies at a bound.
const BOUND_MARGIN: f64 = 0.01;

/// Precision of a uniform prior of a position in the box: one over its variance 1/12.
const UNIFORM_PRECISION: f64 = 12.0;

/// Name of a change of all frequencies by one factor, beside the changes of parameters. No parameter can have a colon in its name.
pub const ALL_FREQUENCIES: &str = "structure:frequencies";

/// Name of a change of the misfit: of the frequencies, as no change of parameters changes them.
pub const MISFIT: &str = "structure:misfit";

/// The name of a monitored quantity as people read it: `spring:k12`, a stiffness that follows from a parameter by a law, is the "stiffness of
/// spring k12", and `group:k1+k2`, parameters that the measurements cannot tell apart, is "k1 and k2 together". A parameter is itself.
pub fn in_words(quantity: &str) -> String {
    match quantity.split_once(':') {
        Some(("spring", name)) => format!("stiffness of spring {name}"),
        Some(("group", names)) => format!("{} together", names.replace('+', " and ")),
        _ if quantity == ALL_FREQUENCIES => "all frequencies".to_owned(),
        _ if quantity == MISFIT => "frequencies that no parameter explains".to_owned(),
        _ => quantity.to_owned(),
    }
}

/// Direction of change of a parameter that is damage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DamageDirection {
    /// A decrease: P(x < δ). This is the default, because damage reduces stiffness.
    #[default]
    Decrease,
    /// An increase: P(x > δ).
    Increase,
    /// No change is damage: the parameter is only estimated.
    None,
}

/// Form of a prior between the bounds of a parameter.
///
/// ```text
///  uniform      p(x) ∝ 1
///  normal       p(x) ∝ exp(−z²/2),      z = (x − mean)/std
///  log-normal   p(x) ∝ exp(−z²/2)/x,    z = ln(x/median)/ln_std
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PriorForm {
    /// Constant.
    #[default]
    Uniform,
    /// Normal.
    Normal {
        /// Mean, in the unit of the parameter.
        mean: f64,
        /// Standard deviation, in the unit of the parameter.
        std: f64,
    },
    /// Log-normal.
    LogNormal {
        /// Median, in the unit of the parameter.
        median: f64,
        /// Standard deviation of ln x.
        ln_std: f64,
    },
}

impl PriorForm {
    /// The standard score z of a value; 0 for a uniform prior.
    fn score(self, value: f64) -> f64 {
        match self {
            Self::Uniform => 0.0,
            Self::Normal { mean, std } => (value - mean) / std,
            Self::LogNormal { median, ln_std } => (value / median).ln() / ln_std,
        }
    }
}

/// An unknown parameter with its prior between `lower` and `upper`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Parameter {
    /// Unique name.
    pub name: String,
    /// Unit of the value, for display.
    pub unit: String,
    /// Lower bound of the prior, in `unit`.
    pub lower: f64,
    /// Upper bound of the prior, in `unit`.
    pub upper: f64,
    /// Direction of change that is damage.
    pub damage: DamageDirection,
    /// Form of the prior between its bounds.
    #[serde(default, skip_serializing_if = "is_uniform")]
    pub form: PriorForm,
}

fn is_uniform(form: &PriorForm) -> bool {
    *form == PriorForm::Uniform
}

impl Parameter {
    /// The interval of the prior.
    pub fn prior(&self) -> Range<f64> {
        self.lower..self.upper
    }

    /// Whether relative changes of the parameter are meaningful: the prior does not include 0.
    pub fn has_share(&self) -> bool {
        self.lower > 0.0 || self.upper < 0.0
    }

    /// Position of a value in the prior interval: 0 at `lower`, 1 at `upper`.
    pub fn to_unit(&self, value: f64) -> f64 {
        (value - self.lower) / (self.upper - self.lower)
    }

    /// The value at a position in the prior interval, the inverse of [`Self::to_unit`].
    pub fn from_unit(&self, position: f64) -> f64 {
        self.lower + position * (self.upper - self.lower)
    }

    /// Whether the prior is uniform.
    pub fn is_uniform(&self) -> bool {
        self.form == PriorForm::Uniform
    }

    /// Standard scores of the bounds and Φ at them; only for a prior that is not uniform.
    fn ends(&self) -> ([f64; 2], [f64; 2]) {
        let scores = [self.form.score(self.lower), self.form.score(self.upper)];
        (scores, scores.map(normal_cdf))
    }

    /// Cumulative distribution of the prior, 0 at `lower` and 1 at `upper`. Values outside are treated as the nearest bound.
    pub fn level(&self, value: f64) -> f64 {
        let value = value.clamp(self.lower, self.upper);
        if self.is_uniform() {
            return self.to_unit(value);
        }
        let (_, [low, high]) = self.ends();
        (normal_cdf(self.form.score(value)) - low) / (high - low)
    }

    /// Quantile of the prior, the inverse of [`Self::level`].
    pub fn at_level(&self, level: f64) -> f64 {
        let score = || {
            let (_, [low, high]) = self.ends();
            normal_quantile(low + level * (high - low))
        };
        match self.form {
            PriorForm::Uniform => self.from_unit(level),
            PriorForm::Normal { mean, std } => (mean + std * score()).clamp(self.lower, self.upper),
            PriorForm::LogNormal { median, ln_std } => {
                (median * (ln_std * score()).exp()).clamp(self.lower, self.upper)
            }
        }
    }

    /// Logarithm of the density of the prior in the unit box, nats: 0 for a uniform one. Values outside are treated as the nearest
    /// bound.
    ///
    /// ```text
    ///  p(u) = p(x) (upper − lower),    ∫₀¹ p(u) du = 1
    /// ```
    pub fn log_prior(&self, value: f64) -> f64 {
        let value = value.clamp(self.lower, self.upper);
        let scale = match self.form {
            PriorForm::Uniform => return 0.0,
            PriorForm::Normal { std, .. } => std,
            PriorForm::LogNormal { ln_std, .. } => ln_std * value,
        };
        let (_, [low, high]) = self.ends();
        let score = self.form.score(value);
        -0.5 * (score * score + (2.0 * PI).ln()) - (scale * (high - low) / (self.upper - self.lower)).ln()
    }

    /// Density of the prior, in one over the unit of the parameter; 0 outside the bounds.
    pub fn prior_density(&self, value: f64) -> f64 {
        if (self.lower..=self.upper).contains(&value) {
            self.log_prior(value).exp() / (self.upper - self.lower)
        } else {
            0.0
        }
    }

    /// Median of the prior, in its unit.
    pub fn prior_median(&self) -> f64 {
        match self.form {
            PriorForm::Uniform => f64::midpoint(self.lower, self.upper),
            PriorForm::Normal { .. } | PriorForm::LogNormal { .. } => self.at_level(0.5),
        }
    }

    /// Mean and variance of the position in the box under the prior: ½ and 1/12 for a uniform one, otherwise those of the normal
    /// distribution on an interval.
    ///
    /// ```text
    ///  normal       E z = (φ(a) − φ(b))/P,    Var z = 1 + (a φ(a) − b φ(b))/P − (E z)²,    P = Φ(b) − Φ(a)
    ///  log-normal   E xʳ = medianʳ exp(r² s²/2) (Φ(b − r s) − Φ(a − r s))/P,    s = ln_std
    /// ```
    ///
    /// a, b: the standard scores of the bounds.
    fn box_moments(&self) -> (f64, f64) {
        let width = self.upper - self.lower;
        let ([a, b], [low, high]) = self.ends();
        let share = high - low;
        match self.form {
            PriorForm::Uniform => (0.5, 1.0 / UNIFORM_PRECISION),
            PriorForm::Normal { mean, std } => {
                let density = |z: f64| (-0.5 * z * z).exp() / (2.0 * PI).sqrt();
                let of_score = (density(a) - density(b)) / share;
                let variance = 1.0 + (a * density(a) - b * density(b)) / share - of_score * of_score;
                (self.to_unit(mean + std * of_score), variance * (std / width).powi(2))
            }
            PriorForm::LogNormal { median, ln_std } => {
                let moment = |r: f64| {
                    let inside = normal_cdf(b - r * ln_std) - normal_cdf(a - r * ln_std);
                    median.powf(r) * (0.5 * (r * ln_std).powi(2)).exp() * inside / share
                };
                let mean = moment(1.0);
                (self.to_unit(mean), (moment(2.0) - mean * mean) / (width * width))
            }
        }
    }

    /// Mean of the position in the box under the prior.
    pub fn box_mean(&self) -> f64 {
        self.box_moments().0
    }

    /// One over the variance of the position in the box under the prior: 12 for a uniform one.
    pub fn box_precision(&self) -> f64 {
        match self.form {
            PriorForm::Uniform => UNIFORM_PRECISION,
            PriorForm::Normal { .. } | PriorForm::LogNormal { .. } => self.box_moments().1.recip(),
        }
    }

    /// Variance of the prior, in its unit squared.
    pub fn prior_variance(&self) -> f64 {
        (self.upper - self.lower).powi(2) / self.box_precision()
    }

    /// Standard deviation of the prior, in its unit.
    pub fn prior_std(&self) -> f64 {
        (self.upper - self.lower) / self.box_precision().sqrt()
    }

    /// Mean and standard deviation of a normal distribution in place of the prior, in its unit: for a uniform one the middle and half
    /// the width, so that the bounds are one standard deviation away; for the others those of the prior.
    pub fn as_normal(&self) -> (f64, f64) {
        match self.form {
            PriorForm::Uniform => (f64::midpoint(self.lower, self.upper), 0.5 * (self.upper - self.lower)),
            PriorForm::Normal { mean, std } => (mean, std),
            PriorForm::LogNormal { .. } => (self.from_unit(self.box_mean()), self.prior_std()),
        }
    }

    /// Whether a value lies where the prior ends: within 1 % of the width from a bound of a uniform prior; for a prior with tails as
    /// far out as three standard deviations of a normal distribution.
    pub fn is_at_end(&self, value: f64) -> bool {
        let (position, margin) =
            if self.is_uniform() { (self.to_unit(value), BOUND_MARGIN) } else { (self.level(value), TAIL_LEVEL) };
        !(margin..=1.0 - margin).contains(&position)
    }
}

/// The parameters in the column order of every θ matrix. Names are unique and each prior has `lower < upper`, which the check of
/// the structure file guarantees.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct ParameterSpace {
    parameters: Vec<Parameter>,
}

impl ParameterSpace {
    /// A space of parameters that have been checked.
    pub fn new(parameters: Vec<Parameter>) -> Self {
        Self { parameters }
    }

    /// Number of parameters d.
    pub fn len(&self) -> usize {
        self.parameters.len()
    }

    /// Whether there are no parameters.
    pub fn is_empty(&self) -> bool {
        self.parameters.is_empty()
    }

    /// The parameters in column order.
    pub fn iter(&self) -> std::slice::Iter<'_, Parameter> {
        self.parameters.iter()
    }

    /// The parameters in column order, as a slice.
    pub fn as_slice(&self) -> &[Parameter] {
        &self.parameters
    }

    /// Whether all priors are uniform.
    pub fn is_uniform(&self) -> bool {
        self.parameters.iter().all(Parameter::is_uniform)
    }

    /// Logarithm of the density of the prior in the unit box at `theta`, `[d]`, nats: the sum over the parameters.
    pub fn log_prior<'a>(&self, theta: impl IntoIterator<Item = &'a f64>) -> f64 {
        self.parameters.iter().zip(theta).map(|(parameter, value)| parameter.log_prior(*value)).sum()
    }

    /// Column of a named parameter.
    pub fn position(&self, name: &str) -> Option<usize> {
        self.parameters.iter().position(|p| p.name == name)
    }
}

impl<'a> IntoIterator for &'a ParameterSpace {
    type Item = &'a Parameter;
    type IntoIter = std::slice::Iter<'a, Parameter>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parameter(lower: f64, upper: f64, form: PriorForm) -> Parameter {
        let (name, unit) = ("k1".to_owned(), "N/m".to_owned());
        Parameter { name, unit, lower, upper, damage: DamageDirection::Decrease, form }
    }

    /// Each form, also with bounds that are not symmetric.
    fn all() -> Vec<Parameter> {
        let log_normal = PriorForm::LogNormal { median: 50.0, ln_std: 0.4 };
        vec![
            parameter(3.0, 7.0, PriorForm::Uniform),
            parameter(60.0, 140.0, PriorForm::Normal { mean: 100.0, std: 10.0 }),
            parameter(95.0, 140.0, PriorForm::Normal { mean: 100.0, std: 10.0 }),
            parameter(50.0 * (-1.6_f64).exp(), 50.0 * 1.6_f64.exp(), log_normal),
            parameter(20.0, 60.0, log_normal),
        ]
    }

    #[test]
    fn level_and_quantile_are_inverse_and_the_density_is_the_slope_of_the_level() {
        for p in all() {
            assert!(p.level(p.lower).abs() < 1e-15 && (p.level(p.upper) - 1.0).abs() < 1e-15, "{p:?}");
            for i in 1..100 {
                let level = f64::from(i) / 100.0;
                let x = p.at_level(level);
                assert!((p.level(x) - level).abs() < 1e-9, "{p:?} at {level}");
                assert!((p.from_unit(p.to_unit(x)) - x).abs() < 1e-12 * x);
                let step = 1e-4 * (p.upper - p.lower);
                if x - step < p.lower || x + step > p.upper {
                    continue;
                }
                let slope = (p.level(x + step) - p.level(x - step)) / (2.0 * step);
                assert!((p.prior_density(x) / slope - 1.0).abs() < 1e-4, "{p:?} at {x}: {slope}");
            }
            assert!(p.prior_density(p.lower - 1e-6).max(p.prior_density(p.upper + 1e-6)) <= 0.0, "{p:?}");
        }
    }

    #[test]
    fn the_density_integrates_to_one_and_has_the_stated_moments() {
        for p in all() {
            let cells = 200_000;
            let (mut sum, mut first, mut second) = (0.0, 0.0, 0.0);
            for i in 0..cells {
                let u = (f64::from(i) + 0.5) / f64::from(cells);
                let weight = p.log_prior(p.from_unit(u)).exp() / f64::from(cells);
                (sum, first, second) = (sum + weight, first + weight * u, second + weight * u * u);
            }
            assert!((sum - 1.0).abs() < 1e-8, "{p:?}: {sum}");
            assert!((p.box_mean() - first).abs() < 1e-8, "{p:?}: {} {first}", p.box_mean());
            let variance = second - first * first;
            assert!((p.box_precision() * variance - 1.0).abs() < 1e-6, "{p:?}: {variance}");
            assert!((p.prior_std().powi(2) / p.prior_variance() - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn the_end_of_a_prior_is_a_margin_of_a_uniform_one_and_three_standard_deviations_of_the_others() {
        let [uniform, normal, _, log_normal, _] = &all()[..] else { unreachable!() };
        assert!(uniform.is_at_end(3.03) && !uniform.is_at_end(3.05) && uniform.is_at_end(6.97));
        assert!(
            normal.is_at_end(69.9) && !normal.is_at_end(70.5) && normal.is_at_end(130.1) && !normal.is_at_end(129.5)
        );
        let at = |z: f64| 50.0 * (0.4 * z).exp();
        assert!(log_normal.is_at_end(at(-3.02)) && !log_normal.is_at_end(at(-2.98)) && log_normal.is_at_end(at(3.02)));
    }

    #[test]
    fn a_uniform_prior_is_written_as_before_other_forms_existed() {
        let json = serde_json::to_string(&all()[0]).unwrap();
        assert_eq!(json, r#"{"name":"k1","unit":"N/m","lower":3.0,"upper":7.0,"damage":"decrease"}"#);
    }

    #[test]
    fn a_quantity_has_no_prefix_where_people_read_its_name() {
        assert_eq!(in_words("spring:k12"), "stiffness of spring k12");
        assert_eq!(in_words("group:k1+k2"), "k1 and k2 together");
        assert_eq!(in_words("west_ei"), "west_ei");
    }
}
