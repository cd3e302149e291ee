//! JSON bodies of answers: units in field names, times in RFC 3339 UTC, never NaN.

mod table;

pub use table::HISTORY_COLUMNS;

use serde::Serialize;
use utoipa::ToSchema;

use crate::assessment::{Assessment, BatchState};
use crate::damage::{Correlation, JointDamage, JointReference, QuantityAssessment, QuantityKind};
use crate::measurement::table::understood::Understood;
use crate::measurement::ModalMeasurement;
use crate::monitor::stored::{BatchHeader, BatchRecord, HistoryEntry, ReferenceRecord, StoredChartPoint};
use crate::monitor::{BatchView, Missing};
use crate::process::reference::ReferenceProcess;
use crate::quantity::{StructureId, Timestamp};
use crate::trust::{Finding, TrustVerdict};

/// One batch.
#[derive(Debug, Serialize, ToSchema)]
pub struct Batch {
    structure: String,
    batch: String,
    source: String,
    received_at: Timestamp,
    measured_from: Timestamp,
    measured_to: Timestamp,
    measurement_count: usize,
    state: BatchState,
    #[serde(skip_serializing_if = "Option::is_none")]
    failure: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    next_step: Option<String>,
    content_digest: String,
    /// Id of the token with which the batch was posted; `null` without one, for a message of a broker, and for a batch that an earlier version
    /// of the program has stored.
    #[schema(required)]
    posted_by: Option<String>,
    assessment: Option<AssessmentBody>,
    /// Points of the batch on the alarm charts.
    charts: Vec<ChartBody>,
    #[serde(skip_serializing_if = "Option::is_none")]
    measurements: Option<Vec<ModalMeasurement>>,
    /// Only for a table that was posted: what was understood of it.
    #[serde(skip_serializing_if = "Option::is_none")]
    table: Option<Box<Understood>>,
}

impl Batch {
    /// The answer for a batch, with its measurements if requested.
    pub fn new(view: BatchView, with_measurements: bool) -> Self {
        let BatchView { record, assessment, charts, missing } = view;
        let rejected = assessment.as_ref().is_some_and(|assessment| !assessment.trust.accepted());
        let next_step = missing.map(|missing| next_step(&record, &missing, rejected));
        let (measured_from, measured_to) = record.batch.time_span();
        Self {
            structure: record.batch.structure.to_string(),
            batch: record.batch_id,
            source: record.batch.source,
            received_at: record.received_at,
            measured_from,
            measured_to,
            measurement_count: record.batch.measurements.len(),
            state: record.state,
            failure: record.failure,
            next_step,
            content_digest: record.content_digest.to_string(),
            posted_by: record.batch.posted_by,
            assessment: assessment.map(AssessmentBody::from),
            charts: charts.into_iter().map(ChartBody::from).collect(),
            measurements: with_measurements.then_some(record.batch.measurements),
            table: None,
        }
    }

    /// The answer for a batch of which a row cannot be read: its state is `failed`, for this reason.
    pub fn of_header(header: BatchHeader, unreadable: String) -> Self {
        Self {
            structure: header.structure.to_string(),
            batch: header.batch_id,
            source: header.source,
            received_at: header.received_at,
            measured_from: header.measured_from,
            measured_to: header.measured_to,
            measurement_count: header.measurement_count,
            state: BatchState::Failed,
            failure: Some(unreadable),
            next_step: None,
            content_digest: header.content_digest.to_string(),
            posted_by: header.posted_by,
            assessment: None,
            charts: Vec::new(),
            measurements: None,
            table: None,
        }
    }

    /// Adds what was understood of the table with which the batch was posted.
    pub fn of_table(self, table: Option<Understood>) -> Self {
        Self { table: table.map(Box::new), ..self }
    }
}

