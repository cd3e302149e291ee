//! Ranking all candidates for one further cause by their evidence.

use std::collections::BTreeSet;

use nalgebra::DVector;
use rayon::prelude::*;

use super::effect::FittedEffect;
use super::everywhere::{self, supported_nats};
use super::fit::{Fit, Start};
use super::grammar::Candidate;
use super::mixture::log_sum;
use super::onset::at_its_onset;
use super::screen::{promises, Promise, Whitened};
use super::setting_starts::{Guess, PresentSettings};
use super::study::{part_of, Study};
use super::weighing::log_density;
use structures::physics::effect::Target;
use structures::simulator::law::LawKind;

/// Candidates that are fitted in each search: those with the largest estimated gain, and the best of each kind of target.
const FITTED: usize = 16;
const OF_EACH_KIND: usize = 1;

/// Candidates for which every law is fitted.
const REFINED: usize = 5;

/// Evidence that a covariate must add to a constant effect on the same target, nats.
const COVARIATE_NATS: f64 = 3.0;

/// Constant effects that are fitted if an arbitrary constant is significant: all in structures of up to about ten bodies. They are not
/// chosen by the score test alone, because it is a linear estimate at size 0, and constant effects are often large: parameters
/// have adapted to them, and the estimate of the true one can lie far below that of others.
const CONSTANTS: usize = 80;

/// If an arbitrary constant for each output has an estimated gain below this, no constant effect can be accepted, nats.
const CONSTANT_NATS: f64 = 6.0;

/// Sizes from which the fit of a constant effect to a part of the rows starts, as multiples of its typical size, besides the estimate of the score test:
/// those of a deviation in no single part, and of others. And about how many rows these are. The fit to all rows starts at the best of them.
const DEVIATION_STARTS: [f64; 4] = [0.3, -0.3, 1.0, 2.0];
const CONSTANT_STARTS: [f64; 2] = [1.0, -1.0];
const PART: usize = 50;

/// Constant effects beside which a dependence of the same target on covariates is searched, the best ones, and dependences that are fitted for each.
const VARIED: usize = 4;
const VARIED_BY: usize = 2;

/// Greatest number of hosts, which are attachment points, at which an oscillator is tried.
const MOST_HOSTS: usize = 12;

/// Laws of a candidate whose log evidence lies within this of the best one are kept with their fits, nats.
const NEARLY_AS_GOOD_NATS: f64 = 3.0;

/// A candidate with its best law.
#[derive(Debug, Clone)]
pub struct Ranked {
    /// The candidate.
    pub candidate: Candidate,
    /// Fit with the best law of the candidate as its last effect.
    pub fit: Fit,
    /// ln of the posterior odds against no further cause, nats.
    pub log_odds: f64,
    /// Posterior probability among all candidates and no further cause.
    pub probability: f64,
    /// Each law tried, and its log evidence minus that of the present fit, nats.
    pub laws: Vec<(LawKind, f64)>,
    /// Fits with its other laws that are nearly as probable, each with the probability of its law relative to the best one.
    pub other_laws: Vec<(f64, Fit)>,
}

/// One law of one candidate, fitted.
struct Trial {
    /// Index of the candidate.
    candidate: usize,
    law: LawKind,
    fit: Fit,
    /// Penalty for numbers that are chosen but not fitted, such as the time of a step, nats.
    cost_nats: f64,
}

impl Trial {
    /// Log evidence with the cost of settings outside their priors and of numbers that are not fitted, nats.
    fn merit(&self) -> f64 {
        self.fit.log_evidence - self.fit.outside.nats - self.cost_nats
    }

