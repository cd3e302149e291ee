//! Transitional MCMC against closed forms, and the Bhattacharyya likelihood.

use std::f64::consts::TAU;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Mutex;

use modalwatch::stats::{self, Stream};
use modalwatch::updating::distance::{bhattacharyya, epsilon_squared, log_likelihood, Moments};
use modalwatch::updating::tmcmc::{tmcmc, Error, Samples, Settings, Stage, Target};
use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;

fn normal(stream: &mut Stream) -> f64 {
    stream.sample(StandardNormal)
}

/// ln N(x; mean, std²).
fn log_normal(x: f64, mean: f64, std: f64) -> f64 {
    -0.5 * ((x - mean) / std).powi(2) - 0.5 * (TAU * std * std).ln()
}

fn sample<T: Target>(target: &T, seed: u64) -> Samples {
    tmcmc(target, &Settings::default(), seed, &|_| {}).unwrap()
}

fn column(samples: &Samples, k: usize) -> Vec<f64> {
    samples.theta.column(k).iter().copied().collect()
}

/// Mean and its standard error.
fn mean_and_error(values: &[f64]) -> (f64, f64) {
    (stats::mean(values), stats::sample_std(values).unwrap() / (values.len() as f64).sqrt())
}

// ---- Targets ----

/// Prior N(0, s²·I), n rows of data with N(θ, Σ).
struct Conjugate {
    s: f64,
    n: f64,
    precision: DMatrix<f64>,
    data_mean: DVector<f64>,
    /// Log-likelihood at θ equal to the mean of the data.
    log_largest: f64,
}

impl Conjugate {
    fn new(d: usize) -> Self {
        let (s, n) = (3.0, 20.0);
        // Unequal scales and a correlation of 0.6.
        let entry = |i: usize, j: usize| (if i == j { 0.25 } else { 0.15 }) * 2f64.powi((i + j) as i32);
        let sigma = DMatrix::from_fn(d, d, entry);
        let precision = sigma.clone().try_inverse().unwrap();
        let data_mean = DVector::from_fn(d, |i, _| 1.0 + 0.5 * i as f64);
        // The scatter of the data about their mean has its expected value, n·d in units of Σ.
        let log_largest = -0.5 * n * (d as f64 * TAU.ln() + sigma.determinant().ln()) - 0.5 * n * d as f64;
        Self { s, n, precision, data_mean, log_largest }
    }

    fn posterior(&self) -> (DVector<f64>, DMatrix<f64>) {
        let d = self.data_mean.len();
        let own = &self.precision * self.n;
        let covariance = (&own + DMatrix::identity(d, d) / self.s.powi(2)).try_inverse().unwrap();
        (&covariance * own * &self.data_mean, covariance)
    }

    /// ln p(data) = ln prior(m) + ln L(m) − ln posterior(m) at the posterior mean m, as at any θ.
    fn log_evidence(&self) -> f64 {
        let (mean, covariance) = self.posterior();
        let prior: f64 = mean.iter().map(|x| log_normal(*x, 0.0, self.s)).sum();
        let density = -0.5 * (mean.len() as f64 * TAU.ln() + covariance.determinant().ln());
        prior + self.log_likelihood(mean.as_slice()) - density
    }
}

impl Target for Conjugate {
    fn dimensions(&self) -> usize {
        self.data_mean.len()
    }

    fn draw_prior(&self, stream: &mut Stream) -> Vec<f64> {
        (0..self.dimensions()).map(|_| self.s * normal(stream)).collect()
    }

    // Without the constant factor, which must not matter.
    fn log_prior(&self, theta: &[f64]) -> f64 {
        -0.5 * theta.iter().map(|x| (x / self.s).powi(2)).sum::<f64>()
    }

    fn log_likelihood(&self, theta: &[f64]) -> f64 {
        let off = DVector::from_column_slice(theta) - &self.data_mean;
        self.log_largest - 0.5 * self.n * off.dot(&(&self.precision * &off))
    }
}

/// A uniform prior over a box, and a likelihood as a function.
struct InBox<L: Fn(&[f64]) -> f64 + Sync> {
    bounds: Vec<(f64, f64)>,
    log_likelihood: L,
}

impl<L: Fn(&[f64]) -> f64 + Sync> Target for InBox<L> {
    fn dimensions(&self) -> usize {
        self.bounds.len()
    }

