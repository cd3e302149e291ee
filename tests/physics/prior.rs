//! Normal and log-normal priors in structure files: what they mean, and what is refused.

use modalwatch::parameter::PriorForm;
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use modalwatch::stats::normal_cdf;

/// A mass on a spring, with the further lines of its parameter.
fn text(nominal: &str, parameter: &str) -> String {
    format!(
        "id = \"one\"\nmodes = 1\nmeasurement_noise = {{ relative = 0.002 }}\nmass = [{{ name = \"m1\", kg = 100.0 }}]\n\
         spring = [{{ name = \"k1\", from = \"ground\", to = \"m1\"{nominal} }}]\n[[parameter]]\nname = \"p\"\nsets = {{ spring = \"k1\" \
         }}\n{parameter}\n"
    )
}

fn simulator(nominal: &str, parameter: &str) -> Simulator {
    Simulator::new(StructureDefinition::parse_toml(&text(nominal, parameter)).unwrap()).unwrap()
}

/// Largest distance between the shares of `values` below each of them and a distribution function.
fn kolmogorov(mut values: Vec<f64>, distribution: impl Fn(f64) -> f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let count = values.len() as f64;
    let apart = |(i, x): (usize, &f64)| (distribution(*x) - (i as f64 + 0.5) / count).abs();
    values.iter().enumerate().map(apart).fold(0.0, f64::max)
}

/// The standard score of a value under a prior.
type Score = Box<dyn Fn(f64) -> f64>;

#[test]
fn training_sets_have_the_distribution_of_the_prior() {
    let log_std = (1.0_f64 + 0.2 * 0.2).ln().sqrt();
    let cases: [(&str, f64, f64, Score); 3] = [
        ("prior = { normal = { mean = 1000.0, std = 100.0 } }", 600.0, 1400.0, Box::new(|x| (x - 1000.0) / 100.0)),
        (
            "prior = { log_normal = { median = 1000.0, relative_std = 0.2 } }",
            1000.0 * (-4.0 * log_std).exp(),
            1000.0 * (4.0 * log_std).exp(),
            Box::new(move |x: f64| (x / 1000.0).ln() / log_std),
        ),
        // A factor has the same prior in per cent.
        ("scale = true\nprior = { normal = { mean = 0.9, std = 0.1 } }", 50.0, 130.0, Box::new(|x| (x - 90.0) / 10.0)),
    ];
    for (prior, lower, upper, score) in cases {
        let simulator = simulator(", n_per_m = 1000.0", prior);
        let parameter = &simulator.space().as_slice()[0];
        assert!((parameter.lower - lower).abs() < 1e-9 * upper && (parameter.upper - upper).abs() < 1e-9 * upper);
        let drawn: Vec<f64> = simulator.training_set(20_000, 5).unwrap().theta.iter().copied().collect();
        assert!(drawn.iter().all(|x| (lower..=upper).contains(x)), "{prior}");
        let distance = kolmogorov(drawn, |x| normal_cdf(score(x)));
        // One in a thousand sets of 20,000 exceeds 1.95/√20,000 = 0.0138. Cutting the tails off changes the distribution by 0.00003.
        assert!(distance < 0.0138, "{prior}: {distance}");
    }
}

#[test]
fn the_relative_standard_deviation_is_that_of_the_stiffness_itself() {
    let simulator = simulator("", "prior = { log_normal = { median = 1000.0, relative_std = 0.3 } }");
    let drawn: Vec<f64> = simulator.training_set(100_000, 5).unwrap().theta.iter().copied().collect();
    let share = modalwatch::stats::sample_std(&drawn).unwrap() / modalwatch::stats::mean(&drawn);
    // The standard error of a relative standard deviation from 100,000 values is 0.3 %, some more for the longer tail; cutting the tails
    // off makes it 0.1 % smaller.
    assert!((share / 0.3 - 1.0).abs() < 0.015, "{share}");
}

