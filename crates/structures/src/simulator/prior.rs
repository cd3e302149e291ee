//! Priors as the structure file states them, and what is wrong with a prior that cannot be one.

use std::fmt;
use std::marker::PhantomData;

use serde::de::value::MapAccessDeserializer;
use serde::de::{DeserializeSeed, Error as _, MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

use crate::parameter::{PriorForm, PRIOR_REACH};
use crate::quantity::{shown, significant};

/// Largest relative standard deviation of a log-normal prior. It reaches from a twenty-eighth of its median to 28 times it.
const WIDEST_RELATIVE_STD: f64 = 1.0;

/// Smallest standard deviation, as a share of the mean: a narrower prior leaves nothing to estimate.
const LEAST_RELATIVE_STD: f64 = 1e-6;

/// Prior distribution of a parameter: one of the three.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Prior {
    /// Uniform between the two values.
    Uniform([f64; 2]),
    /// Normal, cut off at four standard deviations from the mean.
    Normal(NormalPrior),
    /// Log-normal: the logarithm is normal, cut off at four of its standard deviations from that of the median.
    LogNormal(LogNormalPrior),
}

/// A normal prior.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NormalPrior {
    /// Mean, in the unit of the parameter, or as a factor for `scale`.
    pub mean: f64,
    /// Standard deviation, in the same unit.
    pub std: f64,
}

/// A log-normal prior.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct LogNormalPrior {
    /// Median, above 0, in the unit of the parameter, or as a factor for `scale`.
    pub median: f64,
    /// Standard deviation as a share of the mean: 0.2 for 20 %.
    pub relative_std: f64,
}

/// Reads a prior. A derived implementation would take `normal = [50.0, 150.0]`, which looks like a range, for mean and standard deviation,
/// and would not say what is wrong with two priors at once.
impl<'de> Deserialize<'de> for Prior {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct OneKey;
        impl<'de> Visitor<'de> for OneKey {
            type Value = Prior;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("{ uniform = [low, high] }, { normal = { … } } or { log_normal = { … } }")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Prior, A::Error> {
                let Some(key) = map.next_key::<String>()? else {
                    return Err(A::Error::custom("the prior is empty: give one of uniform, normal and log_normal"));
                };
                let prior = match key.as_str() {
                    "uniform" => Prior::Uniform(map.next_value()?),
                    "normal" => Prior::Normal(map.next_value_seed(Table::of("{ mean = …, std = … }"))?),
                    "log_normal" => {
                        Prior::LogNormal(map.next_value_seed(Table::of("{ median = …, relative_std = … }"))?)
                    }
                    other => return Err(A::Error::unknown_variant(other, &["uniform", "normal", "log_normal"])),
                };
                match map.next_key::<String>()? {
                    None => Ok(prior),
                    Some(other) => Err(A::Error::custom(format!(
                        "the prior has both {key} and {}: a parameter has one prior, remove one of the two",
                        shown(&other)
                    ))),
                }
            }
        }
        deserializer.deserialize_map(OneKey)
    }
}

/// Reads a table of named numbers, and no list.
struct Table<T> {
    expected: &'static str,
    of: PhantomData<T>,
}

impl<T> Table<T> {
    fn of(expected: &'static str) -> Self {
        Self { expected, of: PhantomData }
    }
}

impl<'de, T: Deserialize<'de>> DeserializeSeed<'de> for Table<T> {
    type Value = T;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<T, D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de, T: Deserialize<'de>> Visitor<'de> for Table<T> {
    type Value = T;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.expected)
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<T, A::Error> {
        T::deserialize(MapAccessDeserializer::new(map))
    }
}

impl LogNormalPrior {
    /// Standard deviation of the logarithm, s = √ln(1 + v²) for the relative standard deviation v.
    fn ln_std(self) -> f64 {
        self.relative_std.powi(2).ln_1p().sqrt()
    }
}

impl Prior {
    /// Smallest and largest possible value, in the unit of the file.
    pub fn bounds(self) -> [f64; 2] {
        match self {
            Self::Uniform(bounds) => bounds,
            Self::Normal(NormalPrior { mean, std }) => [mean - PRIOR_REACH * std, mean + PRIOR_REACH * std],
            Self::LogNormal(prior) => {
                let factor = (PRIOR_REACH * prior.ln_std()).exp();
                [prior.median / factor, prior.median * factor]
            }
        }
    }

    /// The form of the prior, with values in the unit of the file times `factor`.
    pub(super) fn form(self, factor: f64) -> PriorForm {
        match self {
            Self::Uniform(_) => PriorForm::Uniform,
            Self::Normal(NormalPrior { mean, std }) => PriorForm::Normal { mean: factor * mean, std: factor * std },
            Self::LogNormal(prior) => PriorForm::LogNormal { median: factor * prior.median, ln_std: prior.ln_std() },
        }
    }