    /// Fits the effect of a score test, starting from its first guess; `None` if the fit fails or its log evidence cannot come near
    /// `floor`, nats.
    fn new(
        study: &Study<'_>,
        rows: &[usize],
        (fit, floor): (&Fit, f64),
        candidate: &Candidate,
        promise: &Promise,
    ) -> Option<Self> {
        let effect =
            candidate.effect(study.simulator, study.data, rows, promise.law, promise.with_level, promise.step_days);
        let constant = promise.law == LawKind::Constant;
        let of_part = (constant && effect.numbers.len() == 1).then(|| {
            let effects: Vec<FittedEffect> = fit.effects.iter().cloned().chain([effect.clone()]).collect();
            of_part(study, rows, (fit, &effects), candidate, promise.psi.first().copied())
        });
        let of_part = of_part.flatten();
        let start = match &of_part {
            Some(of_part) => Start::at(of_part),
            None if constant => Start::with_constant(fit, Some(promise.psi.clone())),
            None => Start::with(fit, Some(promise.psi.clone())),
        };
        Self::from_start(study, rows, (fit, floor), (promise.candidate, promise.law), effect, &start)
    }

    /// Fits an effect in addition to those of `fit`, from a start; `None` as in [`Self::new`].
    fn from_start(
        study: &Study<'_>,
        rows: &[usize],
        (fit, floor): (&Fit, f64),
        (candidate, law): (usize, LawKind),
        effect: FittedEffect,
        start: &Start<'_>,
    ) -> Option<Self> {
        let effects: Vec<FittedEffect> = fit.effects.iter().cloned().chain([effect]).collect();
        let found = study.fit_above(floor, rows, &effects, Some(start))?;
        let (fit, cost_nats) = at_its_onset(study, rows, found);
        Some(Self { candidate, law, fit, cost_nats })
    }
}

/// Ranks all candidates for one cause in addition to the effects of `fit`, and estimates the share of independent rows under the
/// best candidate. `rows`: indices of the rows that are used.
///
/// ```text
///  ln odds = ln Σ_laws exp( r·(ln E_law − ln E_fit) + w_law − w_fit − cost ) − ln(number of laws) + ln prior
///  r = (1 − ρ)/(1 + ρ)
/// ```
///
/// E: evidence by Laplace's method; w: log density of the bodies that were weighed, 0 without any; r: share of independent rows; ρ: correlation of successive residuals. Only the candidates
/// with the largest estimated gain in a score test are fitted. The first `known` effects of the fit belong to the structure:
/// their numbers may be wrong, so that a further effect of the same kind is allowed for them. `None` if the frequencies cannot
/// be computed.
///
/// Source: Kass and Raftery (1995), JASA 90.
pub fn rank(
    study: &Study<'_>,
    rows: &[usize],
    fit: &Fit,
    candidates: &[Candidate],
    known: usize,
) -> Option<(Vec<Ranked>, f64)> {
    let views = study.view(rows, fit)?;
    let whitened = Whitened::new(study, rows, fit, &views)?;
    let taken = |c: &Candidate| {
        fit.effects[known..].iter().any(|e| e.target == c.target && e.law.covariate == c.covariate && c.level.is_none())
    };
    let mut promised = promises(study, rows, &whitened, fit, candidates)?;
    promised.retain(|p| !taken(&candidates[p.candidate]));
    let merit = |p: &Promise| p.less_its_numbers(rows.len()) + candidates[p.candidate].weight.ln();
    promised.sort_by(|a, b| merit(b).total_cmp(&merit(a)));

    let fitted =
        |floor: f64, promise: &Promise| Trial::new(study, rows, (fit, floor), &candidates[promise.candidate], promise);
    let first = most_promising(&promised, candidates);
    let mut tried: Vec<Trial> = first.par_iter().filter_map(|promise| fitted(f64::NEG_INFINITY, promise)).collect();
    // No constant effect can gain more than an arbitrary constant for each output.
    let ones = DVector::from_element(rows.len(), 1.0);
    let constant = whitened.free_score(&whitened.output_sums(study.outputs()), &ones);
    if constant.nats > CONSTANT_NATS {
        let left = promised.iter().filter(|p| candidates[p.candidate].covariate.is_none());
        let left = left.filter(|p| !tried.iter().any(|t| t.candidate == p.candidate)).take(CONSTANTS);
        let (left, floor) = (left.collect::<Vec<_>>(), best_evidence(&tried));
        tried.extend(left.par_iter().filter_map(|promise| fitted(floor, promise)).collect::<Vec<_>>());
        let floor = best_evidence(&tried);
        tried.extend(unscreened(study, rows, (fit, floor), candidates));
        tried.extend(everywhere(study, rows, fit, candidates));
        let varying = varying(study, rows, (fit, floor), candidates, &tried);
        tried.extend(varying);
    }
    tried.extend(corrections(study, rows, fit, candidates));
    let evidence = |t: &Trial| t.merit() + candidates[t.candidate].weight.ln() + log_density(study.data, &t.fit, 1.0);
    let mut order: Vec<(usize, f64)> = tried.iter().map(|t| (t.candidate, evidence(t))).collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1));
    let refined: Vec<usize> = order.iter().take(REFINED).map(|o| o.0).collect();
    let further: Vec<&Promise> = promised
        .iter()
        .filter(|p| refined.contains(&p.candidate))
        .filter(|p| !tried.iter().any(|t| t.candidate == p.candidate && t.law == p.law))
        .collect();
    let floor = best_evidence(&tried);
    tried.extend(further.par_iter().filter_map(|promise| fitted(floor, promise)).collect::<Vec<_>>());

    let best = tried.iter().max_by(|a, b| a.merit().total_cmp(&b.merit()));
    let share = best.map_or(Some(1.0), |t| independent_share(study, rows, &t.fit))?;
    Some((by_probability(study, fit, candidates, &tried, share), share))
}

