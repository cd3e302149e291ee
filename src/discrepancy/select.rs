//! Naming causes: forward selection by evidence, what else could be it, and a check on blocks left out.

use nalgebra::DVector;
use rayon::prelude::*;

use super::grammar::Candidate;
use super::model::{Effect, Fit, Start, Study};
use super::screen::{promises, Promise, Whitened};
use super::{Progress, Step};
use crate::physics::effect::Target;
use crate::simulator::law::LawKind;

/// Candidates that are fitted in full at each step: the most promising, and the best of each kind.
const FITTED: usize = 16;
const OF_EACH_KIND: usize = 1;

/// Candidates of which every law is fitted.
const REFINED: usize = 5;

/// A further cause is taken when all candidates together are this much more probable than none, nats.
const ACCEPTED_NATS: f64 = 3.0;

/// What a covariate must add to a constant effect on the same target, nats.
const COVARIATE_NATS: f64 = 3.0;

/// Promise of an arbitrary constant of each mode below which no further constant effect can be accepted, nats.
const CONSTANT_NATS: f64 = 6.0;

/// Hosts that an oscillator is tried at.
const MOST_HOSTS: usize = 12;

/// Most causes that are looked for.
const MOST_CAUSES: usize = 4;

/// Blocks of time, dealt to folds in turn, that cross-validation leaves out.
const BLOCKS: usize = 20;
const FOLDS: usize = 5;

/// Places of a step that are distinguished: what its time costs.
const STEP_PLACES: f64 = 20.0;

/// A candidate with its best law.
#[derive(Debug, Clone)]
pub struct Ranked {
    /// The candidate.
    pub candidate: Candidate,
    /// Fit with its best law as the last effect.
    pub fit: Fit,
    /// ln of its probability relative to no further cause, prior included, nats.
    pub log_odds: f64,
    /// Probability among all candidates and none.
    pub probability: f64,
    /// Each law tried and its log-evidence above the present fit's, nats.
    pub laws: Vec<(LawKind, f64)>,
}

/// One cause that was accepted, and what stood beside it.
#[derive(Debug, Clone)]
pub struct Slot {
    /// Candidates by probability, the cause first.
    pub ranked: Vec<Ranked>,
    /// Gain in log predictive density on blocks left out, nats a row, and its standard error.
    pub cross_validation: (f64, f64),
}

/// The causes that were found.
pub struct Selection {
    /// Fit with the effects that the structure has already.
    pub base: Fit,
    /// Fit with all causes beside those; the effects of the slots come last, in the same order.
    pub fit: Fit,
    /// The causes.
    pub slots: Vec<Slot>,
    /// Candidates there were, laws counted.
    pub tried: usize,
    /// Share of the rows that are worth independent ones, from the residual's correlation in time.
    pub independent_share: f64,
}

/// Finds the causes, one after another, then looks at each again with the others in place.
pub fn select(
    study: &Study<'_>,
    rows: &[usize],
    known: &[Effect],
    candidates: &[Candidate],
    progress: &Progress<'_>,
) -> Option<Selection> {
    let base = study.fit(rows, known, None)?;
    let mut fit = base.clone();
    let mut slots: Vec<Slot> = Vec::new();
    let tried = candidates.iter().map(|c| c.laws(study.data).len()).sum();
    let mut independent_share = 1.0;
    for number in 0..MOST_CAUSES {
        progress(Step::Searching { cause: number + 1, of: MOST_CAUSES });
        let (ranked, share) = rank(study, rows, &fit, candidates, known.len())?;
        independent_share = share;
        let total = log_sum(ranked.iter().map(|r| r.log_odds));
        let Some(best) = ranked.first().filter(|_| total > ACCEPTED_NATS) else { break };
        // A cause that has no answer for rows left out is none either.
        let cross_validation = cross_validate(study, rows, &fit, &best.fit).unwrap_or((f64::NEG_INFINITY, 0.0));
        // A cause that clearly predicts worse is none, whatever it explains.
        if cross_validation.0 + 2.0 * cross_validation.1 <= 0.0 {
            break;
        }
        fit = best.fit.clone();
        slots.push(Slot { ranked, cross_validation });
    }
    if slots.len() > 1 {
        fit = look_again(study, rows, candidates, known.len(), fit, &mut slots, progress)?;
    }
    Some(Selection { base, fit, slots, tried, independent_share })
}

