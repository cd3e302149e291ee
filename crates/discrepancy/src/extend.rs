//! Extending a structure: the causes of a diagnosis become effects of a new version.

use std::collections::BTreeMap;

use super::data::{Data, Origin, Values, TIME};
use super::diagnosis::{DiagnosisVerdict, Outcome};
use super::effect::FittedEffect;
use super::fit::{Fit, Start};
use super::grammar::Class;
use super::rank::Ranked;
use super::study::Study;
use structures::measurement::CovariateKind;
use structures::physics::effect::Target;
use structures::simulator::definition::{CovariateDefinition, DefinitionError, EffectDefinition, StructureDefinition};
use structures::simulator::effect::target_definition;
use structures::simulator::law::LawKind;
use structures::simulator::Simulator;
use structures::stats;

/// Number of quantiles of a covariate that are stored with an effect.
const SEEN: usize = 17;

/// A structure with the causes of a diagnosis in it.
pub struct Extended {
    /// The new version.
    pub definition: StructureDefinition,
    /// What was added, in words.
    pub added: Vec<String>,
    /// Causes that were not added, each with the reason.
    pub left_out: Vec<String>,
}

/// Why a structure is not extended.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Nothing can be added.
    #[error("no cause can be added to the structure: {}", if .0.is_empty() { "the diagnosis found no cause".to_owned() } else { .0.join("; ") })]
    Nothing(Vec<String>),
    /// The causes do not explain the data.
    #[error(
        "the causes that were found do not explain the data; compensating for them would hide the remaining deviation, whose cause \
         must be found first"
    )]
    Unexplained,
    /// The causes cannot be fitted in the form that a structure takes.
    #[error("the causes cannot be fitted in a form that an assessment can use")]
    NoFit,
    /// The new structure is not valid: under its effects, the frequencies cannot be computed for some parameters.
    #[error("the extended structure is refused: {0}")]
    Definition(#[from] DefinitionError),
}

/// Adds every cause that an assessment can compensate for to the structure, and fits the numbers of all effects to all rows.
///
/// A stiffness that changes with time is left out, because it may be damage; so are a step in time and a setting, because a
/// batch contains neither what came before it nor what was set. A lagged effect is replaced by its best form without a lag.
///
/// # Errors
/// [`Error`] if no cause can be added, if the causes do not explain the data, if they cannot be fitted in this form, or if the
/// extended structure is not valid.
pub fn extend(simulator: &Simulator, data: &Data, outcome: &Outcome) -> Result<Extended, Error> {
    if outcome.diagnosis.verdict == DiagnosisVerdict::NoneOfThese {
        return Err(Error::Unexplained);
    }
    let bare = simulator.without_effects();
    // The effects of the structure, and masses that were hung in some rows.
    let given = outcome.after.effects.len() - outcome.causes.len();
    let (mut added, mut left_out) = (Vec::new(), Vec::new());
    let mut effects: Vec<FittedEffect> = outcome.after.effects[..given].to_vec();
    let mut psi: Vec<Option<Vec<f64>>> = outcome.after.psi[..given].iter().cloned().map(Some).collect();
    // A cause that is left out of the structure stays in the fit, because the numbers of the others would compensate for it.
    let mut written = vec![true; simulator.effects().len()];
    written.resize(given, false);
    for (place, ranked) in outcome.causes.iter().enumerate() {
        let sentence = &outcome.diagnosis.causes[place].sentence;
        let effect = &outcome.after.effects[given + place];
        if let Some(why) = why_left_out(data, ranked, effect, outcome, place) {
            left_out.push(format!("{sentence}: {why}"));
            written.push(false);
            psi.push(Some(outcome.after.psi[given + place].clone()));
            effects.push(effect.clone());
        } else if effect.law.kind == LawKind::Lagged {
            let effect = without_lag(&bare, data, &outcome.training, ranked, effect);
            let law = effect.law.kind.name();
            added.push(format!(
                "{sentence} (in its {law} form without the lag: a batch does not contain what came before)"
            ));
            psi.push(Some(effect.numbers.iter().map(|n| n.prior_mean).collect()));
            effects.push(effect);
            written.push(true);
        } else {
            added.push(sentence.clone());
            written.push(true);
            psi.push(Some(outcome.after.psi[given + place].clone()));
            effects.push(effect.clone());
        }
    }
    if added.is_empty() {
        return Err(Error::Nothing(left_out));
    }
    let study = Study::new(&bare, data);
    // The causes were chosen without the rows held out; their numbers may be fitted to these rows too, but not to those since a
    // lasting change, which may be damage.
    let all: Vec<usize> = (0..data.rows()).filter(|row| outcome.set_aside.binary_search(row).is_err()).collect();
    let fit = study
        .fit(&all, &effects, Some(&Start { fit: &outcome.after, psi, noise_as_stated: false }))
        .ok_or(Error::NoFit)?;
    let definition = extended_definition(simulator, data, &fit, &written, &added);
    // Checks the whole structure: under an effect, the frequencies may not exist for some parameters.
    Simulator::new(definition.clone())?;
    Ok(Extended { definition, added, left_out })
}

