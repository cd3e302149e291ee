//! The manifest of a backup, and the names of backups.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::error::Error;
use crate::quantity::Timestamp;

/// Name of the manifest inside a backup.
pub const MANIFEST_FILE: &str = "manifest.json";
pub use super::super::file::BACKUP_FOLDER as FOLDER;
/// Version of the format.
pub(super) const FORMAT: u32 = 1;
/// The manifest of a backup.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = BackupManifest)]
pub struct Manifest {
    /// Version of the format of the manifest.
    pub format: u32,
    /// Name of the backup, which is that of its folder.
    pub name: String,
    /// When it was made, RFC 3339.
    pub created_at: String,
    /// Version of the program that made it.
    pub program_version: String,
    /// Schema version of the database.
    pub schema_version: i64,
    /// File name of the copy.
    pub database: String,
    /// Size of the copy, bytes.
    pub bytes: u64,
    /// SHA-256 of the copy.
    pub sha256: String,
    /// Number of rows of each table.
    pub rows: BTreeMap<String, u64>,
    /// Trained baselines that the stored data depend on.
    pub models: Vec<BackupModel>,
    /// Whether the secrets of webhooks are in the copy. Without them its webhooks are disabled and need new ones. Backups of versions that
    /// did not state it have them.
    #[serde(default = "yes")]
    pub with_secrets: bool,
}

fn yes() -> bool {
    true
}

/// A trained baseline.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = BackupModel)]
pub struct BackupModel {
    /// Structure it was trained for.
    pub structure: String,
    /// Its digest.
    pub digest: String,
    /// `database` if it is in the backup; `program` if it is part of every modalwatch of that version; otherwise its file in a
    /// models folder, which is not in the backup.
    pub kept_in: String,
}

/// Checks the name of a backup, which becomes the name of a folder.
///
/// # Errors
/// [`Error::Name`].
pub fn check_name(name: &str) -> Result<(), Error> {
    let starts_well = name.chars().next().is_some_and(|c| c.is_ascii_alphanumeric());
    let allowed = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    if starts_well && name.len() <= 64 && name.chars().all(allowed) {
        Ok(())
    } else {
        Err(Error::Name(crate::quantity::shown(name)))
    }
}

/// The name of a backup made at a time, such as `2026-03-01T12-00-00.123456Z`.
pub fn name_of(at: Timestamp) -> String {
    at.to_string().replace(':', "-")
}

/// Reads the manifest of a backup.
///
/// # Errors
/// [`Error::Manifest`].
pub fn read_manifest(backup: &Path) -> Result<Manifest, Error> {
    let path = backup.join(MANIFEST_FILE);
    let wrong = |reason: String| Error::Manifest { path: path.clone(), reason };
    let text = fs::read(&path).map_err(|e| wrong(e.to_string()))?;
    let manifest: Manifest = serde_json::from_slice(&text).map_err(|e| wrong(e.to_string()))?;
    if manifest.format != FORMAT {
        return Err(wrong(format!("it has format {}, but this program reads format {FORMAT}", manifest.format)));
    }
    // The name was read from a file. It must not lead out of the folder of the backup.
    if Path::new(&manifest.database).file_name() != Some(std::ffi::OsStr::new(&manifest.database)) {
        return Err(wrong(format!("{} is not a file name", crate::quantity::shown(&manifest.database))));
    }
    Ok(manifest)
}
