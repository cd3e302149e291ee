//! Making a backup: a copy in a temporary folder, which receives its name when it is complete.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use sqlx::Connection as _;
use sqlx_sqlite::{SqliteConnectOptions, SqliteConnection, SqliteSynchronous};

use super::super::database_file::DatabaseFile;
use super::super::error::Error as StoreError;
use super::super::file::{refuse_foreign, take_lock, DATABASE_FILE};
use super::super::reader::Reader;
use super::copy::{read_contents, sha256, sync_folder, Contents};
use super::draft_folder::DraftFolder;
use super::error::{at, Error};
use super::manifest::{check_name, read_manifest, BackupModel, Manifest, FOLDER, FORMAT, MANIFEST_FILE};
use crate::private;
use crate::quantity::Timestamp;
use crate::volume;

impl DatabaseFile<'_> {
    /// Makes a backup under `backups/<name>` of the data folder while the service continues to run.
    ///
    /// # Errors
    /// [`Error::Name`], [`Error::Exists`], [`Error::NoRoom`], [`Error::Damaged`] if the copy fails its check.
    pub async fn backup(self, name: &str, content: Content, now: Timestamp) -> Result<Manifest, Error> {
        check_name(name)?;
        let target = self.folder().join(FOLDER).join(name);
        let Reader::Sqlite(pool) = &self.database.reader else { return Err(Error::Server) };
        let pages: (i64,) = sqlx::query_as("select page_count * page_size from pragma_page_count, pragma_page_size")
            .fetch_one(pool)
            .await?;
        let draft = Draft::begin(&target, pages.0.unsigned_abs() + self.min_free_bytes())?;
        let mut reader = pool.acquire().await?;
        vacuum_into(&mut reader, &draft.database()).await?;
        drop(reader);
        draft.finish(content, now).await
    }

    /// The manifests of the backups in the data folder, newest first, and the names of folders whose manifest cannot be read.
    ///
    /// # Errors
    /// [`Error::File`] if the folder cannot be listed.
    pub fn backups(self) -> Result<(Vec<Manifest>, Vec<String>), Error> {
        let folder = self.folder().join(FOLDER);
        let (mut found, mut unreadable) = (Vec::new(), Vec::new());
        let entries = match fs::read_dir(&folder) {
            Ok(entries) => entries,
            Err(missing) if missing.kind() == std::io::ErrorKind::NotFound => return Ok((found, unreadable)),
            Err(error) => return Err(at(&folder)(error)),
        };
        for entry in entries {
            let entry = entry.map_err(at(&folder))?;
            let name = entry.file_name().to_string_lossy().into_owned();
            // The names of unfinished backups begin with a dot.
            if name.starts_with('.') {
                continue;
            }
            match read_manifest(&entry.path()) {
                Ok(manifest) => found.push(manifest),
                Err(_) => unreadable.push(name),
            }
        }
        found.sort_by(|a, b| b.created_at.cmp(&a.created_at));
        Ok((found, unreadable))
    }
}

/// Makes a backup of the database of a data folder that no service has open. The copy is not migrated.
///
/// # Errors
/// [`StoreError::Locked`] when a service has the folder open, otherwise as [`DatabaseFile::backup`].
pub async fn of_folder(data_dir: &Path, target: &Path, content: Content, now: Timestamp) -> Result<Manifest, Error> {
    let database = data_dir.join(DATABASE_FILE);
    let bytes = fs::metadata(&database).map_err(|_| Error::NoDatabase(data_dir.to_owned()))?.len();
    let _lock = take_lock(data_dir)?;
    refuse_foreign(&database).await?;
    let draft = Draft::begin(target, bytes)?;
    let mut connection = SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(&database)).await?;
    vacuum_into(&mut connection, &draft.database()).await?;
    connection.close().await?;
    draft.finish(content, now).await
}

/// What a backup contains beside the data.
#[derive(Debug, Clone, Default)]
pub struct Content {
    /// Trained baselines in use that are not in the database.
    pub models: Vec<BackupModel>,
    /// Whether the secrets of webhooks are in the copy.
    pub with_secrets: bool,
}

