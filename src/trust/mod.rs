//! Whether an answer may be believed: what is odd about the data, and whether the simulation can produce them at all.
//!
//! [`quality`] looks at the measurements alone, [`fit`] at what the simulation leaves unexplained, [`cause`] names the
//! common slips behind a batch that does not fit.

pub mod cause;
pub mod fit;
pub mod quality;

use serde::{Deserialize, Serialize};

use crate::baseline::Baseline;

/// Whether the probability of damage of a batch may be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = TrustVerdict)]
pub enum Verdict {
    /// Nothing speaks against it.
    Accepted,
    /// Something does: the probability of damage is withheld and no damage alarm raised.
    Rejected,
}

/// What a finding does to the answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = FindingEffect)]
pub enum Effect {
    /// The reader is told.
    Note,
    /// The batch moves no alarm chart.
    HoldAlarm,
    /// The batch is rejected.
    Reject,
}

/// What was found; the names are part of the API.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = FindingCode)]
pub enum Code {
    /// No parameters of the prior give these frequencies within their noise.
    SimulationDoesNotFit,
    /// As many parameters as modes: a misfit inside the prior box cannot show.
    FitNotTestable,
    /// The values are in another unit than Hz.
    UnitSuspected,
    /// Modes are in another order.
    ModesSwapped,
    /// A mode was missed and those above it moved down.
    ModesShifted,
    /// All measurements are the same: a sensor that hangs.
    NoScatter,
    /// A measurement repeats an earlier one to the last digit.
    StaleRepeat,
    /// Frequencies on a grid coarser than their scatter.
    Quantised,
    /// Single measurements far from the others or from anything the simulation gives; left out.
    Outlier,
    /// Measurements that lie a little beyond the prior; they count as its nearest point.
    OutsidePrior,
    /// Many samples lie at an edge of a prior.
    PriorEdge,
    /// Less noise stated than the baseline was trained for; taken as the least it knows.
    NoiseBelowRange,
    /// Measurements that lack modes which the baseline needs; left out.
    NotUsable,
    /// More noise stated than the baseline was trained for; those modes are left out.
    NoiseAboveRange,
    /// Covariates outside what the undamaged state saw.
    Extrapolated,
    /// Parameters where the table behind an emulator has no runs.
    BeyondRuns,
    /// The undamaged state has a covariate that this batch lacks.
    CovariateMissing,
    /// Too few effective samples for the hyperparameters.
    FewEffectiveSamples,
    /// The baseline in use did not pass its calibration and was allowed all the same.
    Uncalibrated,
    /// Parameters that these modes cannot tell apart.
    NotIdentifiable,
    /// Modes that the emulator of a table follows badly.
    EmulatorDoubtful,
}

/// One thing a reader must know before believing the figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Finding {
    /// Its name.
    pub code: Code,
    /// What it does to the answer.
    pub effect: Effect,
    /// A sentence for people.
    pub message: String,
    /// Index of the measurements concerned; empty for the whole batch.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub measurements: Vec<usize>,
}

impl Finding {
    /// A finding about the whole batch.
    pub fn new(code: Code, effect: Effect, message: impl Into<String>) -> Self {
        Self { code, effect, message: message.into(), measurements: Vec::new() }
    }

    /// The same about some of its measurements.
    #[must_use]
    pub fn of(mut self, measurements: Vec<usize>) -> Self {
        self.measurements = measurements;
        self
    }
}

/// How far an assessment can be believed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Trust {
    /// The verdict.
    pub verdict: Verdict,
    /// Probability of a misfit at least this large if the simulation is right; `None` where the modes are no more than the
    /// parameters, and nothing can be tested.
    pub p_value: Option<f64>,
    /// Root mean square of what the simulation leaves unexplained, in standard deviations of the noise and for each degree
    /// of freedom: 1 where all is well.
    pub distance: Option<f64>,
    /// Modes beyond the free parameters, over all measurements.
    pub degrees_of_freedom: usize,
    /// What was found, the weightiest first.
    pub findings: Vec<Finding>,
}

