//! The measurement that would decide between the candidates of a diagnosis.
//!
//! For each measurement that is possible for the structure, the expected probability of the right candidate after it is computed
//! by simulation of the candidates: measurements are drawn from the prediction of each candidate, and the probabilities are
//! updated with the predictions of all of them.
//!
//! - [`experiment`]: a measurement; `condition`: the conditions in which it is made; `options`: those that are possible;
//! - `predict`: what a fit predicts for it; `simulated`: measurements drawn from that; `value`: the expected probability after it;
//!   `words`: its text.

mod condition;
pub mod experiment;
mod options;
mod predict;
mod simulated;
mod value;
mod words;

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::rank::Ranked;
use super::study::Study;
use experiment::{Experiment, Kind, NextMeasurement};
use predict::{Prediction, Predictor};
use simulated::Normals;
use structures::parameter::Parameter;
use value::{repeats_to_wanted, value, Member, Value, BLOCKS, FEWER_BLOCKS, MOST_REPEATS, SOME_BLOCKS, WANTED};

/// Rows in each condition with which measurements are compared.
const REPEATS: usize = 10;

/// Candidates below this probability, and more than so many, are not simulated.
const LEAST_PROBABILITY: f64 = 5e-3;
const MOST_CANDIDATES: usize = 16;

/// A law of a candidate below this probability is not simulated, unless it is its best one; the others take its probability.
const LEAST_OF_LAW: f64 = 2e-2;

/// Greatest number of measurements that are compared in full, beside the best of each kind and those that join two of them.
const SHORT_LIST: usize = 8;

/// Greatest number of measurements that are reported, and of those of one kind.
const MOST_REPORTED: usize = 20;
const MOST_OF_A_KIND: usize = 3;

/// Measurements that are compared in full to distinguish two candidates, the best by few simulations.
const LIKELY_BEST: usize = 3;

/// Smallest expected probability with which a measurement is recommended for distinguishing two candidates of equal probability.
const DISTINGUISHES: f64 = 0.6;

/// The possible measurements and what each of the candidates of one cause predicts for them.
pub(super) struct Outlook<'a> {
    study: &'a Study<'a>,
    ranked: Vec<&'a Ranked>,
    /// A candidate with one of its laws.
    members: Vec<LawOfCandidate<'a>>,
    options: Vec<Experiment>,
    /// Number of the options that are single measurements; those that join two of them follow.
    single: usize,
    /// `[options][members]`; `None` for a prediction that cannot be computed.
    predictions: Vec<Vec<Option<Prediction>>>,
    normals: Normals,
}

/// A candidate, given by its place, with one of its laws.
struct LawOfCandidate<'a> {
    candidate: usize,
    /// Probability of the law among those of the candidate.
    share: f64,
    predictor: Predictor<'a>,
}

/// A measurement with its value in [`REPEATS`] and in [`MOST_REPEATS`] rows, and the number of rows with which it suffices.
struct Valued {
    option: usize,
    usual: Value,
    most: Value,
    repeats_to_95: Option<usize>,
}

impl<'a> Outlook<'a> {
    /// The measurements that are possible for `ranked` candidates of one cause, the most probable first. `rows`: rows in which
    /// causes were searched.
    pub(super) fn new(study: &'a Study<'a>, rows: &[usize], ranked: Vec<&'a Ranked>, independent_share: f64) -> Self {
        let decisive: Vec<&Ranked> = ranked.iter().copied().take(MOST_CANDIDATES).collect();
        let options = options::options(study.simulator, study.data, rows, &decisive);
        let mut members = Vec::new();
        for (candidate, r) in ranked.iter().enumerate() {
            let laws =
                || std::iter::once((1.0, &r.fit)).chain(r.other_laws.iter().map(|(relative, fit)| (*relative, fit)));
            let total: f64 = laws().map(|(relative, _)| relative).sum();
            members.extend(laws().map(|(relative, fit)| LawOfCandidate {
                candidate,
                share: relative / total,
                predictor: Predictor::new(study, fit, independent_share),
            }));
        }
        let (predictions, normals) = (Vec::new(), Normals::new(0, 0, 0));
        let mut outlook =
            Self { study, ranked, members, options: Vec::new(), single: options.len(), predictions, normals };
        outlook.add(options);
        outlook
    }

