//! Selection of the candidates that a diagnosis names as causes, and of the alternatives that it reports.

use super::data::Data;
use super::describe::{self, Cause};
use super::diagnosis::{Alternative, SURE};
use super::discriminate::discriminating_measurement;
use super::grammar::Class;
use super::rank::Ranked;
use super::select::Selection;
use crate::simulator::Simulator;

/// An answer that is not sure names candidates until their probabilities sum to this, at most so many.
const COVERED: f64 = 0.985;
const MOST_NAMED: usize = 8;

/// Alternatives that are reported in any case.
const MOST_ALTERNATIVES: usize = 5;

/// Further alternatives are reported if their log odds lie within this of those of the chosen cause, up to so many.
const NEARLY_NATS: f64 = 5.0;
const MOST_NEARLY: usize = 20;

/// The causes of a selection in words.
pub(super) struct Named {
    pub(super) causes: Vec<Cause>,
    pub(super) alternatives: Vec<Alternative>,
    /// Whether any cause is less probable than [`SURE`].
    pub(super) ambiguous: bool,
    /// For each slot, whether possible damage is among several candidates named.
    pub(super) maybe_damage: Vec<bool>,
}

/// Names the causes and their alternatives; the structure has `known` effects already.
pub(super) fn name(simulator: &Simulator, data: &Data, selection: &Selection, known: usize) -> Named {
    let bare = simulator.without_effects();
    let mut all = Named { causes: Vec::new(), alternatives: Vec::new(), ambiguous: false, maybe_damage: Vec::new() };
    for (index, slot) in selection.slots.iter().enumerate() {
        let best = &slot.ranked[0];
        let described = |r: &Ranked| {
            // The chosen candidate is described by the final fit, every other by its own.
            let (fit, effect) =
                if std::ptr::eq(r, best) { (&selection.fit, known + index) } else { (&r.fit, r.fit.effects.len() - 1) };
            describe::cause(simulator, data, r, fit, effect, selection.independent_share)
        };
        let unsure = best.probability <= SURE;
        all.ambiguous |= unsure;
        let named = if unsure { named(&slot.ranked) } else { vec![0] };
        let damage = |place: &usize| slot.ranked[*place].candidate.class == Class::PossibleDamage;
        all.maybe_damage.push(unsure && named.iter().any(damage));
        all.causes.push(described(best));
        if selection.slots.len() == 1 {
            all.causes.extend(named.iter().skip(1).map(|place| described(&slot.ranked[*place])));
        }
        for (place, other) in slot.ranked.iter().enumerate().skip(1) {
            let near = place <= MOST_NEARLY && other.log_odds > best.log_odds - NEARLY_NATS;
            if near || named.contains(&place) || place <= MOST_ALTERNATIVES {
                all.alternatives.push(Alternative {
                    cause: described(other),
                    instead_of: index + 1,
                    log_evidence_difference: other.log_odds - best.log_odds,
                    discriminating_measurement: discriminating_measurement(&bare, data, best, other),
                });
            }
        }
    }
    all
}

/// Indices of the candidates that an unsure answer names: first the best of each set of exact equivalents, until they cover
/// [`COVERED`] of the probability; then, up to [`MOST_NAMED`], their equivalents.
fn named(ranked: &[Ranked]) -> Vec<usize> {
    let equivalent = |a: &Ranked, b: &Ranked| {
        let same = (&a.candidate.covariate, &a.candidate.level) == (&b.candidate.covariate, &b.candidate.level);
        same && a.candidate.acts_on_all() && b.candidate.acts_on_all()
    };
    let mut places: Vec<usize> = Vec::new();
    let mut covered = 0.0;
    for (place, r) in ranked.iter().enumerate() {
        if places.len() == MOST_NAMED || covered >= COVERED {
            break;
        }
        if !places.iter().any(|p| equivalent(&ranked[*p], r)) {
            places.push(place);
            covered +=
                ranked.iter().filter(|o| std::ptr::eq(*o, r) || equivalent(o, r)).map(|o| o.probability).sum::<f64>();
        }
    }
    for (place, r) in ranked.iter().enumerate() {
        let further = !places.contains(&place) && places.iter().any(|p| equivalent(&ranked[*p], r));
        if places.len() < MOST_NAMED && further {
            places.push(place);
        }
    }
    places
}
