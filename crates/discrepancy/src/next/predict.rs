//! What a fit predicts for a further measurement.

use nalgebra::{DMatrix, DVector};

use super::condition::Condition;
use super::experiment::Experiment;
use crate::data::{Column, Origin, Values, SETTING, TIME};
use crate::declared::WEIGHING_STD;
use crate::effect::FittedEffect;
use crate::fit::Fit;
use crate::study::Study;
use crate::weighing;
use structures::measurement::CovariateValue;
use structures::physics::effect::Target;
use structures::simulator::law::{Input, LawKind};
use structures::stats;

/// Noise of a mode shape as a share of its root mean square, if the structure file states none.
const SHAPE_NOISE: f64 = 0.03;

/// Step of the central differences of mode shapes, in standard deviations of each number.
const STEP: f64 = 0.1;

/// Normal approximation of the predictive density of a measurement, as the mean of a number R of rows in each condition:
///
/// ```text
///  y ~ N( m, J C Jᵀ + L + W/R )
/// ```
///
/// m: prediction at the numbers of the fit; C: covariance of the numbers of the fit; L: errors that repeating does not reduce; W:
/// noise and spread of one row. The q quantities are logarithms of frequencies and of ratios of masses, and components of shapes.
#[derive(Debug, Clone)]
pub(super) struct Prediction {
    /// m, `[q]`.
    pub(super) mean: DVector<f64>,
    /// J C Jᵀ + L, `[q, q]`.
    pub(super) lasting: DMatrix<f64>,
    /// W, `[q, q]`.
    pub(super) of_row: DMatrix<f64>,
}

/// A fit, prepared for predictions.
pub(super) struct Predictor<'a> {
    study: &'a Study<'a>,
    fit: &'a Fit,
    /// Covariance of the free means and ψ, `[free + ψ, free + ψ]`.
    covariance: DMatrix<f64>,
    /// Inputs of each effect at all rows.
    inputs: Vec<Vec<Input>>,
    /// Relative noise of each measured mode, `[modes]`.
    noise: Vec<f64>,
}

/// The parameters of the structure and the effects in one condition.
struct State {
    /// `[d]`
    theta: Vec<f64>,
    /// Columns of the free parameters that are not set here.
    unset: Vec<bool>,
    targets: Vec<Target>,
    /// `[sizes]`
    sizes: Vec<f64>,
    /// For each number of ψ the index of the size that it moves, and the derivative.
    moved: Vec<(usize, f64)>,
}

/// The quantities of one condition: prediction, derivatives by the numbers `[q, free + ψ]` and by the parameters `[q, d]`,
/// standard deviation of each in one row, and standard deviation of each that repeating does not reduce, common to all
/// conditions.
#[derive(Default)]
struct Block {
    mean: Vec<f64>,
    by_number: Vec<DVector<f64>>,
    by_parameter: Vec<DVector<f64>>,
    std: Vec<f64>,
    common: Vec<f64>,
}

impl<'a> Predictor<'a> {
    /// The predictions of a fit whose rows carry the information of `independent_share` of their number.
    pub(super) fn new(study: &'a Study<'a>, fit: &'a Fit, independent_share: f64) -> Self {
        let inputs = |(effect, psi): (&FittedEffect, &Vec<f64>)| {
            study.data.inputs(&effect.law, effect.lag().map(|lag| psi[lag]))
        };
        let inputs = fit.effects.iter().zip(&fit.psi).map(inputs).collect();
        let noise = (0..study.simulator.modes()).map(|mode| noise(study, fit, mode)).collect();
        Self { study, fit, covariance: &fit.covariance / independent_share, inputs, noise }
    }

