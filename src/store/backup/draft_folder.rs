//! Temporary folders of unfinished backups.
//!
//! Each holds a lock as long as its program runs. A folder whose lock is free was left behind by a program that was killed; the next backup
//! beside it removes it.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use tempfile::TempDir;

use crate::private;

/// Beginnings of the names of temporary folders of backups and restorations.
const PREFIXES: [&str; 2] = [".draft-", ".restore-"];

const LOCK_FILE: &str = ".lock";

/// A temporary folder, which is removed when this is dropped.
pub struct DraftFolder {
    folder: TempDir,
    _lock: File,
}

impl DraftFolder {
    /// Creates a folder in `parent` for its owner only, after removing what killed programs have left there.
    ///
    /// # Errors
    /// The error of the operating system.
    pub fn create(parent: &Path) -> io::Result<Self> {
        for left in left_behind(parent) {
            match fs::remove_dir_all(&left) {
                Ok(()) => tracing::info!("Removed what a broken-off backup has left: {}", left.display()),
                Err(error) => {
                    tracing::warn!(%error, "Could not remove what a broken-off backup has left: {}: {error}", left.display());
                }
            }
        }
        let folder = private::temporary_folder(PREFIXES[0], parent)?;
        let lock =
            private::open(File::options().create(true).truncate(false).write(true), &folder.path().join(LOCK_FILE))?;
        lock.lock()?;
        Ok(Self { folder, _lock: lock })
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Keeps the folder, to be renamed, without its lock.
    ///
    /// # Errors
    /// The error of the operating system.
    pub fn keep(self) -> io::Result<PathBuf> {
        fs::remove_file(self.folder.path().join(LOCK_FILE))?;
        Ok(self.folder.keep())
    }
}

/// Temporary folders in a folder that no running program uses. Those of versions without locks count, too.
pub fn left_behind(parent: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(parent).into_iter().flatten().flatten();
    let is_draft = |name: &str| PREFIXES.iter().any(|prefix| name.starts_with(prefix));
    entries
        .filter(|entry| {
            entry.file_type().is_ok_and(|kind| kind.is_dir()) && is_draft(&entry.file_name().to_string_lossy())
        })
        .map(|entry| entry.path())
        .filter(|path| !is_held(path))
        .collect()
}

/// Whether a running program uses a temporary folder. One without a lock may be just being created.
fn is_held(folder: &Path) -> bool {
    if let Ok(lock) = File::open(folder.join(LOCK_FILE)) {
        return matches!(lock.try_lock(), Err(TryLockError::WouldBlock));
    }
    let age = fs::metadata(folder).and_then(|folder| folder.modified()).map(|at| at.elapsed().unwrap_or_default());
    age.is_ok_and(|age| age.as_secs() < 60)
}