/// Why a batch has no assessment or comparison, with the request that helps.
fn next_step(record: &BatchRecord, missing: &Missing, rejected: bool) -> String {
    let route = declare_reference(&record.batch.structure);
    match missing {
        Missing::OutdatedReference(_) => format!("{missing}: {route}"),
        Missing::Reference if rejected => {
            format!("{missing}: {route} with batches of the healthy structure; this one is rejected")
        }
        Missing::Reference => format!("{missing}: {route} {{\"batches\": [\"{}\"]}}", record.batch_id),
        Missing::Model(_)
        | Missing::PartOfReference(_)
        | Missing::Assessment
        | Missing::NotYet
        | Missing::UnreadableReference(_) => missing.to_string(),
    }
}

/// The request that declares the undamaged reference of a structure.
pub fn declare_reference(structure: &StructureId) -> String {
    format!("POST /v1/structures/{structure}/reference")
}

/// Path of a batch.
pub fn location(record: &BatchRecord) -> String {
    format!("/v1/structures/{}/batches/{}", record.batch.structure, record.batch_id)
}

/// Assessment of a batch.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Assessment)]
pub struct AssessmentBody {
    model_digest: String,
    structure_digest: String,
    undamaged_version: Option<u32>,
    /// As text: many JSON readers lose digits of numbers above 2^53.
    seed: String,
    draws_per_measurement: usize,
    measurements_used: usize,
    measurements_left_out: usize,
    measurements_outside: usize,
    /// Number of independent measurements that those used are worth for the mean, the smallest of all parameters: fewer where successive
    /// measurements are correlated. `null` in assessments of earlier versions of the program.
    #[schema(required)]
    effective_measurements: Option<f64>,
    effective_sample_size: f64,
    misfit_percent: Vec<Option<f64>>,
    assessed_at: Timestamp,
    exceeds: bool,
    /// `accepted` or `rejected`. A rejected assessment has no probabilities of damage.
    trust: TrustVerdict,
    extrapolated: bool,
    fit_p_value: Option<f64>,
    /// √(χ²/degrees of freedom): 1 if noise explains the whole difference between measurement and simulation.
    fit_distance: Option<f64>,
    fit_degrees_of_freedom: usize,
    /// Findings that qualify the results.
    findings: Vec<Finding>,
    parameters: Vec<ParameterBody>,
    /// Correlations of the parameters that indicate damage, without the noise of the measurements; absent where the batch does not
    /// determine them.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    correlations: Vec<Correlation>,
    /// Probability that any parameter is beyond its threshold, beside that of the undamaged reference.
    #[serde(skip_serializing_if = "Option::is_none")]
    joint_damage: Option<JointDamage>,
}

/// Results for one monitored quantity. Mean and standard deviation are those of the population from which the
/// measurements of the batch were drawn; intervals have 90 % probability.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ParameterAssessment)]
pub struct ParameterBody {
    name: String,
    unit: String,
    kind: QuantityKind,
    mean: f64,
    mean_interval: Option<[f64; 2]>,
    std: Option<f64>,
    std_interval: Option<[f64; 2]>,
    edge_mass: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    group: Option<String>,
    threshold: Option<f64>,
    probability_of_damage: Option<f64>,
    probability_of_damage_interval: Option<[f64; 2]>,
    exceeds: Option<bool>,
    relative_change: Option<f64>,
    relative_change_interval: Option<[f64; 2]>,
    pooled: PooledBody,
}

/// Estimate of the paper: moments of all posterior samples pooled.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = PooledEstimate)]
pub struct PooledBody {
    mean: f64,
    std: Option<f64>,
    variance_within: f64,
    variance_between: Option<f64>,
    probability_of_damage: Option<f64>,
    /// Whether this probability is above that of the undamaged reference, as in the paper; many healthy batches have it so.
    exceeds: Option<bool>,
}

/// A batch on an alarm chart.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ChartPoint)]
pub struct ChartBody {
    batch: String,
    measured_to: Timestamp,
    chart: String,
    /// Shift towards damage in standard errors; with a process behind the reference, the evidence for a step on the fast chart. On the
    /// chart of the fit, 1 means rejected.
    shift: f64,
    shift_limit: f64,
    /// Moving average of the shifts; with a process, the evidence for a lasting loss on the slow chart.
    ewma: f64,
    ewma_limit: Option<f64>,
    /// Probability of damage at which the shift reaches its limit, if the spread is that of the undamaged reference.
    probability_of_damage_limit: Option<f64>,
    /// True if the batch did not change the chart, because of maintenance or a finding that suspends alarms.
    held: bool,
    state: String,
}

