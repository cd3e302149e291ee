//! Backups: a complete copy of the database with a manifest, and restoring it.
//!
//! ```text
//!  DIR/modalwatch.sqlite     the copy, made by VACUUM INTO: a single file without a log
//!  DIR/manifest.json         schema, program version, row counts, SHA-256 of the copy, digests of the trained baselines
//! ```
//!
//! The secrets of webhooks are left out unless they are asked for: the webhooks of the copy are disabled and have none.
//!
//! The folder receives its name only after the copy was checked and synced to disk. The copy is made by a connection that only
//! reads, so that batches are accepted in the meantime; it contains the data that were stored when it began.

mod copy;
mod draft;
mod draft_folder;
mod error;
mod manifest;
mod restore;

pub use copy::verify;
pub use draft::{of_folder, Content};
pub use draft_folder::{left_behind, DraftFolder};
pub use error::Error;
pub use manifest::{check_name, name_of, read_manifest, BackupModel, Manifest, FOLDER, MANIFEST_FILE};
pub use restore::{restore, Restored};
