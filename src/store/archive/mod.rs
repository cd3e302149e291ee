//! The archive of a structure: its data as lines of JSON, to be imported by another installation.
//!
//! ```text
//!  {"record":"archive", …}            what the archive contains, and what it does not
//!  {"record":"structure", …}          its present definition
//!  {"record":"version", …}            earlier versions of it
//!  {"record":"model", …}              trained baselines for it
//!  {"record":"batch", …}              batches with measurements, in the order of arrival
//!  {"record":"undamaged_state", …}
//!  {"record":"maintenance", …}
//!  {"record":"acknowledgement", …}
//!  {"record":"alarm_action", …}      comments, assignees, closings and reopenings, in their order
//!  {"record":"note", …}              notes on the time line
//!  {"record":"end", …}                count and SHA-256 of all lines before
//! ```
//!
//! The first line states the version of the format: 4; 3 for archives that do not state with which token a batch was posted, 2 for those that do
//! not state what it was compared with, and 1 for those without actions and notes are read as well.
//!
//! Assessments, charts and alarms are not part of it, because the importing installation computes them again from these data
//! with the same seeds. Each batch is compared with the undamaged references that it was compared with.

mod export;
mod import;
mod people;
mod record;
mod undamaged;

pub use export::Archive;
pub use import::{Checked, CheckedBatch, Stored};
pub use people::ImportedActions;
pub use record::{
    Acknowledged, ArchivedAction, ArchivedModel, ArchivedNote, Batch, End, Head, Maintenance, Measurement, Record,
    Structure, Undamaged, UndamagedQuantity, Version, FORMAT, NOT_CARRIED,
};
