//! From the measurements of one batch to its assessment: pure functions of data, trained baseline, undamaged reference and seed,
//! so that the service and the command line agree to the bit.
//!
//! ```text
//!  measurements ─ admission ─► observations ─ samples ─► posterior samples ─ population ─► hyperparameters
//!  hyperparameters, undamaged reference ─ comparison ─► assessment ─ chart_points ─► points on the alarm charts
//! ```
//!
//! Nothing here reads a clock or a database: the time of an assessment is passed in.

mod admission;
mod batch_mean;
mod beyond_prior;
mod carried;
mod chart_points;
mod comparison;
mod conditions;
mod dependence;
mod detail;
mod estimate;
mod healthy;
mod misfit;
mod narrow;
mod population;
mod quantities;
mod reference;
mod result;
mod samples;
mod usual_misfit;
mod wrong_values;

pub use chart_points::{chart_points, ChartRules, KnownLimits, NewChartPoint, NewCharts, NewProcessPoint};
pub use comparison::assess;
pub use detail::{detail, BatchDetail, ModeDetail, ParameterDetail};
pub use quantities::monitored_quantities;
pub use reference::{undamaged_reference, DoubtfulBatch, ReferenceBatches, ReferenceError};
pub use result::{Assessment, BatchState};
pub use samples::{draw, BatchSamples, Context, Draws, Earlier, Error};