    fn draw_prior(&self, stream: &mut Stream) -> Vec<f64> {
        self.bounds.iter().map(|(lower, upper)| lower + (upper - lower) * stream.random::<f64>()).collect()
    }

    fn log_prior(&self, theta: &[f64]) -> f64 {
        let inside = theta.iter().zip(&self.bounds).all(|(x, (lower, upper))| (lower..=upper).contains(&x));
        if inside {
            0.0
        } else {
            f64::NEG_INFINITY
        }
    }

    fn log_likelihood(&self, theta: &[f64]) -> f64 {
        (self.log_likelihood)(theta)
    }
}

// ---- Sampler ----

#[test]
fn a_conjugate_posterior_and_its_evidence_are_the_closed_form() {
    for d in 2..=4 {
        let target = Conjugate::new(d);
        let (mean, covariance) = target.posterior();
        let samples = sample(&target, 1);
        assert_eq!(samples.theta.shape(), (1_000, d));
        for i in 0..d {
            let own = column(&samples, i);
            // For 1,000 samples with a remaining correlation of 0.3, the standard error of the mean is 0.035 standard deviations,
            // measured over 200 seeds; the tolerance is four times that.
            let off = (stats::mean(&own) - mean[i]) / covariance[(i, i)].sqrt();
            assert!(off.abs() < 0.14, "d {d}, mean of {i}: {off}");
            for j in 0..=i {
                let other = column(&samples, j);
                let (a, b) = (stats::mean(&own), stats::mean(&other));
                let products: Vec<f64> = own.iter().zip(&other).map(|(x, y)| (x - a) * (y - b)).collect();
                let scale = (covariance[(i, i)] * covariance[(j, j)]).sqrt();
                let off = (stats::mean(&products) - covariance[(i, j)]) / scale;
                // The relative standard error of a variance is √(2/1,000) = 4.5 %, that of a covariance is smaller. A factor of 1.1
                // accounts for remaining copies; the tolerance is four times that.
                assert!(off.abs() < 0.2, "d {d}, covariance of {i} and {j}: {off}");
            }
        }
        let off = samples.log_evidence - target.log_evidence();
        println!("d {d}: log-evidence off by {off:.3} ± {:.3}", samples.log_evidence_std_error);
        assert!(off.abs() < 4.0 * samples.log_evidence_std_error, "d {d}: {off}");
        for (theta, own) in samples.theta.row_iter().zip(&samples.log_likelihood) {
            let theta: Vec<f64> = theta.iter().copied().collect();
            assert!((target.log_likelihood(&theta) - own).abs() < 1e-12, "log-likelihood of another sample");
        }
    }
}

#[test]
fn the_evidence_is_unbiased_and_its_error_is_the_scatter_over_seeds() {
    for d in [2, 4] {
        let target = Conjugate::new(d);
        let runs: Vec<Samples> = (0..60).map(|seed| sample(&target, seed)).collect();
        let off: Vec<f64> = runs.iter().map(|r| r.log_evidence - target.log_evidence()).collect();
        // The estimate of the evidence is unbiased; its logarithm is too low by half its variance on average.
        let (ratio, ratio_error) = mean_and_error(&off.iter().map(|o| o.exp()).collect::<Vec<_>>());
        assert!((ratio - 1.0).abs() < 3.0 * ratio_error, "d {d}: evidence {ratio} ± {ratio_error} of the exact one");
        let reported = stats::mean(&runs.iter().map(|r| r.log_evidence_std_error.powi(2)).collect::<Vec<_>>()).sqrt();
        let (bias, error) = mean_and_error(&off);
        assert!(
            (bias + 0.5 * reported.powi(2)).abs() < 3.0 * error,
            "d {d}: error of the log-evidence {bias} ± {error}"
        );
        // The relative standard error of the scatter over 60 runs is 1/√(2·60) = 9 %: a third is more than three times that.
        let scatter = stats::sample_std(&off).unwrap();
        println!("d {d}: evidence × {ratio:.3} ± {ratio_error:.3}, log {bias:.3} ± {error:.3}; scatter {scatter:.3}, reported {reported:.3}");
        assert!((1.0 / 1.35..1.35).contains(&(reported / scatter)), "d {d}: reported {reported}, scatter {scatter}");
        // Copies among the samples would make the standard error of the mean of each run larger than that of 1,000 independent
        // samples, 0.0316 standard deviations. A remaining correlation of 0.3 gives 0.035, measured with an error of 9 %; the
        // tolerance is three times that.
        let (mean, covariance) = target.posterior();
        let means: Vec<f64> =
            runs.iter().map(|r| (stats::mean(&column(r, 0)) - mean[0]) / covariance[(0, 0)].sqrt()).collect();
        let scatter = stats::sample_std(&means).unwrap();
        assert!((0.025..0.045).contains(&scatter), "d {d}: means scatter by {scatter} of a standard deviation");
    }
}

