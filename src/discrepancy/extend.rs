//! Extending: the causes of a diagnosis become effects of the structure.

use std::collections::BTreeMap;

use super::data::{Data, Values};
use super::grammar::Class;
use super::model::{Effect, Fit, Start, Study};
use super::{Outcome, Verdict};
use crate::measurement::CovariateKind;
use crate::physics::effect::Target;
use crate::simulator::definition::{CovariateDefinition, DefinitionError, EffectDefinition, StructureDefinition};
use crate::simulator::effect::target_definition;
use crate::simulator::law::LawKind;
use crate::simulator::Simulator;
use crate::stats;

/// Quantiles of a covariate that an effect remembers.
const SEEN: usize = 17;

/// A structure with the causes of a diagnosis in it.
pub struct Extended {
    /// The new version.
    pub definition: StructureDefinition,
    /// What was added, in words.
    pub added: Vec<String>,
    /// Causes that were not added, and why.
    pub left_out: Vec<String>,
}

/// Why a structure is not extended.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Nothing can be added.
    #[error("there is nothing to extend the structure with: {}", if .0.is_empty() { "the diagnosis found no cause".to_owned() } else { .0.join("; ") })]
    Nothing(Vec<String>),
    /// What was found is not the whole of it.
    #[error(
        "what the diagnosis found does not explain the data: compensating a part of it would hide the rest; find out what is \
         left first"
    )]
    Unexplained,
    /// The causes cannot be fitted in the form that a structure takes.
    #[error("the causes cannot be fitted in a form that an assessment can use")]
    NoFit,
    /// The new structure is refused: its effects leave no frequencies somewhere.
    #[error("the extended structure is refused: {0}")]
    Definition(#[from] DefinitionError),
}

/// The structure with every cause that an assessment can account for.
///
/// A stiffness that changes with time stays out: it may be damage. A lagged effect is taken in its best form without a lag,
/// a step in time and a setting stay out, since one batch does not say what came before or what was set.
///
/// # Errors
/// [`Error`].
pub fn extend(simulator: &Simulator, data: &Data, outcome: &Outcome) -> Result<Extended, Error> {
    if outcome.diagnosis.verdict == Verdict::NoneOfThese {
        return Err(Error::Unexplained);
    }
    let bare = simulator.without_effects();
    let known = simulator.effects().len();
    let (mut added, mut left_out) = (Vec::new(), Vec::new());
    let mut effects: Vec<Effect> = outcome.after.effects[..known].to_vec();
    let mut psi: Vec<Option<Vec<f64>>> = outcome.after.psi[..known].iter().cloned().map(Some).collect();
    let causes = &outcome.diagnosis.causes;
    let chosen: Vec<&super::Ranked> = outcome.causes.iter().collect();
    let mut kept = Vec::new();
    for (place, ranked) in chosen.iter().enumerate() {
        let cause = &causes[place];
        let mut leave = |why: &str| left_out.push(format!("{}: {why}", cause.sentence));
        let effect = &outcome.after.effects[known + place];
        if ranked.candidate.class == Class::PossibleDamage {
            leave("it may be damage, which is not compensated");
            continue;
        }
        if outcome.maybe_damage[place] {
            leave("these data cannot tell it from a stiffness that changes with time, which may be damage");
            continue;
        }
        if matches!(effect.target, Target::SettingOffset(_) | Target::SettingScale(_)) {
            leave("settings are no part of the structure; correct them where they are entered");
            continue;
        }
        if effect.law.kind == LawKind::Step || effect.law.covariate.as_deref().is_some_and(super::is_time) {
            leave("a change with time cannot be told from one batch; define the structure anew from that time on");
            continue;
        }
        let mut values = outcome.after.psi[known + place].clone();
        let mut effect = effect.clone();
        if effect.law.kind == LawKind::Lagged {
            let other = ranked.laws.iter().filter(|l| l.0 != LawKind::Lagged).max_by(|a, b| a.1.total_cmp(&b.1));
            let law = other.map_or(LawKind::Linear, |l| l.0);
            let with_level = effect.law.with_level;
            effect = ranked.candidate.effect(&bare, data, &outcome.training, law, with_level, 0.0);
            values = effect.numbers.iter().map(|n| n.prior_mean).collect();
            added.push(format!(
                "{} (in its {} form without the lag: one batch does not say what came before)",
                cause.sentence,
                law.name()
            ));
        } else {
            added.push(cause.sentence.clone());
        }
        kept.push(place);
        effects.push(effect);
        psi.push(Some(values));
    }
    if kept.is_empty() {
        return Err(Error::Nothing(left_out));
    }
    let study = Study::new(&bare, data);
    let all: Vec<usize> = (0..data.rows()).collect();
    // Everything was chosen without the rows held out; the numbers may be learnt from all.
    let fit = study.fit(&all, &effects, Some(&Start { fit: &outcome.after, psi })).ok_or(Error::NoFit)?;
    let mut definition = simulator.definition().clone();
    definition.parent = Some(simulator.digest().to_string());
    let old = std::mem::take(&mut definition.effects);
    for (place, effect) in fit.effects.iter().enumerate() {
        let (name, description) = match place.checked_sub(known) {
            None => (old[place].name.clone(), old[place].description.clone()),
            Some(new) => (free_name(&definition, &old, place), Some(added[new].clone())),
        };
        let written = definition_of(&bare, data, &fit, place, name, description);
        let Some(mut written) = written else { continue };
        if let Some(before) = old.get(place) {
            written.seen.clone_from(&before.seen);
        }
        declare(&mut definition, data, effect);
        definition.effects.push(written);
    }
    // The check of the whole: an effect may leave no frequencies somewhere.
    Simulator::new(definition.clone())?;
    Ok(Extended { definition, added, left_out })
}

