//! A tower with weather in one storey and new damage in another, in measurements that a diagnosis holds out by default.

use rand_distr::StandardNormal;
use serde_json::{json, Value};

use super::world;

/// Without a trained model: a diagnosis needs the simulation only.
pub const STRUCTURE: &str = r#"
id = "tower"
modes = 4
measurement_noise = { relative = 0.002 }
mass = [{ name = "m1", kg = 1.0 }, { name = "m2", kg = 0.9 }, { name = "m3", kg = 0.9 }, { name = "m4", kg = 0.7 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 3000.0 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 2600.0 },
    { name = "k3", from = "m2", to = "m3", n_per_m = 2400.0 },
    { name = "k4", from = "m3", to = "m4", n_per_m = 2000.0 },
]
parameter = [
    { name = "k1", prior = { uniform = [2000.0, 4000.0] }, sets = { spring = "k1" } },
    { name = "k2", prior = { uniform = [1800.0, 3400.0] }, sets = { spring = "k2" } },
]
covariate = [{ name = "temperature_c" }]
"#;

/// The day of 2024 from which k2 has lost 8 %: 27 September.
const LOSS: i64 = 270;

/// Ten days with one measurement a day; k1 softens with temperature.
pub fn batch(first_day: i64, rng: &mut impl rand::Rng) -> Vec<Value> {
    let mut one = |day: i64| {
        let mut normal = || rng.sample::<f64, _>(StandardNormal);
        let t = 10.0 - 10.0 * (std::f64::consts::TAU * (day as f64 - 20.0) / 365.0).cos() + 3.0 * normal();
        let k1 = 3000.0 * (1.0 - 0.003 * (t - 10.0)) * (1.0 + 0.004 * normal());
        let k2 = 2600.0 * if day >= LOSS { 0.92 } else { 1.0 } * (1.0 + 0.004 * normal());
        let springs = [(None, 0, k1), (Some(0), 1, k2), (Some(1), 2, 2400.0), (Some(2), 3, 2000.0)];
        let exact = world::frequencies_hz(&[1.0, 0.9, 0.9, 0.7], &springs).unwrap();
        let f: Vec<f64> = exact.iter().map(|f| f * (1.0 + 0.002 * normal())).collect();
        let at = world::rfc3339(world::EPOCH_2024_S + 86_400 * day);
        json!({ "measured_at": at, "frequencies_hz": f, "covariates": { "temperature_c": t } })
    };
    (first_day..first_day + 10).map(&mut one).collect()
}