/// With all causes found, each is taken out and looked for again: the first was chosen while the others hid in the noise.
fn look_again(
    study: &Study<'_>,
    rows: &[usize],
    candidates: &[Candidate],
    known: usize,
    mut fit: Fit,
    slots: &mut Vec<Slot>,
    progress: &Progress<'_>,
) -> Option<Fit> {
    let found = slots.len();
    for number in 0..found {
        progress(Step::LookingAgain { cause: number + 1, of: found });
        // The first goes out and comes back last, so that slots and effects keep the same order.
        let old = slots.remove(0);
        let (mut effects, mut psi) = (fit.effects.clone(), fit.psi.clone());
        effects.remove(known);
        psi.remove(known);
        let start = Start { fit: &fit, psi: psi.into_iter().map(Some).collect() };
        let without = study.fit(rows, &effects, Some(&start))?;
        let (ranked, _) = rank(study, rows, &without, candidates, known)?;
        let needed = log_sum(ranked.iter().map(|r| r.log_odds)) > ACCEPTED_NATS;
        let Some(best) = ranked.first().filter(|_| needed) else {
            fit = without;
            continue;
        };
        fit = best.fit.clone();
        slots.push(Slot { ranked, cross_validation: old.cross_validation });
    }
    for (index, slot) in slots.iter_mut().enumerate() {
        let (mut effects, mut psi) = (fit.effects.clone(), fit.psi.clone());
        effects.remove(known + index);
        psi.remove(known + index);
        let start = Start { fit: &fit, psi: psi.into_iter().map(Some).collect() };
        let without = study.fit(rows, &effects, Some(&start))?;
        slot.cross_validation = cross_validate(study, rows, &without, &fit).unwrap_or((f64::NEG_INFINITY, 0.0));
    }
    Some(fit)
}

/// All candidates beside a fit, by probability; and the share of rows that are worth independent ones under the best. The first
/// `known` effects of the fit are the structure's own: what they say may be wrong, and a further one of the same kind mend it.
fn rank(
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
    let penalty = |p: &Promise| p.nats - 0.5 * p.psi.len() as f64 * (rows.len() as f64).ln();
    let merit = |p: &Promise| penalty(p) + candidates[p.candidate].weight.ln();
    promised.sort_by(|a, b| merit(b).total_cmp(&merit(a)));

    let mut chosen: Vec<&Promise> = Vec::new();
    let mut kinds: Vec<(std::mem::Discriminant<Target>, usize)> = Vec::new();
    for promise in &promised {
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
    let start =
        |further: Option<Vec<f64>>| Start { fit, psi: fit.psi.iter().cloned().map(Some).chain([further]).collect() };
    let fitted = |promise: &&Promise| {
        let candidate = &candidates[promise.candidate];
        let effect =
            candidate.effect(study.simulator, study.data, rows, promise.law, promise.with_level, promise.step_days);
        let effects: Vec<Effect> = fit.effects.iter().cloned().chain([effect]).collect();
        let found = study.fit(rows, &effects, Some(&start(Some(promise.psi.clone()))))?;
        let cost = if promise.law == LawKind::Step { STEP_PLACES.ln() } else { 0.0 };
        Some((promise.candidate, promise.law, found, cost))
    };
    let mut tried: Vec<(usize, LawKind, Fit, f64)> = chosen.par_iter().filter_map(fitted).collect();
    // Any constant effect promises at most what each mode's own constant does.
    let ones = DVector::from_element(rows.len(), 1.0);
    let constant = whitened.free_score(&whitened.mode_sums(study.simulator.modes()), &ones);
    if constant.nats > CONSTANT_NATS {
        tried.extend(unscreened(study, rows, fit, candidates));
    }
    let mut order: Vec<(usize, f64)> =
        tried.iter().map(|(c, _, f, cost)| (*c, f.log_evidence - cost + candidates[*c].weight.ln())).collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1));
    let refined: Vec<usize> = order.iter().take(REFINED).map(|o| o.0).collect();
    let further: Vec<&Promise> = promised
        .iter()
        .filter(|p| refined.contains(&p.candidate) && !tried.iter().any(|t| t.0 == p.candidate && t.1 == p.law))
        .collect();
    tried.extend(further.par_iter().filter_map(fitted).collect::<Vec<_>>());

    let best = tried.iter().max_by(|a, b| a.2.log_evidence.total_cmp(&b.2.log_evidence));
    let share = best.map_or(Some(1.0), |(_, _, fit, _)| independent_share(study, rows, fit))?;
    let mut ranked: Vec<Ranked> = Vec::new();
    for (index, candidate) in candidates.iter().enumerate() {
        let mut own: Vec<&(usize, LawKind, Fit, f64)> = tried.iter().filter(|t| t.0 == index).collect();
        own.sort_by(|a, b| (b.2.log_evidence - b.3).total_cmp(&(a.2.log_evidence - a.3)));
        let Some(first) = own.first() else { continue };
        let gain = |t: &&(usize, LawKind, Fit, f64)| share * (t.2.log_evidence - fit.log_evidence) - t.3;
        let laws = candidate.laws(study.data).len() as f64;
        let log_odds = log_sum(own.iter().map(gain)) - laws.ln() + candidate.weight.ln();
        let laws = own.iter().map(|t| (t.1, gain(t))).collect();
        ranked.push(Ranked { candidate: candidate.clone(), fit: first.2.clone(), log_odds, probability: 0.0, laws });
    }
    drop_disguises(&mut ranked);
    ranked.sort_by(|a, b| b.log_odds.total_cmp(&a.log_odds));
    // None of them has odds of 1.
    let total = log_sum(ranked.iter().map(|r| r.log_odds).chain([0.0]));
    for r in &mut ranked {
        r.probability = (r.log_odds - total).exp();
    }
    Some((ranked, share))
}

