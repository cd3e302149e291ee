//! Corrections of parameter values: settings in another frame or unit, exchanged settings, and effects on parameters.

use nalgebra::DMatrix;

use crate::physics::effect::Target;

/// Parameters after the targets that act on them, with the derivatives of the result.
#[derive(Debug, Clone, PartialEq)]
pub struct CorrectedParameters {
    /// Corrected values x, `[d]`.
    pub theta: Vec<f64>,
    /// ∂x/∂θ, `[d, d]`.
    pub by_theta: DMatrix<f64>,
    /// ∂x/∂g by the sizes of all targets, `[d, sizes]`; 0 for the sizes of targets that do not act on parameters.
    pub by_size: DMatrix<f64>,
}

impl CorrectedParameters {
    /// Applies the targets that act on parameters, in their order, to the values `theta`, `[d]`, as they hold for `mode`;
    /// targets of another mode are left out. `sizes` holds the sizes of all targets, `[sizes]`.
    ///
    /// ```text
    ///  offset: x = p + g      scale: x = p(1 + g)      unit: x = factor·p      mirror: x = g₂ − p      exchange: (x₁, x₂) = (p₂, p₁)
    /// ```
    pub fn new(theta: &[f64], targets: &[Target], sizes: &[f64], mode: usize) -> Self {
        let d = theta.len();
        let mut corrected =
            Self { theta: theta.to_vec(), by_theta: DMatrix::identity(d, d), by_size: DMatrix::zeros(d, sizes.len()) };
        let mut first = 0;
        for target in targets {
            if let Some(target) = of_mode(target, mode) {
                corrected.apply(target, sizes, first);
            }
            first += target.sizes();
        }
        corrected
    }

    fn apply(&mut self, target: &Target, sizes: &[f64], first: usize) {
        let on = || sizes[first] > 0.5;
        match target {
            Target::SettingOffset(column) | Target::ParameterOffset(column) => {
                self.theta[*column] += sizes[first];
                self.by_size[(*column, first)] += 1.0;
            }
            Target::SettingScale(column) | Target::ParameterScale(column) => {
                let before = self.theta[*column];
                self.scale(*column, 1.0 + sizes[first]);
                self.by_size[(*column, first)] += before;
            }
            Target::SettingUnit { column, factor } if on() => self.scale(*column, *factor),
            Target::SettingMirror(column) if on() => {
                self.scale(*column, -1.0);
                self.theta[*column] += sizes[first + 1];
                self.by_size[(*column, first + 1)] += 1.0;
            }
            Target::SettingExchange(one, other) if on() => {
                self.theta.swap(*one, *other);
                self.by_theta.swap_rows(*one, *other);
                self.by_size.swap_rows(*one, *other);
            }
            _ => {}
        }
    }

    fn scale(&mut self, column: usize, factor: f64) {
        self.theta[column] *= factor;
        self.by_theta.row_mut(column).scale_mut(factor);
        self.by_size.row_mut(column).scale_mut(factor);
    }

    /// Limits a parameter to `[low, high]`; a value that was limited no longer depends on anything.
    pub fn clamp(&mut self, column: usize, [low, high]: [f64; 2]) {
        let value = self.theta[column];
        if !(low..=high).contains(&value) {
            self.theta[column] = value.clamp(low, high);
            self.by_theta.row_mut(column).fill(0.0);
            self.by_size.row_mut(column).fill(0.0);
        }
    }
}

/// The target as it acts on the frequency of one mode; `None` if it acts on that of another mode only.
fn of_mode(target: &Target, mode: usize) -> Option<&Target> {
    match target {
        Target::InMode(own, target) => (*own == mode).then_some(&**target),
        _ => Some(target),
    }
}

/// Modes `0..modes` in groups that share all corrections of parameters: first the modes that no target singles out, then each of
/// the others by itself. The first group may be empty.
pub fn groups_of_modes(targets: &[Target], modes: usize) -> Vec<Vec<usize>> {
    let single = |mode: &usize| targets.iter().any(|t| matches!(t, Target::InMode(own, _) if own == mode));
    let (own, shared): (Vec<usize>, Vec<usize>) = (0..modes).partition(single);
    std::iter::once(shared).chain(own.into_iter().map(|mode| vec![mode])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compares the derivatives of a chain of corrections with central differences.
    #[test]
    fn derivatives_equal_central_differences() {
        let targets = [
            Target::SettingUnit { column: 0, factor: 25.4 },
            Target::SettingOffset(0),
            Target::SettingExchange(0, 1),
            Target::SettingScale(1),
            Target::SettingMirror(1),
            Target::InMode(2, Box::new(Target::SettingOffset(1))),
            Target::ParameterOffset(2),
            Target::ParameterScale(2),
        ];
        let sizes = [1.0, 0.3, 1.0, 0.2, 1.0, 4.0, 0.7, 0.5, -0.1];
        let theta = [1.5, 2.5, 3.5];
        for mode in [0, 2] {
            let found = CorrectedParameters::new(&theta, &targets, &sizes, mode);
            // By hand: 25.4·1.5 + 0.3 is exchanged with 2.5, scaled and mirrored.
            let second = 4.0 - 1.2 * (25.4 * 1.5 + 0.3) + if mode == 2 { 0.7 } else { 0.0 };
            let wanted = [2.5, second, 0.9 * (3.5 + 0.5)];
            for (x, wanted) in found.theta.iter().zip(wanted) {
                assert!((x - wanted).abs() < 1e-12, "{x} {wanted}");
            }
            let step = 1e-6;
            for k in 0..3 {
                let at = |sign: f64| {
                    let mut moved = theta;
                    moved[k] += sign * step;
                    CorrectedParameters::new(&moved, &targets, &sizes, mode).theta
                };
                let (up, down) = (at(1.0), at(-1.0));
                for i in 0..3 {
                    let difference = (up[i] - down[i]) / (2.0 * step);
                    assert!((difference - found.by_theta[(i, k)]).abs() < 1e-7, "{difference} {}", found.by_theta);
                }
            }
            for g in [1, 3, 5, 6, 7, 8] {
                let at = |sign: f64| {
                    let mut moved = sizes;
                    moved[g] += sign * step;
                    CorrectedParameters::new(&theta, &targets, &moved, mode).theta
                };
                let (up, down) = (at(1.0), at(-1.0));
                for i in 0..3 {
                    let difference = (up[i] - down[i]) / (2.0 * step);
                    assert!((difference - found.by_size[(i, g)]).abs() < 1e-7, "{g}: {difference} {}", found.by_size);
                }
            }
        }
    }
}