#[test]
fn short_chains_increase_the_estimated_error() {
    // With one step per stage, samples remain similar over the stages, and the sum of the variances of the stages would give only
    // a third of the scatter.
    let target = Conjugate::new(2);
    let settings = Settings { most_steps: 1, ..Settings::default() };
    let runs: Vec<Samples> = (0..60).map(|seed| tmcmc(&target, &settings, seed, &|_| {}).unwrap()).collect();
    let scatter = stats::sample_std(&runs.iter().map(|r| r.log_evidence).collect::<Vec<_>>()).unwrap();
    let reported = stats::mean(&runs.iter().map(|r| r.log_evidence_std_error.powi(2)).collect::<Vec<_>>()).sqrt();
    let by_stage = |s: &Stage| 1.0 / s.effective_sample_size - 1e-3;
    let independent = runs[0].stages.iter().map(by_stage).sum::<f64>().sqrt();
    println!("scatter {scatter:.3}, reported {reported:.3}, stages alone {independent:.3}");
    // As above, 9 % of the scatter, and about 15 % for an error that is itself estimated from few families.
    assert!((1.0 / 1.5..1.5).contains(&(reported / scatter)), "reported {reported}, scatter {scatter}");
    assert!(independent < 0.5 * scatter);
}

#[test]
fn the_evidence_of_a_likelihood_inside_a_box_is_one_over_the_volume() {
    let bounds = vec![(0.0, 1.0), (-50.0, 50.0), (1e6, 3e6)];
    let (centre, std) = ([0.4, -10.0, 2.2e6], [0.01, 2.0, 1e4]);
    let volume: f64 = bounds.iter().map(|(lower, upper)| upper - lower).product();
    let target =
        InBox { bounds, log_likelihood: |x: &[f64]| (0..3).map(|k| log_normal(x[k], centre[k], std[k])).sum() };
    let samples = sample(&target, 5);
    let off = samples.log_evidence + volume.ln();
    assert!(off.abs() < 4.0 * samples.log_evidence_std_error, "{off} ± {}", samples.log_evidence_std_error);
    for k in 0..3 {
        let own = column(&samples, k);
        // As for the conjugate posterior.
        assert!(((stats::mean(&own) - centre[k]) / std[k]).abs() < 0.14, "mean of {k}");
        // The standard error is √(1/2,000) = 0.022 standard deviations, times 1.1; the tolerance is four times that.
        assert!((stats::sample_std(&own).unwrap() / std[k] - 1.0).abs() < 0.1, "spread of {k}");
    }
}

#[test]
fn two_modes_keep_their_weights() {
    let mode = |x: &[f64], at: f64| log_normal(x[0], at, 0.5) + log_normal(x[1], at, 0.5);
    let target = InBox {
        bounds: vec![(-10.0, 10.0); 2],
        log_likelihood: |x: &[f64]| (0.3 * mode(x, -5.0).exp() + 0.7 * mode(x, 5.0).exp()).ln(),
    };
    let runs: Vec<Samples> = (0..40).map(|seed| sample(&target, seed)).collect();
    let below = |r: &Samples| column(r, 0).iter().filter(|x| **x < 0.0).count() as f64 / 1_000.0;
    let shares: Vec<f64> = runs.iter().map(below).collect();
    let (share, error) = mean_and_error(&shares);
    let scatter = stats::sample_std(&shares).unwrap();
    println!("share of the smaller mode {share:.3} ± {error:.3}, scatter of one run {scatter:.3}");
    assert!((share - 0.3).abs() < 3.0 * error, "{share} ± {error}");
    // A single draw of 1,000 gives a standard error of 0.014. Samples cannot leave their mode, so that it accumulates over all 6
    // stages, in each of which the weights halve the effective sample size: √(1 + 2·6) times as much is 0.052. A run that lost a
    // mode would have an error of 0.3.
    assert!(shares.iter().all(|s| (s - 0.3).abs() < 0.2), "{shares:?}");
    assert!(scatter < 0.055, "{scatter}");
    let (ratio, error) = mean_and_error(&runs.iter().map(|r| (r.log_evidence + 400f64.ln()).exp()).collect::<Vec<_>>());
    assert!((ratio - 1.0).abs() < 3.0 * error, "evidence {ratio} ± {error} of the exact one");
}

