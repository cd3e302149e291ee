//! The population behind a batch by TMCMC, against what the population was drawn with and against sampling theory.

use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::population::Population as Drawn;
use modalwatch::simulator::Simulator;
use modalwatch::stats;
use modalwatch::updating::stochastic::{settings, Error, Population};
use modalwatch::updating::tmcmc::Target as _;
use nalgebra::DMatrix;

const MODES: [usize; 3] = [0, 1, 2];

fn three_dof() -> Simulator {
    let text = include_str!("../../models/three-dof/structure.toml");
    Simulator::new(StructureDefinition::parse_toml(text).unwrap()).unwrap()
}

fn moments() -> Vec<(String, f64, f64)> {
    [("k1", 4.0, 0.3), ("k2", 5.0, 0.1), ("k3", 6.0, 0.2)].map(|(k, m, s)| (k.to_owned(), m, s)).to_vec()
}

#[test]
fn the_posterior_of_mean_and_spread_is_as_wide_as_sampling_theory_says_and_where_the_sample_is() {
    let simulator = three_dof();
    let count = 200;
    let drawn = Drawn::new(simulator.space(), &moments()).unwrap().draw(&simulator, count, 0.0, 3).unwrap();
    let population = Population::new(&simulator, &drawn.frequencies_hz, &MODES, 0.0, 128, 1).unwrap();
    let (samples, estimate) = population.sample(&settings(1_000), 1, &|_| {}).unwrap();
    let root = (count as f64).sqrt();
    for k in 0..3 {
        let realised: Vec<f64> = drawn.theta.column(k).iter().copied().collect();
        let (mean, std) = (stats::mean(&realised), stats::sample_std(&realised).unwrap());
        println!("{} {mean:.4} {:.4}, {std:.4} {:.4}", moments()[k].0, estimate.mean[k], estimate.std[k]);
        // Posterior means of 1,000 samples have an error of about 0.1 posterior standard deviations; the curvature of the map and
        // the finite simulated sample add as much.
        assert!((estimate.mean[k] - mean).abs() < 0.4 * std / root, "mean of {k}: {} {mean}", estimate.mean[k]);
        assert!((estimate.std[k] - std).abs() < 0.4 * std / (2.0_f64.sqrt() * root), "std of {k}: {}", estimate.std[k]);
        let spread = |column: usize| {
            stats::sample_std(&samples.theta.column(column).iter().copied().collect::<Vec<f64>>()).unwrap()
        };
        // σ/√n and σ/√2n. The error of a standard deviation of 1,000 correlated samples is about 5 %.
        for (found, theory) in [(spread(k), std / root), (spread(3 + k), std / (2.0_f64.sqrt() * root))] {
            assert!((0.8..1.25).contains(&(found / theory)), "{k}: {found} against {theory}");
        }
    }
}

#[test]
fn noise_of_the_measurements_is_not_taken_for_spread() {
    let simulator = three_dof();
    let drawn = Drawn::new(simulator.space(), &moments()).unwrap().draw(&simulator, 200, 1.0, 4).unwrap();
    let std_of_k2 = |noise: f64| {
        let population = Population::new(&simulator, &drawn.frequencies_hz, &MODES, noise, 128, 1).unwrap();
        population.sample(&settings(500), 1, &|_| {}).unwrap().1.std[1]
    };
    let (modelled, ignored) = (std_of_k2(1.0), std_of_k2(0.0));
    let exact = stats::sample_std(&drawn.theta.column(1).iter().copied().collect::<Vec<f64>>()).unwrap();
    println!("k2: drawn {exact:.4}, with the noise modelled {modelled:.4}, with the noise ignored {ignored:.4}");
    // Noise of 0.1 % changes k2 by 0.08 N/m in a single measurement: if it is not modelled, √(0.1² + 0.08²) results.
    assert!((modelled - exact).abs() < 0.02, "{modelled} {exact}");
    assert!(ignored > 1.15 * exact, "{ignored} {exact}");
}

#[test]
fn data_without_a_distribution_are_refused() {
    let simulator = three_dof();
    let few = DMatrix::from_element(4, 3, 0.5);
    assert!(matches!(Population::new(&simulator, &few, &MODES, 0.0, 128, 1), Err(Error::TooFew { found: 4, .. })));
    let same = DMatrix::from_fn(20, 3, |_, mode| 0.5 + mode as f64);
    assert!(matches!(Population::new(&simulator, &same, &MODES, 0.0, 128, 1), Err(Error::Singular)));
    let drawn = Drawn::new(simulator.space(), &moments()).unwrap().draw(&simulator, 20, 0.0, 3).unwrap();
    let many = Population::new(&simulator, &drawn.frequencies_hz, &MODES, 0.0, 1 << 17, 1);
    assert!(matches!(many, Err(Error::Points { .. })));
    // With fewer points than a covariance needs, the likelihood would be zero everywhere.
    let few = Population::new(&simulator, &drawn.frequencies_hz, &MODES, 0.0, 4, 1);
    assert!(matches!(few, Err(Error::Points { .. })));
}

