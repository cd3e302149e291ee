//! Laws: the size g of an effect as a function of a covariate c.

use serde::{Deserialize, Serialize};

/// Value of |rate·u| below which the exponential law is computed from its Taylor series.
const SERIES: f64 = 1e-4;

/// Form of a law, with u = c − reference.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum LawKind {
    /// g = size.
    Constant,
    /// g = level + slope·u.
    Linear,
    /// g = level + slope_below·min(c − knee, 0) + slope_above·max(c − knee, 0).
    Bilinear,
    /// g = level + slope·u + curvature·u².
    Quadratic,
    /// g = level + slope·(exp(rate·u) − 1)/rate.
    Exponential,
    /// g = the coefficient of the category; 0 for a category without a coefficient.
    Category,
    /// g = size from the time `reference` on, 0 before.
    Step,
    /// g = level + slope·(c̃ − reference), where c̃ is the covariate after a first-order lag: dc̃/dt = (c − c̃)/lag.
    Lagged,
    /// g = level + slope·u + second_slope·v + product·u·v, where u and v are two covariates minus their means.
    Product,
    /// g = cosine·cos φ + sine·sin φ, where φ is the phase of the day or of the year.
    Cycle,
}

/// A law with everything except its coefficients ψ.
#[derive(Debug, Clone, PartialEq)]
pub struct Law {
    /// Form of the law.
    pub kind: LawKind,
    /// Name of the covariate: `None` for a constant, `time` for a step.
    pub covariate: Option<String>,
    /// Value of the covariate at which g = level; for a step its time in days.
    pub reference: f64,
    /// Whether the level is a coefficient; otherwise it is 0.
    pub with_level: bool,
    /// Categories that have a coefficient, for [`LawKind::Category`].
    pub levels: Vec<String>,
}

/// One value of a covariate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Input {
    /// A number; for time in days.
    Number(f64),
    /// A number after a first-order lag, and its derivative with respect to the lag, per day.
    Lagged(f64, f64),
    /// Index of a category in [`Law::levels`]; `None` for a category without a coefficient.
    Level(Option<usize>),
    /// Two numbers, each minus its mean, for [`LawKind::Product`]; cosine and sine of a phase for [`LawKind::Cycle`].
    Pair(f64, f64),
    /// Unknown: the effect then consists of its level alone.
    Missing,
}

impl LawKind {
    /// Name in structure files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Constant => "constant",
            Self::Linear => "linear",
            Self::Bilinear => "bilinear",
            Self::Quadratic => "quadratic",
            Self::Exponential => "exponential",
            Self::Category => "category",
            Self::Step => "step",
            Self::Lagged => "lagged",
            Self::Product => "product",
            Self::Cycle => "cycle",
        }
    }

    /// Names of the coefficients, the level first; empty for a law by category, whose coefficients are named after the
    /// categories.
    pub const fn numbers(self) -> &'static [&'static str] {
        match self {
            Self::Constant | Self::Step => &["size"],
            Self::Linear => &["level", "slope_per_unit"],
            Self::Bilinear => &["level", "slope_below_per_unit", "slope_above_per_unit", "knee"],
            Self::Quadratic => &["level", "slope_per_unit", "curvature_per_unit2"],
            Self::Exponential => &["level", "slope_per_unit", "rate_per_unit"],
            Self::Category => &[],
            Self::Lagged => &["level", "slope_per_unit", "lag_days"],
            Self::Product => &["level", "slope_per_unit", "second_slope_per_unit", "product_per_unit2"],
            Self::Cycle => &["cosine", "sine"],
        }
    }

    /// Whether the law can have a level.
    pub fn has_level(self) -> bool {
        self.numbers().first() == Some(&"level")
    }
}

impl Law {
    /// The law of a product of two covariates, without level; `name`: name of the product.
    pub fn of_product(name: &str) -> Self {
        let covariate = Some(name.to_owned());
        Self { kind: LawKind::Product, covariate, reference: 0.0, with_level: false, levels: Vec::new() }
    }