#[test]
fn the_same_seed_gives_the_same_bits_on_any_number_of_threads() {
    let target = Conjugate::new(3);
    let run = |threads: usize, seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| sample(&target, seed))
    };
    let one = run(1, 7);
    assert_eq!(one, run(2, 7));
    assert_eq!(one, run(3, 7));
    assert_ne!(one.theta, run(1, 8).theta);
}

#[test]
fn a_likelihood_of_zero_takes_its_share_of_the_evidence() {
    // The likelihood is zero except in the given share of the box. For 0.3 and 0.05 the zeros alone exceed the target for the
    // variation of the weights.
    for share in [0.6, 0.5, 0.3, 0.05] {
        let log_likelihood =
            |x: &[f64]| if x[0] < share { log_normal(x[0], 0.0, 0.2 * share) } else { f64::NEG_INFINITY };
        let target = InBox { bounds: vec![(0.0, 1.0); 2], log_likelihood };
        let runs: Vec<Samples> = (0..30).map(|seed| sample(&target, seed)).collect();
        let leaves_zeros_first = runs[0].stages[0].exponent <= 0.0;
        // At 0.5 the draws decide.
        assert!(share > 0.45 && share < 0.55 || leaves_zeros_first == (share < 0.5), "{share}: {:?}", runs[0].stages);
        assert!(runs.iter().all(|r| r.log_likelihood.iter().all(|l| l.is_finite())));
        // Half of the normal distribution lies in the box, all but 6e-7 of it below `share`.
        let ratios: Vec<f64> = runs.iter().map(|r| r.log_evidence.exp() / 0.5).collect();
        let (ratio, error) = mean_and_error(&ratios);
        println!("share {share}: evidence × {ratio:.3} ± {error:.3}");
        assert!((ratio - 1.0).abs() < 3.0 * error, "{share}: {ratio} ± {error}");
    }
}

#[test]
fn a_flat_likelihood_is_one_stage_and_exact() {
    let target = InBox { bounds: vec![(0.0, 1.0); 2], log_likelihood: |_: &[f64]| -1e5 };
    let samples = sample(&target, 1);
    assert_eq!(samples.stages.len(), 1);
    assert!((samples.log_evidence + 1e5).abs() < 1e-9);
    assert!(samples.log_evidence_std_error < 1e-6);
}

#[test]
fn a_parameter_that_the_prior_fixes_or_one_survivor_does_not_stop_the_rest() {
    let fixed = InBox {
        bounds: vec![(0.0, 1.0), (2e6 / 3.0, 2e6 / 3.0)],
        log_likelihood: |x: &[f64]| log_normal(x[0], 0.5, 0.05),
    };
    let samples = sample(&fixed, 1);
    assert!(samples.log_evidence.abs() < 4.0 * samples.log_evidence_std_error);
    assert!((stats::sample_std(&column(&samples, 0)).unwrap() / 0.05 - 1.0).abs() < 0.1);
    // Exactly, without rounding errors.
    assert!(samples.theta.column(1).iter().all(|x| x.total_cmp(&(2e6 / 3.0)).is_eq()));

    // One of 1,000 draws from the prior is expected where the likelihood is positive; this seed has one.
    let narrow = InBox {
        bounds: vec![(0.0, 1.0)],
        log_likelihood: |x: &[f64]| if (x[0] - 0.5).abs() < 5e-4 { 0.0 } else { f64::NEG_INFINITY },
    };
    let one = |s: &Samples| (s.stages[0].effective_sample_size - 1.0).abs() < 1e-9;
    let samples = (0..20)
        .filter_map(|seed| tmcmc(&narrow, &Settings::default(), seed, &|_| {}).ok())
        .find(one)
        .expect("a third of the seeds leave one survivor");
    // Uniform over a width of 1e-3: a standard deviation of 2.9e-4, most of which the samples should cover from a single point.
    let std = stats::sample_std(&column(&samples, 0)).unwrap();
    assert!((2e-4..3.5e-4).contains(&std), "{std}");
    assert!((samples.log_evidence - 1e-3f64.ln()).abs() < 1e-9);
    assert!(samples.log_evidence_std_error > 0.9, "with one survivor the relative error of the evidence is at least 1");
}

