//! Tables of finite-element runs as simulations.

use std::fmt::Write as _;

use modalwatch::physics::effect::{Direction, Target};
use modalwatch::simulator::definition::{DefinitionProblem, StructureDefinition};
use modalwatch::simulator::Simulator;
use modalwatch::stats;
use rand::seq::SliceRandom as _;
use rand::Rng as _;

/// Latin hypercube runs of a simulator over its prior as CSV.
fn runs(simulator: &Simulator, count: usize, seed: u64) -> String {
    let mut stream = stats::stream(seed, "latin hypercube");
    let mut columns: Vec<Vec<f64>> = Vec::new();
    for parameter in simulator.space() {
        let mut strata: Vec<usize> = (0..count).collect();
        strata.shuffle(&mut stream);
        let mut within = |stratum: &usize| (*stratum as f64 + stream.random::<f64>()) / count as f64;
        columns.push(strata.iter().map(|s| parameter.from_unit(within(s))).collect());
    }
    let mut names: Vec<String> = simulator.space().iter().map(|p| p.name.clone()).collect();
    names.extend((1..=simulator.modes()).map(|m| format!("f{m}_hz")));
    let mut csv = format!("run,{}\n", names.join(","));
    for run in 0..count {
        let theta: Vec<f64> = columns.iter().map(|c| c[run]).collect();
        let f = simulator.frequencies_hz(&theta).unwrap();
        let cells: Vec<String> = theta.iter().chain(&f).map(ToString::to_string).collect();
        writeln!(csv, "{},{}", run + 1, cells.join(",")).unwrap();
    }
    csv
}

fn rig() -> Simulator {
    Simulator::new(StructureDefinition::parse_toml(include_str!("../../models/rig/structure.toml")).unwrap()).unwrap()
}

const HEAD: &str = r#"id = "rig-table"
simulation = "table"
modes = 3
[[parameter]]
name = "p12"
unit = "m"
prior = { uniform = [0.0, 0.12] }
[[parameter]]
name = "p23"
unit = "m"
prior = { uniform = [0.0, 0.12] }
[table]
"#;

fn table_file(csv: &str) -> String {
    format!("{HEAD}csv = '''\n{csv}'''\n")
}

fn table() -> Simulator {
    Simulator::new(StructureDefinition::parse_toml(&table_file(&runs(&rig(), 200, 1))).unwrap()).unwrap()
}

#[test]
fn a_table_reproduces_the_simulation_it_was_made_from() {
    let (direct, table) = (rig(), table());
    let mut stream = stats::stream(2, "points");
    let (mut squares, mut slope_squares) = ([0.0; 3], [0.0; 2]);
    let count = 400;
    for _ in 0..count {
        let theta: Vec<f64> = direct.space().iter().map(|p| p.from_unit(stream.random_range(0.02..0.98))).collect();
        let (exact, found) = (direct.frequencies_hz(&theta).unwrap(), table.frequencies_hz(&theta).unwrap());
        let (jacobian, emulated) = (direct.jacobian(&theta).unwrap(), table.jacobian(&theta).unwrap());
        slope_squares[0] += (&jacobian - &emulated).norm_squared();
        slope_squares[1] += jacobian.norm_squared();
        for mode in 0..3 {
            squares[mode] += (found[mode] / exact[mode]).ln().powi(2) / f64::from(count);
        }
    }
    let slope_error = (slope_squares[0] / slope_squares[1]).sqrt();
    println!("slopes: relative error {slope_error:.1e}");
    assert!(slope_error < 0.02, "{slope_error}");
    for (mode, square) in squares.iter().enumerate() {
        let estimated = table.table().unwrap().emulator().relative_error(mode);
        println!("mode {}: error {:.1e}, estimated {estimated:.1e}", mode + 1, square.sqrt());
        // The estimated error includes the edges of the box, where the error is largest.
        assert!(square.sqrt() < 2.0 * estimated && estimated < 1e-3, "mode {mode}: {} {estimated}", square.sqrt());
        assert!(
            (table.std_hz(mode, 10.0) - 10.0 * estimated).abs() < 1e-12,
            "without noise only the error of the emulator remains"
        );
    }
    assert!(table.warnings().is_empty(), "{:?}", table.warnings());
    assert!(table.structure().is_none() && table.is_noisy());
}

#[test]
fn effects_on_a_table_have_the_slopes_of_central_differences() {
    let table = table();
    let direction = |frequencies: Vec<f64>| Direction { frequencies, ..Direction::default() };
    let targets = [
        Target::ParameterScale(0),
        Target::SettingOffset(1),
        Target::FrequencyScale(Some(1)),
        Target::FrequencyOffset(None),
        Target::ModeOrder(vec![0, 2, 1]),
        Target::Everywhere(vec![direction(vec![0.5, -1.0, 0.0]), direction(vec![1.0, 0.0, 0.4])]),
    ];
    let (theta, sizes) = ([0.05, 0.07], [0.04, 0.003, 0.01, 0.02, 0.02, -0.01]);
    let found = table.respond(&theta, 3, &targets, &sizes).unwrap();
    let f = table.frequencies_hz(&[0.05 * 1.04, 0.073]).unwrap();
    let scaled = [f[0], 1.01 * f[2] * (-0.02f64).exp(), f[1] * (-0.004f64).exp()];
    for (got, wanted) in found.frequencies_hz.iter().zip(scaled.map(|f| f + 0.02)) {
        assert!((got - wanted).abs() < 1e-12 * wanted, "{got} {wanted}");
    }
    for column in 0..sizes.len() {
        let at = |sign: f64| {
            let mut moved = sizes;
            moved[column] += sign * 1e-5;
            table.respond(&theta, 3, &targets, &moved).unwrap().frequencies_hz
        };
        let (up, down) = (at(1.0), at(-1.0));
        for mode in 0..3 {
            let difference = (up[mode] - down[mode]) / 2e-5;
            let slope = found.by_size[(mode, column)];
            assert!((slope - difference).abs() < 1e-5 * (1.0 + slope.abs()), "size {column}: {slope} {difference}");
        }
    }
    assert!(table.respond(&theta, 3, &[Target::Springs(vec![0])], &[0.1]).is_err(), "a table has no springs");
}

