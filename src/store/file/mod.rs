//! The SQLite file: its folder and lock, its identity, how it is opened, and its limits.

mod folder;
mod identity;
mod opening;
mod schema;
mod settings;

pub(super) use folder::{prepare_folder, take_lock};
pub use folder::{BACKUP_FOLDER, DATABASE_FILE};
#[cfg(test)]
pub(super) use identity::APPLICATION_ID;
pub(super) use identity::{refuse_foreign, OpenedFile};
pub use opening::schema_version;
pub(super) use opening::{check_version, library_version, open, Opened};
pub(super) use schema::{foreign_objects, triggers};
pub(super) use settings::Limits;
pub use settings::StoreSettings;
