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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quantity::Timestamp;
    use crate::simulator::definition::StructureDefinition;

    const TOWER: &str = r#"
        id = "tower"
        modes = 2
        measurement_noise = { relative = 0.001 }
        mass = [{ name = "m1", kg = 1.0 }, { name = "m2", kg = 1.0 }]
        spring = [
            { name = "k1", from = "ground", to = "m1", n_per_m = 1000.0 },
            { name = "k2", from = "m1", to = "m2", n_per_m = 800.0 },
        ]
        parameter = [{ name = "k1", prior = { uniform = [500.0, 1500.0] }, sets = { spring = "k1" } }]
        covariate = [{ name = "temperature_c" }, { name = "operator", kind = "category" }]

        [discrepancy]
        inputs = [
            { covariate = "temperature_c", centre = 10.0, scale = 5.0, seen = [0.0, 20.0] },
            { covariate = "operator", levels = ["A", "B"] },
        ]
        points = [[-1.0, 0.0], [0.0, 1.0], [1.5, 0.0]]
        [[discrepancy.mode]]
        mode = 2
        std = 0.01
        lengths = [1.0, 2.0]
        weights = [0.5, -1.0, 0.8]
        factor = [[0.3], [0.1, 0.2], [0.0, 0.1, 0.4]]
    "#;

    fn tower() -> Simulator {
        Simulator::new(StructureDefinition::parse_toml(TOWER).unwrap()).unwrap()
    }

    fn measurement(temperature_c: Option<f64>, operator: &str) -> ModalMeasurement {
        let operator = ("operator".to_owned(), CovariateValue::Category(operator.to_owned()));
        let temperature = temperature_c.map(|t| ("temperature_c".to_owned(), CovariateValue::Number(t)));
        ModalMeasurement {
            measured_at: Timestamp::from_micros(0).unwrap(),
            frequencies_hz: vec![Hertz::new(3.0).map(Some).unwrap(), Hertz::new(8.0).map(Some).unwrap()],
            std_hz: Some(vec![None, Some(0.02)]),
            mode_shapes: None,
            covariates: [operator].into_iter().chain(temperature).collect(),
            settings: BTreeMap::new(),
        }
    }

    #[test]
    fn each_mistake_of_a_discrepancy_is_named_with_its_place() {
        let cases = [
            ("measurement_noise = { relative = 0.001 }", "", "/discrepancy", "measurement_noise above 0"),
            (
                "covariate = \"operator\", l",
                "covariate = \"lab\", l",
                "/discrepancy/inputs/1/covariate",
                "no [[covariate]] \"lab\"",
            ),
            (
                "covariate = \"operator\", levels = [\"A\", \"B\"]",
                "covariate = \"operator\", seen = [0.0, 1.0]",
                "/discrepancy/inputs/1/levels",
                "list its levels",
            ),
            (
                "covariate = \"operator\", l",
                "setting = \"k9\", l",
                "/discrepancy/inputs/1/setting",
                "no parameter \"k9\"",
            ),
            (
                "covariate = \"operator\", l",
                "setting = \"k1\", covariate = \"operator\", l",
                "/discrepancy/inputs/1",
                "either a covariate or a setting",
            ),
            ("scale = 5.0", "scale = 0.0", "/discrepancy/inputs/0/scale", "above 0"),
            ("seen = [0.0, 20.0]", "seen = [20.0, 0.0]", "/discrepancy/inputs/0/seen", "ascending order"),
            ("[0.0, 1.0], [1.5", "[0.0, 2.0], [1.5", "/discrepancy/points/1", "an index of its levels, 0 to 1"),
            ("[0.0, 1.0], [1.5", "[0.0], [1.5", "/discrepancy/points/1", "2 finite numbers"),
            ("mode = 2", "mode = 3", "/discrepancy/mode/0/mode", "modes 1 to 2"),
            ("std = 0.01", "std = -0.01", "/discrepancy/mode/0/std", "above 0 and below 1"),
            ("lengths = [1.0, 2.0]", "lengths = [1.0]", "/discrepancy/mode/0/lengths", "2 finite numbers"),
            ("weights = [0.5, -1.0, 0.8]", "weights = [0.5]", "/discrepancy/mode/0/weights", "3 finite numbers"),
            ("factor = [[0.3]", "factor = [[1.3]", "/discrepancy/mode/0/factor", "more than 1"),
            ("[0.1, 0.2], ", "[0.1], ", "/discrepancy/mode/0/factor", "lower triangle of 3 rows"),
        ];
        for (text, by, pointer, message) in cases {
            assert!(TOWER.contains(text), "{text}");
            let error = StructureDefinition::parse_toml(&TOWER.replacen(text, by, 1)).unwrap_err();
            let found = error.problems.iter().any(|p| p.pointer == pointer && p.message.contains(message));
            assert!(found, "{by}: {error}");
        }
    }

    #[test]
    fn a_measurement_is_corrected_by_the_mean_and_gets_the_variance() {
        let tower = tower();
        let own = measurement(Some(12.0), "B");
        let corrected = tower.corrected(&own);
        let moments = tower.discrepancy().unwrap().at(Some(&[0.4, 1.0]))[1];
        assert!(moments.mean.abs() > 1e-4 && moments.variance > 0.0 && moments.variance < 1e-4, "{moments:?}");
        let hz = |mode: usize| corrected.frequencies_hz[mode].unwrap().get();
        assert!((hz(1) - 8.0 * (-moments.mean).exp()).abs() < 1e-12 && (hz(0) - 3.0).abs() < 1e-12);
        let std = corrected.std_hz.as_ref().unwrap();
        let expected = (0.02 * (-moments.mean).exp()).hypot(hz(1) * moments.variance.sqrt());
        assert!((std[1].unwrap() - expected).abs() < 1e-12 && (std[0].unwrap() - 0.003).abs() < 1e-12, "{std:?}");

        // Without an input, the prior: no correction, σ = 1 % of 8 Hz.
        let (blind, unknown) = (measurement(None, "A"), measurement(Some(12.0), "C"));
        for (own, reservations) in [(&blind, (1, 0)), (&unknown, (0, 1))] {
            let corrected = tower.corrected(own);
            assert!((corrected.frequencies_hz[1].unwrap().get() - 8.0).abs() < 1e-12);
            assert!((corrected.std_hz.as_ref().unwrap()[1].unwrap() - 0.02_f64.hypot(0.08)).abs() < 1e-12);
            let (missing, beyond) = tower.discrepancy_reservations(own);
            assert_eq!((missing.len(), beyond.len()), reservations);
        }
        assert_eq!(tower.discrepancy_reservations(&measurement(Some(22.5), "A")).1, ["temperature_c"]);
        assert_eq!(tower.discrepancy_reservations(&measurement(Some(21.5), "A")).1.len(), 0);
    }

    /// Over many drawn functions, ln f minus the mean of g has the variance of g.
    #[test]
    fn simulated_measurements_contain_the_discrepancy() {
        let tower = tower();
        let discrepancy = tower.discrepancy().unwrap();
        let (mut squares, mut sum, mut count) = (0.0, 0.0, 0.0);
        for seed in 0..4_000 {
            for ((covariates, settings), factors) in tower.draw_discrepancy(&[vec![1000.0]], seed).unwrap() {
                let inputs = discrepancy.inputs(&covariates, &settings);
                let moments = discrepancy.at(inputs.u.as_deref())[1];
                let unit = (factors[1].ln() - moments.mean) / moments.variance.sqrt();
                assert!((factors[0] - 1.0).abs() < 1e-15);
                squares += unit * unit;
                sum += unit;
                count += 1.0;
            }
        }
        // Standard errors over 4,000 draws: 0.016 of the mean and 0.022 of the variance; four of them.
        assert!(
            (sum / count).abs() < 0.064 && (squares / count - 1.0).abs() < 0.09,
            "{} {}",
            sum / count,
            squares / count
        );
        assert!(tower.typical_discrepancy_variance()[0].abs() < f64::MIN_POSITIVE);
    }
}