#[test]
fn the_points_of_the_simulation_have_the_moments_of_thousands() {
    let simulator = three_dof();
    let count = 500;
    let drawn = Drawn::new(simulator.space(), &moments()).unwrap().draw(&simulator, count, 0.0, 5).unwrap();
    let log_likelihood = |simulated: usize, seed: u64| {
        let population = Population::new(&simulator, &drawn.frequencies_hz, &MODES, 0.0, simulated, seed).unwrap();
        modalwatch::updating::tmcmc::Target::log_likelihood(&population, &[4.0, 5.0, 6.0, 0.3, 0.1, 0.2])
    };
    let exact = log_likelihood(1 << 14, 1);
    for seed in 0..10 {
        let few = log_likelihood(modalwatch::updating::stochastic::simulated_for(count), seed);
        println!("ln L {few:.3} of few points, {exact:.3} of many");
        // A difference of one nat matters between two points of the posterior.
        assert!((few - exact).abs() < 0.5, "{few} {exact}");
    }
}

#[test]
fn a_normal_prior_counts_once_for_the_mean_of_the_population() {
    // The same bounds, 3 to 7, under both priors.
    let normal = |text: &str| text.replace("uniform = [3.0, 7.0]", "normal = { mean = 5.0, std = 0.5 }");
    let text = normal(include_str!("../../models/three-dof/structure.toml"));
    let (flat, tailed) = (three_dof(), Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap());
    // Eight measurements determine the mean of k1 so badly that its prior, two standard deviations away, matters.
    let drawn = Drawn::new(flat.space(), &moments()).unwrap().draw(&flat, 8, 0.0, 3).unwrap();
    let of = |simulator| Population::new(simulator, &drawn.frequencies_hz, &MODES, 0.0, 128, 1).unwrap();
    let log_prior = |theta: &[f64]| of(&tailed).log_prior(theta);
    let z = |theta: &[f64]| theta[..3].iter().map(|mean| -0.5 * ((mean - 5.0) / 0.5).powi(2)).sum::<f64>();
    let [near, far] = [[5.0, 5.1, 4.8, 0.3, 0.1, 0.2], [4.0, 5.0, 6.2, 0.2, 0.1, 0.4]];
    assert!((log_prior(&near) - log_prior(&far) - (z(&near) - z(&far))).abs() < 1e-9);
    assert!(log_prior(&[5.0, 5.0, 5.0, 0.3, 0.51, 0.2]).is_infinite(), "no population is wider than the prior");
    let mut stream = stats::stream(1, "test");
    let first: Vec<f64> = (0..4_000).map(|_| of(&tailed).draw_prior(&mut stream)[0]).collect();
    // Four standard errors.
    assert!((stats::mean(&first) - 5.0).abs() < 4.0 * 0.5 / 4_000.0_f64.sqrt());
    assert!((stats::sample_std(&first).unwrap() / 0.5 - 1.0).abs() < 4.0 / 8_000.0_f64.sqrt());

    let (samples, uniform) = of(&flat).sample(&settings(1_000), 1, &|_| {}).unwrap();
    let (_, found) = of(&tailed).sample(&settings(1_000), 2, &|_| {}).unwrap();
    // Samples under the uniform prior, weighted by the normal one.
    let rows: Vec<Vec<f64>> = samples.theta.row_iter().map(|row| row.iter().copied().collect()).collect();
    let weights: Vec<f64> = rows.iter().map(|row| log_prior(row).exp()).collect();
    let mean = |k: usize| {
        rows.iter().zip(&weights).map(|(row, weight)| weight * row[k]).sum::<f64>() / weights.iter().sum::<f64>()
    };
    let error = stats::sample_std(&samples.theta.column(0).iter().copied().collect::<Vec<f64>>()).unwrap();
    println!(
        "k1: {:.4} under the uniform prior, {:.4} under the normal one, {:.4} by weights; ± {error:.4}",
        uniform.mean[0],
        found.mean[0],
        mean(0)
    );
    // Both have an error of about 0.1 posterior standard deviations; the prior moves the mean by 0.4 of them.
    assert!((found.mean[0] - mean(0)).abs() < 0.25 * error, "{} {}", found.mean[0], mean(0));
    assert!(found.mean[0] - uniform.mean[0] > 0.15 * error, "{} {}", found.mean[0], uniform.mean[0]);
}