    /// Adds measurements with the predictions for them.
    fn add(&mut self, options: Vec<Experiment>) {
        let of_member = |member: &LawOfCandidate<'_>| {
            let of_option = |e: &Experiment| member.predictor.predict(e, reference(self.study, e).as_ref());
            options.iter().map(of_option).collect::<Vec<_>>()
        };
        let by_member: Vec<Vec<Option<Prediction>>> = self.members.par_iter().map(of_member).collect();
        let first = self.options.len();
        self.predictions.extend(options.iter().map(|_| Vec::new()));
        self.options.extend(options);
        for own in by_member {
            for (option, prediction) in own.into_iter().enumerate() {
                self.predictions[first + option].push(prediction);
            }
        }
        let widths = self.predictions.iter().flatten().flatten().map(|p| p.mean.len());
        self.normals = Normals::new(self.members.len(), BLOCKS, widths.max().unwrap_or(0));
    }

    /// The value of an option for some candidates, given as places and probabilities that sum to 1; `None` if it cannot be
    /// computed for one of them.
    fn value(&self, option: usize, candidates: &[(usize, f64)], repeats: usize, blocks: usize) -> Option<Value> {
        let mut members: Vec<Member<'_>> = Vec::new();
        for (candidate, probability) in candidates {
            let first = members.len();
            let own = self.predictions[option].iter().zip(&self.members).filter(|(_, m)| m.candidate == *candidate);
            for (prediction, member) in own {
                // The first law of a candidate is its best one.
                if members.len() == first || probability * member.share >= LEAST_OF_LAW {
                    let (candidate, probability) = (*candidate, member.share);
                    members.push(Member { candidate, probability, prediction: prediction.as_ref()? });
                }
            }
            let kept: f64 = members[first..].iter().map(|member| member.probability).sum();
            for member in &mut members[first..] {
                member.probability *= probability / kept;
            }
        }
        value(&members, repeats, blocks, &self.normals)
    }

    /// The measurements, the best first: those that reach [`WANTED`] with [`REPEATS`] rows or fewer in each condition, then by the
    /// number of rows that they need, then by the expected probability of the right candidate after [`MOST_REPEATS`] rows; of equal
    /// ones that with the least effort. Empty if fewer than two candidates are probable.
    pub(super) fn next_measurements(&mut self) -> Vec<NextMeasurement> {
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
        let by_value = self.by_value(&candidates);
        let best: Vec<&Experiment> = by_value.iter().map(|option| &self.options[*option]).collect();
        let joined = options::joined(&best);
        let first = self.options.len();
        self.add(joined);
        let short_list = self.at_most(1, &by_value);
        let short_list = by_value.iter().enumerate().filter(|(place, o)| *place < SHORT_LIST || short_list.contains(o));
        let all: Vec<usize> = short_list.map(|(_, option)| *option).chain(first..self.options.len()).collect();
        let mut valued: Vec<Valued> = all.par_iter().filter_map(|option| self.valued(*option, &candidates)).collect();
        let hundredths = |value: &Value| (100.0 * value.probability).round() as i64;
        valued.sort_by_key(|v| {
            let rows = v.repeats_to_95.map_or(usize::MAX, |repeats| repeats.max(REPEATS));
            let not_reached = if v.repeats_to_95.is_none() { -hundredths(&v.most) } else { 0 };
            (rows, not_reached, self.options[v.option].effort(), -hundredths(&v.usual))
        });
        let order: Vec<usize> = valued.iter().map(|v| v.option).collect();
        let reported = self.at_most(MOST_OF_A_KIND, &order);
        valued.retain(|v| reported.contains(&v.option));
        valued.truncate(MOST_REPORTED);
        let now: f64 = candidates.iter().map(|c| c.1 * c.1).sum();
        valued.iter().map(|v| self.reported(v, now, &candidates)).collect()
    }

    /// The first `most` of each kind among some options: of the same act, instrument, and with or without mode shapes.
    fn at_most(&self, most: usize, options: &[usize]) -> Vec<usize> {
        let kind = |option: usize| {
            let e = &self.options[option];
            (e.kind, e.second_instrument, e.points.is_empty())
        };
        let mut chosen: Vec<usize> = Vec::new();
        for option in options {
            if chosen.iter().filter(|known| kind(**known) == kind(*option)).count() < most {
                chosen.push(*option);
            }
        }
        chosen
    }

    /// The options by the expected probability of the right candidate after [`REPEATS`] rows, the best first.
    fn by_value(&self, candidates: &[(usize, f64)]) -> Vec<usize> {
        let valued = |option: usize| Some((option, self.value(option, candidates, REPEATS, FEWER_BLOCKS)?));
        let mut values: Vec<(usize, Value)> = (0..self.options.len()).into_par_iter().filter_map(valued).collect();
        values.sort_by(|a, b| b.1.probability.total_cmp(&a.1.probability));
        values.into_iter().map(|(option, _)| option).collect()
    }

    fn valued(&self, option: usize, candidates: &[(usize, f64)]) -> Option<Valued> {
        let computed = |repeats: usize| self.value(option, candidates, repeats, SOME_BLOCKS);
        let usual = self.value(option, candidates, REPEATS, BLOCKS)?;
        let most = computed(MOST_REPEATS)?;
        let with = |repeats: usize| match repeats {
            REPEATS => Some(usual),
            MOST_REPEATS => Some(most),
            _ => computed(repeats),
        };
        let between = if usual.probability >= WANTED { (0, REPEATS) } else { (REPEATS, MOST_REPEATS) };
        Some(Valued { option, usual, most, repeats_to_95: repeats_to_wanted(with, between) })
    }

    /// A measurement as it is reported.
    fn reported(&self, valued: &Valued, now: f64, candidates: &[(usize, f64)]) -> NextMeasurement {
        let (simulator, data) = (self.study.simulator, self.study.data);
        let experiment = &self.options[valued.option];
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
            probability_after: valued.usual.probability,
            standard_error: valued.usual.standard_error,
            repeats_to_95: valued.repeats_to_95,
            sentence: String::new(),
        };
        measurement.sentence = words::sentence(&what, &measurement, valued.most.probability);
        measurement
    }

    /// The single measurement, in words, that best distinguishes two candidates, given as places, if both are equally probable.
    pub(super) fn distinguishing(&self, a: usize, b: usize) -> String {
        let candidates = [(a, 0.5), (b, 0.5)];
        let valued = |option: usize, blocks: usize| {
            Some((option, self.value(option, &candidates, REPEATS, blocks)?.probability))
        };
        let key = |(option, probability): &(usize, f64)| {
            ((100.0 * probability).round() as i64, std::cmp::Reverse(self.options[*option].effort()))
        };
        let mut roughly: Vec<(usize, f64)> =
            (0..self.single).filter_map(|option| valued(option, FEWER_BLOCKS)).collect();
        roughly.sort_by_key(|v| std::cmp::Reverse(key(v)));
        let best = roughly.iter().take(LIKELY_BEST).filter_map(|(option, _)| valued(*option, BLOCKS)).max_by_key(key);
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
    let middle: Vec<f64> = study.simulator.space().iter().map(Parameter::prior_median).collect();
    study.simulator.shapes_under(&middle, experiment.modes, (&[], &[]), &experiment.points).ok()?
}
