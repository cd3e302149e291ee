//! What a job computes, and its result, as texts: so that a worker in another process can compute it.
//!
//! The result is the same, bit for bit, as in the service, for the very same program. A model comes back as its two files, which are checked
//! by digest and self-test when they are read.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::halt::{computed, Halt};
use super::queue::Queue;
use super::study::{read_study, train_model, DiagnosisRequest, ExtensionTraining, TrainedExtension};
use crate::baseline::recipe::RecipeRequest;
use crate::baseline::train::Trained;
use crate::baseline::Baseline;
use crate::quantity::Digest;
use crate::simulator::Simulator;
use crate::store::{JobResult, Store};

/// What a job computes. Whatever else it needs is in the database.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(in crate::monitor) enum Task {
    /// A diagnosis.
    Diagnosis {
        /// The version of the structure.
        version: Digest,
        /// The measurements.
        request: DiagnosisRequest,
    },
    /// A training.
    Training {
        /// The version of the structure.
        version: Digest,
        /// How it is trained.
        recipe: RecipeRequest,
    },
    /// An extension by a diagnosis.
    Extension {
        /// The version of the structure that is extended.
        version: Digest,
        /// The measurements of the diagnosis.
        request: DiagnosisRequest,
        /// How it is trained.
        training: ExtensionTraining,
        /// The trained baseline in use, from whose weights the training starts.
        before: Option<Digest>,
    },
}

/// A result as JSON; the weights of a model are beside it.
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum Carried {
    Diagnosis { diagnosis: String, report: Option<String> },
    Training { manifest: String },
    Extension { manifest: String, definition: String, added: Vec<String>, left_out: Vec<String> },
}

impl Task {
    /// The version of the structure that it needs.
    pub(in crate::monitor) const fn version(&self) -> &Digest {
        match self {
            Self::Diagnosis { version, .. } | Self::Training { version, .. } | Self::Extension { version, .. } => {
                version
            }
        }
    }

    /// The trained baseline that it needs.
    pub(in crate::monitor) const fn before(&self) -> Option<&Digest> {
        match self {
            Self::Extension { before, .. } => before.as_ref(),
            _ => None,
        }
    }

    /// Computes it in a worker, with the version of the structure and the trained baseline that it needs. `queue` has the job.
    ///
    /// # Errors
    /// [`Halt`].
    pub(super) async fn compute(
        self,
        store: &Store,
        queue: &Queue,
        id: &str,
        simulator: Simulator,
        before: Option<Arc<Baseline>>,
    ) -> Result<JobResult, Halt> {
        let structure = simulator.id().clone();
        let study = |request| read_study(store, queue, id.to_owned(), &structure, simulator.clone(), request);
        match self {
            Self::Diagnosis { request, .. } => {
                let study = study(request).await?;
                let (diagnosis, report) = computed("diagnosis", move || study.diagnose()).await?;
                Ok(carried(&Carried::Diagnosis { diagnosis, report }, None))
            }
            Self::Training { recipe, .. } => {
                let (queue, id, recipe) = (queue.clone(), id.to_owned(), recipe.recipe(&simulator));
                let work = move || train_model(&queue, &id, &simulator, &recipe);
                let Trained { manifest_json, weights, .. } = computed("training", work).await?;
                Ok(carried(&Carried::Training { manifest: text(manifest_json)? }, Some(weights)))
            }
            Self::Extension { request, training, .. } => {
                let study = study(request).await?;
                let work = move || study.extend(before.as_deref(), training);
                let TrainedExtension { added, left_out, simulator, trained } = computed("extension", work).await?;
                let (manifest, definition) = (text(trained.manifest_json)?, simulator.definition().canonical_json());
                Ok(carried(&Carried::Extension { manifest, definition, added, left_out }, Some(trained.weights)))
            }
        }
    }
}

fn carried(carried: &Carried, weights: Option<Vec<u8>>) -> JobResult {
    JobResult { content: Ok(serde_json::to_string(carried).expect("a result is plain data")), weights }
}

fn text(manifest: Vec<u8>) -> Result<String, Halt> {
    String::from_utf8(manifest).map_err(|error| Halt::Failed(format!("a manifest is not UTF-8: {error}")))
}

/// The diagnosis that a worker has delivered, as JSON, and its report as HTML.
///
/// # Errors
/// [`Halt::Failed`] with the failure of the job, or because the result cannot be read.
pub(super) fn delivered_diagnosis(result: JobResult) -> Result<(String, Option<String>), Halt> {
    match read(result)? {
        (Carried::Diagnosis { diagnosis, report }, _) => Ok((diagnosis, report)),
        _ => Err(of_another_kind()),
    }
}

/// The model that a worker has trained for a structure.
///
/// # Errors
/// As [`delivered_diagnosis`].
pub(super) async fn delivered_training(result: JobResult, simulator: Simulator) -> Result<Trained, Halt> {
    let (Carried::Training { manifest }, weights) = read(result)? else { return Err(of_another_kind()) };
    computed("reading of a model", move || loaded(manifest, weights, &simulator)).await
}

/// The extension that a worker has trained.
///
/// # Errors
/// As [`delivered_diagnosis`].
pub(super) async fn delivered_extension(result: JobResult) -> Result<TrainedExtension, Halt> {
    let (Carried::Extension { manifest, definition, added, left_out }, weights) = read(result)? else {
        return Err(of_another_kind());
    };
    let work = move || {
        let simulator = Simulator::parse_json(&definition).map_err(|e| unreadable(&e))?;
        let trained = loaded(manifest, weights, &simulator)?;
        Ok(TrainedExtension { added, left_out, simulator, trained })
    };
    computed("reading of a model", work).await
}

fn read(result: JobResult) -> Result<(Carried, Vec<u8>), Halt> {
    let content = result.content.map_err(Halt::Failed)?;
    let carried = serde_json::from_str(&content).map_err(|e| Halt::Failed(unreadable(&e)))?;
    Ok((carried, result.weights.unwrap_or_default()))
}

fn loaded(manifest: String, weights: Vec<u8>, simulator: &Simulator) -> Result<Trained, String> {
    let manifest_json = manifest.into_bytes();
    let baseline = Baseline::load(&manifest_json, &weights, simulator).map_err(|e| unreadable(&e))?;
    Ok(Trained { baseline, manifest_json, weights })
}

fn unreadable(error: &dyn std::fmt::Display) -> String {
    format!("what a worker has computed cannot be read: {error}")
}

fn of_another_kind() -> Halt {
    Halt::Failed("a worker has delivered the result of another kind of job".to_owned())
}
