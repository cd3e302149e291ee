//! Many runs at once, of structures under effects and with parameters that are masses or deviations: the same as one by one.

use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use nalgebra::DMatrix;

const HANGER: &str = r#"
id = "hanger"
simulation = "beam"
modes = 4
measurement_noise = { relative = 0.001 }
node = [{ name = "deck", x_m = 0.0, support = "pinned" }, { name = "arch", x_m = 20.0, support = "pinned" }]
[[beam]]
name = "bar"
from = "deck"
to = "arch"
bending_stiffness_n_m2 = 1e5
mass_kg_per_m = 30.0
elements = 12
[[parameter]]
name = "ei"
scale = true
prior = { uniform = [0.8, 1.2] }
sets = { beam = "bar" }
[[parameter]]
name = "tension"
prior = { uniform = [-0.7, 6.0] }
sets = { deviation = "axial_force" }
[[parameter]]
name = "restraint"
prior = { uniform = [0.0, 3.0] }
sets = { deviation = "end_restraint" }
[[parameter]]
name = "curve"
prior = { normal = { mean = 0.0, std = 0.01 } }
sets = { deviation = "calibration" }
damage = "none"
"#;

const TOWER: &str = r#"
id = "tower"
modes = 3
measurement_noise = { relative = 0.002 }
mass = [{ name = "m1", kg = 1e5 }, { name = "m2", kg = 1e5 }, { name = "m3", kg = 8e4 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 3e7 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 2e7 },
    { name = "k3", from = "m2", to = "m3", n_per_m = 2.5e7 },
]
covariate = [{ name = "temperature_c" }, { name = "snow_kn" }]
[[parameter]]
name = "low"
scale = true
prior = { uniform = [0.5, 1.5] }
sets = [{ spring = "k1" }, { spring = "k2" }]
[[parameter]]
name = "top"
scale = true
prior = { uniform = [0.5, 1.5] }
sets = { spring = "k3" }
[[effect]]
name = "warm"
target = { springs = ["k2", "k3"] }
law = "linear"
covariate = "temperature_c"
numbers = { slope_per_unit = -0.005 }
seen = [-10.0, 0.0, 30.0]
[[effect]]
name = "snow"
target = { masses = ["m3"] }
law = "linear"
covariate = "snow_kn"
numbers = { slope_per_unit = 0.002 }
seen = [0.0, 10.0, 50.0]
[[effect]]
name = "instrument"
target = { frequency_scale = 0 }
law = "constant"
numbers = { size = 0.01 }
"#;

fn simulator(text: &str) -> Simulator {
    Simulator::new(StructureDefinition::parse_toml(text).unwrap()).unwrap()
}

/// Compares all rows with the frequencies and slopes of each row by itself; rows without frequencies are NaN.
fn compare(simulator: &Simulator, theta: &DMatrix<f64>) {
    let (modes, d) = (simulator.modes(), theta.ncols());
    let all = simulator.frequencies_of_rows_hz(theta, 0..theta.nrows());
    // Measured about as the first row simulates, so that some rows are near and others are not.
    let near_hz: Vec<Option<f64>> = all[..modes].iter().map(|hz| Some(1.01 * hz)).collect();
    let near = simulator.frequencies_near_hz(theta, 0..theta.nrows(), &near_hz);
    let slopes = simulator.slopes_near(theta, 0..theta.nrows(), &near_hz);
    for row in 0..theta.nrows() {
        let own: Vec<f64> = theta.row(row).iter().copied().collect();
        let expected = simulator.frequencies_and_jacobian(&own);
        let of_row = modes * row..modes * (row + 1);
        let Ok((expected_hz, jacobian)) = expected else {
            assert!(all[of_row].iter().all(|hz| hz.is_nan()), "{own:?} has no frequencies");
            assert!(simulator.frequencies_hz(&own).is_err());
            continue;
        };
        let alone = simulator.frequencies_hz(&own).unwrap();
        for mode in 0..modes {
            let place = modes * row + mode;
            for found in [all[place], near[place], slopes.frequencies_hz[place], alone[mode]] {
                assert!((found / expected_hz[mode] - 1.0).abs() < 1e-9, "{own:?} mode {mode}: {found} {expected_hz:?}");
            }
            for column in 0..d {
                let (found, expected) = (slopes.slopes[place * d + column], jacobian[(mode, column)]);
                assert!((found - expected).abs() < 1e-6 * jacobian.row(mode).amax(), "{own:?}: {found} {expected}");
            }
        }
    }
}

#[test]
fn a_hanger_whose_tension_restraint_and_calibration_are_parameters() {
    let simulator = simulator(HANGER);
    let rows = [
        [100.0, 4.0, 0.5, 0.0],
        [100.5, 4.1, 0.45, 0.005],
        [90.0, 0.0, 0.0, -0.01],
        [110.0, 5.5, 2.5, 0.02],
        // A compression that leaves some stiffness, and one beyond the load of buckling.
        [100.0, -0.6, 0.0, 0.0],
        [80.0, -0.9, 0.0, 0.0],
        [120.0, -0.9, 3.0, 0.01],
        [95.0, 2.0, 1.0, 0.0],
        [85.0, 3.0, 0.2, -0.02],
    ];
    compare(&simulator, &DMatrix::from_fn(rows.len(), 4, |row, column| rows[row][column]));
}

#[test]
fn a_tower_under_temperature_snow_and_an_instrument_with_an_error() {
    let simulator = simulator(TOWER);
    let theta = DMatrix::from_fn(11, 2, |row, column| 70.0 + 5.0 * row as f64 + 20.0 * column as f64);
    let mut before = Vec::new();
    for sizes in [[0.0, 0.0, 0.0], [-0.15, 0.1, 0.01], [0.05, 0.02, -0.03]] {
        let under = simulator.under(&sizes);
        compare(&under, &theta);
        // Each has its own: what was prepared for other sizes is not used.
        let frequencies_hz = under.frequencies_of_rows_hz(&theta, 0..1);
        assert_ne!(frequencies_hz, before);
        before = frequencies_hz;
    }
    // k (1 + g), m (1 + g) and f (1 + g), built in.
    let built = TOWER.split("[[effect]]").next().unwrap();
    let built = built.replace("kg = 8e4", "kg = 8.8e4").replace("n_per_m = 2e7", "n_per_m = 1.7e7");
    let built = self::simulator(&built.replace("n_per_m = 2.5e7", "n_per_m = 2.125e7"));
    let expected = built.frequencies_of_rows_hz(&theta, 0..11);
    let found = simulator.under(&[-0.15, 0.1, 0.01]).frequencies_of_rows_hz(&theta, 0..11);
    assert!(found.iter().zip(&expected).all(|(found, expected)| (found / (1.01 * expected) - 1.0).abs() < 1e-10));
}
