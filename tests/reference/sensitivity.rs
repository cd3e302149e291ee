//! Sensitivity-based updating recovers the parameters behind the frequencies from any start in the prior.

use std::fmt::Write as _;

use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use modalwatch::stats;
use modalwatch::updating::sensitivity::{prior_lattice, update, update_all};
use rand::Rng as _;

const CASES: [(&str, &str); 2] = [
    ("three-dof", include_str!("../../models/three-dof/structure.toml")),
    ("rig", include_str!("../../models/rig/structure.toml")),
];

fn simulator(text: &str) -> Simulator {
    Simulator::new(StructureDefinition::parse_toml(text).unwrap()).unwrap()
}

fn measured(simulator: &Simulator, theta: &[f64]) -> Vec<Option<f64>> {
    simulator.frequencies_hz(theta).unwrap().into_iter().map(Some).collect()
}

#[test]
fn updating_from_two_hundred_starts_converges_to_the_truth_or_reports_a_misfit() {
    // The means of the undamaged reference of each case.
    let truths = [vec![4.0, 5.0, 6.0], vec![0.0475, 0.0475]];
    for ((name, text), truth) in CASES.into_iter().zip(truths) {
        let simulator = simulator(text);
        let frequencies = measured(&simulator, &truth);
        let mut stream = stats::stream(1, "starts");
        let (mut met, mut at_truth, mut rested, mut iterations) = (0, 0, 0, 0);
        for _ in 0..200 {
            let start: Vec<f64> = simulator.space().iter().map(|p| p.from_unit(stream.random::<f64>())).collect();
            let found = update(&simulator, &frequencies, &start).unwrap();
            rested += usize::from(found.converged);
            met += usize::from(found.is_met());
            iterations += found.iterations;
            let near = |(p, (a, b)): (&modalwatch::parameter::Parameter, (&f64, &f64))| {
                (a - b).abs() < 1e-6 * (p.upper - p.lower)
            };
            at_truth += usize::from(simulator.space().iter().zip(found.theta.iter().zip(&truth)).all(near));
        }
        println!(
            "{name}: {rested} of 200 at rest, {met} meet the frequencies, {at_truth} at the truth; {iterations} steps"
        );
        assert_eq!(rested, 200, "{name}");
        // The rig has a second point in the box with similar frequencies. If a start leads there, the search converges to a misfit
        // and reports it.
        assert!(met >= if name == "rig" { 140 } else { 200 }, "{name}: {met}");
        // Frequencies that are matched at another point would be a second solution, which the means of these states do not have.
        assert_eq!(at_truth, met, "{name}");
    }
}

#[test]
fn with_further_starts_every_point_of_the_prior_is_met() {
    for (name, text) in CASES {
        let simulator = simulator(text);
        let mut stream = stats::stream(2, "truths");
        let truths: Vec<Vec<f64>> =
            (0..400).map(|_| simulator.space().iter().map(|p| p.from_unit(stream.random::<f64>())).collect()).collect();
        let rows: Vec<Vec<Option<f64>>> = truths.iter().map(|t| measured(&simulator, t)).collect();
        let found = update_all(&simulator, &rows, &prior_lattice(&simulator)).unwrap();
        let met = found.iter().filter(|u| u.is_met()).count();
        let missed: Vec<_> = found.iter().zip(&truths).filter(|(u, _)| !u.is_met()).collect();
        println!("{name}: {met} of 400 met, not {missed:?}");
        assert!(met >= 398, "{name}: {met}");
    }
}

#[test]
fn a_measurement_from_beyond_the_prior_ends_at_its_edge() {
    let simulator = simulator(CASES[0].1);
    let found = update(&simulator, &measured(&simulator, &[2.8, 5.0, 6.0]), &[5.0, 5.0, 5.0]).unwrap();
    assert!(found.converged && !found.is_met(), "{found:?}");
    assert!((found.theta[0] - 3.0).abs() < 1e-12, "{found:?}");
    // The other stiffnesses compensate a part of the missing 0.2 N/m, but remain close.
    assert!((found.theta[1] - 5.0).abs() < 0.3 && (found.theta[2] - 6.0).abs() < 0.3, "{found:?}");
}

#[test]
fn a_missing_mode_is_left_out_of_the_misfit() {
    let simulator = simulator(CASES[1].1);
    for missing in 0..3 {
        let mut frequencies = measured(&simulator, &[0.05, 0.06]);
        frequencies[missing] = None;
        let found = update(&simulator, &frequencies, &[0.05, 0.055]).unwrap();
        assert!(found.is_met(), "without mode {missing}: {found:?}");
    }
}

/// Latin hypercube runs of the rig as CSV.
fn rig_runs(rig: &Simulator, count: usize) -> String {
    use rand::seq::SliceRandom as _;
    let mut stream = stats::stream(5, "latin hypercube");
    let mut partner: Vec<usize> = (0..count).collect();
    partner.shuffle(&mut stream);
    let mut csv = "p12,p23,f1_hz,f2_hz,f3_hz\n".to_owned();
    for (run, other) in partner.into_iter().enumerate() {
        let mut within = |stratum: usize| 0.12 * (stratum as f64 + stream.random::<f64>()) / count as f64;
        let theta = [within(run), within(other)];
        let f = rig.frequencies_hz(&theta).unwrap();
        writeln!(csv, "{},{},{},{},{}", theta[0], theta[1], f[0], f[1], f[2]).unwrap();
    }
    csv
}

#[test]
fn a_table_of_two_hundred_runs_gives_the_hyperparameters_of_the_simulation_itself() {
    let rig = simulator(CASES[1].1);
    let parameter = |p: &str| format!("[[parameter]]\nname = \"{p}\"\nprior = {{ uniform = [0.0, 0.12] }}\n");
    let head = "id = \"rig-table\"\nsimulation = \"table\"\nmodes = 3\nmeasurement_noise = { relative = 0.001 }\n";
    let text =
        format!("{head}{}{}[table]\ncsv = '''\n{}'''\n", parameter("p12"), parameter("p23"), rig_runs(&rig, 200));
    let table = simulator(&text);
    for (seed, mean) in [(1, [0.0475, 0.0475]), (2, [0.03, 0.06]), (3, [0.07, 0.04])] {
        let moments = [("p12", mean[0]), ("p23", mean[1])].map(|(name, mean)| (name.to_owned(), mean, 0.008)).to_vec();
        let population = modalwatch::simulator::population::Population::new(rig.space(), &moments).unwrap();
        let drawn = population.draw(&rig, 100, 0.2, seed).unwrap();
        let rows: Vec<Vec<Option<f64>>> =
            drawn.frequencies_hz.row_iter().map(|row| row.iter().copied().map(Some).collect()).collect();
        let hyperparameters = |simulator: &Simulator| -> Vec<f64> {
            let found = update_all(simulator, &rows, &prior_lattice(simulator)).unwrap();
            let columns = (0..2).map(|k| found.iter().map(|u| u.theta[k]).collect::<Vec<f64>>());
            columns.flat_map(|values| [stats::mean(&values), stats::sample_std(&values).unwrap()]).collect()
        };
        let (direct, emulated) = (hyperparameters(&rig), hyperparameters(&table));
        println!("direct {direct:?}, table {emulated:?}");
        for (a, b) in direct.iter().zip(&emulated) {
            assert!((a / b - 1.0).abs() < 0.02, "{direct:?} {emulated:?}");
        }
    }
}