/// Leaves out what is another candidate in disguise. A law with a level explains a constant too: unless its covariate adds to
/// the constant of the same target, it is that constant. An oscillator that adds nothing to a heavier host is that.
fn drop_disguises(ranked: &mut Vec<Ranked>) {
    let best = |r: &Ranked| r.laws.iter().map(|l| l.1).fold(f64::NEG_INFINITY, f64::max);
    let constants: Vec<(Target, f64)> = ranked
        .iter()
        .filter(|r| r.candidate.covariate.is_none())
        .map(|r| (r.candidate.target.clone(), best(r)))
        .collect();
    ranked.retain(|r| {
        // An oscillator tuned far away is an added mass, which says it with one number less.
        if let Target::Oscillator(host) = r.candidate.target {
            let heavier = constants.iter().find(|c| c.0 == Target::Masses(vec![host])).map(|c| c.1);
            return heavier.is_none_or(|heavier| best(r) > heavier + COVARIATE_NATS);
        }
        let constant = constants.iter().find(|c| c.0 == r.candidate.target).map(|c| c.1);
        r.candidate.covariate.is_none() || constant.is_none_or(|constant| best(r) > constant + COVARIATE_NATS)
    });
}

/// Candidates whose size 0 is no place to take a slope at: oscillators, from several tunings, and orders of modes.
fn unscreened(
    study: &Study<'_>,
    rows: &[usize],
    fit: &Fit,
    candidates: &[Candidate],
) -> Vec<(usize, LawKind, Fit, f64)> {
    let f = study.simulator.nominal_frequencies_hz();
    let mut tunings = vec![0.6 * f[0], 0.9 * f[0]];
    tunings.extend(f.windows(2).flat_map(|w| [0.7 * w[0] + 0.3 * w[1], 0.3 * w[0] + 0.7 * w[1]]));
    tunings.extend([1.1 * f[f.len() - 1], 1.5 * f[f.len() - 1]]);
    let ordered = fit.effects.iter().any(|e| matches!(e.target, Target::ModeOrder(_)));
    // Hundreds of hosts would take hours: some of them stand for their neighbours.
    let hosts = study.simulator.structure().map_or(0, |s| s.attachment_points().len());
    let every = hosts.div_ceil(MOST_HOSTS);
    let mut jobs: Vec<(usize, Option<Vec<f64>>)> = Vec::new();
    let mut oscillators = 0..;
    for (index, candidate) in candidates.iter().enumerate() {
        let present = fit.effects.iter().any(|e| e.target == candidate.target);
        match candidate.target {
            Target::Oscillator(_) if !present && oscillators.next().is_some_and(|place| place % every == 0) => {
                let kg = 0.5 * candidate.typical_size(study.simulator);
                jobs.extend(tunings.iter().map(|hz| (index, Some(vec![kg, *hz]))));
            }
            Target::ModeOrder(_) if !ordered => jobs.push((index, None)),
            _ => {}
        }
    }
    let fitted = |(index, psi): &(usize, Option<Vec<f64>>)| {
        let effect = candidates[*index].effect(study.simulator, study.data, rows, LawKind::Constant, false, 0.0);
        let effects: Vec<Effect> = fit.effects.iter().cloned().chain([effect]).collect();
        let psi = fit.psi.iter().cloned().map(Some).chain([psi.clone()]).collect();
        Some((*index, LawKind::Constant, study.fit(rows, &effects, Some(&Start { fit, psi }))?, 0.0))
    };
    let all: Vec<(usize, LawKind, Fit, f64)> = jobs.par_iter().filter_map(fitted).collect();
    // Of an oscillator the best tuning counts.
    let mut best: Vec<(usize, LawKind, Fit, f64)> = Vec::new();
    for one in all {
        match best.iter_mut().find(|b| b.0 == one.0) {
            Some(known) if known.2.log_evidence >= one.2.log_evidence => {}
            Some(known) => *known = one,
            None => best.push(one),
        }
    }
    best
}