    /// Names of the coefficients ψ, in order.
    pub fn numbers(&self) -> Vec<String> {
        if self.kind == LawKind::Category {
            return self.levels.clone();
        }
        let skipped = usize::from(self.kind.has_level() && !self.with_level);
        self.kind.numbers()[skipped..].iter().map(ToString::to_string).collect()
    }

    /// Returns the size g of the effect at one value of the covariate for the coefficients `psi`, and writes its derivatives
    /// ∂g/∂ψ to `slopes`. Both slices are as long as [`Self::numbers`], `[ψ]`. g is in the unit of the target of the effect.
    /// The formulas are those of [`LawKind`].
    ///
    /// # Panics
    /// If `psi` or `slopes` is too short.
    pub fn size(&self, input: Input, psi: &[f64], slopes: &mut [f64]) -> f64 {
        slopes.fill(0.0);
        let c = match input {
            // The level does not depend on the covariate.
            Input::Missing if self.with_level && self.kind.has_level() => {
                slopes[0] = 1.0;
                return psi[0];
            }
            Input::Missing => return 0.0,
            Input::Level(level) => {
                let Some(level) = level else { return 0.0 };
                slopes[level] = 1.0;
                return psi[level];
            }
            Input::Pair(u, _) => u + self.reference,
            Input::Number(c) | Input::Lagged(c, _) => c,
        };
        let first = usize::from(self.kind.has_level() && self.with_level);
        let level = if first == 1 {
            slopes[0] = 1.0;
            psi[0]
        } else {
            0.0
        };
        let (psi, slopes) = (&psi[first..], &mut slopes[first..]);
        let u = c - self.reference;
        level
            + match self.kind {
                LawKind::Constant => {
                    slopes[0] = 1.0;
                    psi[0]
                }
                LawKind::Step => {
                    slopes[0] = f64::from(u8::from(u >= 0.0));
                    psi[0] * slopes[0]
                }
                LawKind::Linear => {
                    slopes[0] = u;
                    psi[0] * u
                }
                LawKind::Quadratic => {
                    slopes[0] = u;
                    slopes[1] = u * u;
                    psi[0] * u + psi[1] * u * u
                }
                LawKind::Bilinear => {
                    let from_knee = c - psi[2];
                    slopes[0] = from_knee.min(0.0);
                    slopes[1] = from_knee.max(0.0);
                    slopes[2] = if from_knee < 0.0 { -psi[0] } else { -psi[1] };
                    psi[0] * slopes[0] + psi[1] * slopes[1]
                }
                LawKind::Exponential => {
                    let (shape, slope) = exponential(psi[1] * u);
                    slopes[0] = u * shape;
                    slopes[1] = psi[0] * u * u * slope;
                    psi[0] * u * shape
                }
                LawKind::Lagged => {
                    slopes[0] = u;
                    slopes[1] = if let Input::Lagged(_, by_lag) = input { psi[0] * by_lag } else { 0.0 };
                    psi[0] * u
                }
                LawKind::Product => {
                    let v = if let Input::Pair(_, v) = input { v } else { 0.0 };
                    slopes[..3].copy_from_slice(&[u, v, u * v]);
                    psi[0] * u + psi[1] * v + psi[2] * u * v
                }
                LawKind::Cycle => {
                    let v = if let Input::Pair(_, v) = input { v } else { 0.0 };
                    slopes[..2].copy_from_slice(&[u, v]);
                    psi[0] * u + psi[1] * v
                }
                LawKind::Category => 0.0,
            }
    }

    /// Whether a target that is switched on and off acts at an input: always under a constant law, in the categories that are
    /// listed, and from the time of a step on.
    pub fn acts(&self, input: Input) -> bool {
        match (self.kind, input) {
            (LawKind::Constant, _) | (LawKind::Category, Input::Level(Some(_))) => true,
            (LawKind::Step, Input::Number(time)) => time >= self.reference,
            _ => false,
        }
    }
}