/// Why a cause is not added to the structure; `None` if it is.
fn why_left_out(
    data: &Data,
    ranked: &Ranked,
    effect: &FittedEffect,
    outcome: &Outcome,
    place: usize,
) -> Option<&'static str> {
    if ranked.candidate.class == Class::PossibleDamage {
        return Some("it may be damage, which is not compensated");
    }
    if outcome.maybe_damage[place] {
        return Some("these data cannot distinguish it from a stiffness that changes with time, which may be damage");
    }
    if matches!(effect.target, Target::Everywhere(_)) {
        if outcome.everywhere().is_none() {
            return Some("it is in no single place, and an effect of a structure file acts on one");
        }
        return Some("it is in no single place; accept it as a constant discrepancy of each mode (`--learned`, over HTTP `\"learned\": true`)");
    }
    if matches!(effect.target, Target::ModeGain { .. }) || !effect.target.settings().is_empty() {
        return Some("settings are not part of the structure; correct them where they are entered");
    }
    if effect.law.kind == LawKind::Step || effect.law.covariate.as_deref() == Some(TIME) {
        return Some("a change with time cannot be recognised in one batch; define a new structure from that time on");
    }
    let origin = effect.law.covariate.as_deref().and_then(|name| data.column(name)).map(|column| column.origin);
    match origin {
        Some(Origin::Setting) => {
            Some("an effect of a structure file depends on a covariate, and this one depends on a setting")
        }
        Some(Origin::Cycle(_)) => Some(
            "the time stands for something that was not recorded: record what varies with it, such as the temperature",
        ),
        Some(Origin::Product(..)) => {
            Some("an effect of a structure file depends on one covariate, and this one on two")
        }
        _ => None,
    }
}

/// A lagged effect in the best of its forms without a lag, at the mean of its prior.
fn without_lag(
    simulator: &Simulator,
    data: &Data,
    rows: &[usize],
    ranked: &Ranked,
    effect: &FittedEffect,
) -> FittedEffect {
    let other = ranked.laws.iter().filter(|l| l.0 != LawKind::Lagged).max_by(|a, b| a.1.total_cmp(&b.1));
    let law = other.map_or(LawKind::Linear, |l| l.0);
    ranked.candidate.effect(simulator, data, rows, law, effect.law.with_level, 0.0)
}

/// The definition with the effects of a fit that are to be `written`: first those of the structure, then those described by
/// `added`.
fn extended_definition(
    simulator: &Simulator,
    data: &Data,
    fit: &Fit,
    written: &[bool],
    added: &[String],
) -> StructureDefinition {
    let bare = simulator.without_effects();
    let mut added = added.iter();
    let known = simulator.effects().len();
    let mut definition = simulator.definition().clone();
    definition.parent = Some(simulator.digest().to_string());
    let old = std::mem::take(&mut definition.effects);
    for (place, effect) in fit.effects.iter().enumerate().filter(|(place, _)| written[*place]) {
        let (name, description) = if place < known {
            (old[place].name.clone(), old[place].description.clone())
        } else {
            (free_name(&definition, &old, place), added.next().cloned())
        };
        let written = definition_of(&bare, data, fit, place, name, description);
        let Some(mut written) = written else { continue };
        if let Some(before) = old.get(place) {
            written.seen.clone_from(&before.seen);
        }
        declare(&mut definition, data, effect);
        definition.effects.push(written);
    }
    definition
}

/// A name that no effect of the structure has.
fn free_name(definition: &StructureDefinition, old: &[EffectDefinition], place: usize) -> String {
    let taken = |name: &str| definition.effects.iter().chain(old).any(|e| e.name == name);
    let mut number = place + 1;
    while taken(&format!("effect{number}")) {
        number += 1;
    }
    format!("effect{number}")
}

/// Declares the covariate of an effect in the structure, unless it is declared already.
fn declare(definition: &mut StructureDefinition, data: &Data, effect: &FittedEffect) {
    let Some(name) = &effect.law.covariate else { return };
    if definition.covariates.iter().any(|c| c.name == *name) {
        return;
    }
    let category = data.column(name).is_some_and(|c| matches!(c.values, Values::Categories(..)));
    let kind = if category { CovariateKind::Category } else { CovariateKind::Number };
    definition.covariates.push(CovariateDefinition { name: name.clone(), kind, unit: None, range: None });
}

/// Effect `place` of a fit as a structure file states it; `None` for a target that a file cannot state.
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
