//! The measurement that would decide between the candidates of a diagnosis.
//!
//! For each measurement that is possible for the structure, the expected probability of the right candidate after it is computed
//! by simulation of the candidates: measurements are drawn from the prediction of each candidate, and the probabilities are
//! updated with the predictions of all of them.
//!
//! - [`experiment`]: a measurement; `condition`: the conditions in which it is made; `options`: those that are possible;
//! - `predict`: what a fit predicts for it; `value`: the expected probability after it; `words`: its text.

mod condition;
pub mod experiment;
mod options;
mod predict;
mod value;
mod words;

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::rank::Ranked;
use super::study::Study;
use experiment::{Experiment, Kind, NextMeasurement};
use predict::{Prediction, Predictor};
use value::{repeats_to_wanted, value, Normals, Value};

/// Rows in each condition with which measurements are compared.
const REPEATS: usize = 10;

/// Candidates below this probability, and more than so many, are not simulated.
const LEAST_PROBABILITY: f64 = 2e-3;
const MOST_CANDIDATES: usize = 12;

/// Greatest number of measurements that are reported.
const MOST_REPORTED: usize = 20;

/// Smallest expected probability with which a measurement is recommended for distinguishing two candidates of equal probability.
const DISTINGUISHES: f64 = 0.6;

/// The possible measurements and what each of the candidates of one cause predicts for them.
pub(super) struct Outlook<'a> {
    study: &'a Study<'a>,
    ranked: Vec<&'a Ranked>,
    options: Vec<Experiment>,
    /// `[options][candidates]`; `None` for a prediction that cannot be computed.
    predictions: Vec<Vec<Option<Prediction>>>,
    normals: Normals,
}

impl<'a> Outlook<'a> {
    /// The measurements that are possible for `ranked` candidates of one cause, the most probable first. `rows`: rows in which
    /// causes were searched.
    pub(super) fn new(study: &'a Study<'a>, rows: &[usize], ranked: Vec<&'a Ranked>, independent_share: f64) -> Self {
        let decisive: Vec<&Ranked> = ranked.iter().copied().take(MOST_CANDIDATES).collect();
        let options = options::options(study.simulator, study.data, rows, &decisive);
        let of_candidate = |r: &&Ranked| {
            let predictor = Predictor::new(study, &r.fit, independent_share);
            let of_option = |e: &Experiment| predictor.predict(e, reference(study, e).as_ref());
            options.iter().map(of_option).collect::<Vec<_>>()
        };
        let by_candidate: Vec<Vec<Option<Prediction>>> = ranked.par_iter().map(of_candidate).collect();
        let mut predictions: Vec<Vec<Option<Prediction>>> = options.iter().map(|_| Vec::new()).collect();
        for own in by_candidate {
            for (option, prediction) in own.into_iter().enumerate() {
                predictions[option].push(prediction);
            }
        }
        let widths = predictions.iter().flatten().flatten().map(|p| p.mean.len());
        let normals = Normals::new(MOST_CANDIDATES.min(ranked.len()).max(2), widths.max().unwrap_or(0));
        Self { study, ranked, options, predictions, normals }
    }

    /// The value of an option for some candidates, given as places and probabilities that sum to 1; `None` if it cannot be
    /// computed for one of them.
    fn value(&self, option: usize, candidates: &[(usize, f64)], repeats: usize) -> Option<Value> {
        let own = |(place, _): &(usize, f64)| self.predictions[option][*place].as_ref();
        let predictions = candidates.iter().map(own).collect::<Option<Vec<_>>>()?;
        let probabilities: Vec<f64> = candidates.iter().map(|c| c.1).collect();
        value(&predictions, &probabilities, repeats, &self.normals)
    }