/// Largest log evidence of the fits, nats; −∞ for none.
fn best_evidence(tried: &[Trial]) -> f64 {
    tried.iter().map(|t| t.fit.log_evidence).fold(f64::NEG_INFINITY, f64::max)
}

/// The score tests whose effects are fitted, only the best of each candidate: the first [`FITTED`], and further ones for kinds of
/// target that are not among them.
fn most_promising<'a>(promised: &'a [Promise], candidates: &[Candidate]) -> Vec<&'a Promise> {
    let mut chosen: Vec<&Promise> = Vec::new();
    let mut kinds: Vec<(std::mem::Discriminant<Target>, usize)> = Vec::new();
    for promise in promised {
        if chosen.iter().any(|p| p.candidate == promise.candidate) {
            continue;
        }
        let kind = std::mem::discriminant(&candidates[promise.candidate].target);
        let seen = kinds.iter().position(|(k, _)| *k == kind).unwrap_or_else(|| {
            kinds.push((kind, 0));
            kinds.len() - 1
        });
        if chosen.len() < FITTED || kinds[seen].1 < OF_EACH_KIND {
            kinds[seen].1 += 1;
            chosen.push(promise);
        }
    }
    chosen
}

/// The candidates that were tried, the most probable first.
fn by_probability(
    study: &Study<'_>,
    fit: &Fit,
    candidates: &[Candidate],
    tried: &[Trial],
    independent_share: f64,
) -> Vec<Ranked> {
    let mut ranked: Vec<Ranked> = Vec::new();
    let credit = everywhere::credit_nats(study, tried.iter().map(|t| &t.fit));
    for (index, candidate) in candidates.iter().enumerate() {
        let mut own: Vec<&Trial> = tried.iter().filter(|t| t.candidate == index).collect();
        own.sort_by(|a, b| b.merit().total_cmp(&a.merit()));
        let Some(first) = own.first() else { continue };
        let weighed = log_density(study.data, fit, independent_share);
        let gain = |t: &&Trial| {
            let weighed = log_density(study.data, &t.fit, independent_share) - weighed;
            let inside = fit.outside.nats - t.fit.outside.nats;
            let last = t.fit.effects.len() - 1;
            let credit = if t.fit.effects[last].mixture.is_some() { credit } else { 0.0 };
            let evidence = (t.fit.log_evidence - fit.log_evidence + credit).min(supported_nats(&t.fit, last, fit));
            independent_share * evidence + inside - t.cost_nats + weighed
        };
        let laws = candidate.laws(study.data).len() as f64;
        let log_odds = log_sum(own.iter().map(gain)) - laws.ln() + candidate.weight.ln();
        let laws = own.iter().map(|t| (t.law, gain(t))).collect();
        let relative = |t: &&Trial| (gain(t) - gain(first)).exp();
        let near = own[1..].iter().filter(|t| relative(t) > (-NEARLY_AS_GOOD_NATS).exp());
        let other_laws = near.map(|t| (relative(t), t.fit.clone())).collect();
        let (candidate, fit) = (candidate.clone(), first.fit.clone());
        ranked.push(Ranked { candidate, fit, log_odds, probability: 0.0, laws, other_laws });
    }
    drop_equivalents(&mut ranked);
    ranked.sort_by(|a, b| b.log_odds.total_cmp(&a.log_odds));
    // No further cause has odds of 1.
    let total = log_sum(ranked.iter().map(|r| r.log_odds).chain([0.0]));
    for r in &mut ranked {
        r.probability = (r.log_odds - total).exp();
    }
    ranked
}

