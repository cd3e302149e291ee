//! Restoring a backup.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use sqlx::Connection as _;
use sqlx_sqlite::{SqliteConnectOptions, SqliteConnection};

use super::super::error::Error as StoreError;
use super::super::file::{take_lock, DATABASE_FILE};
use super::copy::{check_copy, sync_folder, verify};
use super::error::{at, Error};
use super::manifest::{name_of, Manifest};
use crate::private;
use crate::quantity::Timestamp;
use crate::volume;

/// The result of a restore.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Restored {
    /// The manifest of the backup.
    pub manifest: Manifest,
    /// New path of the database that was replaced.
    pub kept_aside: Option<PathBuf>,
    /// Webhooks that are disabled because the backup has no secrets.
    pub webhooks_without_secret: u64,
}

/// Copies the database of a backup into a data folder that no service has open. If it fails, the folder keeps its database.
///
/// With `replace`, an existing database is kept beside the new one under a name with the time `now`.
///
/// # Errors
/// [`Error::NotEmpty`] without `replace`; [`Error::Damaged`], [`Error::TooNew`]; [`StoreError::Locked`].
pub async fn restore(backup: &Path, data_dir: &Path, replace: bool, now: Timestamp) -> Result<Restored, Error> {
    let manifest = verify(backup).await?;
    private::create_folder(data_dir).map_err(at(data_dir))?;
    let _lock = take_lock(data_dir)?;
    let database = data_dir.join(DATABASE_FILE);
    let there = fs::metadata(&database).is_ok_and(|file| file.len() > 0);
    if there && !replace {
        return Err(Error::NotEmpty(data_dir.to_owned()));
    }
    let free = volume::free_bytes(data_dir).map_err(at(data_dir))?;
    if free < manifest.bytes {
        return Err(Error::NoRoom { needed: manifest.bytes, free, path: data_dir.to_owned() });
    }
    let draft = private::temporary_folder(".restore-", data_dir).map_err(at(data_dir))?;
    let copy = draft.path().join(DATABASE_FILE);
    let (from, to) = (backup.join(&manifest.database), copy.clone());
    let copied = tokio::task::spawn_blocking(move || {
        fs::copy(&from, &to).map_err(at(&from))?;
        // A backup may be kept read-only; a database must be writable.
        let mut permissions = fs::metadata(&to).map_err(at(&to))?.permissions();
        make_writable(&mut permissions);
        fs::set_permissions(&to, permissions).map_err(at(&to))?;
        private::narrow(&to).map_err(at(&to))?;
        File::options().write(true).open(&to).and_then(|file| file.sync_all()).map_err(at(&to))
    });
    copied.await.map_err(|_| Error::Store(StoreError::Panicked))??;
    // Checks the file in the data folder and not the one it was copied from.
    let webhooks_without_secret = check_copy(&copy, &manifest).await?.webhooks_without_secret;
    let kept_aside = if there { Some(keep_aside(&database, now).await?) } else { None };
    for beside in ["-wal", "-shm"] {
        let path = with_suffix(&database, beside);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(at(&path)(error)),
            _ => {}
        }
    }
    // The rename is atomic: before it the folder has the old database, after it the new one.
    fs::rename(&copy, &database).map_err(at(&database))?;
    sync_folder(data_dir)?;
    Ok(Restored { manifest, kept_aside, webhooks_without_secret })
}

/// Gives the present database a second name, which remains when the first is replaced.
async fn keep_aside(database: &Path, now: Timestamp) -> Result<PathBuf, Error> {
    // After a checkpoint the log is empty and the file is complete. If a damaged database refuses it, its log is kept as well.
    if let Ok(mut connection) =
        SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(database).create_if_missing(false)).await
    {
        let _ = sqlx::query("pragma wal_checkpoint(truncate)").execute(&mut connection).await;
        let _ = connection.close().await;
    }
    let aside = with_suffix(database, &format!(".before-restore-{}", name_of(now)));
    for suffix in ["-wal", ""] {
        let (from, to) = (with_suffix(database, suffix), with_suffix(&aside, suffix));
        if from.exists() && fs::hard_link(&from, &to).is_err() {
            // Some file systems have no hard links.
            fs::copy(&from, &to).map_err(at(&to))?;
            File::open(&to).and_then(|file| file.sync_all()).map_err(at(&to))?;
        }
    }
    for suffix in ["-wal", ""] {
        let path = with_suffix(&aside, suffix);
        private::narrow(&path).map_err(at(&path))?;
    }
    sync_folder(database.parent().unwrap_or(Path::new(".")))?;
    Ok(aside)
}

fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    PathBuf::from(name)
}

#[cfg(unix)]
fn make_writable(permissions: &mut fs::Permissions) {
    use std::os::unix::fs::PermissionsExt as _;
    permissions.set_mode(permissions.mode() | 0o600);
}

#[cfg(not(unix))]
fn make_writable(permissions: &mut fs::Permissions) {
    permissions.set_readonly(false);
}