/// Share of the rows that are worth independent ones: (1 − ρ)/(1 + ρ), ρ the correlation of whitened residuals with those of
/// the row before; 1 where ρ is no more than chance.
fn independent_share(study: &Study<'_>, rows: &[usize], fit: &Fit) -> Option<f64> {
    let views = study.view(rows, fit)?;
    let mut series: Vec<Vec<f64>> = vec![Vec::new(); study.simulator.modes()];
    for view in &views {
        let factor = view.covariance.clone().cholesky()?.l();
        let white = factor.solve_lower_triangular(&view.residual)?;
        for (place, mode) in view.present.iter().enumerate() {
            series[*mode].push(white[place] * view.weight.sqrt());
        }
    }
    let (mut products, mut squares, mut pairs) = (0.0, 0.0, 0.0);
    for values in &mut series {
        // A constant deviation is no correlation in time.
        let mean = crate::stats::mean(values);
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

/// Mean gain in log density of rows left out, by the second fit over the first, and its standard error over blocks.
fn cross_validate(study: &Study<'_>, rows: &[usize], before: &Fit, after: &Fit) -> Option<(f64, f64)> {
    let block = |place: usize| place * BLOCKS / rows.len();
    let fold = |number: usize| {
        let (left, kept): (Vec<usize>, Vec<usize>) = (0..rows.len()).partition(|p| block(*p) % FOLDS == number);
        let kept: Vec<usize> = kept.iter().map(|p| rows[*p]).collect();
        let out: Vec<usize> = left.iter().map(|p| rows[*p]).collect();
        let density = |fit: &Fit| -> Option<Vec<f64>> {
            let start = Start { fit, psi: fit.psi.iter().cloned().map(Some).collect() };
            let refitted = study.fit(&kept, &fit.effects, Some(&start))?;
            Some(study.view(&out, &refitted)?.iter().map(|v| v.log_density).collect())
        };
        let (a, b) = (density(before)?, density(after)?);
        Some(left.iter().zip(b.iter().zip(&a)).map(|(p, (b, a))| (block(*p), b - a)).collect::<Vec<_>>())
    };
    let gains: Vec<(usize, f64)> =
        (0..FOLDS).into_par_iter().map(fold).collect::<Option<Vec<_>>>()?.into_iter().flatten().collect();
    let n = gains.len() as f64;
    let mean = gains.iter().map(|g| g.1).sum::<f64>() / n;
    let sums: Vec<f64> =
        (0..BLOCKS).map(|b| gains.iter().filter(|g| g.0 == b).map(|g| g.1 - mean).sum::<f64>()).collect();
    Some((mean, sums.iter().map(|s| s * s).sum::<f64>().sqrt() / n))
}

/// ln Σ exp; −∞ of nothing.
pub fn log_sum(values: impl Iterator<Item = f64>) -> f64 {
    let values: Vec<f64> = values.collect();
    let largest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if largest.is_finite() {
        largest + values.iter().map(|v| (v - largest).exp()).sum::<f64>().ln()
    } else {
        f64::NEG_INFINITY
    }
}