#[test]
fn parameters_in_strict_dependence_are_sampled_along_their_ridge() {
    // The data determine only the sum, to 1e-6 of the width of the prior.
    let target = InBox { bounds: vec![(0.0, 1.0); 2], log_likelihood: |x: &[f64]| log_normal(x[0] + x[1], 1.0, 1e-6) };
    let samples = sample(&target, 3);
    // The sum of two uniform draws has the density 1 at 1.
    assert!(samples.log_evidence.abs() < 4.0 * samples.log_evidence_std_error, "{}", samples.log_evidence);
    // Uniform along the ridge: 1/√12 with a relative standard error of 2 %, times 1.1; the tolerance is four times that.
    let std = stats::sample_std(&column(&samples, 0)).unwrap();
    assert!((std * 12f64.sqrt() - 1.0).abs() < 0.1, "{std}");
}

#[test]
fn the_stages_record_what_was_done() {
    struct Counted(Conjugate, AtomicUsize);
    impl Target for Counted {
        fn dimensions(&self) -> usize {
            self.0.dimensions()
        }
        fn draw_prior(&self, stream: &mut Stream) -> Vec<f64> {
            self.0.draw_prior(stream)
        }
        fn log_prior(&self, theta: &[f64]) -> f64 {
            self.0.log_prior(theta)
        }
        fn log_likelihood(&self, theta: &[f64]) -> f64 {
            self.1.fetch_add(1, Ordering::Relaxed);
            self.0.log_likelihood(theta)
        }
    }
    let target = Counted(Conjugate::new(3), AtomicUsize::new(0));
    let seen = Mutex::new(Vec::new());
    let samples = tmcmc(&target, &Settings::default(), 2, &|stage| seen.lock().unwrap().push(*stage)).unwrap();
    assert_eq!(seen.into_inner().unwrap(), samples.stages);
    assert_eq!(samples.evaluations, target.1.into_inner());
    assert_eq!(samples.evaluations, samples.stages.iter().map(|s| s.evaluations).sum::<usize>());
    let (last, earlier) = samples.stages.split_last().unwrap();
    assert!((last.exponent - 1.0).abs() < f64::EPSILON);
    for (stage, next) in samples.stages.iter().zip(&samples.stages[1..]) {
        assert!(next.exponent > stage.exponent);
    }
    for stage in earlier {
        // A coefficient of variation of 1: ESS = n/(1 + 1).
        assert!((stage.effective_sample_size - 500.0).abs() < 0.1, "{stage:?}");
        assert!(stage.correlation <= 0.3 && (0.15..0.5).contains(&stage.acceptance), "{stage:?}");
    }
}

#[test]
fn what_cannot_be_sampled_is_an_error() {
    let run = |log_likelihood: fn(&[f64]) -> f64, settings: &Settings| {
        tmcmc(&InBox { bounds: vec![(0.0, 1.0)], log_likelihood }, settings, 1, &|_| {}).unwrap_err()
    };
    let default = Settings::default();
    assert_eq!(run(|_| f64::NEG_INFINITY, &default), Error::ZeroLikelihood { draws: 1_000 });
    for bad in [|_: &[f64]| f64::NAN, |_: &[f64]| f64::INFINITY] {
        assert!(matches!(run(bad, &default), Error::NotADensity { density: "likelihood", .. }));
    }
    let crawl = Settings { weight_variation: 1e-3, samples: 10, most_steps: 1, ..default.clone() };
    assert!(matches!(run(|x| 100.0 * x[0], &crawl), Error::TooManyStages { stages: 300, .. }));
    let empty = InBox { bounds: Vec::new(), log_likelihood: |_: &[f64]| 0.0 };
    assert_eq!(tmcmc(&empty, &default, 1, &|_| {}).unwrap_err(), Error::NoParameters);
    for settings in [
        Settings { samples: 1, ..default.clone() },
        Settings { weight_variation: 0.0, ..default.clone() },
        Settings { weight_variation: f64::NAN, ..default.clone() },
        Settings { weight_variation: f64::INFINITY, ..default.clone() },
        Settings { correlation: f64::NAN, ..default.clone() },
        Settings { correlation: -0.1, ..default.clone() },
        Settings { most_steps: 0, ..default.clone() },
    ] {
        assert!(matches!(run(|_| 0.0, &settings), Error::Setting { .. }), "{settings:?}");
    }
}