/// (eˣ − 1)/x and its derivative with respect to x.
fn exponential(x: f64) -> (f64, f64) {
    if x.abs() < SERIES {
        return (1.0 + x / 2.0 + x * x / 6.0, 0.5 + x / 3.0);
    }
    let shape = x.exp_m1() / x;
    (shape, (x.exp() - shape) / x)
}

/// A covariate after a first-order lag τ, and its derivative with respect to τ (per day), at ascending times. Missing values
/// (NaN) leave both unchanged. All slices are `[n]`.
///
/// ```text
///  c̃_j = c̃_{j−1} + (1 − e^{−Δ/τ}) (c_j − c̃_{j−1}),    c̃_0 = c_0
/// ```
pub fn lagged(times_days: &[f64], values: &[f64], lag_days: f64) -> Vec<(f64, f64)> {
    let start = values.iter().copied().find(|v| v.is_finite()).unwrap_or(0.0);
    let (mut state, mut slope, mut before) = (start, 0.0, times_days.first().copied().unwrap_or(0.0));
    let follow = |(&time, &value): (&f64, &f64)| {
        if value.is_finite() {
            let elapsed = (time - before).max(0.0) / lag_days;
            let kept = (-elapsed).exp();
            // ∂kept/∂τ = kept·Δ/τ²
            slope = slope * kept + (state - value) * kept * elapsed / lag_days;
            state = value + (state - value) * kept;
            before = time;
        }
        (state, slope)
    };
    times_days.iter().zip(values).map(follow).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_of_every_law_equal_central_differences() {
        let law = |kind: LawKind, with_level| Law {
            kind,
            covariate: None,
            reference: 0.7,
            with_level,
            levels: if kind == LawKind::Category { vec!["a".into(), "b".into()] } else { Vec::new() },
        };
        let kinds = [
            (LawKind::Constant, vec![0.3]),
            (LawKind::Linear, vec![0.1, -0.2]),
            (LawKind::Bilinear, vec![0.1, -0.4, -0.05, 0.2]),
            (LawKind::Quadratic, vec![0.1, -0.2, 0.05]),
            (LawKind::Exponential, vec![0.1, -0.2, 0.3]),
            (LawKind::Exponential, vec![0.1, -0.2, 1e-6]),
            (LawKind::Step, vec![0.2]),
            (LawKind::Category, vec![0.2, -0.1]),
            (LawKind::Product, vec![0.1, 0.2, -0.3, 0.4]),
            (LawKind::Cycle, vec![0.2, -0.3]),
        ];
        for (kind, psi) in kinds {
            for c in [-2.0, 0.71, 3.0] {
                let input = match kind {
                    LawKind::Category => Input::Level(Some(1)),
                    LawKind::Product | LawKind::Cycle => Input::Pair(c, 0.4 * c + 1.0),
                    _ => Input::Number(c),
                };
                let law = law(kind, true);
                let mut slopes = vec![0.0; psi.len()];
                law.size(input, &psi, &mut slopes);
                for (i, slope) in slopes.iter().enumerate() {
                    let at = |h: f64| {
                        let mut moved = psi.clone();
                        moved[i] += h;
                        law.size(input, &moved, &mut vec![0.0; psi.len()])
                    };
                    let difference = (at(1e-6) - at(-1e-6)) / 2e-6;
                    assert!((difference - slope).abs() < 1e-7, "{kind:?} {i} at {c}: {difference} {slope}");
                }
            }
        }
    }

    #[test]
    fn a_lagged_step_is_exponential_and_its_derivative_is_exact() {
        let times: Vec<f64> = (0..50).map(|i| f64::from(i) * 0.5).collect();
        let values: Vec<f64> = (0..50).map(|i| if i == 0 { 0.0 } else { 1.0 }).collect();
        for ((value, slope), time) in lagged(&times, &values, 4.0).into_iter().zip(&times) {
            assert!((value - (1.0 - (-time / 4.0).exp())).abs() < 1e-12);
            let exact = -(-time / 4.0_f64).exp() * time / 16.0;
            assert!((slope - exact).abs() < 1e-12, "{slope} {exact}");
        }
    }
}
