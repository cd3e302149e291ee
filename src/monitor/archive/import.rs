//! Import of a structure from an archive.

use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::Arc;

use serde::Serialize;
use tokio::sync::mpsc::channel;

use super::check::Checker;
use super::error::ImportError;
use super::lines::{check_whole, each_line};
use crate::baseline::Baseline;
use crate::monitor::assessor::Assessor;
use crate::monitor::error::Error;
use crate::monitor::replay::Replay;
use crate::quantity::{Digest, StructureId};
use crate::simulator::Simulator;
use crate::store::archive::{Head, ImportedActions, Record, Stored};

/// Lines buffered between the file and the store.
const BUFFERED: usize = 64;

/// The result of an import.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Imported {
    /// The structure.
    pub structure: StructureId,
    /// Versions that were new.
    pub versions: u64,
    /// Trained baselines that were new.
    pub models: u64,
    /// All batches of the archive.
    pub batches: u64,
    /// Batches of the archive that were not stored before.
    pub batches_new: u64,
    /// Undamaged references that were new.
    pub undamaged_states: u64,
    /// Maintenance windows that were new.
    pub maintenance_windows: u64,
    /// Acknowledgements whose alarm exists and was not acknowledged before.
    pub acknowledgements: u64,
    /// Comments, assignments, closings and reopenings of alarms that were new.
    pub alarm_actions: u64,
    /// Notes that were new.
    pub notes: u64,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

/// Imports an archive: checks all of it, stores it in one transaction, and assesses its batches.
pub(super) async fn import(assessor: &Assessor, replay: &Replay, path: &Path) -> Result<Imported, ImportError> {
    let file = path.to_owned();
    let checked = tokio::task::spawn_blocking(move || {
        let mut checker: Option<Checker> = None;
        let head = check_whole(&file, |head, record| {
            let checker = checker.get_or_insert_with(|| Checker::new(head.structure.clone()));
            if let Record::Model(model) = &record {
                checker.check_model(model)?;
            }
            checker.check(record).map(drop)
        })?;
        let checker = checker.unwrap_or_else(|| Checker::new(head.structure.clone()));
        Ok::<_, ImportError>((head, checker.into_present()?))
    });
    let (head, simulator) = checked.await.map_err(|_| Error::Panicked)??;
    let stored = store(assessor, path, &head).await?;
    let mut warnings = Vec::new();
    if head.settings != assessor.settings.of_answers() {
        warnings.push(format!(
            "the archive was written with settings that differ from those of this service ({}): assessments may differ",
            head.settings
        ));
    }
    // All of the archive is stored now, which an error would deny.
    let actions = assess(assessor, replay, simulator, &mut warnings).await.unwrap_or_else(|failure| {
        warnings.push(format!(
            "everything is stored, but batches wait for their assessment, with which the next start of the service goes on: {failure}"
        ));
        ImportedActions::default()
    });
    Ok(Imported {
        structure: head.structure,
        versions: stored.versions,
        models: stored.models,
        batches: stored.batches,
        batches_new: stored.batches_new,
        undamaged_states: stored.undamaged_states,
        maintenance_windows: stored.maintenance_windows,
        acknowledgements: actions.acknowledgements,
        alarm_actions: actions.actions,
        notes: stored.notes,
        warnings,
    })
}

/// Stores the records of a checked archive in one transaction.
async fn store(assessor: &Assessor, path: &Path, head: &Head) -> Result<Stored, ImportError> {
    // A separate thread reads the lines, so that a large file neither fills the memory nor blocks an async thread.
    let (sender, lines) = channel(BUFFERED);
    let (file, structure) = (path.to_owned(), head.structure.clone());
    let reader = tokio::task::spawn_blocking(move || {
        let mut checker = Checker::new(structure);
        each_line(&file, |number, record| {
            let checked = checker.check(record).map_err(|error| error.at_line(number))?;
            sender.blocking_send((number, checked)).map_err(|_| stopped(number))
        })
    });
    let library = assessor.structures.library();
    let in_library = library.get(&head.structure).and_then(|entry| entry.baseline.as_ref());
    let known_model = in_library.map(|baseline| baseline.digest().clone());
    let line = Arc::new(AtomicU64::new(0));
    let stored = assessor.store.archive().import(&head.structure, known_model, lines, Arc::clone(&line)).await;
    let read = reader.await.map_err(|_| Error::Panicked)?;
    match (stored, read) {
        (Ok(stored), _) => Ok(stored),
        // The file has changed since it was checked.
        (Err(_), Err(read @ (ImportError::File { .. } | ImportError::NotWhole(_)))) => Err(read),
        (Err(error), _) => Err(ImportError::from(error).at_line(line.load(Ordering::Relaxed))),
    }
}

/// The error that ends the reading thread when the import has stopped.
fn stopped(line: u64) -> ImportError {
    ImportError::Line { line, reason: "the import was stopped".to_owned() }
}

/// Assesses the batches with the imported trained model, and stores what people did with the alarms that this raises.
async fn assess(
    assessor: &Assessor,
    replay: &Replay,
    simulator: Simulator,
    warnings: &mut Vec<String>,
) -> Result<ImportedActions, ImportError> {
    let structure = simulator.id().clone();
    let baseline = assessor.structures.baseline_for(&simulator).await?;
    if let Err(reason) = &baseline {
        warnings.push(format!("batches wait for their assessment: {reason}"));
    }
    let in_use: Option<Digest> = baseline.as_ref().ok().map(|baseline: &Arc<Baseline>| baseline.digest().clone());
    assessor.structures.activate(simulator, baseline);
    if let Some(in_use) = in_use {
        if let Some(state) = assessor.store.reference().undamaged(&structure).await? {
            if in_use != state.model_digest {
                warnings.push(format!(
                    "the undamaged reference {} was made with the trained model {}, which is not in use here: batches are not \
                     compared with it",
                    state.state.version, state.model_digest
                ));
            }
        }
        let batches = assessor.store.reference().keep_none_of_other_models(&structure, &in_use).await?;
        if batches > 0 {
            warnings.push(format!(
                "{batches} batches were compared with an undamaged reference of another trained baseline, which is not in use here: \
                 they are not compared with it"
            ));
        }
    }
    let actions = replay.resume(&structure).await?;
    if actions.without_alarm > 0 {
        warnings.push(format!(
            "{} comments and other actions have no alarm here: alarms are computed again on import",
            actions.without_alarm
        ));
    }
    Ok(actions)
}