/// Removes candidates that a simpler candidate explains as well: a law with a level also explains a constant, so its covariate must
/// add evidence to the constant effect on the same target.
fn drop_equivalents(ranked: &mut Vec<Ranked>) {
    let best = |r: &Ranked| r.laws.iter().map(|l| l.1).fold(f64::NEG_INFINITY, f64::max);
    let constants: Vec<(Target, f64)> = ranked
        .iter()
        .filter(|r| r.candidate.covariate.is_none())
        .map(|r| (r.candidate.target.clone(), best(r)))
        .collect();
    ranked.retain(|r| {
        let constant = constants.iter().find(|c| c.0 == r.candidate.target).map(|c| c.1);
        r.candidate.covariate.is_none() || constant.is_none_or(|constant| best(r) > constant + COVARIATE_NATS)
    });
}

/// Fits a deviation of the whole simulation, unless the fit has one.
fn everywhere(study: &Study<'_>, rows: &[usize], fit: &Fit, candidates: &[Candidate]) -> Option<Trial> {
    let candidate = candidates.iter().position(|c| matches!(c.target, Target::Everywhere(_)))?;
    if fit.effects.iter().any(|e| e.mixture.is_some()) {
        return None;
    }
    let effect = everywhere::effect(study, rows, fit)?;
    let effects: Vec<FittedEffect> = fit.effects.iter().cloned().chain([effect]).collect();
    let fit = study.fit(rows, &effects, Some(&Start::with(fit, None)))?;
    Some(Trial { candidate, law: LawKind::Constant, fit, cost_nats: 0.0 })
}

/// Fits the candidates without a score test: oscillators, from several tuning frequencies, and orders of modes, because the frequencies have
/// no derivative at size 0; and constant deviations in no single part, from several sizes, because parameters have adapted to them, so that the derivative
/// may have the wrong sign.
fn unscreened(study: &Study<'_>, rows: &[usize], (fit, floor): (&Fit, f64), candidates: &[Candidate]) -> Vec<Trial> {
    let f = study.simulator.nominal_frequencies_hz();
    let mut tunings = vec![0.6 * f[0], 0.9 * f[0]];
    tunings.extend(f.windows(2).flat_map(|w| [0.7 * w[0] + 0.3 * w[1], 0.3 * w[0] + 0.7 * w[1]]));
    tunings.extend([1.1 * f[f.len() - 1], 1.5 * f[f.len() - 1]]);
    let ordered = fit.effects.iter().any(|e| matches!(e.target, Target::ModeOrder(_)));
    // Fits for hundreds of attachment points would take hours: only every n-th point is tried and represents its neighbours.
    let hosts = study.simulator.structure().map_or(0, |s| s.attachment_points().len());
    let every = hosts.div_ceil(MOST_HOSTS);
    let mut jobs: Vec<(usize, Option<Vec<f64>>)> = Vec::new();
    let mut oscillators = 0..;
    for (index, candidate) in candidates.iter().enumerate() {
        let same = |e: &FittedEffect| e.target == candidate.target && e.law.covariate == candidate.covariate;
        let present = fit.effects.iter().any(same);
        match &candidate.target {
            Target::Oscillator(_) if !present && oscillators.next().is_some_and(|place| place % every == 0) => {
                let kg = 0.5 * candidate.typical_size(study.simulator);
                jobs.extend(tunings.iter().map(|hz| (index, Some(vec![kg, *hz]))));
            }
            Target::ModeOrder(_) if !ordered => jobs.push((index, None)),
            Target::Deviation(_) if !present && candidate.covariate.is_none() => jobs.push((index, None)),
            _ => {}
        }
    }
    let fitted = |(index, psi): &(usize, Option<Vec<f64>>)| {
        let effect = candidates[*index].effect(study.simulator, study.data, rows, LawKind::Constant, false, 0.0);
        let effects: Vec<FittedEffect> = fit.effects.iter().cloned().chain([effect]).collect();
        let of_part = match &candidates[*index].target {
            Target::Deviation(_) => Some(of_part(study, rows, (fit, &effects), &candidates[*index], None)?),
            _ => None,
        };
        let start = of_part.as_ref().map_or_else(|| Start::with_constant(fit, psi.clone()), Start::at);
        let from = |start: Option<&Start<'_>>| study.fit_above(floor, rows, &effects, start);
        // The parameters have adapted to the wrong modes, from where the right ones may not be reached.
        let afresh = matches!(candidates[*index].target, Target::ModeOrder(_)).then(|| from(None)).flatten();
        let found = [from(Some(&start)), afresh].into_iter().flatten();
        let fit = found.max_by(|a, b| a.log_evidence.total_cmp(&b.log_evidence))?;
        Some(Trial { candidate: *index, law: LawKind::Constant, fit, cost_nats: 0.0 })
    };
    // Only the best start of a candidate is kept.
    best_of_each(jobs.par_iter().filter_map(fitted).collect())
}