#[test]
fn where_there_are_no_runs_the_table_says_so() {
    let table = table();
    assert!(!table.is_extrapolated(&[0.06, 0.06]));
    assert!(table.is_extrapolated(&[0.13, 0.06]));
    // Two modes that cross within the table.
    let mut csv = "a,f1_hz,f2_hz\n".to_owned();
    for run in 0..80 {
        let a = f64::from(run) / 79.0;
        let (one, other) = (10.0 + a, 10.51);
        writeln!(csv, "{a},{},{}", one.min(other), one.max(other)).unwrap();
    }
    let head = "id = \"crossing\"\nsimulation = \"table\"\nmodes = 2\n";
    let parameter = "[[parameter]]\nname = \"a\"\nprior = { uniform = [0.0, 1.0] }\n";
    let text = format!("{head}{parameter}[table]\ncsv = '''\n{csv}'''\n");
    let crossing = Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap();
    assert!(crossing.warnings().iter().any(|w| w.contains("modes 1 and 2")), "{:?}", crossing.warnings());
}

#[test]
fn a_table_beside_its_structure_file_is_read_with_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("structure.toml");
    let text = format!("{HEAD}file = \"runs.csv\"\n");
    std::fs::write(&path, &text).unwrap();
    let error = modalwatch::baseline::library::read_structure_file(&path).unwrap_err().to_string();
    assert!(error.contains("runs.csv") && error.contains("/table/file"), "{error}");
    std::fs::write(folder.path().join("runs.csv"), runs(&rig(), 80, 1)).unwrap();
    let read = modalwatch::baseline::library::read_structure_file(&path).unwrap();
    assert_eq!(read.table().unwrap().runs(), 80);
    // The runs belong to the definition, so that other runs give another digest.
    let again = StructureDefinition::parse_json(&read.definition().canonical_json()).unwrap();
    assert_eq!(again.digest(), *read.digest());
    assert!(StructureDefinition::parse_toml(&text).unwrap_err().to_string().contains("send its text as csv"));
}

#[test]
fn mistakes_in_a_table_are_named_with_their_place() {
    let good = table_file(&runs(&rig(), 80, 1));
    let line = good.lines().find(|l| l.starts_with("7,")).unwrap().to_owned();
    let cells: Vec<&str> = line.split(',').collect();
    let body = "[[mass]]\nname = \"m\"\nkg = 1.0\n[table]".to_owned();
    let sets = "name = \"p12\"\nsets = { spring = \"k\" }\n".to_owned();
    #[rustfmt::skip]
    let cases = [
        ("run,p12", "run,p13".to_owned(), "/table/csv", "no column \"p12\""),
        ("f3_hz", "f4_hz".to_owned(), "/table/csv", "f3_hz is missing"),
        ("run,p12", "label,p12".to_owned(), "/table/csv", "\"label\" is neither a parameter nor a frequency"),
        (line.as_str(), line.replace(cells[4], "x"), "/table/csv", "column f2_hz: \"x\" is not a finite number"),
        (line.as_str(), line.replace(cells[4], "999"), "/table/csv", "run 7"),
        ("uniform = [0.0, 0.12]", "uniform = [0.0, 0.2]".to_owned(), "/parameter/0/prior/uniform", "does not extrapolate"),
        ("name = \"p12\"\n", sets, "/parameter/0/sets", "set nothing"),
        ("[table]", body, "/mass", "has no mass"),
    ];
    for (from, to, pointer, message) in cases {
        assert!(good.contains(from), "{from:?}");
        let error = StructureDefinition::parse_toml(&good.replacen(from, &to, 1)).unwrap_err();
        let fits = |p: &DefinitionProblem| p.pointer.starts_with(pointer) && p.message.contains(message);
        assert!(error.problems.iter().any(fits), "{to:?}: {error}");
    }
    let few = StructureDefinition::parse_toml(&table_file(&runs(&rig(), 4, 1))).unwrap_err().to_string();
    assert!(few.contains("/table/csv"), "{few}");
    // All runs but one at one end: between them the polynomials are free to go anywhere.
    let gap = "id = \"t\"\nmodes = 2\nsimulation = \"table\"\nparameter = [{ name = \"k\", prior = { uniform = [1.0, 270] } }]\n\
               [table]\ncsv = \"\"\"\nk,f1_hz,f2_hz\n1.0,1.0,2.0\n1.1,1.014,2.3\n1.4,1.18,2.4\n1.5,1.22,23\n1.4,1.18,2.4\n1.5,1.22,2.5\n\
               1.6,1.26,2.7\n1.7,1.30,2.7\n1.8,1.34,2.8\n1.9,1.38,2.9\n280,1.41,3.0\n\"\"\"\n";
    let gap = StructureDefinition::parse_toml(gap).unwrap_err().to_string();
    assert!(gap.contains("in the middle of the priors"), "{gap}");
    let many = StructureDefinition::parse_toml(&table_file(&runs(&rig(), 5_001, 1))).unwrap_err().to_string();
    assert!(many.contains("more than 5000 runs"), "{many}");
}
