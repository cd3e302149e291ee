//! Computing the jobs of the service that serves the database: the part of a worker.

use std::convert::Infallible;
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tracing::warn;

use super::halt::Halt;
use super::queue::{Queue, Report};
use super::task::Task;
use crate::baseline::Baseline;
use crate::monitor::events::Events;
use crate::simulator::Simulator;
use crate::store::{Computations, JobClaim, JobResult, Store};

/// Longest time between two renewals of a claim, each of which says what the job is doing.
const BETWEEN_RENEWALS: Duration = Duration::from_secs(1);

/// What a worker has made of a job.
pub(in crate::monitor) enum Worked {
    /// A result, or why there is none.
    Ended(JobResult),
    /// It was cancelled, or claimed by another worker.
    Lost,
    /// The worker is to stop.
    Stopped,
}

/// What a job computes with: itself, the version of the structure, and the trained baseline that it starts from.
pub(in crate::monitor) type Inputs = (Task, Simulator, Option<Arc<Baseline>>);

/// Computes a job until it ends, its claim is lost, or the worker is to stop. The last two take until its next epoch, cell or step. The claim
/// is renewed meanwhile, also while the inputs are read.
///
/// # Errors
/// Those of the inputs.
pub(in crate::monitor) async fn compute<E>(
    store: &Store,
    computations: Computations<'_>,
    claim: &JobClaim,
    inputs: impl Future<Output = Result<Inputs, E>>,
    lease: Duration,
    stopped: &mut watch::Receiver<bool>,
) -> Result<Worked, E> {
    let (id, queue) = (&claim.job.id, Queue::new(Events::default()));
    queue.add(id, &claim.job.structure, claim.job.kind, None);
    let work = async {
        let (task, simulator, before) = inputs.await?;
        Ok(match queue.turn(id).await {
            Ok(()) => task.compute(store, &queue, id, simulator, before).await,
            Err(halt) => Err(halt),
        })
    };
    let outcome = tokio::select! {
        outcome = work => outcome?,
        never = renew(computations, claim, &queue, lease) => match never {},
        never = stop(&queue, stopped) => match never {},
    };
    Ok(match outcome {
        Ok(result) => Worked::Ended(result),
        Err(Halt::Failed(failure)) => Worked::Ended(JobResult { content: Err(failure), weights: None }),
        Err(Halt::Cancelled) => Worked::Lost,
        Err(Halt::Stopping) => Worked::Stopped,
    })
}

/// Renews the claim of a job again and again, and says what it is doing. A job whose claim is lost is cancelled.
async fn renew(computations: Computations<'_>, claim: &JobClaim, queue: &Queue, lease: Duration) -> Infallible {
    let id = &claim.job.id;
    loop {
        tokio::time::sleep(BETWEEN_RENEWALS.min(lease / 4)).await;
        let progress = queue.status(id).map(|status| {
            let report = Report { what: status.progress, share: status.share, time_left_s: status.time_left_s };
            serde_json::to_string(&report).expect("a report is plain data")
        });
        match computations.renew_job(claim, lease, progress).await {
            Ok(true) => {}
            Ok(false) => {
                queue.cancel(id);
            }
            // If the claim was lost meanwhile, the result is refused.
            Err(error) => warn!(job = %id, %error, "Could not renew the claim of the job {id}, trying again: {error}"),
        }
    }
}

/// Ends the job when the worker is to stop, which it is also when nobody can tell it any more.
async fn stop(queue: &Queue, stopped: &mut watch::Receiver<bool>) -> Infallible {
    let _ = stopped.wait_for(|stopped| *stopped).await;
    queue.stop();
    std::future::pending().await
}