/// The best of the fits to a part of the rows that start at several sizes of a constant effect, the last of the effects, and at a guess.
fn of_part(
    study: &Study<'_>,
    rows: &[usize],
    (fit, effects): (&Fit, &[FittedEffect]),
    candidate: &Candidate,
    guess: Option<f64>,
) -> Option<Fit> {
    let part = part_of(rows, PART);
    let typical = candidate.typical_size(study.simulator);
    let lowest = effects.last()?.numbers.first()?.bounds.0;
    let shares: &[f64] = if guess.is_some() { &CONSTANT_STARTS } else { &DEVIATION_STARTS };
    let starts = shares.iter().map(|share| share * typical).chain(guess).filter(|size| *size > lowest);
    let from = |size: f64| study.fit(&part, effects, Some(&Start::with_constant(fit, Some(vec![size]))));
    starts.filter_map(from).max_by(|a, b| a.log_evidence.total_cmp(&b.log_evidence))
}

/// Fits dependences on covariates for the targets of the best constant effects among `tried`, starting from the fits of these. A score test finds such
/// a dependence beside its constant part; without it, the parameters have adapted to that part, and the test may promise nothing.
fn varying(
    study: &Study<'_>,
    rows: &[usize],
    (fit, floor): (&Fit, f64),
    candidates: &[Candidate],
    tried: &[Trial],
) -> Vec<Trial> {
    let varies = |trial: &&Trial| {
        let target = &candidates[trial.candidate].target;
        trial.law == LawKind::Constant && candidates.iter().any(|c| c.target == *target && c.covariate.is_some())
    };
    let mut constants: Vec<&Trial> = tried.iter().filter(varies).collect();
    constants.sort_by(|a, b| b.merit().total_cmp(&a.merit()));
    constants.truncate(VARIED);
    let of_one = |constant: &&Trial| {
        let target = &candidates[constant.candidate].target;
        let own: Vec<usize> = (0..candidates.len())
            .filter(|c| candidates[*c].target == *target && candidates[*c].covariate.is_some())
            .collect();
        let views = study.view(rows, &constant.fit)?;
        let whitened = Whitened::new(study, rows, &constant.fit, &views)?;
        let of_own: Vec<Candidate> = own.iter().map(|c| candidates[*c].clone()).collect();
        let mut promised = promises(study, rows, &whitened, &constant.fit, &of_own)?;
        promised.retain(|p| p.law.has_level());
        let merit = |p: &Promise| p.less_its_numbers(rows.len());
        promised.sort_by(|a, b| merit(b).total_cmp(&merit(a)));
        let mut seen = BTreeSet::new();
        promised.retain(|p| seen.insert(p.candidate));
        let fitted = |promise: &Promise| {
            let candidate = &of_own[promise.candidate];
            let effect = candidate.effect(study.simulator, study.data, rows, promise.law, true, promise.step_days);
            let level = constant.fit.psi.last()?.first()?;
            let psi = if promise.with_level { promise.psi.clone() } else { [&[0.0], &promise.psi[..]].concat() };
            let psi = psi.iter().enumerate().map(|(place, number)| if place == 0 { number + level } else { *number });
            let mut start = Start::at(&constant.fit);
            *start.psi.last_mut()? = Some(psi.collect());
            Trial::from_start(study, rows, (fit, floor), (own[promise.candidate], promise.law), effect, &start)
        };
        Some(promised.iter().filter(|p| merit(p) > 0.0).take(VARIED_BY).filter_map(fitted).collect::<Vec<_>>())
    };
    constants.par_iter().filter_map(of_one).flatten().collect()
}