// ---- Distance ----

/// Rows of N(shift, AAᵀ), A lower triangular with entries of `scale`.
fn rows(count: usize, columns: usize, shift: f64, scale: f64, seed: u64) -> DMatrix<f64> {
    let mut stream = stats::stream(seed, "rows");
    let z = DMatrix::from_fn(count, columns, |_, _| normal(&mut stream));
    let a =
        DMatrix::from_fn(columns, columns, |i, j| if i >= j { scale * (1.0 + i as f64 - 0.4 * j as f64) } else { 0.0 });
    (z * a.transpose()).add_scalar(shift)
}

#[test]
fn moments_are_those_of_the_rows() {
    // 300 Hz with a standard deviation of 1e-5 Hz, which sums of squares would lose to rounding.
    let sample = rows(200, 3, 300.0, 1e-5, 1);
    let moments = Moments::from_matrix(&sample);
    let mean = sample.row_mean();
    let centred = DMatrix::from_fn(200, 3, |i, j| sample[(i, j)] - mean[j]);
    let covariance = centred.transpose() * &centred / 199.0;
    for j in 0..3 {
        assert!((moments.mean()[j] - mean[j]).abs() < 1e-12 * 300.0);
    }
    assert!((moments.covariance() - &covariance).amax() < 1e-8 * covariance.amax());
}

#[test]
fn the_distance_is_the_integral_of_the_root_of_both_densities() {
    let standardised = |mean: f64, std: f64, seed: u64| {
        let z = rows(50, 1, 0.0, 1.0, seed);
        let values: Vec<f64> = z.iter().copied().collect();
        let (m, s) = (stats::mean(&values), stats::sample_std(&values).unwrap());
        z.map(|x| mean + std * (x - m) / s)
    };
    for (mean, std) in [(0.0, 1.0), (0.5, 1.0), (0.0, 3.0), (-2.0, 0.4), (6.0, 2.0)] {
        let closed = bhattacharyya(&standardised(0.0, 1.0, 1), &standardised(mean, std, 2)).unwrap();
        // The trapezoidal rule for a smooth function that vanishes at both ends is exact to rounding.
        let step = 1e-3;
        let root = |x: f64| (0.5 * (log_normal(x, 0.0, 1.0) + log_normal(x, mean, std))).exp();
        let integral: f64 = (-40_000..=40_000).map(|i| root(f64::from(i) * step) * step).sum();
        assert!((closed + integral.ln()).abs() < 1e-10, "N({mean}, {std}²): {closed}, {}", -integral.ln());
    }
}

#[test]
fn the_distance_is_symmetric_zero_to_itself_and_blind_to_linear_maps() {
    let (a, b) = (rows(40, 3, 0.0, 1.0, 1), rows(300, 3, 0.7, 1.4, 2));
    let distance = bhattacharyya(&a, &b).unwrap();
    assert!(distance > 0.01);
    assert!((distance - bhattacharyya(&b, &a).unwrap()).abs() < 1e-14);
    assert!(bhattacharyya(&a, &a).unwrap() < 1e-15);
    let map = DMatrix::from_row_slice(3, 3, &[2e3, 1e3, 0.0, 0.0, -0.5, 0.2, 0.01, 0.0, 0.03]);
    let mapped = |x: &DMatrix<f64>| (x * map.transpose()).add_scalar(5.0);
    assert!((distance - bhattacharyya(&mapped(&a), &mapped(&b)).unwrap()).abs() < 1e-9);
    // The general formula, by inverse and determinants.
    let (p, q) = (Moments::from_matrix(&a), Moments::from_matrix(&b));
    let middle = (p.covariance() + q.covariance()) / 2.0;
    let delta = DVector::from_column_slice(p.mean()) - DVector::from_column_slice(q.mean());
    let shift = delta.dot(&(middle.clone().try_inverse().unwrap() * &delta)) / 8.0;
    let determinants = p.covariance().determinant() * q.covariance().determinant();
    let spread = 0.5 * (middle.determinant() / determinants.sqrt()).ln();
    assert!((distance - shift - spread).abs() < 1e-12);
}