impl From<StoredChartPoint> for ChartBody {
    fn from(p: StoredChartPoint) -> Self {
        Self {
            batch: p.batch_id,
            measured_to: p.measured_to,
            chart: p.series,
            shift: p.shift,
            shift_limit: p.shift_limit,
            ewma: p.ewma,
            ewma_limit: p.ewma_limit,
            probability_of_damage_limit: p.probability_limit,
            held: p.held,
            state: p.state,
        }
    }
}

impl From<Assessment> for AssessmentBody {
    fn from(a: Assessment) -> Self {
        let (correlations, joint_damage) = a.joint.map(|joint| (joint.correlations, joint.damage)).unwrap_or_default();
        let exceeds = a.quantities.iter().any(|q| q.damage.as_ref().is_some_and(|d| d.exceeds));
        Self {
            model_digest: a.model_digest.to_string(),
            structure_digest: a.structure_digest.to_string(),
            undamaged_version: a.undamaged_version,
            seed: a.seed.to_string(),
            draws_per_measurement: a.draws_per_measurement,
            measurements_used: a.measurements_used,
            measurements_left_out: a.measurements_left_out,
            measurements_outside: a.measurements_outside,
            effective_measurements: a.trust.effective_measurements,
            effective_sample_size: a.effective_sample_size,
            misfit_percent: a.misfit_percent,
            assessed_at: a.assessed_at,
            exceeds,
            trust: a.trust.verdict,
            extrapolated: a.trust.extrapolated(),
            fit_p_value: a.trust.p_value,
            fit_distance: a.trust.distance,
            fit_degrees_of_freedom: a.trust.degrees_of_freedom,
            findings: a.trust.findings,
            parameters: a.quantities.into_iter().map(ParameterBody::from).collect(),
            correlations,
            joint_damage,
        }
    }
}

impl From<QuantityAssessment> for ParameterBody {
    fn from(q: QuantityAssessment) -> Self {
        let damage = q.damage.as_ref();
        Self {
            mean: q.mean,
            mean_interval: q.mean_interval,
            std: q.std,
            std_interval: q.std_interval,
            edge_mass: q.prior_bound_mass,
            threshold: damage.map(|d| d.threshold),
            probability_of_damage: damage.map(|d| d.probability_of_damage),
            probability_of_damage_interval: damage.and_then(|d| d.probability_interval),
            exceeds: damage.map(|d| d.exceeds),
            relative_change: damage.map(|d| d.relative_change),
            relative_change_interval: damage.and_then(|d| d.relative_change_interval),
            pooled: PooledBody {
                mean: q.pooled.mean,
                std: q.pooled.std,
                variance_within: q.pooled.within,
                variance_between: q.pooled.between,
                probability_of_damage: damage.map(|d| d.pooled_probability),
                exceeds: damage.and_then(|d| d.pooled_exceeds),
            },
            group: q.group,
            name: q.name,
            unit: q.unit,
            kind: q.kind,
        }
    }
}

/// One batch of the history.
#[derive(Debug, Serialize, ToSchema)]
pub struct HistoryItem {
    batch: String,
    source: String,
    measured_from: Timestamp,
    measured_to: Timestamp,
    received_at: Timestamp,
    measurement_count: usize,
    state: BatchState,
    #[serde(skip_serializing_if = "Option::is_none")]
    failure: Option<String>,
    assessment: Option<AssessmentBody>,
}

impl From<HistoryEntry> for HistoryItem {
    fn from(entry: HistoryEntry) -> Self {
        Self {
            batch: entry.batch_id,
            source: entry.source,
            measured_from: entry.measured_from,
            measured_to: entry.measured_to,
            received_at: entry.received_at,
            measurement_count: entry.measurement_count,
            state: entry.state,
            failure: entry.failure,
            assessment: entry.assessment.map(AssessmentBody::from),
        }
    }
}

