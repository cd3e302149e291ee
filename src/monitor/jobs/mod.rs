//! Diagnoses, extensions and trainings as jobs, outside the queue of assessments.
//!
//! [`Jobs`] is in `runner`; `diagnoses`, `extensions` and `trainings` start the three kinds, and `restart` begins those again that a
//! stop interrupted. `queue` has the order, the progress and the ends by request, `halt` what ends a computation; `study` and `watch` compute and report. `by_worker` leaves
//! what a job computes to a worker, `at_worker` computes it there, and `task` has what goes between the two.

mod at_worker;
mod by_worker;
mod diagnoses;
mod extensions;
mod halt;
mod queue;
mod restart;
mod runner;
mod study;
mod task;
mod trainings;
mod watch;

pub(super) use self::at_worker::{compute, Worked};
pub use self::extensions::ExtensionResult;
pub use self::queue::JobStatus;
pub use self::runner::Jobs;
pub use self::study::{DiagnosisRequest, ExtensionTraining};
pub(super) use self::task::Task;
pub(super) use self::trainings::answer_at_once;
pub use self::trainings::{TrainingRequest, TrainingResult};