    /// Key of the prior in the structure file.
    pub fn key(self) -> &'static str {
        match self {
            Self::Uniform(_) => "uniform",
            Self::Normal(_) => "normal",
            Self::LogNormal(_) => "log_normal",
        }
    }

    /// JSON pointer to the prior of the parameter with this index.
    pub(super) fn pointer(self, parameter: usize) -> String {
        format!("/parameter/{parameter}/prior/{}", self.key())
    }

    /// What is wrong with the numbers of the prior, as the rest of a pointer below [`Self::pointer`] and a sentence.
    pub(super) fn mistake(self) -> Option<(&'static str, String)> {
        match self {
            Self::Uniform([lower, upper]) => (!(lower.is_finite() && upper.is_finite() && lower < upper)).then(|| {
                let message =
                    format!("uniform = [{lower}, {upper}]: both bounds must be finite, the first below the second");
                ("", message)
            }),
            Self::Normal(prior) => prior.mistake(),
            Self::LogNormal(prior) => prior.mistake(),
        }
    }

    /// What to write instead of a prior that allows impossible values: a complete clause after a semicolon, or nothing.
    pub(super) fn instead(self) -> String {
        match self {
            Self::Uniform(_) | Self::LogNormal(_) => String::new(),
            Self::Normal(NormalPrior { mean, std }) if mean > 0.0 => {
                let share = std / mean;
                let log_normal = if share <= WIDEST_RELATIVE_STD {
                    let share = significant(share);
                    format!("log_normal = {{ median = {}, relative_std = {share} }} stays above 0", significant(mean))
                } else {
                    "a log_normal prior stays above 0".to_owned()
                };
                format!("; a std below {} keeps the prior above 0, and {log_normal}", significant(mean / PRIOR_REACH))
            }
            Self::Normal(_) => "; the mean must be above 0".to_owned(),
        }
    }

    /// The prior in words with its range, such as "normal prior of mean 1 and standard deviation 0.1, which runs from 0.6 to 1.4".
    pub(super) fn words(self) -> String {
        let [low, high] = self.bounds();
        match self {
            Self::Uniform(_) => format!("prior [{low}, {high}]"),
            Self::Normal(NormalPrior { mean, std }) => format!(
                "normal prior of mean {mean} and standard deviation {std}, which runs from {} to {} (± {PRIOR_REACH} standard \
                 deviations),",
                significant(low),
                significant(high)
            ),
            Self::LogNormal(LogNormalPrior { median, relative_std }) => format!(
                "log-normal prior of median {median} and relative standard deviation {relative_std}, which runs from {} to {},",
                significant(low),
                significant(high)
            ),
        }
    }
}

impl NormalPrior {
    fn mistake(self) -> Option<(&'static str, String)> {
        let Self { mean, std } = self;
        if !mean.is_finite() {
            return Some(("/mean", format!("mean = {mean}: it must be a finite number")));
        }
        if !(std.is_finite() && std > 0.0) {
            let message = format!(
                "std = {std}: the standard deviation must be finite and above 0, in the unit of the mean, such as std = {}",
                significant(if mean == 0.0 { 1.0 } else { 0.1 * mean.abs() })
            );
            return Some(("/std", message));
        }
        let narrow = std < LEAST_RELATIVE_STD * mean.abs();
        narrow.then(|| {
            let message = format!(
                "std = {std} is less than a millionth of mean = {mean}, so that nothing is left to estimate: state a wider \
                 prior, or remove the parameter and give the stiffness"
            );
            ("/std", message)
        })
    }
}

impl LogNormalPrior {
    fn mistake(self) -> Option<(&'static str, String)> {
        let Self { median, relative_std } = self;
        if !(median.is_finite() && median > 0.0) {
            let message = format!("median = {median}: the median of a log-normal prior must be finite and above 0");
            return Some(("/median", message));
        }
        let possible = relative_std.is_finite() && (LEAST_RELATIVE_STD..=WIDEST_RELATIVE_STD).contains(&relative_std);
        (!possible).then(|| {
            let per_cent = if relative_std > WIDEST_RELATIVE_STD && relative_std <= 100.0 {
                format!(
                    "; did you mean {relative_std} %, relative_std = {}? For a wider prior use uniform",
                    relative_std / 100.0
                )
            } else {
                String::new()
            };
            let message = format!(
                "relative_std = {relative_std}: it is the standard deviation as a share of the mean, above 0 and at most \
                 {WIDEST_RELATIVE_STD}, such as 0.2 for 20 %{per_cent}"
            );
            ("/relative_std", message)
        })
    }
}
