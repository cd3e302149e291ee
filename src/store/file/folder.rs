//! The data folder: creating it, its permissions, and its lock.

use std::fs::{File, TryLockError};
use std::path::Path;

use tracing::{info, warn};

use super::super::error::Error;
use crate::private;

/// Name of the database inside the data folder.
pub const DATABASE_FILE: &str = "modalwatch.sqlite";
const LOCK_FILE: &str = "modalwatch.lock";

/// Name of the folder of backups inside the data folder.
pub const BACKUP_FOLDER: &str = "backups";

/// Beginnings of the names of temporary folders of backups and restorations, which a killed program leaves behind.
const DRAFTS: [&str; 2] = [".draft-", ".restore-"];

/// Creates the folder and the database file, checks their permissions, and takes the lock of the folder.
pub(in super::super) fn prepare_folder(data_dir: &Path, database: &Path) -> Result<File, Error> {
    private::create_folder(data_dir).map_err(failed(data_dir))?;
    // Checks the permission bits instead of trying to write, because root can write to read-only files.
    for path in [data_dir, database] {
        if path.exists() && std::fs::metadata(path).map_err(failed(path))?.permissions().readonly() {
            return Err(Error::ReadOnly(path.to_owned()));
        }
    }
    create_database(database).map_err(failed(database))?;
    let lock = take_lock(data_dir)?;
    remove_drafts(data_dir)?;
    keep_private(data_dir)?;
    Ok(lock)
}

/// Takes the lock of an existing folder.
pub(in super::super) fn take_lock(data_dir: &Path) -> Result<File, Error> {
    let lock_path = data_dir.join(LOCK_FILE);
    let mut options = File::options();
    let lock =
        private::open(options.create(true).truncate(false).write(true), &lock_path).map_err(failed(&lock_path))?;
    match lock.try_lock() {
        Ok(()) => Ok(lock),
        Err(TryLockError::WouldBlock) => Err(Error::Locked(data_dir.to_owned())),
        Err(TryLockError::Error(source)) => Err(Error::Folder { path: lock_path, source }),
    }
}

/// Creates the database file if it is missing; SQLite gives its log files the same permissions. A file that exists is not opened: closing
/// it again would release the locks that SQLite holds on it in this process.
fn create_database(database: &Path) -> std::io::Result<()> {
    match private::open(File::options().write(true).create_new(true), database) {
        Err(error) if error.kind() != std::io::ErrorKind::AlreadyExists => Err(error),
        _ => Ok(()),
    }
}

fn failed(path: &Path) -> impl FnOnce(std::io::Error) -> Error + use<'_> {
    |source| Error::Folder { path: path.to_owned(), source }
}

/// Takes what this program has written to the folder from everybody but its owner: earlier versions left that to the mask of the process.
fn keep_private(data_dir: &Path) -> Result<(), Error> {
    private::narrow(&data_dir.join(BACKUP_FOLDER)).map_err(failed(data_dir))?;
    for entry in std::fs::read_dir(data_dir).map_err(failed(data_dir))? {
        let path = entry.map_err(failed(data_dir))?.path();
        // The database, its log files, the lock, and databases kept aside by a restoration.
        let ours = path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("modalwatch."));
        if ours && path.is_file() {
            private::narrow(&path).map_err(failed(&path))?;
        }
    }
    Ok(())
}

/// Removes what broken-off backups and restorations have left. The lock of the folder is held, so none of them is being made. What cannot
/// be removed, because another user has made it, stays.
fn remove_drafts(data_dir: &Path) -> Result<(), Error> {
    for folder in [data_dir.to_owned(), data_dir.join(BACKUP_FOLDER)] {
        if !folder.is_dir() {
            continue;
        }
        for entry in std::fs::read_dir(&folder).map_err(failed(&folder))? {
            let entry = entry.map_err(failed(&folder))?;
            let (name, path) = (entry.file_name().to_string_lossy().into_owned(), entry.path());
            let is_folder = entry.file_type().is_ok_and(|kind| kind.is_dir());
            if !is_folder || !DRAFTS.iter().any(|draft| name.starts_with(draft)) {
                continue;
            }
            let shown = path.display();
            match std::fs::remove_dir_all(&path) {
                Ok(()) => info!(folder = %shown, "Removed what a broken-off backup has left: {shown}"),
                Err(error) => {
                    warn!(folder = %shown, %error, "Could not remove what a broken-off backup has left: {shown}: {error}");
                }
            }
        }
    }
    Ok(())
}
