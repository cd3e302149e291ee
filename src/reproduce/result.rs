//! Results of a reproduction.

use serde::Serialize;

use crate::gsa::Sensitivity;
use crate::updating::law::ExponentialFit;

/// A reproduction of the paper, in the form that `--json` prints.
#[derive(Debug, Clone, Serialize)]
pub struct Reproduction {
    /// The machine that it ran on.
    pub machine: Machine,
    /// Its settings.
    pub settings: Settings,
    /// Section 5: three simulated masses.
    pub case1: Option<Case>,
    /// Section 6: the rig.
    pub case2: Option<Case>,
    /// Total elapsed time, s.
    pub seconds: f64,
}

/// The machine a reproduction ran on.
#[derive(Debug, Clone, Serialize)]
pub struct Machine {
    /// Name of the processor.
    pub processor: String,
    /// Number of threads.
    pub threads: usize,
    /// Operating system and architecture.
    pub system: String,
    /// Version of this program.
    pub program_version: String,
}

impl Machine {
    /// This machine.
    pub fn here() -> Self {
        // Only Linux gives the name of the processor here; other systems report the architecture.
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

/// Settings of a reproduction.
#[derive(Debug, Clone, Serialize)]
pub struct Settings {
    /// Number of repetitions with new measurements, each by all three methods.
    pub repetitions: usize,
    /// Seed of all draws.
    pub seed: u64,
    /// Number of samples of TMCMC.
    pub tmcmc_samples: usize,
    /// Number of simulated samples that the flow was trained on.
    pub training_samples: usize,
    /// Number of training epochs.
    pub training_epochs: usize,
    /// Whether this is a short demonstration with fewer repetitions and shorter training.
    pub quick: bool,
}

/// Method by which the parameters were found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// Sensitivity-based updating by each measurement.
    Sensitivity,
    /// TMCMC with the Bhattacharyya distance.
    Tmcmc,
    /// The conditional invertible neural network.
    Cinn,
}

/// Results of one of the two cases. The tables have the numbers of the paper; those of the other case are empty.
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
    /// Results that only case 2 has.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rig: Option<Rig>,
    /// Notes for readers of these results.
    pub notes: Vec<String>,
}

/// Distribution of a value over the repetitions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Median.
    pub median: f64,
    /// 5 % quantile.
    pub low: f64,
    /// 95 % quantile.
    pub high: f64,
}

/// A value found here, and that of the paper.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Compared {
    /// Values found here over the repetitions.
    pub ours: Spread,
    /// Value that the data were simulated with.
    pub target: f64,
    /// Value in the paper, from a single run; none if the paper shows none for this method and state.
    pub paper: Option<f64>,
    /// Share of the repetitions with a value below that of the paper, %; equal values count half.
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
    /// Method by which it was found.
    pub method: Method,
    /// Whether the parameter has changed in this state.
    pub damaged: bool,
    /// Mean.
    pub mean: Compared,
    /// Standard deviation.
    pub std: Compared,
    /// Probability of damage, 0 to 1; none without a comparison of states.
    pub probability_of_damage: Option<Compared>,
    /// |mean − mean of the drawn values|, over the repetitions.
    pub mean_error: Spread,
    /// Mean over the repetitions of |mean − mean of the drawn values|.
    pub mean_absolute_mean_error: f64,
    /// Mean over the repetitions of |std − standard deviation of the drawn values|.
    pub mean_absolute_std_error: f64,
    /// Mean over the repetitions of |PoD − share of the drawn values beyond the threshold of the drawn undamaged values|.
    pub mean_absolute_pod_error: Option<f64>,
    /// Mean over the repetitions of the share of the drawn values outside the prior box, %.
    pub outside_prior_percent: f64,
}

/// Time of one step of a method.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Time {
    /// The method.
    pub method: Method,
    /// `updating`, `training` or `inference`.
    pub step: String,
    /// Elapsed time here, s; the median over the repetitions.
    pub seconds: f64,
    /// Elapsed time in the paper, s.
    pub paper_seconds: f64,
    /// Time of TMCMC here, divided by this time.
    pub times_faster_than_tmcmc: f64,
    /// Number of model runs, if they were counted.
    pub model_runs: Option<usize>,
    /// Description of the task.
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
    /// One posterior sample for each true value.
    pub estimate: Vec<f64>,
    /// Coefficient of determination of the samples.
    pub r_squared: f64,
}

/// Measurements and posterior of one state, in one repetition.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct State {
    /// Name of the state, as in [`Row`].
    pub name: String,
    /// Frequencies, Hz, `[m][n]`.
    pub frequencies_hz: Vec<Vec<f64>>,
    /// The parameters, and in case 2 the stiffnesses that they set.
    pub quantities: Vec<Quantity>,
}

/// A quantity in one state.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Quantity {
    /// Name, `spring:k12` for a stiffness set through a law.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// Bounds of the prior; none for a stiffness set through a law.
    pub prior: Option<[f64; 2]>,
    /// Mean and standard deviation of the normal distribution it was drawn from; none in case 2.
    pub target: Option<[f64; 2]>,
    /// Values that the measurements were simulated with.
    pub realised: Vec<f64>,
    /// Posterior samples of the trained flow, ten for each measurement, in the order of the measurements.
    pub samples: Vec<f64>,
    /// Damage threshold δ of the undamaged state.
    pub threshold: f64,
    /// Probability of damage: share of the samples below the threshold.
    pub probability_of_damage: f64,
}

/// What one method found from the measurements that all methods were given.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MethodSamples {
    /// The method.
    pub method: Method,
    /// Samples of the population of each parameter, `[d][samples]`; for TMCMC, draws from the normal distributions of its posterior.
    pub samples: Vec<Vec<f64>>,
}

/// Results that only the rig has.
#[derive(Debug, Clone, Serialize)]
pub struct Rig {
    /// The 61 configurations of Figure 16.
    pub configurations: Vec<Configuration>,
    /// Figure 17: inputs p12, p23, m1 to m3, kg1 to kg3; outputs f1 to f3.
    pub sensitivity: Sensitivity,
    /// Figure 18: k12(p12) and k23(p23).
    pub laws: Vec<LawFit>,
}

/// Positions of the two links.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Configuration {
    /// Position of the first link, m.
    pub p12_m: f64,
    /// Position of the second link, m.
    pub p23_m: f64,
    /// Whether one of them is at its lowest position, which is the damage.
    pub damaged: bool,
}

/// Stiffness of a coupling as a function of the position of its link.
#[derive(Debug, Clone, Serialize)]
pub struct LawFit {
    /// `k12` or `k23`.
    pub coupling: String,
    /// Position (m) and stiffness (N/m) identified from the frequencies of one configuration.
    pub points: Vec<(f64, f64)>,
    /// Fit of k = A·exp(B·p) + C.
    pub fit: ExponentialFit,
    /// A, B and C of the paper's Eq. 26, with which the frequencies were simulated.
    pub paper: [f64; 3],
}
