//! The jobs of a worker: diagnoses, trainings and extensions that the service which serves the database leaves to it.

use tokio::sync::watch;
use tracing::{info, warn};

use super::models::Missing;
use super::{patiently, Ended, Inner, Worker};
use crate::monitor::jobs::{compute, Task, Worked};
use crate::store::{Computations, JobClaim};

impl Worker {
    /// Computes a job that was claimed, until it ends or is lost, or the worker is to stop.
    pub(super) async fn work_at_job(
        &self,
        computations: Computations<'_>,
        claim: &JobClaim,
        stopped: &mut watch::Receiver<bool>,
    ) {
        let (id, structure, state) = (&claim.job.id, &claim.job.structure, &self.inner.state);
        info!(structure.id = %structure, job = %id, "Computing the job {id} of {structure}");
        state.works_at(Some(structure));
        let ended = self.compute(computations, claim, stopped).await;
        state.works_at(None);
        let given_back = match ended {
            Some(Ended::Complete) => return,
            Some(Ended::Lost) => {
                metrics::counter!("modalwatch_computations_lost_total").increment(1);
                warn!(structure.id = %structure, job = %id, "The job {id} of {structure} was cancelled, or lost to another worker");
                return;
            }
            Some(Ended::Lacking) => {
                state.leaves(id);
                computations.release_job(claim).await
            }
            Some(Ended::Failed(error)) => {
                warn!(structure.id = %structure, job = %id, %error, "Gave back the job {id} of {structure}: {error}");
                computations.release_job(claim).await
            }
            None => computations.release_job(claim).await,
        };
        if let Err(error) = given_back {
            warn!(job = %id, %error, "Could not give back the job {id}, whose lease will end by itself: {error}");
        }
    }

    /// Computes a job and delivers its result; `None` if the worker is to stop.
    async fn compute(
        &self,
        computations: Computations<'_>,
        claim: &JobClaim,
        stopped: &mut watch::Receiver<bool>,
    ) -> Option<Ended> {
        let Inner { store, models, lease, state, .. } = &*self.inner;
        let (id, structure) = (&claim.job.id, &claim.job.structure);
        let inputs = async {
            let task: Task = serde_json::from_str(&claim.job.task)
                .map_err(|error| Missing::Absent(format!("it cannot be read: {error}")))?;
            let before = match task.before() {
                Some(model) => Some(models.find(structure, task.version(), model).await?),
                None => None,
            };
            let simulator = models.version(structure, task.version()).await?;
            Ok((task, simulator, before))
        };
        let worked = match compute(store, computations, claim, inputs, *lease, stopped).await {
            Ok(worked) => worked,
            Err(Missing::Absent(reason)) => {
                warn!(structure.id = %structure, job = %id, "The job {id} of {structure} is left to others: {reason}");
                return Some(Ended::Lacking);
            }
            Err(Missing::Store(error)) => return Some(Ended::Failed(error)),
        };
        match worked {
            Worked::Ended(result) => match patiently(|| computations.deliver_job(claim, &result)).await {
                Ok(true) => {
                    state.delivered(1);
                    Some(Ended::Complete)
                }
                Ok(false) => Some(Ended::Lost),
                Err(error) => Some(Ended::Failed(error)),
            },
            Worked::Lost => Some(Ended::Lost),
            Worked::Stopped => None,
        }
    }
}