/// The best trial of each candidate.
fn best_of_each(trials: Vec<Trial>) -> Vec<Trial> {
    let mut best: Vec<Trial> = Vec::new();
    for one in trials {
        match best.iter_mut().find(|b| b.candidate == one.candidate) {
            Some(known) if known.merit() >= one.merit() => {}
            Some(known) => *known = one,
            None => best.push(one),
        }
    }
    best
}

/// Fits the corrections of settings that have no score test, from their first guesses.
fn corrections(study: &Study<'_>, rows: &[usize], fit: &Fit, candidates: &[Candidate]) -> Vec<Trial> {
    let present = PresentSettings {
        simulator: study.simulator,
        data: study.data,
        rows,
        corrected: study.corrected_settings(rows, fit),
        any_outside: fit.outside.rows > 0,
    };
    if present.corrected.is_empty() {
        return Vec::new();
    }
    let present_target = |target: &Target| fit.effects.iter().any(|e| e.target == *target);
    let mut jobs: Vec<(usize, Guess)> = Vec::new();
    for (index, candidate) in candidates.iter().enumerate().filter(|(_, c)| !present_target(&c.target)) {
        jobs.extend(present.guesses(candidate).into_iter().map(|guess| (index, guess)));
    }
    let fitted = |(index, guess): &(usize, Guess)| {
        let effect = candidates[*index].effect(study.simulator, study.data, rows, guess.law, false, guess.step_days);
        let effects: Vec<FittedEffect> = fit.effects.iter().cloned().chain([effect]).collect();
        let found = study.fit(rows, &effects, Some(&Start::with(fit, Some(guess.psi.clone()))))?;
        let (found, cost_nats) = at_its_onset(study, rows, found);
        Some(Trial { candidate: *index, law: guess.law, fit: found, cost_nats })
    };
    best_of_each(jobs.par_iter().filter_map(fitted).collect())
}

/// Effective number of independent rows as a share of all rows: (1 − ρ)/(1 + ρ), with ρ the correlation of successive whitened
/// residuals; 1 if ρ is within three standard errors of 0. `None` if the frequencies cannot be computed in some row.
fn independent_share(study: &Study<'_>, rows: &[usize], fit: &Fit) -> Option<f64> {
    let views = study.view(rows, fit)?;
    let mut series: Vec<Vec<f64>> = vec![Vec::new(); study.outputs()];
    for view in &views {
        let factor = view.covariance.clone().cholesky()?.l();
        let white = factor.solve_lower_triangular(&view.residual)?;
        for (place, output) in view.present.iter().enumerate() {
            series[*output].push(white[place] * view.weight.sqrt());
        }
    }
    let (mut products, mut squares, mut pairs) = (0.0, 0.0, 0.0);
    for values in &mut series {
        // The mean is subtracted, because a constant deviation is not a correlation in time.
        let mean = structures::stats::mean(values);
        for value in values.iter_mut() {
            *value -= mean;
        }
        squares += values.iter().map(|v| v * v).sum::<f64>();
        products += values.windows(2).map(|w| w[0] * w[1]).sum::<f64>();
        pairs += values.len().saturating_sub(1) as f64;
    }
    let correlation: f64 = products / f64::max(squares, f64::MIN_POSITIVE);
    let chance = 3.0 / f64::max(pairs, 1.0).sqrt();
    Some(if correlation > chance { (1.0 - correlation) / (1.0 + correlation) } else { 1.0 })
}
