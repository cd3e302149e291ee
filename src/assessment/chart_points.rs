//! The points of a batch on the alarm charts, and their limits.

use std::collections::HashMap;
use std::sync::Mutex;

use super::result::Assessment;
use crate::alarm::chart::{self, fit_settings, ChartPoint, FIT_SERIES};
use crate::alarm::limits::LimitCurve;
use crate::alarm::AlarmSettings;
use crate::baseline::Baseline;
use crate::damage::{UndamagedQuantity, UndamagedReference};
use crate::parameter::DamageDirection;
use crate::trust::{FindingCode, FindingEffect};

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
}

/// Cache of simulated limits, by degrees of freedom and number of charts. A simulation keeps all cores busy for some hundredths of
/// a second, during which batches would wait.
#[derive(Default)]
pub struct KnownLimits {
    found: Mutex<HashMap<(usize, usize), LimitCurve>>,
}

impl KnownLimits {
    /// Simulates the limits that batches compared with this reference will need, before one of them waits for it.
    pub fn prepare(&self, baseline: &Baseline, undamaged: &UndamagedReference, settings: &AlarmSettings) {
        let charted = charted(baseline, undamaged);
        for (quantity, _) in &charted {
            self.get(quantity.reference.degrees_of_freedom, charted.len(), settings);
        }
    }

    fn get(&self, degrees_of_freedom: usize, charts: usize, settings: &AlarmSettings) -> LimitCurve {
        let key = (degrees_of_freedom.clamp(1, MANY_DEGREES), charts);
        let found = || self.found.lock().expect("no holder of this lock panics");
        let known = found().get(&key).copied();
        // The lock is not held during the simulation, so that others do not wait. Two threads that simulate the same key get the
        // same result.
        known.unwrap_or_else(|| {
            let simulated = LimitCurve::simulate(key.0, key.1, settings);
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
) -> Vec<NewChartPoint> {
    let mut points: Vec<NewChartPoint> = fit_point(assessment, settings).into_iter().collect();
    let Some(undamaged) = undamaged.filter(|_| assessment.trust.accepted()) else { return points };
    let charted = charted(baseline, undamaged);
    for (reference, direction) in &charted {
        let Some(quantity) = assessment.quantities.iter().find(|q| q.name == reference.name) else { continue };
        let (mean, within, n) = (quantity.pooled.mean, quantity.pooled.within, assessment.measurements_used);
        let Some(shift) = chart::shift(&reference.reference, *direction, mean, within, n) else { continue };
        let curve = known.get(reference.reference.degrees_of_freedom, charted.len(), settings);
        let limits = curve.at(chart::shared(&reference.reference, within, n));
        points.push(NewChartPoint {
            series: reference.name.clone(),
            undamaged_version: undamaged.version,
            point: ChartPoint::damage(shift, &limits, !assessment.trust.moves_charts()),
            probability_limit: chart::probability_limit(reference, limits.single, within, n),
            settings: *settings,
        });
    }
    points
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
    })
}

/// Parameters and groups with a damage direction. A spring that follows a parameter is left out, because its chart would only
/// repeat that of the parameter.
fn charted<'a>(
    baseline: &Baseline,
    undamaged: &'a UndamagedReference,
) -> Vec<(&'a UndamagedQuantity, DamageDirection)> {
    let (space, groups) = (baseline.space(), baseline.groups());
    let direction = |name: &str| {
        let column = match groups.iter().find(|group| group.name == name) {
            Some(group) => group.columns[0],
            None => space.position(name).filter(|column| !groups.iter().any(|g| g.columns.contains(column)))?,
        };
        Some(space.as_slice()[column].damage).filter(|d| *d != DamageDirection::None)
    };
    undamaged.quantities.iter().filter_map(|quantity| Some((quantity, direction(&quantity.name)?))).collect()
}