#[test]
fn a_singular_covariance_has_no_distance() {
    let good = rows(40, 3, 0.0, 1.0, 1);
    let mut dependent = good.clone();
    dependent.set_column(2, &(good.column(0) * 2.0 - good.column(1)));
    let mut constant = good.clone();
    constant.column_mut(1).fill(0.1);
    let mut unknown = good.clone();
    unknown[(3, 1)] = f64::NAN;
    for bad in [dependent, constant, unknown, rows(3, 3, 0.0, 1.0, 2), rows(1, 3, 0.0, 1.0, 2), DMatrix::zeros(0, 3)] {
        assert_eq!(bhattacharyya(&good, &bad), None, "{bad}");
        assert_eq!(bhattacharyya(&bad, &good), None, "{bad}");
    }
}

/// The claim in the documentation of `epsilon_squared`, compared with the exact likelihood of normal observations.
#[test]
fn four_n_times_the_distance_is_the_log_likelihood_ratio_near_the_truth() {
    let n = 100.0;
    let standardised = rows(400, 1, 0.0, 1.0, 3);
    let values: Vec<f64> = standardised.iter().copied().collect();
    let (m, s) = (stats::mean(&values), stats::sample_std(&values).unwrap());
    let population = |mu: f64, sigma: f64| Moments::from_matrix(&standardised.map(|x| mu + sigma * (x - m) / s));
    let truth = population(0.0, 1.0);
    for (mu, sigma) in [(0.02, 1.0), (-0.02, 1.0), (0.0, 1.02), (0.0, 0.98), (0.015, 1.015)] {
        let own = log_likelihood(truth.bhattacharyya(&population(mu, sigma)).unwrap(), epsilon_squared(n));
        // −n KL(N(0, 1) ‖ N(μ, σ²)).
        let exact = -n * (f64::ln(sigma) + (1.0 + mu * mu) / (2.0 * sigma * sigma) - 0.5);
        // The next order: at a distance of 2 % from the truth, a few times 2 % of the ratio.
        assert!((own / exact - 1.0).abs() < 0.06, "({mu}, {sigma}): {own}, exact {exact}");
    }
}

#[test]
fn the_likelihood_of_the_distance_gives_the_spread_of_the_exact_posterior() {
    let (n, simulated) = (100, 4_000);
    let measured = rows(n, 1, 10.0, 2.0, 4);
    let values: Vec<f64> = measured.iter().copied().collect();
    let (mean, std) = (stats::mean(&values), stats::sample_std(&values).unwrap());
    let measured = Moments::from_matrix(&measured);
    // The same draws at every θ.
    let z: Vec<f64> = rows(simulated, 1, 0.0, 1.0, 5).iter().copied().collect();
    // Both sides are samples: the variance of the difference of their means is 1/n + 1/N, as for n·N/(n + N) rows compared with the
    // truth.
    let epsilon_squared = epsilon_squared((n * simulated) as f64 / (n + simulated) as f64);
    let target = InBox {
        bounds: vec![(0.0, 20.0), (0.1, 10.0)],
        log_likelihood: |x: &[f64]| {
            let rows: Vec<f64> = z.iter().map(|z| x[0] + x[1] * z).collect();
            let distance = measured.bhattacharyya(&Moments::from_rows(&rows, 1));
            distance.map_or(f64::NEG_INFINITY, |d| log_likelihood(d, epsilon_squared))
        },
    };
    let samples = sample(&target, 6);
    let (mu, sigma) = (column(&samples, 0), column(&samples, 1));
    let root_n = (n as f64).sqrt();
    let mu_ratio = stats::sample_std(&mu).unwrap() / (std / root_n);
    let sigma_ratio = stats::sample_std(&sigma).unwrap() / (std / (2f64.sqrt() * root_n));
    println!("spread of μ × {mu_ratio:.3}, of σ × {sigma_ratio:.3}");
    // The standard deviation of 1,000 samples is known to 1/√2,000 = 0.022 times 1.1; three times that, 0.012 for n_eff, and
    // 1/n for what is beyond the second order.
    assert!((mu_ratio - 1.0).abs() < 0.1 && (sigma_ratio - 1.0).abs() < 0.1, "{mu_ratio}, {sigma_ratio}");
    // The draws have an error of 1/√4,000: 0.16 of a posterior standard deviation; three times that and the Monte Carlo error.
    assert!(((stats::mean(&mu) - mean) / (std / root_n)).abs() < 0.6);
    assert!(((stats::mean(&sigma) - std) / (std / (2f64.sqrt() * root_n))).abs() < 0.6);
}
