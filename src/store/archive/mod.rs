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
//!  {"record":"end", …}                count and SHA-256 of all lines before
//! ```
//!
//! Assessments, charts and alarms are not part of it, because the importing installation computes them again from these data
//! with the same seeds.

mod export;
mod import;
mod record;

pub use export::Archive;
pub use record::{
    Acknowledged, ArchivedModel, Batch, End, Head, Maintenance, Measurement, Record, Structure, Undamaged,
    UndamagedQuantity, Version, FORMAT, NOT_CARRIED,
};
