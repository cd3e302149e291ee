//! The errors of the operations of the monitor.

use serde::Serialize;

use super::compute::QueueFull;
use super::readers::TooManyReaders;
use crate::assessment;
use crate::damage;
use crate::quantity::{Digest, StructureId, Timestamp};
use crate::simulator::definition::DefinitionError;
use crate::store;

/// An error that several operations can return.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No such structure.
    #[error("there is no structure {0}")]
    UnknownStructure(StructureId),
    /// No such batch of that structure.
    #[error("structure {structure} has no batch {batch}")]
    UnknownBatch {
        /// The structure.
        structure: StructureId,
        /// The id in the request, as it is shown in messages.
        batch: String,
    },
    /// The structure has no trained baseline in use.
    #[error("structure {structure} has no trained model in use: {reason}")]
    NoModel {
        /// The structure.
        structure: StructureId,
        /// Why, and the next step.
        reason: String,
    },
    /// The version before an extension has no trained baseline.
    #[error(
        "version {version} of structure {structure}, which was in use before the extension, has no trained model, and the extended version \
         stays in use: {reason}"
    )]
    NoEarlierModel {
        /// The structure.
        structure: StructureId,
        /// The version before the extension.
        version: Digest,
        /// Why, and the next step.
        reason: String,
    },
    /// A batch without a current assessment.
    #[error("batch {batch} is not assessed: {reason}")]
    NotAssessed {
        /// The batch.
        batch: String,
        /// Why.
        reason: String,
    },
    /// The queue is full; nothing was stored.
    #[error(transparent)]
    QueueFull(#[from] QueueFull),
    /// Too many computations for readers run or wait.
    #[error(transparent)]
    TooManyReaders(#[from] TooManyReaders),
    /// The structure has batches under another definition.
    #[error("structure {0} has batches that were measured under another definition, or is being deleted; use another id for the new one")]
    StructureInUse(StructureId),
    /// The version of the structure changed during the operation.
    #[error("structure {0} changed to another version in the meantime: nothing was changed")]
    VersionChanged(StructureId),
    /// The present version of the structure is not an extension.
    #[error("structure {0} is not an extension of an earlier version: there is nothing to undo")]
    NoStepBack(StructureId),
    /// An invalid definition.
    #[error("the definition of a structure is refused: {0}")]
    Definition(#[from] DefinitionError),
    /// A stored definition is not valid any more: the database was written by another version of the program.
    #[error(
        "the stored definition of structure {structure} is refused by this version of the program: {reason}; its batches are \
         kept: run the version that wrote it, or define the structure under another id"
    )]
    DefinitionRefused {
        /// The structure.
        structure: StructureId,
        /// Why.
        reason: String,
    },
    /// The database failed.
    #[error(transparent)]
    Store(store::Error),
    /// A computation or a background task panicked, which is a programming error.
    #[error("a task panicked")]
    Panicked,
}

impl From<store::Error> for Error {
    /// What was deleted while it was worked on is unknown, and no failure of the database.
    fn from(error: store::Error) -> Self {
        let parsed = |id: &str| StructureId::parse(id).ok();
        match &error {
            store::Error::UnknownStructure(id) => parsed(id).map(Self::UnknownStructure),
            store::Error::UnknownBatch { structure, batch } => {
                parsed(structure).map(|structure| Self::UnknownBatch { structure, batch: batch.clone() })
            }
            _ => None,
        }
        .unwrap_or(Self::Store(error))
    }
}

/// Why a batch was not accepted.
#[derive(Debug, thiserror::Error)]
pub enum IngestError {
    /// The key was used for other content.
    #[error("the idempotency key was used for batch {batch} with other content")]
    KeyConflict {
        /// The batch stored under that key.
        batch: String,
    },
    /// A measurement of this source and time is already stored in a batch with other content.
    #[error(
        "measurement {ordinal} at {measured_at} of this source is already in batch {batch}, which has other content"
    )]
    MeasurementConflict {
        /// Index in the batch that was sent.
        ordinal: usize,
        /// Its time.
        measured_at: Timestamp,
        /// The batch that contains it.
        batch: String,
    },
    /// Any other error.
    #[error(transparent)]
    Monitor(#[from] Error),
}

