//! Values printed in the paper, for comparison.
//!
//! Source: Wang et al. (2025), Tables 2 to 10 and Eq. 26.

use super::result::Method;

/// Name, mean and standard deviation of the stiffnesses of case 1, N/m (Table 2).
pub const TARGET_1: [(&str, f64, f64); 3] = [("k1", 4.0, 0.3), ("k2", 5.0, 0.1), ("k3", 6.0, 0.2)];

/// Damage scenarios of case 1: remaining share of the mean of each stiffness (Table 1).
pub const SCENARIOS: [(&str, [f64; 3]); 3] =
    [("scenario 1", [0.9, 1.0, 1.0]), ("scenario 2", [1.0, 0.9, 0.8]), ("scenario 3", [0.9, 0.9, 0.8])];

/// A, B and C of k12 and of k23 (Eq. 26): N/m, 1/m, N/m.
pub const LAWS: [[f64; 3]; 2] = [[221.75, 31.64, 855.75], [300.45, 28.89, 725.37]];

/// Mean, standard deviation and probability of damage that the paper prints for a parameter in a state.
pub struct Printed {
    state: &'static str,
    parameter: &'static str,
    method: Method,
    /// Mean.
    pub mean: f64,
    /// Standard deviation.
    pub std: f64,
    /// Probability of damage, 0 to 1.
    pub probability_of_damage: Option<f64>,
}

const fn cinn(state: &'static str, parameter: &'static str, mean: f64, std: f64, pod: Option<f64>) -> Printed {
    Printed { state, parameter, method: Method::Cinn, mean, std, probability_of_damage: pod }
}

const fn other(state: &'static str, parameter: &'static str, method: Method, mean: f64, std: f64) -> Printed {
    Printed { state, parameter, method, mean, std, probability_of_damage: None }
}

use Method::{Sensitivity, Tmcmc};

/// Tables 3 to 5.
pub const CASE_1: &[Printed] = &[
    cinn("undamaged", "k1", 4.083, 0.314, None),
    cinn("undamaged", "k2", 5.008, 0.097, None),
    cinn("undamaged", "k3", 5.987, 0.188, None),
    cinn("scenario 1", "k1", 3.606, 0.327, Some(0.456)),
    cinn("scenario 2", "k2", 4.511, 0.091, Some(1.0)),
    cinn("scenario 2", "k3", 4.794, 0.202, Some(1.0)),
    cinn("scenario 3", "k1", 3.581, 0.275, Some(0.546)),
    cinn("scenario 3", "k2", 4.520, 0.090, Some(1.0)),
    cinn("scenario 3", "k3", 4.826, 0.171, Some(1.0)),
    other(FIVE_HUNDRED, "k1", Sensitivity, 3.998, 0.274),
    other(FIVE_HUNDRED, "k2", Sensitivity, 4.999, 0.099),
    other(FIVE_HUNDRED, "k3", Sensitivity, 5.998, 0.204),
    other(FIVE_HUNDRED, "k1", Tmcmc, 3.970, 0.279),
    other(FIVE_HUNDRED, "k2", Tmcmc, 4.998, 0.101),
    other(FIVE_HUNDRED, "k3", Tmcmc, 6.042, 0.215),
    other(FIVE_HUNDRED, "k1", Method::Cinn, 4.083, 0.314),
    other(FIVE_HUNDRED, "k2", Method::Cinn, 5.008, 0.097),
    other(FIVE_HUNDRED, "k3", Method::Cinn, 5.987, 0.188),
];

/// Tables 8 and 9, m.
pub const CASE_2: &[Printed] = &[
    cinn("undamaged", "p12", 0.0503, 0.0137, Some(0.05)),
    cinn("undamaged", "p23", 0.0454, 0.0147, Some(0.05)),
    cinn("damaged", "p12", 0.0334, 0.0166, Some(0.5636)),
    cinn("damaged", "p23", 0.0337, 0.0183, Some(0.4546)),
    other(ALL_61, "p12", Sensitivity, 0.0442, 0.0144),
    other(ALL_61, "p23", Sensitivity, 0.0449, 0.0145),
    other(ALL_61, "p12", Tmcmc, 0.0487, 0.0141),
    other(ALL_61, "p23", Tmcmc, 0.0466, 0.0153),
    other(ALL_61, "p12", Method::Cinn, 0.0473, 0.0158),
    other(ALL_61, "p23", Method::Cinn, 0.0453, 0.0156),
];

/// Name of the state of Table 5.
pub const FIVE_HUNDRED: &str = "500 measurements";

/// Name of the state of Table 9.
pub const ALL_61: &str = "all 61";

/// Times in the paper, s: updating by the sensitivity method and by TMCMC, training and inference of the cINN (Tables 6 and 10).
pub const SECONDS: [[f64; 4]; 2] = [[95.0, 3202.0, 433.0, 12.0], [77.0, 1587.0, 401.0, 8.0]];

/// Values that the paper prints for a parameter in a state by a method, if there are any.
pub fn printed(all: &'static [Printed], state: &str, parameter: &str, method: Method) -> Option<&'static Printed> {
    all.iter().find(|p| p.state == state && p.parameter == parameter && p.method == method)
}