#[test]
fn a_stiffness_that_the_file_does_not_state_is_the_median_of_its_prior() {
    for (prior, nominal) in [
        ("prior = { normal = { mean = 1000.0, std = 100.0 } }", 1000.0),
        ("prior = { log_normal = { median = 900.0, relative_std = 0.5 } }", 900.0),
        ("prior = { uniform = [600.0, 1000.0] }", 800.0),
    ] {
        let simulator = simulator("", prior);
        let frequency = (nominal / 100.0_f64).sqrt() / std::f64::consts::TAU;
        assert!((simulator.nominal_frequencies_hz()[0] / frequency - 1.0).abs() < 1e-9, "{prior}");
    }
}

#[test]
fn definitions_keep_their_prior_through_json_and_uniform_ones_their_digest() {
    for prior in [
        "prior = { normal = { mean = 1000.0, std = 100.0 } }",
        "prior = { log_normal = { median = 900.0, relative_std = 0.5 } }",
    ] {
        let definition = StructureDefinition::parse_toml(&text("", prior)).unwrap();
        let json = definition.canonical_json();
        assert_eq!(StructureDefinition::parse_json(&json).unwrap(), definition, "{json}");
    }
    let definition = StructureDefinition::parse_toml(&text("", "prior = { uniform = [600.0, 1000.0] }")).unwrap();
    assert!(definition.canonical_json().contains(r#""prior":{"uniform":[600.0,1000.0]}"#));
    let simulator = Simulator::new(definition).unwrap();
    assert_eq!(simulator.space().as_slice()[0].form, PriorForm::Uniform);
}

#[test]
fn each_prior_that_cannot_be_one_is_refused_with_its_reason() {
    const NORMAL: &str = "/parameter/0/prior/normal";
    const LOG_NORMAL: &str = "/parameter/0/prior/log_normal";
    const PRIOR: &str = "/parameter/0/prior";
    // The prior, the pointer and a part of the message.
    let cases: &[(&str, &str, &str)] = &[
        ("normal = { mean = 100.0, std = -10.0 }", "/parameter/0/prior/normal/std", "std = -10: the standard deviation must be finite and above 0"),
        ("normal = { mean = 100.0, std = 0.0 }", "/parameter/0/prior/normal/std", "such as std = 10"),
        ("normal = { mean = 100.0, std = nan }", "/parameter/0/prior/normal/std", "std = NaN"),
        ("normal = { mean = 100.0, std = 1e-5 }", "/parameter/0/prior/normal/std", "less than a millionth"),
        ("normal = { mean = inf, std = 10.0 }", "/parameter/0/prior/normal/mean", "mean = inf: it must be a finite number"),
        (
            "normal = { mean = 100.0, std = 30.0 }",
            NORMAL,
            "the normal prior of mean 100 and standard deviation 30, which runs from -20 to 220 (± 4 standard deviations), lets spring \
             \"k1\" have a stiffness of -20 to 220 N/m: it must be finite and not negative; a std below 25 keeps the prior above 0, and \
             log_normal = { median = 100, relative_std = 0.3 } stays above 0",
        ),
        ("normal = { mean = -100.0, std = 10.0 }", NORMAL, "the mean must be above 0"),
        ("normal = { mean = 100.0, std = 25.0 }", NORMAL, "the prior allows a mechanism"),
        ("normal = [50.0, 150.0]", NORMAL, "expected { mean = …, std = … }"),
        ("normal = { mean = 100.0 }", NORMAL, "missing field `std`"),
        ("normal = { mean = 100.0, sigma = 10.0 }", NORMAL, "unknown field `sigma`, expected `mean` or `std`"),
        ("log_normal = { median = 100.0, relative_std = 0.0 }", "/parameter/0/prior/log_normal/relative_std", "relative_std = 0: it is the standard deviation as a share of the mean, above 0 and at most 1"),
        ("log_normal = { median = 100.0, relative_std = -0.2 }", "/parameter/0/prior/log_normal/relative_std", "such as 0.2 for 20 %"),
        ("log_normal = { median = 100.0, relative_std = 20.0 }", "/parameter/0/prior/log_normal/relative_std", "did you mean 20 %, relative_std = 0.2?"),
        ("log_normal = { median = 0.0, relative_std = 0.2 }", "/parameter/0/prior/log_normal/median", "median = 0: the median of a log-normal prior must be finite and above 0"),
        ("log_normal = { mean = 100.0, std = 0.2 }", LOG_NORMAL, "unknown field `mean`, expected `median` or `relative_std`"),
        ("uniform = [50.0, 150.0], normal = { mean = 100.0, std = 10.0 }", PRIOR, "a parameter has one prior, remove one of the two"),
        ("gaussian = { mean = 100.0, std = 10.0 }", PRIOR, "a prior is one of { uniform = [low, high] }, { normal = { mean = 1.0, std = 0.1 } }"),
        ("", PRIOR, "the prior is empty"),
    ];
    for (prior, pointer, message) in cases {
        let text = text("", &format!("prior = {{ {prior} }}"));
        let error = StructureDefinition::parse_toml(&text).unwrap_err();
        let found = &error.problems[0];
        assert!(found.message.contains(message), "{prior}: {found}");
        assert!(found.pointer.starts_with(pointer), "{prior}: {found}");
        assert_eq!(found.line, Some(9), "{prior}: {found}");
    }
    // JSON gives the same reasons.
    let good =
        StructureDefinition::parse_toml(&text("", "prior = { uniform = [50.0, 150.0] }")).unwrap().canonical_json();
    for (prior, message) in [
        (r#"{"normal":[50.0,150.0]}"#, "expected { mean = …, std = … }"),
        (r#"{"uniform":[50.0,150.0],"normal":{"mean":100.0,"std":10.0}}"#, "a parameter has one prior"),
        (r#"{"normal":{"mean":100.0,"std":-10.0}}"#, "above 0"),
    ] {
        let json = good.replace(r#"{"uniform":[50.0,150.0]}"#, prior);
        assert!(json.contains(prior), "{json}");
        let error = StructureDefinition::parse_json(&json).unwrap_err().to_string();
        assert!(error.contains(message), "{prior}: {error}");
    }
}

#[test]
fn a_table_must_cover_the_prior_up_to_its_ends() {
    let run = |i: u32| format!("{0},{1}\\n", 60.0 + f64::from(i), (60.0 + f64::from(i)).sqrt());
    let runs = (0..80).map(run).collect::<Vec<String>>().concat();
    let text = |std: f64| {
        format!(
            "id = \"t\"\nmodes = 1\nsimulation = \"table\"\ntable = {{ csv = \"p,f1_hz\\n{runs}\" }}\n[[parameter]]\nname = \"p\"\nprior = {{ \
             normal = {{ mean = 100.0, std = {std:?} }} }}\n"
        )
    };
    StructureDefinition::parse_toml(&text(9.5)).unwrap();
    let error = StructureDefinition::parse_toml(&text(15.0)).unwrap_err();
    assert_eq!(error.problems[0].pointer, "/parameter/0/prior/normal", "{error}");
    assert!(error.to_string().contains("extends from 40 to 160, the runs only from 60 to 139"), "{error}");
}

#[test]
fn a_nominal_stiffness_outside_the_prior_is_doubted() {
    let doubts = simulator(", n_per_m = 3e7", "prior = { normal = { mean = 1.0, std = 0.1 } }").prior_doubts();
    assert!(doubts.len() == 1 && doubts[0].far, "{doubts:?}");
    let message = &doubts[0].message;
    assert!(
        message.contains("runs from 0.6 to 1.4 N/m") && message.contains("did you mean `scale = true`"),
        "{message}"
    );
    assert!(simulator(", n_per_m = 3e7", "scale = true\nprior = { normal = { mean = 1.0, std = 0.1 } }")
        .prior_doubts()
        .is_empty());
}
