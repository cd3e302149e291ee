//! Measurements corrected by the learned discrepancy, and simulated measurements that contain it.

use std::borrow::Cow;
use std::collections::BTreeMap;

use nalgebra::DVector;
use rand::Rng as _;
use rand_distr::StandardNormal;

use super::input::Discrepancy;
use crate::measurement::{CovariateValue, ModalMeasurement};
use crate::physics;
use crate::quantity::Hertz;
use crate::simulator::Simulator;
use crate::stats;

/// Covariates and settings of one simulated measurement.
pub type Noted = (BTreeMap<String, CovariateValue>, BTreeMap<String, f64>);

impl Simulator {
    /// Inputs of the learned discrepancy that a measurement lacks, and those outside what it was learned from; both are empty
    /// without a discrepancy.
    pub fn discrepancy_reservations(&self, measurement: &ModalMeasurement) -> (Vec<String>, Vec<String>) {
        self.discrepancy().map_or_else(Default::default, |discrepancy| {
            let inputs = discrepancy.inputs(&measurement.covariates, &measurement.settings);
            (inputs.missing, inputs.beyond)
        })
    }

    /// A measurement as the simulation without the discrepancy would give it; unchanged without a discrepancy.
    ///
    /// ```text
    ///  ln f' = ln f − E g(u),    s'² = s² + f'² var g(u)
    /// ```
    ///
    /// s: stated standard deviation of the frequency, or that of the structure, Hz. Where an input is missing, E g is 0 and var g
    /// the prior variance.
    pub fn corrected<'a>(&self, measurement: &'a ModalMeasurement) -> Cow<'a, ModalMeasurement> {
        let Some(discrepancy) = self.discrepancy() else { return Cow::Borrowed(measurement) };
        let inputs = discrepancy.inputs(&measurement.covariates, &measurement.settings);
        let moments = discrepancy.at(inputs.u.as_deref());
        let mut corrected = measurement.clone();
        let stated = |mode: usize| measurement.std_hz.as_ref().and_then(|stds| stds[mode]);
        let mut std_hz = vec![None; moments.len()];
        for (mode, moments) in moments.iter().enumerate() {
            let Some(measured_hz) = measurement.frequencies_hz[mode].map(Hertz::get) else { continue };
            let factor = (-moments.mean).exp();
            let (f, stated_hz) =
                (measured_hz * factor, stated(mode).unwrap_or_else(|| self.noise().std_hz(measured_hz)));
            // A factor that takes a frequency out of the valid range is no correction.
            let Ok(frequency) = Hertz::new(f) else { continue };
            corrected.frequencies_hz[mode] = Some(frequency);
            std_hz[mode] = Some((stated_hz * factor).hypot(f * moments.variance.sqrt()));
        }
        corrected.std_hz = Some(std_hz);
        Cow::Owned(corrected)
    }

    /// Mean over the support points of the variance of g of each mode, `[m]`; 0 without a discrepancy.
    pub fn typical_discrepancy_variance(&self) -> Vec<f64> {
        let Some(discrepancy) = self.discrepancy() else { return vec![0.0; self.modes()] };
        let rows: Vec<Vec<f64>> = rows(discrepancy);
        let mut sum = vec![0.0; self.modes()];
        for u in &rows {
            for (sum, moments) in sum.iter_mut().zip(discrepancy.at(Some(u))) {
                *sum += moments.variance / rows.len() as f64;
            }
        }
        sum
    }

    /// Draws covariates and settings of n measurements with the parameters `theta` (`[n][d]`), and the factor exp g(u) on each
    /// frequency, `[n][m]`; empty without a discrepancy. Inputs are those of support points, each with the same probability; a
    /// setting is replaced by the parameter of the measurement. One function g is drawn from its posterior for each mode and used
    /// for all measurements. The factor also contains the effects of the structure at these covariates, relative to their mean.
    ///
    /// # Errors
    /// [`physics::Error`] for parameters that give a negative stiffness or a mechanism.
    pub fn draw_discrepancy(&self, theta: &[Vec<f64>], seed: u64) -> Result<Vec<(Noted, Vec<f64>)>, physics::Error> {
        let Some(discrepancy) = self.discrepancy() else { return Ok(Vec::new()) };
        let mut stream = stats::stream(seed, "learned discrepancy");
        let points = rows(discrepancy);
        let mut normal = |count: usize| DVector::from_fn(count, |_, _| stream.sample::<f64, _>(StandardNormal));
        let functions: Vec<_> = discrepancy
            .modes()
            .iter()
            .map(|process| process.as_ref().map(|p| (p, p.coefficients(&normal(points.len())))))
            .collect();
        let mut stream = stats::stream(seed, "inputs of the learned discrepancy");
        let mut one = |theta: &Vec<f64>| {
            let mut u = points[stream.random_range(0..points.len())].clone();
            let noted = self.noted(discrepancy, theta, &mut u);
            let effects = self.effect_factors(theta, &noted)?;
            let factors = functions.iter().zip(effects).map(|(function, effects)| {
                let xi: f64 = stream.sample(StandardNormal);
                let g = function.as_ref().map_or(0.0, |(process, v)| process.value(discrepancy.support(), &u, v, xi));
                effects * g.exp()
            });
            Ok((noted, factors.collect()))
        };
        theta.iter().map(&mut one).collect()
    }

    /// Frequencies under the effects at some covariates, relative to those under their mean sizes, `[m]`.
    fn effect_factors(&self, theta: &[f64], (covariates, _): &Noted) -> Result<Vec<f64>, physics::Error> {
        if self.effects().is_empty() {
            return Ok(vec![1.0; self.modes()]);
        }
        let here = self.under(&self.effect_sizes(covariates).values).frequencies_hz(theta)?;
        Ok(here.iter().zip(self.frequencies_hz(theta)?).map(|(here, mean)| here / mean).collect())
    }

    /// The covariates and settings at standardised inputs `u`, in which settings are replaced by the parameters `theta`.
    fn noted(&self, discrepancy: &Discrepancy, theta: &[f64], u: &mut [f64]) -> Noted {
        let (mut covariates, mut settings) = Noted::default();
        for (input, value) in discrepancy.definition().inputs.iter().zip(u) {
            if let Some(column) = input.setting.as_ref().and_then(|name| self.space().position(name)) {
                *value = input.standardised(theta[column]);
                settings.insert(input.name().to_owned(), theta[column]);
            } else if input.is_category() {
                let level = input.levels[*value as usize].clone();
                covariates.insert(input.name().to_owned(), CovariateValue::Category(level));
            } else {
                let number = input.centre + input.scale * *value;
                covariates.insert(input.name().to_owned(), CovariateValue::Number(number));
            }
        }
        (covariates, settings)
    }
}

/// The support points, `[points][inputs]`.
fn rows(discrepancy: &Discrepancy) -> Vec<Vec<f64>> {
    discrepancy.support().points().row_iter().map(|row| row.iter().copied().collect()).collect()
}