    /// The measurements, the one with the largest expected probability of the right candidate first; of those that agree within
    /// 0.01 one without a second instrument, then the one that needs fewest rows. Empty if fewer than two candidates are probable.
    pub(super) fn next_measurements(&self) -> Vec<NextMeasurement> {
        let probable = self.ranked.iter().enumerate().take(MOST_CANDIDATES);
        let mut candidates: Vec<(usize, f64)> =
            probable.filter(|(_, r)| r.probability >= LEAST_PROBABILITY).map(|(i, r)| (i, r.probability)).collect();
        let total: f64 = candidates.iter().map(|c| c.1).sum();
        for candidate in &mut candidates {
            candidate.1 /= total;
        }
        if candidates.len() < 2 {
            return Vec::new();
        }
        let valued = |option: usize| Some((option, self.value(option, &candidates, REPEATS)?));
        let mut values: Vec<(usize, Value)> = (0..self.options.len()).into_par_iter().filter_map(valued).collect();
        values.sort_by(|a, b| b.1.probability.total_cmp(&a.1.probability));
        values.truncate(MOST_REPORTED);
        let now: f64 = candidates.iter().map(|c| c.1 * c.1).sum();
        let reported = |(option, value): &(usize, Value)| self.reported(*option, *value, now, &candidates);
        let mut all: Vec<NextMeasurement> = values.par_iter().map(reported).collect();
        let hundredths = |m: &NextMeasurement| (100.0 * m.probability_after).round() as i64;
        all.sort_by_key(|m| (-hundredths(m), m.second_instrument, m.repeats_to_95.unwrap_or(usize::MAX)));
        all
    }

    /// A measurement as it is reported.
    fn reported(&self, option: usize, value: Value, now: f64, candidates: &[(usize, f64)]) -> NextMeasurement {
        let (simulator, data) = (self.study.simulator, self.study.data);
        let experiment = &self.options[option];
        let ranked: Vec<&Ranked> = candidates.iter().map(|(place, _)| self.ranked[*place]).collect();
        let conditions = words::conditions(simulator, data, &ranked, experiment);
        let what = words::phrase(simulator, experiment, &conditions);
        let once = experiment.modes == 0;
        let mut measurement = NextMeasurement {
            kind: experiment.kind,
            place: experiment.place.clone(),
            kg: experiment.hung.map(|(_, kg)| kg),
            second_instrument: experiment.second_instrument,
            mode: (experiment.kind == Kind::FurtherMode).then_some(experiment.modes),
            points: words::point_names(simulator, experiment),
            conditions,
            repeats: if once { 1 } else { REPEATS },
            probability_now: now,
            probability_after: value.probability,
            standard_error: value.standard_error,
            repeats_to_95: repeats_to_wanted(|repeats| self.value(option, candidates, repeats)),
            sentence: String::new(),
        };
        measurement.sentence = words::sentence(&what, &measurement);
        measurement
    }

    /// The measurement, in words, that best distinguishes two candidates, given as places, if both are equally probable.
    pub(super) fn distinguishing(&self, a: usize, b: usize) -> String {
        let candidates = [(a, 0.5), (b, 0.5)];
        let valued = |option: usize| Some((option, self.value(option, &candidates, REPEATS)?.probability));
        let best = (0..self.options.len()).filter_map(valued).max_by(|x, y| x.1.total_cmp(&y.1));
        let Some((option, _)) = best.filter(|(_, probability)| *probability >= DISTINGUISHES) else {
            return "none of the measurements that were considered".to_owned();
        };
        let (simulator, experiment) = (self.study.simulator, &self.options[option]);
        let ranked = [self.ranked[a], self.ranked[b]];
        words::phrase(simulator, experiment, &words::conditions(simulator, self.study.data, &ranked, experiment))
    }
}

/// Shapes at the nominal stiffnesses, which decide the sign of those of the candidates; `None` if no shapes are measured.
fn reference(study: &Study<'_>, experiment: &Experiment) -> Option<DMatrix<f64>> {
    if experiment.points.is_empty() {
        return None;
    }
    let middle: Vec<f64> = study.simulator.space().iter().map(|p| f64::midpoint(p.lower, p.upper)).collect();
    study.simulator.shapes_under(&middle, experiment.modes, (&[], &[]), &experiment.points).ok()?
}