/// Removes the secrets of webhooks from a copy, and disables the webhooks: without a secret their messages cannot be signed.
async fn remove_secrets(database: &Path) -> Result<(), Error> {
    // Freed bytes are overwritten, and the journal, which has the bytes from before, is in memory only.
    let options = SqliteConnectOptions::new()
        .filename(database)
        .pragma("secure_delete", "on")
        .pragma("journal_mode", "memory")
        .synchronous(SqliteSynchronous::Full);
    let mut connection = SqliteConnection::connect_with(&options).await?;
    let (any,): (bool,) =
        sqlx::query_as("select exists (select 1 from sqlite_schema where type = 'table' and name = 'webhook')")
            .fetch_one(&mut connection)
            .await?;
    if any {
        sqlx::query("update webhook set secret = '', previous_secret = null, previous_until_us = null, enabled = 0")
            .execute(&mut connection)
            .await?;
    }
    connection.close().await?;
    Ok(())
}

async fn vacuum_into(connection: &mut SqliteConnection, file: &Path) -> Result<(), Error> {
    sqlx::query("vacuum into $1").bind(file.to_string_lossy().into_owned()).execute(connection).await?;
    Ok(())
}

/// An unfinished backup in a temporary folder, which is removed when this is dropped.
struct Draft {
    folder: DraftFolder,
    target: PathBuf,
}

impl Draft {
    fn begin(target: &Path, needed: u64) -> Result<Self, Error> {
        if target.exists() {
            return Err(Error::Exists(target.display().to_string()));
        }
        let parent = target.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        private::create_folder(parent).map_err(at(parent))?;
        let free = volume::free_bytes(parent).map_err(at(parent))?;
        if free < needed {
            return Err(Error::NoRoom { needed, free, path: parent.to_owned() });
        }
        let folder = DraftFolder::create(parent).map_err(at(parent))?;
        Ok(Self { folder, target: target.to_owned() })
    }

    fn database(&self) -> PathBuf {
        self.folder.path().join(DATABASE_FILE)
    }

    /// Checks the copy, writes the manifest, and renames the folder after both were synced to disk.
    async fn finish(self, content: Content, now: Timestamp) -> Result<Manifest, Error> {
        let Content { mut models, with_secrets } = content;
        let database = self.database();
        if !with_secrets {
            remove_secrets(&database).await?;
        }
        let Contents { schema_version, rows, trained, .. } = read_contents(&database).await?;
        models.extend(trained);
        models.sort();
        let blocking = tokio::task::spawn_blocking(move || {
            let database = self.database();
            let file = File::open(&database).map_err(at(&database))?;
            file.sync_all().map_err(at(&database))?;
            let manifest = Manifest {
                format: FORMAT,
                name: self.target.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned()),
                created_at: now.to_string(),
                program_version: env!("CARGO_PKG_VERSION").to_owned(),
                schema_version,
                database: DATABASE_FILE.to_owned(),
                bytes: file.metadata().map_err(at(&database))?.len(),
                sha256: sha256(&database)?,
                rows,
                models,
                with_secrets,
            };
            let record = self.folder.path().join(MANIFEST_FILE);
            let text = serde_json::to_vec_pretty(&manifest).expect("a manifest is plain data");
            fs::write(&record, text).map_err(at(&record))?;
            File::open(&record).and_then(|file| file.sync_all()).map_err(at(&record))?;
            private::narrow(self.folder.path()).map_err(at(self.folder.path()))?;
            sync_folder(self.folder.path())?;
            let draft = self.folder.keep().map_err(at(&self.target))?;
            // A rename never replaces a folder that is not empty, so two backups with the same name cannot mix.
            fs::rename(&draft, &self.target).map_err(|error| {
                let _ = fs::remove_dir_all(&draft);
                at(&self.target)(error)
            })?;
            sync_folder(self.target.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new(".")))?;
            Ok(manifest)
        });
        blocking.await.map_err(|_| Error::Store(StoreError::Panicked))?
    }
}
