//! The points of a batch on the alarm charts.

use std::collections::HashMap;
use std::sync::Mutex;

use crate::alarm::chart::{self, fit_settings, ChartPoint};
use crate::alarm::limits::LimitCurve;
use crate::alarm::AlarmSettings;
use crate::assessment::Assessment;
use crate::baseline::Baseline;
use crate::damage::{UndamagedQuantity, UndamagedState};
use crate::parameter::DamageDirection;
use crate::store::{NewChartPoint, FIT_SERIES};
use crate::trust::{Code, Effect};

/// Degrees of freedom beyond which the undamaged standard deviation counts as known.
const MANY_DEGREES: usize = 2_000;

/// Limits found so far, by degrees of freedom and number of charts: simulating them keeps all cores busy for some hundredths of a
/// second, and batches would wait for them.
#[derive(Default)]
pub struct KnownLimits {
    found: Mutex<HashMap<(usize, usize), LimitCurve>>,
}

impl KnownLimits {
    /// Simulates what batches will need that are compared with this state, before one of them waits for it.
    pub fn prepare(&self, baseline: &Baseline, state: &UndamagedState, settings: &AlarmSettings) {
        let watched = watched(baseline, state);
        for (quantity, _) in &watched {
            self.get(quantity.reference.degrees_of_freedom, watched.len(), settings);
        }
    }

    fn get(&self, degrees_of_freedom: usize, charts: usize, settings: &AlarmSettings) -> LimitCurve {
        let key = (degrees_of_freedom.clamp(1, MANY_DEGREES), charts);
        let found = || self.found.lock().expect("no holder of this lock panics");
        let known = found().get(&key).copied();
        // Without the lock, which others would wait for: of two that simulate the same, the results are the same.
        known.unwrap_or_else(|| {
            let simulated = LimitCurve::simulate(key.0, key.1, settings);
            *found().entry(key).or_insert(simulated)
        })
    }
}

/// The points of an assessed batch: one for the fit, and one for each watched quantity that could be compared.
pub fn points(
    baseline: &Baseline,
    assessment: &Assessment,
    undamaged: Option<&UndamagedState>,
    settings: &AlarmSettings,
    known: &KnownLimits,
) -> Vec<NewChartPoint> {
    let misfit = |code: Code| {
        matches!(code, Code::SimulationDoesNotFit | Code::UnitSuspected | Code::ModesSwapped | Code::ModesShifted)
    };
    let findings = &assessment.trust.findings;
    let rejected = findings.iter().any(|f| f.effect == Effect::Reject && misfit(f.code));
    let mut points = Vec::new();
    // A hanging sensor says nothing of the simulation.
    if rejected || assessment.trust.accepted() {
        points.push(NewChartPoint {
            series: FIT_SERIES.to_owned(),
            undamaged_version: 0,
            point: ChartPoint::fit(rejected),
            probability_limit: None,
            settings: fit_settings(settings),
        });
    }
    let Some(state) = undamaged.filter(|_| assessment.trust.accepted()) else { return points };
    let watched = watched(baseline, state);
    for (reference, direction) in &watched {
        let Some(quantity) = assessment.quantities.iter().find(|q| q.name == reference.name) else { continue };
        let (mean, within, n) = (quantity.pooled.mean, quantity.pooled.within, assessment.measurements_used);
        let Some(shift) = chart::shift(&reference.reference, *direction, mean, within, n) else { continue };
        let curve = known.get(reference.reference.degrees_of_freedom, watched.len(), settings);
        let limits = curve.at(chart::shared(&reference.reference, within, n));
        points.push(NewChartPoint {
            series: reference.name.clone(),
            undamaged_version: state.version,
            point: ChartPoint::damage(shift, &limits, !assessment.trust.moves_charts()),
            probability_limit: chart::probability_limit(reference, limits.single, within, n),
            settings: *settings,
        });
    }
    points
}

/// Parameters and groups that have a damaged side; a spring that follows a parameter would only repeat it.
fn watched<'a>(baseline: &Baseline, state: &'a UndamagedState) -> Vec<(&'a UndamagedQuantity, DamageDirection)> {
    let (space, groups) = (baseline.space(), baseline.groups());
    let direction = |name: &str| {
        let column = match groups.iter().find(|group| group.name == name) {
            Some(group) => group.columns[0],
            None => space.position(name).filter(|column| !groups.iter().any(|g| g.columns.contains(column)))?,
        };
        Some(space.as_slice()[column].damage).filter(|d| *d != DamageDirection::None)
    };
    state.quantities.iter().filter_map(|quantity| Some((quantity, direction(&quantity.name)?))).collect()
}