/// The undamaged reference of a structure.
#[derive(Debug, Serialize, ToSchema)]
pub struct Undamaged {
    structure: String,
    version: u32,
    created_at: Timestamp,
    /// The version that it extends; `null` if it was declared by itself.
    #[schema(required)]
    extends: Option<u32>,
    /// Why it was made, if a reason was given.
    #[schema(required)]
    reason: Option<String>,
    model_digest: String,
    threshold_probability: f64,
    measurement_count: usize,
    /// Number of independent measurements that these are worth, the smallest of all parameters; `null` in references of earlier versions
    /// of the program.
    #[schema(required)]
    effective_measurements: Option<f64>,
    batches: Vec<String>,
    /// Ranges of the covariates in its batches.
    conditions: std::collections::BTreeMap<String, crate::damage::SeenCovariate>,
    /// Reasons to doubt the reference.
    doubts: Vec<String>,
    /// How the parameters move in time, which the alarm charts take into account; `null` if the reference does not show it.
    #[schema(required)]
    process: Option<ProcessBody>,
    /// Why there is no process: the alarm charts then take the batches as independent of each other.
    #[serde(skip_serializing_if = "Option::is_none")]
    without_process: Option<String>,
    parameters: Vec<crate::damage::UndamagedQuantity>,
    /// Joint probability that any parameter of the undamaged population is beyond its threshold; absent where the correlations are
    /// not estimated.
    #[serde(skip_serializing_if = "Option::is_none")]
    joint: Option<JointReference>,
}

/// How the parameters of the undamaged structure move in time.
#[derive(Debug, Serialize, ToSchema)]
pub struct ProcessBody {
    /// Number of batches that show it.
    batches: usize,
    /// Times of the first and the last of them.
    period: [Timestamp; 2],
    /// Median time between batches, s.
    step_s: f64,
    /// Covariates whose influence was learned.
    covariates: Vec<String>,
    /// Correlation of each common factor without a measured cause over one step.
    factor_correlations: Vec<f64>,
    /// The conditions that its batches have seen; absent in references of earlier versions of the program.
    #[serde(skip_serializing_if = "Option::is_none")]
    coverage: Option<crate::process::coverage::Coverage>,
    /// Limits of the charts in standard deviations.
    limits: crate::process::limits::Limits,
    /// Mean number of healthy batches to a false alarm for which the limits were computed.
    mean_run_batches: f64,
    /// The smallest lasting loss of each parameter that its chart finds with 90 % within some batches.
    detectable: Vec<crate::process::detectable::Detectable>,
}

impl From<&ReferenceProcess> for ProcessBody {
    fn from(reference: &ReferenceProcess) -> Self {
        let process = &reference.process;
        Self {
            batches: process.batches,
            period: process.period,
            step_s: process.step_s,
            covariates: process.covariates.clone(),
            factor_correlations: process.numbers().persistence.iter().take(process.factors).copied().collect(),
            coverage: process.coverage.clone(),
            limits: reference.limits,
            mean_run_batches: reference.mean_run_batches,
            detectable: reference.detectable.clone(),
        }
    }
}

impl Undamaged {
    /// The answer for an undamaged reference.
    pub fn new(structure: &crate::quantity::StructureId, record: &ReferenceRecord) -> Self {
        Self {
            structure: structure.to_string(),
            version: record.state.version,
            created_at: record.created_at,
            extends: record.state.origin.extends,
            reason: record.state.origin.reason.clone(),
            model_digest: record.model_digest.to_string(),
            threshold_probability: record.state.threshold_probability,
            measurement_count: record.state.measurements,
            effective_measurements: record.state.effective_measurements(),
            batches: record.batches.clone(),
            conditions: record.state.conditions.clone(),
            doubts: record.state.doubts.clone(),
            process: record.state.process.as_deref().map(ProcessBody::from),
            without_process: record.state.without_process.clone(),
            parameters: record.state.quantities.clone(),
            joint: record.state.joint.clone(),
        }
    }
}