/// A batch that cannot be part of the undamaged reference.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[schema(as = LeftOutBatch)]
pub struct LeftOutBatch {
    /// Its id.
    pub batch: String,
    /// Why it cannot be part of the reference.
    pub reason: String,
}

/// Largest number of batches that are named in a sentence.
const MOST_NAMED: usize = 3;

/// The first batches with their reasons, and the number of the others.
fn named(left_out: &[LeftOutBatch]) -> String {
    let mut named: Vec<String> = left_out
        .iter()
        .take(MOST_NAMED)
        .map(|LeftOutBatch { batch, reason }| format!("batch {batch}: {reason}"))
        .collect();
    if left_out.len() > MOST_NAMED {
        named.push(format!("and {} more", left_out.len() - MOST_NAMED));
    }
    named.join("; ")
}

/// Why batches were not declared as the undamaged reference.
#[derive(Debug, thiserror::Error)]
pub enum DeclareError {
    /// A batch is listed twice.
    #[error("batch {0} is listed twice")]
    RepeatedBatch(String),
    /// There is no reference that could be extended.
    #[error("structure {0} has no undamaged reference that could be extended: declare one first")]
    NothingToExtend(StructureId),
    /// No batch is left by which the reference could be extended.
    #[error(
        "undamaged reference {version} is not extended: {}",
        if left_out.is_empty() { "all named batches are already part of it".to_owned() } else { named(left_out) }
    )]
    NothingNew {
        /// Its version.
        version: u32,
        /// The batches that cannot be added.
        left_out: Vec<LeftOutBatch>,
    },
    /// The batches of an extension show a loss.
    #[error(
        "the undamaged reference is not extended, because these batches differ from its first version ({first}): {change} If an \
         inspection found the structure healthy, say so with \"despite_alarms\": true and a \"reason\"; after a repair, declare a new \
         reference"
    )]
    Loss {
        /// The first version of the chain of extensions.
        first: u32,
        /// The change as a sentence.
        change: String,
    },
    /// No batch was measured in the period.
    #[error("no batch was measured from {from} to {to}")]
    EmptyPeriod {
        /// Begin of the period.
        from: Timestamp,
        /// End of the period.
        to: Timestamp,
    },
    /// No undamaged reference can be computed from the batches that can be trusted.
    #[error("{source}{}", if left_out.is_empty() { String::new() } else { format!("; left out: {}", named(left_out)) })]
    Reference {
        /// The cause.
        source: damage::Error,
        /// The batches that were left out before.
        left_out: Vec<LeftOutBatch>,
    },
    /// The assessment of a batch failed.
    #[error("batch {batch} could not be used: {source}")]
    Assess {
        /// The batch.
        batch: String,
        /// The cause.
        source: assessment::Error,
    },
    /// Batches that cannot be trusted cannot be part of the undamaged reference.
    #[error(
        "{} of {batches} batches cannot be part of the undamaged reference: omit them, or let \"leave_out_doubtful\": true leave \
         them out; {}",
        doubtful.len(), named(doubtful)
    )]
    Doubtful {
        /// Number of batches that were declared.
        batches: usize,
        /// Those that cannot be trusted.
        doubtful: Vec<LeftOutBatch>,
    },
    /// Any other error.
    #[error(transparent)]
    Monitor(#[from] Error),
}

impl DeclareError {
    /// The batches that cannot be part of the reference, if there are any.
    pub fn left_out(&self) -> &[LeftOutBatch] {
        match self {
            Self::Reference { left_out, .. } | Self::NothingNew { left_out, .. } => left_out,
            Self::Doubtful { doubtful, .. } => doubtful,
            _ => &[],
        }
    }
}

