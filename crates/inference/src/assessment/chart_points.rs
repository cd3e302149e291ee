//! The points of a batch on the alarm charts, and their limits.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use super::result::Assessment;
use crate::alarm::chart::{self, fit_settings, process_settings, ChartPoint, FIT_SERIES};
use crate::alarm::limits::LimitCurve;
use crate::alarm::AlarmSettings;
use crate::baseline::Baseline;
use crate::damage::{ChartReference, UndamagedQuantity, UndamagedReference};
use crate::process::estimate::BatchEstimate;
use crate::process::reference::ReferenceProcess;
use crate::trust::{FindingCode, FindingEffect};
use structures::parameter::DamageDirection;

/// From this number of degrees of freedom on, the undamaged standard deviation is treated as known exactly.
const MANY_DEGREES: usize = 2_000;

/// The point of a batch on one chart, before the neighbouring points in time are known.
#[derive(Debug, Clone, PartialEq)]
pub struct NewChartPoint {
    /// Parameter or group of a damage chart, or [`FIT_SERIES`].
    pub series: String,
    /// Version of the undamaged reference that it is compared with; 0 for the fit.
    pub undamaged_version: u32,
    /// Shift and limits.
    pub point: ChartPoint,
    /// Probability of damage that corresponds to the limit of one shift.
    pub probability_limit: Option<f64>,
    /// Rules of the chart.
    pub settings: AlarmSettings,
    /// Whether its alarms are those of the structure. The charts of single quantities of a process raise none: that of all together does, for
    /// one event once.
    pub raises_alarms: bool,
}

/// A batch on the charts of the process behind an undamaged reference, whose evidence depends on the batches before it.
#[derive(Debug, Clone, PartialEq)]
pub struct NewProcessPoint {
    /// The process.
    pub reference: Arc<ReferenceProcess>,
    /// Version of its undamaged reference.
    pub undamaged_version: u32,
    /// The estimate of the batch.
    pub estimate: BatchEstimate,
    /// True if the batch does not move the charts.
    pub held: bool,
    /// Rules of the charts. A change that is certainly smaller than their `smallest_percent` raises no alarm.
    pub settings: AlarmSettings,
}

/// By what the points of a batch follow from one another, on charts on which it is and on those on which it is not.
#[derive(Debug, Clone, PartialEq)]
pub struct ChartRules {
    /// Rules of the charts of a reference without a process.
    pub settings: AlarmSettings,
    /// The process behind the undamaged reference that the batch was compared with.
    pub process: Option<Arc<ReferenceProcess>>,
}

/// What a batch adds to the charts.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct NewCharts {
    /// Points that do not depend on other batches.
    pub points: Vec<NewChartPoint>,
    /// The batch on the charts of the process; `None` without one, or if the batch is not compared with it.
    pub process: Option<NewProcessPoint>,
    /// For the charts on which the batch was before it was assessed again, and is not any more; `None`: it stays on them.
    pub rules: Option<ChartRules>,
}

/// Cache of simulated limits, by degrees of freedom, number of charts and wanted mean run in batches. A simulation keeps all cores busy for some hundredths of
/// a second, during which batches would wait.
#[derive(Default)]
pub struct KnownLimits {
    found: Mutex<HashMap<(usize, usize, u64), LimitCurve>>,
}

impl KnownLimits {
    /// Simulates the limits that batches compared with this reference will need, before one of them waits for it.
    pub fn prepare(&self, baseline: &Baseline, undamaged: &UndamagedReference, settings: &AlarmSettings) {
        let charted = charted(baseline, undamaged);
        for (quantity, _) in &charted {
            self.get(&quantity.reference, charted.len(), settings);
        }
    }

    fn get(&self, reference: &ChartReference, charts: usize, settings: &AlarmSettings) -> LimitCurve {
        let run = settings.run_batches(reference.batches_per_year);
        let key = (reference.degrees_of_freedom.clamp(1, MANY_DEGREES), charts, run.to_bits());
        let found = || self.found.lock().expect("no holder of this lock panics");
        let known = found().get(&key).copied();
        // The lock is not held during the simulation, so that others do not wait. Two threads that simulate the same key get the
        // same result.
        known.unwrap_or_else(|| {
            let simulated = LimitCurve::simulate(key.0, key.1, settings, run);
            *found().entry(key).or_insert(simulated)
        })
    }
}

