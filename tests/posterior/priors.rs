//! Normal and log-normal priors: the posterior of a measurement against quadrature, and the population behind a batch, from which the
//! prior of the single measurements must cancel.

use std::sync::LazyLock;

use modalwatch::assessment::{assess, Context, Draws};
use modalwatch::baseline::observation::{Observation, DEFAULT_NOISE_RANGE};
use modalwatch::baseline::start::locate;
use modalwatch::baseline::train::train;
use modalwatch::baseline::Baseline;
use modalwatch::flow::train::TrainSettings;
use modalwatch::flow::FlowSettings;
use modalwatch::hierarchy::{populations, populations_of_each};
use modalwatch::parameter::{DamageDirection, Parameter, ParameterSpace, PriorForm};
use modalwatch::posterior::PosteriorSamples;
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use modalwatch::stats;
use nalgebra::DMatrix;
use rand::Rng as _;
use rand_distr::StandardNormal;

use super::population::batch;

/// A tower of three masses whose lower two stiffnesses are unknown: three frequencies have one solution.
fn tower(noise: f64, first: &str, second: &str) -> Simulator {
    let text = format!(
        "id = \"tower\"\nmodes = 3\nmeasurement_noise = {{ relative = {noise:?} }}\n\
         mass = [{{ name = \"a\", kg = 1.0 }}, {{ name = \"b\", kg = 1.5 }}, {{ name = \"c\", kg = 1.0 }}]\n\
         spring = [{{ name = \"k1\", from = \"ground\", to = \"a\" }}, {{ name = \"k2\", from = \"a\", to = \"b\" }},\n\
         {{ name = \"k3\", from = \"b\", to = \"c\", n_per_m = 80.0 }}]\n\
         parameter = [\n{{ name = \"p1\", prior = {{ {first} }}, sets = {{ spring = \"k1\" }} }},\n\
         {{ name = \"p2\", prior = {{ {second} }}, sets = {{ spring = \"k2\" }} }}]\n"
    );
    Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap()
}

const NORMAL: &str = "normal = { mean = 100.0, std = 20.0 }";
const LOG_NORMAL: &str = "log_normal = { median = 60.0, relative_std = 0.25 }";

fn trained(simulator: &Simulator) -> Baseline {
    let settings = TrainSettings { epochs: 6, ..TrainSettings::default() };
    train(simulator, 4_000, DEFAULT_NOISE_RANGE, &FlowSettings::default(), &settings, |_| {}).unwrap().baseline
}

static TAILED: LazyLock<Baseline> = LazyLock::new(|| trained(&tower(0.01, NORMAL, LOG_NORMAL)));

/// The same with uniform priors of the same bounds.
static FLAT: LazyLock<Baseline> =
    LazyLock::new(|| trained(&tower(0.01, "uniform = [20.0, 180.0]", "uniform = [22.4, 160.6]")));

/// A standard normal density of z; the stated priors, written down once more.
fn stated(theta: [f64; 2]) -> f64 {
    let log_std = (1.0_f64 + 0.25 * 0.25).ln().sqrt();
    let z = [(theta[0] - 100.0) / 20.0, (theta[1] / 60.0).ln() / log_std];
    (-0.5 * (z[0] * z[0] + z[1] * z[1])).exp() / theta[1]
}

/// Mean and standard deviation of both parameters by quadrature over the prior box, with a prior density up to a constant.
fn quadrature(
    simulator: &Simulator,
    measured_hz: &[f64],
    noise: f64,
    prior: impl Fn([f64; 2]) -> f64,
) -> [(f64, f64); 2] {
    let steps = 300;
    let space = simulator.space().as_slice();
    let at = |k: usize, step: usize| space[k].from_unit((step as f64 + 0.5) / f64::from(steps));
    let mut points = Vec::new();
    for i in 0..steps as usize {
        for j in 0..steps as usize {
            let theta = [at(0, i), at(1, j)];
            let f = simulator.frequencies_hz(&theta).unwrap();
            let log: f64 =
                f.iter().zip(measured_hz).map(|(f, y)| -0.5 * ((y - f) / (noise * f)).powi(2) - f.ln()).sum();
            points.push((theta, log + prior(theta).ln()));
        }
    }
    let largest = points.iter().map(|(_, log)| *log).fold(f64::NEG_INFINITY, f64::max);
    let moment = |k: usize, about: f64, power: i32| {
        let (mut sum, mut mass) = (0.0, 0.0);
        for (theta, log) in &points {
            let weight = (log - largest).exp();
            (sum, mass) = (sum + weight * (theta[k] - about).powi(power), mass + weight);
        }
        sum / mass
    };
    [0, 1].map(|k| {
        let mean = moment(k, 0.0, 1);
        (mean, moment(k, mean, 2).sqrt())
    })
}