/// Why a job was not started, not found or not changed.
#[derive(Debug, thiserror::Error)]
pub enum JobError {
    /// No such diagnosis.
    #[error("there is no diagnosis {0}")]
    UnknownDiagnosis(String),
    /// No such training.
    #[error("there is no training {0}")]
    UnknownTraining(String),
    /// No job with this id runs or waits.
    #[error("there is no job {0} that runs or waits")]
    UnknownJob(String),
    /// The job has computed its result.
    #[error("job {0} has ended: its result is being stored")]
    ResultIsStored(String),
    /// As many jobs as possible run or wait.
    #[error("{0} diagnoses, extensions and trainings run or wait, which is the largest number: wait for the end of one, or end one by DELETE /v1/jobs/{{id}}")]
    TooManyJobs(usize),
    /// The job runs already.
    #[error("job {0} runs already: only a job that waits can be moved")]
    NotWaiting(String),
    /// A training of the structure runs or waits.
    #[error("training {training} of structure {structure} runs or waits: wait for its end, or end it by DELETE /v1/jobs/{training}")]
    TrainingRuns {
        /// The structure.
        structure: StructureId,
        /// The training.
        training: String,
    },
    /// A batch is listed twice.
    #[error("batch {0} is listed twice")]
    RepeatedBatch(String),
    /// More measurements than one diagnosis can use.
    #[error("{found} measurements are more than the {most} that one diagnosis can use: name fewer batches")]
    TooManyMeasurements {
        /// Number of measurements of the requested batches.
        found: usize,
        /// Largest number allowed.
        most: usize,
    },
    /// The structure cannot be extended by this diagnosis.
    #[error("the structure cannot be extended by diagnosis {diagnosis}: {reason}")]
    NoExtension {
        /// The diagnosis.
        diagnosis: String,
        /// Why.
        reason: String,
    },
    /// Any other error.
    #[error(transparent)]
    Monitor(#[from] Error),
}

/// Why another trained baseline was not put into use.
#[derive(Debug, thiserror::Error)]
pub enum ReloadError {
    /// The new trained baseline may not replace the one in use.
    #[error("the new trained model for {structure} is refused ({}): {reason}", match kept {
        Some(digest) => format!("the one with digest {digest} stays in use"),
        None => "no other one is in use".to_owned(),
    })]
    Refused {
        /// The structure.
        structure: StructureId,
        /// Why.
        reason: String,
        /// Digest of the one that stays in use.
        kept: Option<String>,
    },
    /// Any other error.
    #[error(transparent)]
    Monitor(#[from] Error),
}

/// Why no backup was made.
#[derive(Debug, thiserror::Error)]
pub enum BackupError {
    /// Another backup is running.
    #[error("another backup is running: request the backup again when it has finished")]
    Running,
    /// The backup failed.
    #[error(transparent)]
    Failed(#[from] store::backup::Error),
    /// Any other error.
    #[error(transparent)]
    Monitor(#[from] Error),
}

macro_rules! from_store {
    ($($error:ident),+) => {$(
        impl From<store::Error> for $error {
            fn from(error: store::Error) -> Self {
                Self::Monitor(error.into())
            }
        }
    )+};
}

/// Why a structure was not deleted.
#[derive(Debug, thiserror::Error)]
pub enum DeleteError {
    /// Jobs of it run or wait.
    #[error("structure {structure} has jobs that run or wait: cancel them first by DELETE /v1/jobs/{{id}}: {}", .jobs.join(", "))]
    HasJobs {
        /// The structure.
        structure: StructureId,
        /// Their ids.
        jobs: Vec<String>,
    },
    /// Any other reason.
    #[error(transparent)]
    Monitor(#[from] Error),
}

from_store!(IngestError, DeclareError, JobError, ReloadError, DeleteError);
