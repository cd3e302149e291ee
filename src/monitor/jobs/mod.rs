//! Diagnoses, extensions and trainings as jobs, outside the queue of assessments.
//!
//! [`Jobs`] is in `runner`; `diagnoses`, `extensions` and `trainings` start the three kinds, and `restart` begins those again that a
//! stop interrupted. `queue` has the order, the progress and the ends by request; `study` and `watch` compute and report.

mod diagnoses;
mod extensions;
mod queue;
mod restart;
mod runner;
mod study;
mod trainings;
mod watch;

pub use self::extensions::ExtensionResult;
pub use self::queue::JobStatus;
pub use self::runner::Jobs;
pub use self::study::{DiagnosisRequest, ExtensionTraining};
pub use self::trainings::{TrainingRequest, TrainingResult};