    /// The prediction for a measurement; `None` if it cannot be computed, as for frequencies where a stiffness is not positive.
    /// Shapes have the sign with which they are most similar to `reference`, `[points, modes]`.
    pub(super) fn predict(&self, experiment: &Experiment, reference: Option<&DMatrix<f64>>) -> Option<Prediction> {
        let mut blocks = Vec::with_capacity(experiment.conditions.len());
        for condition in &experiment.conditions {
            let mut block = Block::default();
            if let Some(mass) = experiment.weighed {
                self.weigh(&mut block, condition, mass)?;
            }
            if experiment.modes > 0 {
                let state = self.state(experiment, condition);
                self.frequencies(&mut block, experiment, &state)?;
                if let Some(reference) = reference {
                    self.shapes(&mut block, experiment, &state, reference)?;
                }
            }
            blocks.push(block);
        }
        Some(self.joined(&blocks))
    }

    /// The joint prediction of all conditions.
    fn joined(&self, blocks: &[Block]) -> Prediction {
        let total: usize = blocks.iter().map(|b| b.mean.len()).sum();
        let mut mean = DVector::zeros(total);
        let mut slopes = DMatrix::zeros(total, self.covariance.nrows());
        let (mut of_row, mut common) = (DMatrix::zeros(total, total), DVector::zeros(total));
        let mut first = 0;
        for block in blocks {
            let count = block.mean.len();
            for a in 0..count {
                mean[first + a] = block.mean[a];
                common[first + a] = block.common[a];
                slopes.row_mut(first + a).copy_from(&block.by_number[a].transpose());
                for b in 0..count {
                    let shared = block.by_parameter[a].iter().zip(block.by_parameter[b].iter()).zip(&self.fit.spread);
                    of_row[(first + a, first + b)] =
                        shared.map(|((x, y), spread)| x * y * spread * spread).sum::<f64>();
                }
                of_row[(first + a, first + a)] += block.std[a].powi(2);
            }
            first += count;
        }
        let lasting = &slopes * &self.covariance * slopes.transpose() + &common * common.transpose();
        Prediction { mean, lasting, of_row }
    }

    /// The input of an effect.
    fn input(&self, index: usize, condition: &Condition) -> Input {
        let (law, data) = (&self.fit.effects[index].law, self.study.data);
        if matches!(self.fit.effects[index].target, Target::AddedMass(_)) {
            return Input::Number(0.0);
        }
        let Some(name) = law.covariate.as_deref() else { return Input::Number(0.0) };
        let here = self.inputs[index][condition.row];
        if let (Some(Origin::Product(first, second)), Input::Pair(a, b)) = (data.column(name).map(|c| c.origin), here) {
            let moved = |column: usize| self.change(&data.columns[column], condition);
            return Input::Pair(a + moved(first), b + moved(second));
        }
        if let Some(value) = self.set_value(name, condition) {
            return Input::Number(value);
        }
        if law.kind == LawKind::Lagged {
            // The measurements follow the last row within hours, in which a delayed effect hardly moves.
            return self.inputs[index].last().copied().unwrap_or(Input::Missing);
        }
        match condition.changed.get(name) {
            Some(CovariateValue::Number(value)) => Input::Number(*value),
            Some(CovariateValue::Category(name)) => Input::Level(law.levels.iter().position(|level| level == name)),
            None if name == TIME => match data.column(TIME).map(|c| &c.values) {
                Some(Values::Numbers(times)) => Input::Number(times.last().copied().unwrap_or(0.0)),
                _ => Input::Missing,
            },
            None => here,
        }
    }

    /// Value of the column of a setting that is changed in a condition; `None` for other columns.
    fn set_value(&self, column: &str, condition: &Condition) -> Option<f64> {
        let parameter = column.strip_prefix(SETTING)?;
        let of = |(k, value): (&usize, &f64)| {
            (self.study.simulator.space().as_slice()[*k].name == parameter).then_some(*value)
        };
        condition.set.iter().find_map(of)
    }

    /// Value of a numeric column in a condition minus that in its row; 0 if it is not changed.
    fn change(&self, column: &Column, condition: &Condition) -> f64 {
        let Values::Numbers(values) = &column.values else { return 0.0 };
        let changed = match condition.changed.get(&column.name) {
            Some(CovariateValue::Number(value)) => Some(*value),
            _ => None,
        };
        let value = self.set_value(&column.name, condition).or(changed);
        value.map_or(0.0, |value| value - values[condition.row])
    }

