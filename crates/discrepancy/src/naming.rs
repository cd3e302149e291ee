//! Selection of the candidates that a diagnosis names as causes, and of the alternatives that it reports.

use rayon::prelude::*;

use super::describe::{self, Cause};
use super::diagnosis::{Alternative, SURE};
use super::grammar::Class;
use super::next::experiment::NextMeasurement;
use super::next::Outlook;
use super::rank::Ranked;
use super::select::Selection;
use super::study::Study;
use structures::physics::effect::Target;
use structures::simulator::Simulator;

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
    /// Measurements that would decide between the candidates of the first cause that is not sure, the best first.
    pub(super) next_measurements: Vec<NextMeasurement>,
}

/// Names the causes and their alternatives. `rows`: rows in which causes were searched; `known`: number of effects that were in
/// place before.
pub(super) fn name(
    simulator: &Simulator,
    study: &Study<'_>,
    rows: &[usize],
    selection: &Selection,
    known: usize,
) -> Named {
    let data = study.data;
    let mut all = Named {
        causes: Vec::new(),
        alternatives: Vec::new(),
        ambiguous: false,
        maybe_damage: Vec::new(),
        next_measurements: Vec::new(),
    };
    for (index, slot) in selection.slots.iter().enumerate() {
        let best = &slot.ranked[0];
        let described = |r: &Ranked| {
            // The chosen candidate is described by the final fit, every other by its own.
            let (fit, effect) =
                if std::ptr::eq(r, best) { (&selection.fit, known + index) } else { (&r.fit, r.fit.effects.len() - 1) };
            describe::cause(simulator, data, r, fit, effect, selection.independent_share)
        };
        let rival = single_place(&slot.ranked);
        let unsure = best.probability <= SURE || rival.is_some();
        all.ambiguous |= unsure;
        let mut named = if unsure { named(&slot.ranked) } else { vec![0] };
        if let Some(rival) = rival.filter(|rival| !named.contains(rival)) {
            named.truncate(MOST_NAMED - 1);
            named.push(rival);
        }
        let damage = |place: &usize| slot.ranked[*place].candidate.class == Class::PossibleDamage;
        all.maybe_damage.push(unsure && named.iter().any(damage));
        all.causes.push(described(best));
        if selection.slots.len() == 1 {
            all.causes.extend(named.iter().skip(1).map(|place| described(&slot.ranked[*place])));
        }
        let shown = |(place, other): &(usize, &Ranked)| {
            let near = *place <= MOST_NEARLY && other.log_odds > best.log_odds - NEARLY_NATS;
            near || named.contains(place) || *place <= MOST_ALTERNATIVES
        };
        let shown: Vec<&Ranked> = slot.ranked.iter().enumerate().filter(shown).map(|(_, r)| r).collect();
        let mut outlook = Outlook::new(study, rows, shown.clone(), selection.independent_share);
        if unsure && all.next_measurements.is_empty() {
            all.next_measurements = outlook.next_measurements();
        }
        let alternative = |place: usize| Alternative {
            cause: described(shown[place]),
            instead_of: index + 1,
            log_evidence_difference: shown[place].log_odds - best.log_odds,
            discriminating_measurement: outlook.distinguishing(0, place),
        };
        all.alternatives.par_extend((1..shown.len()).into_par_iter().map(alternative));
    }
    all
}

/// Where the simulation may be off everywhere: the constant cause in a single place that the data support at least as well, so that only the prior
/// speaks against it.
fn single_place(ranked: &[Ranked]) -> Option<usize> {
    let best = ranked.first().filter(|r| matches!(r.candidate.target, Target::Everywhere(_)))?;
    let of_data = |r: &Ranked| r.log_odds - r.candidate.weight.ln();
    let in_one_place = |r: &Ranked| {
        let target = &r.candidate.target;
        r.candidate.covariate.is_none()
            && !r.candidate.acts_on_all()
            && !target.is_of_instrument()
            && !matches!(target, Target::Deviation(_) | Target::ModeOrder(_))
    };
    let places = ranked.iter().enumerate().skip(1).filter(|(_, r)| in_one_place(r) && of_data(r) >= of_data(best));
    places.max_by(|a, b| of_data(a.1).total_cmp(&of_data(b.1))).map(|(place, _)| place)
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