fn free_name(definition: &StructureDefinition, old: &[EffectDefinition], place: usize) -> String {
    let taken = |name: &str| definition.effects.iter().chain(old).any(|e| e.name == name);
    let mut number = place + 1;
    while taken(&format!("effect{number}")) {
        number += 1;
    }
    format!("effect{number}")
}

/// Declares the covariate of an effect, where the structure has not yet.
fn declare(definition: &mut StructureDefinition, data: &Data, effect: &Effect) {
    let Some(name) = &effect.law.covariate else { return };
    if definition.covariates.iter().any(|c| c.name == *name) {
        return;
    }
    let category = data.column(name).is_some_and(|c| matches!(c.values, Values::Categories(..)));
    let kind = if category { CovariateKind::Category } else { CovariateKind::Number };
    definition.covariates.push(CovariateDefinition { name: name.clone(), kind });
}

fn definition_of(
    simulator: &Simulator,
    data: &Data,
    fit: &Fit,
    place: usize,
    name: String,
    description: Option<String>,
) -> Option<EffectDefinition> {
    let (effect, psi) = (&fit.effects[place], &fit.psi[place]);
    let names: Vec<&String> = effect.numbers.iter().map(|n| &n.name).collect();
    let covariance = fit.psi_covariance(place);
    let mut order: Vec<usize> = (0..names.len()).collect();
    order.sort_by_key(|i| names[*i]);
    let column = effect.law.covariate.as_deref().and_then(|name| data.column(name));
    let seen = match column.map(|c| &c.values) {
        Some(Values::Numbers(values)) => {
            let known: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
            (0..SEEN).map(|i| stats::quantile(&known, i as f64 / (SEEN - 1) as f64)).collect()
        }
        _ => Vec::new(),
    };
    let numbers: BTreeMap<String, f64> = names.iter().zip(psi).map(|(n, v)| ((*n).clone(), *v)).collect();
    Some(EffectDefinition {
        name,
        description,
        target: target_definition(&effect.target, simulator.structure(), simulator.space())?,
        law: effect.law.kind,
        covariate: effect.law.covariate.clone(),
        reference: effect.law.reference,
        numbers,
        covariance: order.iter().map(|i| order.iter().map(|j| covariance[(*i, *j)]).collect()).collect(),
        seen,
    })
}