/// The points of an assessed batch: one for the fit, and one for each charted quantity that could be compared.
pub fn chart_points(
    baseline: &Baseline,
    assessment: &Assessment,
    undamaged: Option<&UndamagedReference>,
    settings: &AlarmSettings,
    known: &KnownLimits,
) -> NewCharts {
    let mut points: Vec<NewChartPoint> = fit_point(assessment, settings).into_iter().collect();
    let process = undamaged.and_then(|undamaged| undamaged.process.as_ref()).map(Arc::clone);
    let rules = Some(ChartRules { settings: *settings, process });
    let Some(undamaged) = undamaged.filter(|_| assessment.trust.accepted()) else {
        return NewCharts { points, process: None, rules };
    };
    if let Some(reference) = &undamaged.process {
        let process = assessment.estimate.clone().map(|estimate| NewProcessPoint {
            reference: Arc::clone(reference),
            undamaged_version: undamaged.version,
            estimate,
            held: !assessment.trust.moves_charts(),
            settings: process_settings(settings),
        });
        return NewCharts { points, process, rules };
    }
    let charted = charted(baseline, undamaged);
    for (reference, direction) in &charted {
        let Some(quantity) = assessment.quantities.iter().find(|q| q.name == reference.name) else { continue };
        let n = quantity.effective_measurements.unwrap_or(assessment.measurements_used as f64);
        let of_samples =
            || (quantity.pooled.mean, chart::variance_of_mean(&reference.reference, quantity.pooled.within, n));
        // The estimate takes the measurements for independent.
        let of_estimate = |(mean, variance)| (mean, variance * assessment.measurements_used as f64 / n);
        let estimated = of_quantity(&charted_columns(baseline), assessment.estimate.as_ref(), &reference.name);
        let (mean, variance) = estimated.map_or_else(of_samples, of_estimate);
        let error = chart::standard_error(&reference.reference, variance, n);
        let Some(shift) = chart::shift(&reference.reference, *direction, mean, error) else { continue };
        let curve = known.get(&reference.reference, charted.len(), settings);
        let limits = curve.at(chart::shared(&reference.reference, error));
        points.push(NewChartPoint {
            series: reference.name.clone(),
            undamaged_version: undamaged.version,
            point: ChartPoint::damage(shift, &limits, !assessment.trust.moves_charts()),
            probability_limit: chart::probability_limit(reference, limits.single, error),
            settings: *settings,
            raises_alarms: true,
        });
    }
    NewCharts { points, process: None, rules }
}

/// Mean and variance of its error of a charted quantity in an estimate.
fn of_quantity(columns: &[(String, Vec<usize>)], estimate: Option<&BatchEstimate>, name: &str) -> Option<(f64, f64)> {
    let (estimate, d) = (estimate?, columns.len());
    let k = columns.iter().position(|(own, _)| own == name)?;
    Some(((*estimate.mean.get(k)?)?, *estimate.covariance.get(k * d + k)?))
}

/// The point on the chart of the fit; `None` for a batch that was rejected because of its data, such as a sensor that repeats an
/// old value: it does not show whether the simulation fits.
fn fit_point(assessment: &Assessment, settings: &AlarmSettings) -> Option<NewChartPoint> {
    let misfit = |code: FindingCode| {
        use FindingCode::{ModesShifted, ModesSwapped, SimulationDoesNotFit, UnitSuspected};
        matches!(code, SimulationDoesNotFit | UnitSuspected | ModesSwapped | ModesShifted)
    };
    let findings = &assessment.trust.findings;
    let rejected = findings.iter().any(|f| f.effect == FindingEffect::Reject && misfit(f.code));
    (rejected || assessment.trust.accepted()).then(|| NewChartPoint {
        series: FIT_SERIES.to_owned(),
        undamaged_version: 0,
        point: ChartPoint::fit(rejected),
        probability_limit: None,
        settings: fit_settings(settings),
        raises_alarms: true,
    })
}

/// Parameters and groups with a damage direction. A spring that follows a parameter is left out, because its chart would only
/// repeat that of the parameter.
fn charted<'a>(
    baseline: &Baseline,
    undamaged: &'a UndamagedReference,
) -> Vec<(&'a UndamagedQuantity, DamageDirection)> {
    let columns = charted_columns(baseline);
    let direction = |name: &str| {
        let (_, columns) = columns.iter().find(|(own, _)| own == name)?;
        Some(baseline.space().as_slice()[columns[0]].damage).filter(|d| *d != DamageDirection::None)
    };
    undamaged.quantities.iter().filter_map(|quantity| Some((quantity, direction(&quantity.name)?))).collect()
}

/// Parameters that the modes can distinguish, and groups of the others: name, and columns of the parameters behind it.
pub(super) fn charted_columns(baseline: &Baseline) -> Vec<(String, Vec<usize>)> {
    let groups = baseline.groups();
    let alone = |column: &usize| !groups.iter().any(|group| group.columns.contains(column));
    let parameters = baseline.space().iter().enumerate().filter(|(column, _)| alone(column));
    let parameters = parameters.map(|(column, parameter)| (parameter.name.clone(), vec![column]));
    parameters.chain(groups.iter().map(|group| (group.name.clone(), group.columns.clone()))).collect()
}