    /// Parameters and effects in one condition of a measurement.
    fn state(&self, experiment: &Experiment, condition: &Condition) -> State {
        let (data, fit) = (self.study.data, self.fit);
        let setting = |k: usize| condition.set.get(&k).copied().or(data.settings[condition.row][k]);
        let theta = fit.mean.iter().enumerate().map(|(k, mean)| setting(k).unwrap_or(*mean)).collect();
        let unset = fit.free.iter().map(|k| setting(*k).is_none()).collect();
        let (mut targets, mut sizes, mut moved) = (Vec::new(), Vec::new(), Vec::new());
        for (index, (effect, psi)) in fit.effects.iter().zip(&fit.psi).enumerate() {
            let first = sizes.len();
            let (mut own, mut slopes) = (vec![0.0; effect.target.sizes()], vec![0.0; psi.len()]);
            let acts = match &effect.target {
                target if target.is_of_instrument() => !experiment.second_instrument,
                Target::ModeGain { column, .. } => setting(*column).is_some(),
                _ => effect.target.settings().into_iter().all(|k| setting(k).is_some()),
            };
            if acts {
                effect.sizes(self.input(index, condition), psi, &mut own, &mut slopes);
            }
            moved.extend(slopes.iter().enumerate().map(|(place, slope)| (first + effect.moved(place), *slope)));
            sizes.extend(own);
            targets.push(with_modes(&effect.target, experiment.modes));
        }
        if let Some((dof, kg)) = experiment.hung {
            targets.push(Target::AddedMass(dof));
            sizes.push(kg);
        }
        State { theta, unset, targets, sizes, moved }
    }

    /// Adds the logarithms of the frequencies.
    fn frequencies(&self, block: &mut Block, experiment: &Experiment, state: &State) -> Option<()> {
        let (simulator, fit) = (self.study.simulator, self.fit);
        let response = simulator.respond(&state.theta, experiment.modes, &state.targets, &state.sizes).ok()?;
        for (mode, f) in response.frequencies_hz.iter().copied().enumerate() {
            if !(f.is_finite() && f > 0.0) {
                return None;
            }
            block.mean.push(f.ln());
            let mut by = DVector::zeros(self.covariance.nrows());
            let mut by_parameter = DVector::zeros(fit.mean.len());
            for (column, k) in fit.free.iter().enumerate().filter(|(column, _)| state.unset[*column]) {
                by[column] = response.by_parameter[(mode, *k)] / f;
                by_parameter[*k] = by[column];
            }
            for (number, (size, slope)) in state.moved.iter().enumerate() {
                by[fit.free.len() + number] = response.by_size[(mode, *size)] / f * slope;
            }
            block.by_number.push(by);
            block.by_parameter.push(by_parameter);
            block.std.push(self.noise.get(mode).copied().unwrap_or_else(|| self.noise_of_further_mode(mode, f)));
            let kg_error = experiment
                .hung
                .map_or(0.0, |(_, kg)| response.by_size[(mode, state.sizes.len() - 1)] / f * kg * WEIGHING_STD);
            block.common.push(kg_error);
        }
        Some(())
    }

    /// Relative noise of a mode that was not measured: as stated, with the mean noise factor of the others.
    fn noise_of_further_mode(&self, mode: usize, f: f64) -> f64 {
        let logs: Vec<f64> = self.fit.noise_factor[..self.noise.len()].iter().map(|factor| factor.ln()).collect();
        stats::mean(&logs).exp() * (self.study.simulator.std_hz(mode, f) / f).max(1e-5)
    }

    /// Adds the logarithm of the mass of a body over that of the structure file.
    fn weigh(&self, block: &mut Block, condition: &Condition, mass: usize) -> Option<()> {
        let (ratio, by) = weighing::log_ratio(self.fit, mass, |effect| self.input(effect, condition))?;
        block.mean.push(ratio);
        block.by_number.push(by);
        block.by_parameter.push(DVector::zeros(self.fit.mean.len()));
        block.std.push(0.1 * WEIGHING_STD);
        block.common.push(WEIGHING_STD);
        Some(())
    }

