//! The structure with a learned discrepancy.

use super::offer::offer;
use crate::data::{Data, Values};
use crate::diagnosis::{DiagnosisVerdict, Outcome};
use crate::learned::learn::WhyNot;
use crate::study::Study;
use structures::measurement::CovariateKind;
use structures::simulator::definition::{CovariateDefinition, DefinitionError, StructureDefinition};
use structures::simulator::Simulator;

/// A structure with a learned discrepancy.
pub struct LearnedExtension {
    /// The new version.
    pub definition: StructureDefinition,
    /// What was added, in words.
    pub added: String,
    /// What was not added, each with the reason: causes, and inputs that are functions of time.
    pub left_out: Vec<String>,
}

/// Why a structure is not extended by a learned discrepancy.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The simulation explains the data.
    #[error("the simulation explains these data: there is no deviation that a discrepancy could be learned from")]
    NothingFound,
    /// A cause may be damage.
    #[error(
        "one of the causes may be damage ({0}): a discrepancy would learn a part of it; inspect the structure first"
    )]
    MaybeDamage(String),
    /// A stiffness changes among the rows.
    #[error("among the rows to learn from {0}: this may be damage, which must not be learned; give measurements of one state")]
    ChangeInTime(String),
    /// The structure has a discrepancy.
    #[error("the structure has a learned discrepancy already: undo that extension, and learn from all data at once")]
    Repeated,
    /// Nothing is gained.
    #[error("the discrepancy does not predict rows that it has not seen: {0}")]
    NoGain(String),
    /// No discrepancy can be learned.
    #[error("no discrepancy is learned: {why}{}", in_brackets(.refused))]
    Not {
        /// The reason.
        why: WhyNot,
        /// Inputs that are functions of time.
        refused: Vec<String>,
    },
    /// The new structure is not valid.
    #[error("the extended structure is refused: {0}")]
    Definition(#[from] DefinitionError),
}

fn in_brackets(inputs: &[String]) -> String {
    if inputs.is_empty() {
        String::new()
    } else {
        format!(" ({})", inputs.join("; "))
    }
}

/// Learns a discrepancy whatever the verdict of a diagnosis is, and adds the offer to the diagnosis unless it has one.
///
/// # Errors
/// [`WhyNot`].
pub fn offer_anyway(simulator: &Simulator, data: &Data, outcome: &mut Outcome) -> Result<(), WhyNot> {
    if outcome.offered.is_some() {
        return Ok(());
    }
    let bare = simulator.without_effects();
    let study = Study::new(&bare, data);
    let offered = offer(&study, &outcome.training, &outcome.holdout, &outcome.before, outcome.everywhere())?;
    outcome.diagnosis.summary = format!("{} {}", outcome.diagnosis.summary, offered.offer.summary);
    outcome.diagnosis.learned = Some(offered.offer.clone());
    outcome.offered = Some(offered);
    Ok(())
}

/// Adds a discrepancy, learned from the rows that were searched for causes, to the structure. The causes of the diagnosis are not
/// added, because the discrepancy contains what they would explain.
///
/// # Errors
/// [`Error`]: where the diagnosis found nothing or possible damage, where a stiffness changes among the rows, where nothing is
/// gained on rows not seen, and where nothing can be learned.
pub fn extend_learned(simulator: &Simulator, data: &Data, outcome: &Outcome) -> Result<LearnedExtension, Error> {
    let diagnosis = &outcome.diagnosis;
    if diagnosis.verdict == DiagnosisVerdict::NothingFound {
        return Err(Error::NothingFound);
    }
    for (place, cause) in diagnosis.causes.iter().enumerate() {
        if cause.class.is_change() || outcome.maybe_damage.get(place).copied().unwrap_or(false) {
            return Err(Error::MaybeDamage(cause.sentence.clone()));
        }
    }
    if simulator.discrepancy().is_some() {
        return Err(Error::Repeated);
    }
    let bare = simulator.without_effects();
    let study = Study::new(&bare, data);
    let everywhere = outcome.everywhere();
    // Otherwise the rows since the change are not among those that are learned from.
    if everywhere.is_some() && diagnosis.lasting_change.is_some() && outcome.set_aside.is_empty() {
        return Err(Error::ChangeInTime("there is a lasting change".to_owned()));
    }
    let offered = offer(&study, &outcome.training, &outcome.holdout, &outcome.before, everywhere);
    let offered = offered.map_err(|why| {
        let chosen = super::input::choose(simulator, data, &outcome.training);
        Error::Not { why, refused: chosen.refused }
    })?;
    if let Some(change) = &offered.offer.change_in_time {
        return Err(Error::ChangeInTime(change.in_words(data.time_unit)));
    }
    if !offered.offer.gain.is_clear() {
        return Err(Error::NoGain(offered.offer.summary));
    }
    let added = match everywhere {
        Some(_) => "a constant discrepancy of each mode".to_owned(),
        None => format!("a learned discrepancy over {}", offered.offer.inputs.join(", ")),
    };
    let mut definition = simulator.definition().clone();
    definition.parent = Some(simulator.digest().to_string());
    let mut learned = offered.learned.discrepancy.definition().clone();
    learned.description = Some(offered.offer.summary);
    for name in learned.inputs.iter().filter_map(|input| input.covariate.as_ref()) {
        if !definition.covariates.iter().any(|c| c.name == *name) {
            let category = data.column(name).is_some_and(|c| matches!(c.values, Values::Categories(..)));
            let kind = if category { CovariateKind::Category } else { CovariateKind::Number };
            definition.covariates.push(CovariateDefinition { name: name.clone(), kind, unit: None, range: None });
        }
    }
    definition.discrepancy = Some(learned);
    Simulator::new(definition.clone())?;
    let causes = diagnosis
        .causes
        .iter()
        .map(|cause| format!("{}: the learned discrepancy contains what it would explain", cause.sentence));
    Ok(LearnedExtension { definition, added, left_out: causes.chain(offered.offer.refused).collect() })
}
