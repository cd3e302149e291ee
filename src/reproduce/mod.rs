//! The paper, whole: both of its cases by all three methods, over many repetitions, beside its own figures.
//!
//! Source: Wang et al. (2025), MSSP 232, 112743; sections 5 and 6, Tables 3 to 10, Figures 8 to 22.

mod case1;
mod case2;
mod paper;
pub mod report;
mod trial;

use serde::Serialize;

use crate::gsa::Sensitivity;
use crate::updating::law::ExponentialFit;

pub use case1::case1;
pub use case2::{case2, configurations};

/// What was run; serialised, it is what `--json` prints.
#[derive(Debug, Clone, Serialize)]
pub struct Reproduction {
    /// Where it ran.
    pub machine: Machine,
    /// How it ran.
    pub settings: Settings,
    /// Section 5: three masses, simulated.
    pub case1: Option<Case>,
    /// Section 6: the rig.
    pub case2: Option<Case>,
    /// Wall clock of everything, s.
    pub seconds: f64,
}

/// The machine a reproduction ran on.
#[derive(Debug, Clone, Serialize)]
pub struct Machine {
    /// Name of the processor.
    pub processor: String,
    /// Threads used.
    pub threads: usize,
    /// Operating system and architecture.
    pub system: String,
    /// Version of this program.
    pub program_version: String,
}

impl Machine {
    /// This machine.
    pub fn here() -> Self {
        // Linux names its processor here; elsewhere the architecture has to do.
        let cpuinfo = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let named = cpuinfo.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
        Self {
            processor: named.map_or_else(|| std::env::consts::ARCH.to_owned(), |(_, name)| name.trim().to_owned()),
            threads: rayon::current_num_threads(),
            system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            program_version: env!("CARGO_PKG_VERSION").to_owned(),
        }
    }
}

/// How much is run.
#[derive(Debug, Clone, Serialize)]
pub struct Settings {
    /// Repetitions with fresh measurements, each by all three methods.
    pub repetitions: usize,
    /// Seed of all draws.
    pub seed: u64,
    /// Samples of the transitional Markov chains.
    pub tmcmc_samples: usize,
    /// Simulated pairs that the flow was trained on.
    pub training_samples: usize,
    /// Passes over them.
    pub training_epochs: usize,
    /// A short run, to look at: fewer repetitions, a flow trained for a shorter time.
    pub quick: bool,
}

/// How the parameters were found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// A deterministic inverse of each measurement.
    Sensitivity,
    /// TMCMC with the Bhattacharyya distance.
    Tmcmc,
    /// The conditional invertible neural network.
    Cinn,
}

/// One of the two cases. Tables carry the paper's numbers in their names; those of the other case are empty.
#[derive(Debug, Clone, Serialize)]
pub struct Case {
    /// Case 1: Table 3, the undamaged state.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub table3: Vec<Row>,
    /// Case 1: Table 4, the damaged states.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub table4: Vec<Row>,
    /// Case 1: Table 5, the methods on 500 measurements.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub table5: Vec<Row>,
    /// Case 1: Table 6, times.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub table6: Vec<Time>,
    /// Case 2: Table 8, both states.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub table8: Vec<Row>,
    /// Case 2: Table 9, the methods on all 61 configurations.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub table9: Vec<Row>,
    /// Case 2: Table 10, times.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub table10: Vec<Time>,
    /// Estimates of held-out parameters by the trained flow: Figure 8 or 19.
    pub accuracy: Vec<Accuracy>,
    /// Every state of the first repetition: Figures 9 to 13, 20 and 21.
    pub states: Vec<State>,
    /// The same measurements by each method: Figure 14 or 22.
    pub methods: Vec<MethodSamples>,
    /// Case 2 alone.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rig: Option<Rig>,
    /// What a reader must know of these figures.
    pub notes: Vec<String>,
}

/// A figure over the repetitions: half of them lie below the median, a twentieth beyond each end.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Median.
    pub median: f64,
    /// 5 % quantile.
    pub low: f64,
    /// 95 % quantile.
    pub high: f64,
}

/// A figure of ours beside the paper's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Compared {
    /// Over the repetitions.
    pub ours: Spread,
    /// What the data were drawn with.
    pub target: f64,
    /// What the paper found in its single run; none where it shows none for this method and state.
    pub paper: Option<f64>,
    /// Share of our repetitions below the paper's value, %; one that meets it counts half.
    pub paper_percentile: Option<f64>,
}