    /// Adds the components of the mode shapes, with derivatives by central differences.
    fn shapes(
        &self,
        block: &mut Block,
        experiment: &Experiment,
        state: &State,
        reference: &DMatrix<f64>,
    ) -> Option<()> {
        let fit = self.fit;
        let at = |theta: &[f64], sizes: &[f64]| {
            let effects = (state.targets.as_slice(), sizes);
            let shapes =
                self.study.simulator.shapes_under(theta, experiment.modes, effects, &experiment.points).ok()??;
            let sign = |mode: usize| if shapes.column(mode).dot(&reference.column(mode)) < 0.0 { -1.0 } else { 1.0 };
            let signed = DMatrix::from_fn(shapes.nrows(), shapes.ncols(), |p, mode| sign(mode) * shapes[(p, mode)]);
            Some(DVector::from_column_slice(signed.as_slice()))
        };
        let here = at(&state.theta, &state.sizes)?;
        let slope = |number: usize, move_by: &dyn Fn(f64) -> (Vec<f64>, Vec<f64>)| {
            let h = STEP * self.covariance[(number, number)].max(0.0).sqrt();
            if h <= 0.0 {
                return Some(DVector::zeros(here.len()));
            }
            let [(a, b), (c, d)] = [move_by(h), move_by(-h)];
            Some((at(&a, &b)? - at(&c, &d)?) / (2.0 * h))
        };
        let mut slopes = DMatrix::zeros(here.len(), self.covariance.nrows());
        let mut by_parameter = DMatrix::zeros(here.len(), fit.mean.len());
        for (column, k) in fit.free.iter().enumerate().filter(|(column, _)| state.unset[*column]) {
            let moved = |h: f64| {
                let mut theta = state.theta.clone();
                theta[*k] += h;
                (theta, state.sizes.clone())
            };
            slopes.set_column(column, &slope(column, &moved)?);
            by_parameter.set_column(*k, &slopes.column(column).into_owned());
        }
        for (number, (size, by)) in state.moved.iter().enumerate() {
            let moved = |h: f64| {
                let mut sizes = state.sizes.clone();
                sizes[*size] += h * by;
                (state.theta.clone(), sizes)
            };
            slopes.set_column(fit.free.len() + number, &slope(fit.free.len() + number, &moved)?);
        }
        let stated = self.study.simulator.shape_std();
        let std = if stated > 0.0 { stated } else { SHAPE_NOISE / (experiment.points.len() as f64).sqrt() };
        for place in 0..here.len() {
            block.mean.push(here[place]);
            block.by_number.push(slopes.row(place).transpose());
            block.by_parameter.push(by_parameter.row(place).transpose());
            block.std.push(std);
            block.common.push(0.0);
        }
        Some(())
    }
}

/// Relative noise of a measured mode under a fit: the median of the stated noise, times the noise factor.
fn noise(study: &Study<'_>, fit: &Fit, mode: usize) -> f64 {
    let data = study.data;
    let measured = (0..data.rows()).filter(|row| data.log_frequencies[*row][mode].is_finite());
    let stated: Vec<f64> = measured.map(|row| data.noise[row][mode]).collect();
    let f = study.simulator.nominal_frequencies_hz()[mode];
    let stated = if stated.is_empty() { study.simulator.std_hz(mode, f) / f } else { stats::quantile(&stated, 0.5) };
    fit.noise_factor[mode] * stated.max(1e-5)
}

/// A target for another number of modes: an order of modes continues above those measured.
fn with_modes(target: &Target, modes: usize) -> Target {
    match target {
        Target::ModeOrder(order) => {
            let mut order = order.clone();
            while order.len() < modes {
                order.push(order.iter().max().map_or(0, |highest| highest + 1));
            }
            order.truncate(modes);
            Target::ModeOrder(order)
        }
        other => other.clone(),
    }
}
