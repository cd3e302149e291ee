//! The data folder: creating it, its permissions, and its lock.

use std::fs::{File, TryLockError};
use std::path::Path;

use super::super::error::Error;

/// Name of the database inside the data folder.
pub const DATABASE_FILE: &str = "modalwatch.sqlite";
const LOCK_FILE: &str = "modalwatch.lock";

/// Creates the folder and the database file, checks their permissions, and takes the lock of the folder.
pub(in super::super) fn prepare_folder(data_dir: &Path, database: &Path) -> Result<File, Error> {
    std::fs::create_dir_all(data_dir).map_err(failed(data_dir))?;
    // Checks the permission bits instead of trying to write, because root can write to read-only files.
    for path in [data_dir, database] {
        if path.exists() && std::fs::metadata(path).map_err(failed(path))?.permissions().readonly() {
            return Err(Error::ReadOnly(path.to_owned()));
        }
    }
    make_private(database).map_err(failed(database))?;
    take_lock(data_dir)
}

/// Takes the lock of an existing folder.
pub(in super::super) fn take_lock(data_dir: &Path) -> Result<File, Error> {
    let lock_path = data_dir.join(LOCK_FILE);
    let lock = File::options().create(true).truncate(false).write(true).open(&lock_path).map_err(failed(&lock_path))?;
    match lock.try_lock() {
        Ok(()) => Ok(lock),
        Err(TryLockError::WouldBlock) => Err(Error::Locked(data_dir.to_owned())),
        Err(TryLockError::Error(source)) => Err(Error::Folder { path: lock_path, source }),
    }
}

fn failed(path: &Path) -> impl FnOnce(std::io::Error) -> Error + use<'_> {
    |source| Error::Folder { path: path.to_owned(), source }
}

/// Creates the database file if it is missing, accessible to its owner only, because it contains the secrets of webhooks.
/// SQLite gives its log files the same permissions.
fn make_private(database: &Path) -> std::io::Result<()> {
    let mut options = File::options();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    match options.open(database) {
        Err(error) if error.kind() != std::io::ErrorKind::AlreadyExists => Err(error),
        _ => Ok(()),
    }
}