#[test]
fn posteriors_under_priors_with_tails_agree_with_quadrature() {
    let baseline = &*TAILED;
    let simulator = baseline.simulator();
    let draws = 4_000;
    // Off the middle of both priors, and at three noise levels; the last has little to say against the prior.
    let mut pulled = 0;
    for (theta, multiple) in [([75.0, 80.0], 1.0), ([130.0, 45.0], 3.0), ([70.0, 50.0], 5.0), ([100.0, 60.0], 0.5)] {
        let exact = simulator.frequencies_hz(&theta).unwrap();
        let observation = Observation { noise_multiple: vec![multiple; 3], ..Observation::complete(&exact) };
        let samples = baseline.infer(std::slice::from_ref(&observation), draws, 3).unwrap();
        let noise = 0.01 * multiple;
        let truth = quadrature(simulator, &exact, noise, stated);
        let flat = quadrature(simulator, &exact, noise, |_| 1.0);
        for k in 0..2 {
            let own = samples.column(k);
            let (mean, std) = (stats::mean(&own), stats::sample_std(&own).unwrap());
            let (exact_mean, exact_std) = truth[k];
            // At least half the draws are effective where they are resampled, and some repeat: five errors of a quarter of them.
            let error = 5.0 / (0.25 * draws as f64).sqrt();
            println!(
                "p{} × {multiple}: {mean:.2} ± {std:.2}, exact {exact_mean:.2} ± {exact_std:.2}, flat {:.2} ± {:.2}",
                k + 1,
                flat[k].0,
                flat[k].1
            );
            assert!((mean - exact_mean).abs() < error * exact_std, "p{}: {mean}, {exact_mean} ± {exact_std}", k + 1);
            assert!((std / exact_std - 1.0).abs() < error, "p{}: {std}, {exact_std}", k + 1);
            pulled += usize::from(
                (flat[k].0 - exact_mean).abs() > 2.0 * error * exact_std || (flat[k].1 / exact_std - 1.0) > 2.0 * error,
            );
        }
    }
    assert!(pulled >= 4, "the priors must matter for the test to say anything: {pulled} of 8");
}

#[test]
fn the_flow_itself_learns_the_prior() {
    // The mean log-density of truths drawn from the prior is highest for the exact posterior: no other prior does better, on average.
    let baseline = &*TAILED;
    let simulator = baseline.simulator();
    let set = simulator.training_set(400, 77).unwrap();
    let mut stream = stats::stream(77, "test");
    let observations: Vec<Observation> = (0..400)
        .map(|row| {
            let f: Vec<f64> = set
                .frequencies_hz
                .row(row)
                .iter()
                .map(|f| f * (1.0 + 0.03 * stream.sample::<f64, _>(StandardNormal)))
                .collect();
            Observation { noise_multiple: vec![3.0; 3], ..Observation::complete(&f) }
        })
        .collect();
    let own = stats::mean(&baseline.log_density_unit_box(&set.theta, &observations).unwrap());
    let space = simulator.space();
    let prior = stats::mean(&set.theta.row_iter().map(|row| space.log_prior(row.iter())).collect::<Vec<f64>>());
    let uniform = stats::mean(&FLAT.log_density_unit_box(&set.theta, &observations).unwrap());
    println!("log-density of the truth: {own:.3}, of the prior alone {prior:.3}, of a flow with a uniform prior {uniform:.3} nats");
    assert!(own > prior + 0.5, "the measurements say something: {own}, {prior}");
    assert!(own > uniform + 0.2, "the prior says something: {own}, {uniform}");
}

#[test]
fn the_fit_that_a_flow_starts_at_has_the_moments_of_the_posterior() {
    // Priors as narrow as the likelihood, off the truth, and little curvature.
    let simulator =
        tower(0.01, "normal = { mean = 96.0, std = 3.0 }", "log_normal = { median = 62.0, relative_std = 0.03 }");
    let exact = simulator.frequencies_hz(&[100.0, 60.0]).unwrap();
    let fit = locate(&simulator, &Observation::complete(&exact)).unwrap();
    let log_std = (1.0_f64 + 0.03 * 0.03).ln().sqrt();
    let prior = |theta: [f64; 2]| {
        let z = [(theta[0] - 96.0) / 3.0, (theta[1] / 62.0).ln() / log_std];
        (-0.5 * (z[0] * z[0] + z[1] * z[1])).exp() / theta[1]
    };
    for (k, (mean, std)) in quadrature(&simulator, &exact, 0.01, prior).into_iter().enumerate() {
        let p = &simulator.space().as_slice()[k];
        let (found, found_std) = (p.from_unit(fit.unit[k]), fit.std[k] * (p.upper - p.lower));
        println!("p{}: {found:.3} ± {found_std:.3}, exact {mean:.3} ± {std:.3}", k + 1);
        assert!((found - mean).abs() < 0.1 * std, "p{}: {found}, {mean} ± {std}", k + 1);
        assert!((found_std / std - 1.0).abs() < 0.05, "p{}: {found_std}, {std}", k + 1);
    }
}

/// A parameter with a prior on ±4 standard deviations of 10 about 100.
fn parameter(form: PriorForm) -> Parameter {
    let (name, unit) = ("k1".to_owned(), "N/m".to_owned());
    Parameter { name, unit, lower: 60.0, upper: 140.0, damage: DamageDirection::Decrease, form }
}