impl Trust {
    /// The verdict follows from the findings.
    pub fn new(fit: &fit::Fit, mut findings: Vec<Finding>) -> Self {
        findings.sort_by_key(|finding| std::cmp::Reverse(finding.effect));
        let rejected = findings.iter().any(|f| f.effect == Effect::Reject);
        Self {
            verdict: if rejected { Verdict::Rejected } else { Verdict::Accepted },
            p_value: fit.p_value,
            distance: fit.distance,
            degrees_of_freedom: fit.degrees_of_freedom,
            findings,
        }
    }

    /// That of an assessment from before trust was judged.
    pub fn unknown() -> Self {
        Self { verdict: Verdict::Accepted, p_value: None, distance: None, degrees_of_freedom: 0, findings: Vec::new() }
    }

    /// True unless the batch is rejected.
    pub fn accepted(&self) -> bool {
        self.verdict == Verdict::Accepted
    }

    /// True when the batch may move an alarm chart.
    pub fn moves_charts(&self) -> bool {
        self.findings.iter().all(|finding| finding.effect == Effect::Note)
    }

    /// True when it was taken under conditions that the undamaged state did not see, or lies where an emulator has no runs.
    pub fn extrapolated(&self) -> bool {
        self.findings.iter().any(|finding| matches!(finding.code, Code::Extrapolated | Code::BeyondRuns))
    }
}

/// More than this share of bad measurements, and more than one, and a batch is rejected as a whole.
pub const MOST_BAD: f64 = 0.1;

/// True when `bad` of `all` measurements are too many for the others to be believed.
pub fn too_many(bad: usize, all: usize) -> bool {
    bad > 0 && (bad == all || bad as f64 > (MOST_BAD * all as f64).max(1.0))
}

/// Failures of a calibration that a finding quotes.
const SHOWN_FAILURES: usize = 3;

/// What every answer of a baseline must say: that it did not pass its calibration, or cannot tell parameters apart.
pub fn standing_findings(baseline: &Baseline) -> Vec<Finding> {
    let record = &baseline.manifest().calibration;
    let uncalibrated = (!record.passed()).then(|| {
        // A flow that was trained far too short fails in dozens of places, and some of them say it as well as all.
        let some = record.failures.iter().take(SHOWN_FAILURES).cloned().collect::<Vec<_>>().join("; ");
        let more = record.failures.len().saturating_sub(SHOWN_FAILURES);
        let more = if more > 0 { format!("; and {more} more, see its manifest") } else { String::new() };
        let message = format!("the trained baseline in use failed its calibration: {some}{more}");
        Finding::new(Code::Uncalibrated, Effect::Note, message)
    });
    let grouped = baseline.groups().into_iter().map(|group| {
        let names: Vec<&str> = group.columns.iter().map(|&k| baseline.space().as_slice()[k].name.as_str()).collect();
        let message = format!(
            "these modes cannot tell {} apart: their damage is told for their mean, {}, and not for one of them",
            names.join(" and "),
            group.name
        );
        Finding::new(Code::NotIdentifiable, Effect::Note, message)
    });
    // Parameters of different kinds cannot be averaged: the pair is named, and each keeps its own figures.
    let parameters = &baseline.manifest().identifiability.parameters;
    let grouped_names: Vec<&String> = baseline.manifest().identifiability.groups.iter().flatten().collect();
    let confused = parameters.iter().filter(|p| !grouped_names.contains(&&p.name) && p.is_confused()).map(|p| {
        let other = p.confused_with.as_ref().map_or("another", |(name, _)| name.as_str());
        let message = format!("these modes hardly tell {} from {other}: damage of one may show in the other", p.name);
        Finding::new(Code::NotIdentifiable, Effect::Note, message)
    });
    let simulation = baseline.simulator().warnings().into_iter();
    let doubtful = simulation.map(|message| Finding::new(Code::EmulatorDoubtful, Effect::Note, message));
    uncalibrated.into_iter().chain(grouped).chain(confused).chain(doubtful).collect()
}
