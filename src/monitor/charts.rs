//! The points of a batch on the alarm charts.

use std::collections::HashMap;
use std::sync::Mutex;

use crate::alarm::chart::{self, fit_settings, ChartPoint};
use crate::alarm::limits::{limits, Limits, Situation};
use crate::alarm::AlarmSettings;
use crate::assessment::Assessment;
use crate::baseline::Baseline;
use crate::damage::{QuantityAssessment, QuantityKind, UndamagedQuantity, UndamagedState};
use crate::parameter::DamageDirection;
use crate::store::{NewChartPoint, FIT_SERIES};
use crate::trust::{Code, Effect};

/// Steps of the shared part of the variance between which the limits hardly move.
const STEPS: f64 = 40.0;

/// Limits found so far: simulating them takes a tenth of a second.
#[derive(Default)]
pub struct KnownLimits {
    found: Mutex<HashMap<(u32, usize, usize), Limits>>,
}

impl KnownLimits {
    fn get(&self, situation: Situation, settings: &AlarmSettings) -> Limits {
        let rounded = (situation.shared * STEPS).round();
        let key = (rounded as u32, situation.degrees_of_freedom.min(2_000), situation.charts);
        let known = || self.found.lock().expect("no holder of this lock panics").get(&key).copied();
        if let Some(known) = known() {
            return known;
        }
        let found = limits(Situation { shared: rounded / STEPS, ..situation }, settings);
        self.found.lock().expect("no holder of this lock panics").insert(key, found);
        found
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
    let watched = watched(baseline, assessment, state);
    for (quantity, reference, direction) in &watched {
        let (mean, within, n) = (quantity.pooled.mean, quantity.pooled.within, assessment.measurements_used);
        let Some(shift) = chart::shift(&reference.reference, *direction, mean, within, n) else { continue };
        let limits = known.get(situation(reference, within, n, watched.len()), settings);
        points.push(NewChartPoint {
            series: quantity.name.clone(),
            undamaged_version: state.version,
            point: ChartPoint::damage(shift, &limits, !assessment.trust.moves_charts()),
            probability_limit: chart::probability_limit(reference, limits.single, within, n),
            settings: *settings,
        });
    }
    points
}

/// Parameters and groups that have a damaged side; a spring that follows a parameter would only repeat it.
fn watched<'a>(
    baseline: &Baseline,
    assessment: &'a Assessment,
    state: &'a UndamagedState,
) -> Vec<(&'a QuantityAssessment, &'a UndamagedQuantity, DamageDirection)> {
    let direction = |q: &QuantityAssessment| -> Option<DamageDirection> {
        let column = match q.kind {
            QuantityKind::Parameter if q.group.is_none() => baseline.space().position(&q.name)?,
            QuantityKind::Group => baseline.groups().iter().find(|g| g.name == q.name)?.columns[0],
            _ => return None,
        };
        Some(baseline.space().as_slice()[column].damage).filter(|d| *d != DamageDirection::None)
    };
    let reference = |q: &QuantityAssessment| state.quantities.iter().find(|u| u.name == q.name);
    assessment.quantities.iter().filter_map(|q| Some((q, reference(q)?, direction(q)?))).collect()
}

fn situation(quantity: &UndamagedQuantity, within: f64, measurements: usize, charts: usize) -> Situation {
    let reference = &quantity.reference;
    let error = chart::standard_error(reference, within, measurements);
    let between = reference.between_batches_std.powi(2);
    let undamaged = reference.std.powi(2) / reference.measurements as f64 + between / reference.batches.max(1) as f64;
    Situation {
        shared: (undamaged / error.powi(2)).clamp(0.0, 1.0),
        degrees_of_freedom: reference.degrees_of_freedom.max(1),
        charts,
    }
}