/// Samples of the posteriors of a batch whose measurements each have the standard deviation `noise`, under a prior.
fn conjugate(form: PriorForm, measured: &[f64], noise: f64, draws: usize, seed: u64) -> PosteriorSamples {
    let precision = match form {
        PriorForm::Normal { std, .. } => std.powi(-2),
        _ => 0.0,
    };
    let of_data = noise.powi(-2);
    let std = (precision + of_data).sqrt().recip();
    let mut stream = stats::stream(seed, "test: conjugate posteriors");
    let theta = DMatrix::from_fn(measured.len() * draws, 1, |row, _| {
        let mean = (precision * 100.0 + of_data * measured[row / draws]) / (precision + of_data);
        loop {
            let x: f64 = mean + std * stream.sample::<f64, _>(StandardNormal);
            if (60.0..=140.0).contains(&x) {
                return x;
            }
        }
    });
    PosteriorSamples::new(theta, draws)
}

#[test]
fn the_prior_of_single_measurements_cancels_from_the_population() {
    // The population lies one and a half standard deviations of the prior off its middle. Each measurement alone says no more than the
    // prior, so that 40 priors that did not cancel would pull the mean half the way.
    let (mean, std, noise, count, repeats) = (85.0, 4.0, 8.0, 40, 60);
    let forms = [PriorForm::Uniform, PriorForm::Normal { mean: 100.0, std: 10.0 }];
    let mut found = [[0.0; 2]; 2];
    let mut apart = Vec::new();
    let error = ((std * std + noise * noise) / f64::from(count)).sqrt();
    for seed in 0..repeats {
        let mut stream = stats::stream(seed, "test: population");
        let mut normal = |std: f64| std * stream.sample::<f64, _>(StandardNormal);
        let measured: Vec<f64> = (0..count).map(|_| mean + normal(std) + normal(noise)).collect();
        let each = [0, 1].map(|i| {
            let space = ParameterSpace::new(vec![parameter(forms[i])]);
            let samples = conjugate(forms[i], &measured, noise, 128, seed);
            let own = populations(&samples, None, &space, seed).parameters.remove(0);
            let alone = populations_of_each(&samples, &space, seed).parameters.remove(0);
            assert!(
                (alone.mean - own.mean).abs() < 0.1 * error,
                "one parameter at a time: {} {}",
                alone.mean,
                own.mean
            );
            found[i][0] += stats::mean(&own.mean_draws) / repeats as f64;
            found[i][1] += stats::mean(&own.std_draws) / repeats as f64;
            stats::mean(&own.mean_draws)
        });
        apart.push(each[1] - each[0]);
    }
    let difference = stats::mean(&apart);
    println!(
        "mean {:.3} and {:.3}, std {:.3} and {:.3}; standard error of one batch {error:.2}",
        found[0][0], found[1][0], found[0][1], found[1][1]
    );
    for [found, _] in found {
        // Four standard errors of the mean over all batches, and what the prior of the mean, which counts once, moves it.
        let once = error * error / 100.0 * 15.0;
        assert!((found - mean).abs() < 4.0 * error / (repeats as f64).sqrt() + once, "{found}");
    }
    // The prior counts once, for the mean of the batch: error²/(error² + 10²) of the distance of 15. One prior for each of the 40
    // measurements would have moved it by 5.9.
    assert!((difference - 0.3).abs() < 0.3, "{difference}");
    assert!((found[1][1] - found[0][1]).abs() < 0.1 * std, "{found:?}");
}

#[test]
fn a_batch_has_the_same_population_under_a_uniform_prior_and_under_one_with_tails() {
    let moments = [(78.0, 4.0), (75.0, 3.0)];
    let draws = Draws { per_measurement: 10, for_population: 64, seed: 5 };
    let (count, repeats) = (40, 8);
    let (mut off, mut error) = ([[0.0; 2]; 2], [0.0; 2]);
    for seed in 0..repeats {
        let measured = batch(&FLAT, &moments, count, 1.0, 900 + seed);
        for (i, baseline) in [&*FLAT, &*TAILED].into_iter().enumerate() {
            let context = Context { undamaged: None, earlier: None };
            let assessment = assess(baseline, &measured, context, draws, measured[0].measured_at).unwrap();
            for k in 0..2 {
                let quantity = &assessment.quantities[k];
                off[i][k] += (quantity.mean - moments[k].0) / repeats as f64;
                let [low, high] = quantity.mean_interval.unwrap();
                error[k] += (high - low) / 3.29 / 2.0 / repeats as f64;
            }
        }
    }
    for k in 0..2 {
        println!("p{}: mean off by {:.3} under the uniform prior, {:.3} under the one with tails; standard error of one batch {:.3}", k + 1, off[0][k], off[1][k], error[k]);
    }
    for k in 0..2 {
        // The same measurements: only the Monte Carlo error and the prior of the mean differ, which moves a mean by (error/20)² of its
        // distance of 22 from the middle of p1's prior.
        assert!((off[0][k] - off[1][k]).abs() < 0.3 * error[k], "p{}: {off:?}, {error:?}", k + 1);
        assert!(off[1][k].abs() < 4.0 * error[k] / (repeats as f64).sqrt(), "p{}: {off:?}, {error:?}", k + 1);
    }
}