/// Hyperparameters of one parameter in one state by one method.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// `undamaged`, `scenario 1`, `damaged`, `all 61`, ….
    pub state: String,
    /// Name of the parameter.
    pub parameter: String,
    /// Unit of mean and std.
    pub unit: String,
    /// How it was found.
    pub method: Method,
    /// The parameter has changed in this state.
    pub damaged: bool,
    /// Mean.
    pub mean: Compared,
    /// Standard deviation.
    pub std: Compared,
    /// Probability of damage, 0 to 1; none where no state is compared.
    pub probability_of_damage: Option<Compared>,
    /// |mean − mean of the values drawn|, over the repetitions.
    pub mean_error: Spread,
    /// Mean over the repetitions of |mean − mean of the values drawn|.
    pub mean_absolute_mean_error: f64,
    /// Mean over the repetitions of |std − standard deviation of the values drawn|.
    pub mean_absolute_std_error: f64,
    /// |PoD − share of the values drawn beyond the threshold of the values drawn|, mean over the repetitions.
    pub mean_absolute_pod_error: Option<f64>,
    /// Share of the values drawn that lie outside the prior box, %, mean over the repetitions.
    pub outside_prior_percent: f64,
}

/// Time of one step of a method.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Time {
    /// The method.
    pub method: Method,
    /// `updating`, `training`, `inference`.
    pub step: String,
    /// Wall clock here, s; the median where it was run several times.
    pub seconds: f64,
    /// Wall clock in the paper, s.
    pub paper_seconds: f64,
    /// Time of TMCMC here over this one.
    pub times_faster_than_tmcmc: f64,
    /// Model runs, where they were counted.
    pub model_runs: Option<usize>,
    /// On what.
    pub note: String,
}

/// Estimates of one parameter at held-out points of the prior.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Accuracy {
    /// Name of the parameter.
    pub parameter: String,
    /// Unit.
    pub unit: String,
    /// True values.
    pub truth: Vec<f64>,
    /// One posterior sample each.
    pub estimate: Vec<f64>,
    /// Coefficient of determination of the samples.
    pub r_squared: f64,
}

/// Measurements and posterior of one state, in one repetition.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct State {
    /// As in [`Row`].
    pub name: String,
    /// Frequencies, Hz, a list for each mode.
    pub frequencies_hz: Vec<Vec<f64>>,
    /// Quantities: the parameters, and in case 2 the stiffnesses that they set.
    pub quantities: Vec<Quantity>,
}

/// One quantity of a state.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Quantity {
    /// Name, `spring:k12` for a stiffness set through a law.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// Ends of the prior; none for a stiffness set through a law.
    pub prior: Option<[f64; 2]>,
    /// Mean and standard deviation of the normal distribution it was drawn from; none in case 2.
    pub target: Option<[f64; 2]>,
    /// Values drawn.
    pub realised: Vec<f64>,
    /// Posterior samples of the trained flow, ten a measurement, in the order of the measurements.
    pub samples: Vec<f64>,
    /// Damage threshold δ of the undamaged state.
    pub threshold: f64,
    /// Probability of damage: share of the samples beyond the threshold.
    pub probability_of_damage: f64,
}

/// What one method found for each parameter of the measurements that all of them had.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MethodSamples {
    /// The method.
    pub method: Method,
    /// Samples of the population of each parameter: of TMCMC, draws from the normal distributions of its posterior.
    pub samples: Vec<Vec<f64>>,
}

/// What only the rig has.
#[derive(Debug, Clone, Serialize)]
pub struct Rig {
    /// The 61 configurations of Figure 16.
    pub configurations: Vec<Configuration>,
    /// Figure 17: inputs p12, p23, m1 to m3, kg1 to kg3; outputs f1 to f3.
    pub sensitivity: Sensitivity,
    /// Figure 18: k12(p12) and k23(p23).
    pub laws: Vec<LawFit>,
}

/// A setting of the two links.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Configuration {
    /// Position of the first link, m.
    pub p12_m: f64,
    /// Position of the second link, m.
    pub p23_m: f64,
    /// One of them is at its lowest.
    pub damaged: bool,
}

/// A coupling's stiffness over its link's position.
#[derive(Debug, Clone, Serialize)]
pub struct LawFit {
    /// `k12` or `k23`.
    pub coupling: String,
    /// Position, m, and stiffness identified from the frequencies of one configuration, N/m.
    pub points: Vec<(f64, f64)>,
    /// k = A·exp(B·p) + C, fitted.
    pub fit: ExponentialFit,
    /// A, B and C of the paper's Eq. 26, with which the frequencies were simulated.
    pub paper: [f64; 3],
}
