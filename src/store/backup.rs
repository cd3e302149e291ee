//! Backups: a whole copy of the database with a record beside it, and the way back.
//!
//! ```text
//!  DIR/modalwatch.sqlite     the copy, made by VACUUM INTO: one file, no log beside it
//!  DIR/manifest.json         schema, program, rows, SHA-256 of the copy, digests of the trained baselines
//! ```
//!
//! The folder appears under its name only when the copy was checked and is on disk. The copy is made through a reader, so
//! that batches are taken meanwhile; it holds exactly what was stored when it began.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Read as _;
use std::path::{Path, PathBuf};

use data_encoding::HEXLOWER;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::Connection as _;

use super::{newest, refuse_foreign, take_lock, Store, DATABASE_FILE};
use crate::quantity::Timestamp;
use crate::volume;

/// Name of the record inside a backup.
pub const MANIFEST_FILE: &str = "manifest.json";
/// Folder of the service's own backups, inside its data folder.
pub const FOLDER: &str = "backups";
/// Version of the record.
const FORMAT: u32 = 1;
/// Bytes read at a time.
const CHUNK: usize = 1 << 20;

/// What is in a backup.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = BackupManifest)]
pub struct Manifest {
    /// Version of this record.
    pub format: u32,
    /// Name of the backup: that of its folder.
    pub name: String,
    /// When it was made, RFC 3339.
    pub created_at: String,
    /// Program that made it.
    pub program_version: String,
    /// Schema of the database.
    pub schema_version: i64,
    /// Name of the copy.
    pub database: String,
    /// Its bytes.
    pub bytes: u64,
    /// Its SHA-256.
    pub sha256: String,
    /// Rows of each table.
    pub rows: BTreeMap<String, u64>,
    /// Trained baselines that belong to it.
    pub models: Vec<Model>,
}

/// A trained baseline.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = BackupModel)]
pub struct Model {
    /// Structure it was trained for.
    pub structure: String,
    /// Its digest.
    pub digest: String,
    /// `database`, and so in the backup; `program`, and so in every modalwatch of that version; or the file of a models folder,
    /// which is not in the backup.
    pub kept_in: String,
}

/// What a restore did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Restored {
    /// The record of the backup.
    pub manifest: Manifest,
    /// Where the database that was there before is now.
    pub kept_aside: Option<PathBuf>,
}

/// Why there is no backup, or no restore.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A name that is none.
    #[error("{0} is no name for a backup: 1 to 64 of A-Z, a-z, 0-9, '-', '_', '.', beginning with a letter or digit")]
    Name(String),
    /// There is one of this name.
    #[error("there is a backup {0} already: give another name")]
    Exists(String),
    /// Nothing to back up.
    #[error("{0} has no database: give the --data-dir of a service")]
    NoDatabase(PathBuf),
    /// No room for the copy.
    #[error("the copy needs {needed} bytes and {free} are free in {path}")]
    NoRoom {
        /// Bytes of the copy.
        needed: u64,
        /// Bytes free.
        free: u64,
        /// Where.
        path: PathBuf,
    },
    /// A file cannot be read or written.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// No record, or one that cannot be read.
    #[error("{path} is no record of a backup: {reason}")]
    Manifest {
        /// The record.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The copy is not what the record says.
    #[error("{path} is damaged: {reason}; take another backup, nothing was changed")]
    Damaged {
        /// The copy.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Made by a newer program.
    #[error("the backup has schema version {found}, newer than this program's {known}: use the newer modalwatch")]
    TooNew {
        /// Schema of the backup.
        found: i64,
        /// Newest known here.
        known: i64,
    },
    /// The target has a database.
    #[error("{0} has a database: give an empty --data-dir, or --replace, which keeps it aside")]
    NotEmpty(PathBuf),
    /// The store cannot be used.
    #[error(transparent)]
    Store(#[from] super::Error),
}

impl From<sqlx::Error> for Error {
    fn from(error: sqlx::Error) -> Self {
        Self::Store(error.into())
    }
}

fn at(path: &Path) -> impl FnOnce(std::io::Error) -> Error + use<'_> {
    |source| Error::File { path: path.to_owned(), source }
}

/// Checks a name: it becomes a folder, so nothing else is let in.
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

/// A name by the time, such as `2026-03-01T12-00-00.123456Z`.
pub fn name_of_now() -> String {
    Timestamp::now().to_string().replace(':', "-")
}

impl Store {
    /// Makes a backup under `backups/<name>` of the data folder while everything goes on.
    ///
    /// # Errors
    /// [`Error::Name`], [`Error::Exists`], [`Error::NoRoom`], [`Error::Damaged`] when the copy does not pass its check.
    pub async fn backup(&self, name: &str, models: Vec<Model>) -> Result<Manifest, Error> {
        check_name(name)?;
        let target = self.folder().join(FOLDER).join(name);
        let pages: (i64,) = sqlx::query_as("select page_count * page_size from pragma_page_count, pragma_page_size")
            .fetch_one(&self.reader)
            .await?;
        let draft = Draft::begin(&target, pages.0.unsigned_abs() + self.min_free_bytes())?;
        let mut reader = self.reader.acquire().await?;
        vacuum_into(&mut reader, &draft.database()).await?;
        drop(reader);
        draft.finish(models).await
    }

    /// The records of the service's own backups, newest first, and the folders whose record cannot be read.
    ///
    /// # Errors
    /// [`Error::File`] when the folder cannot be listed.
    pub fn backups(&self) -> Result<(Vec<Manifest>, Vec<String>), Error> {
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
            // Drafts begin with a dot.
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

/// Makes a backup of the database of a data folder that no service has open. It is copied as it is: nothing is migrated.
///
/// # Errors
/// [`super::Error::Locked`] when a service has it open, else as [`Store::backup`].
pub async fn of_folder(data_dir: &Path, target: &Path, models: Vec<Model>) -> Result<Manifest, Error> {
    let database = data_dir.join(DATABASE_FILE);
    let bytes = fs::metadata(&database).map_err(|_| Error::NoDatabase(data_dir.to_owned()))?.len();
    let _lock = take_lock(data_dir)?;
    refuse_foreign(&database).await?;
    let draft = Draft::begin(target, bytes)?;
    let mut connection = SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(&database)).await?;
    vacuum_into(&mut connection, &draft.database()).await?;
    connection.close().await?;
    draft.finish(models).await
}

async fn vacuum_into(connection: &mut SqliteConnection, file: &Path) -> Result<(), Error> {
    sqlx::query("vacuum into ?").bind(file.to_string_lossy().into_owned()).execute(connection).await?;
    Ok(())
}

/// A backup in the making, in a folder beside its place; it goes away when dropped.
struct Draft {
    folder: tempfile::TempDir,
    target: PathBuf,
}

impl Draft {
    fn begin(target: &Path, needed: u64) -> Result<Self, Error> {
        if target.exists() {
            return Err(Error::Exists(target.display().to_string()));
        }
        let parent = target.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        fs::create_dir_all(parent).map_err(at(parent))?;
        let free = volume::free_bytes(parent).map_err(at(parent))?;
        if free < needed {
            return Err(Error::NoRoom { needed, free, path: parent.to_owned() });
        }
        let folder = tempfile::Builder::new().prefix(".draft-").tempdir_in(parent).map_err(at(parent))?;
        Ok(Self { folder, target: target.to_owned() })
    }

    fn database(&self) -> PathBuf {
        self.folder.path().join(DATABASE_FILE)
    }

    /// Checks the copy, writes the record, and gives the folder its name when both are on disk.
    async fn finish(self, mut models: Vec<Model>) -> Result<Manifest, Error> {
        let database = self.database();
        let Looked { schema_version, rows, trained } = look_at(&database).await?;
        models.extend(trained);
        models.sort();
        let blocking = tokio::task::spawn_blocking(move || {
            let database = self.database();
            let file = File::open(&database).map_err(at(&database))?;
            file.sync_all().map_err(at(&database))?;
            let manifest = Manifest {
                format: FORMAT,
                name: self.target.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned()),
                created_at: Timestamp::now().to_string(),
                program_version: env!("CARGO_PKG_VERSION").to_owned(),
                schema_version,
                database: DATABASE_FILE.to_owned(),
                bytes: file.metadata().map_err(at(&database))?.len(),
                sha256: sha256(&database)?,
                rows,
                models,
            };
            let record = self.folder.path().join(MANIFEST_FILE);
            let text = serde_json::to_vec_pretty(&manifest).expect("a manifest is plain data");
            fs::write(&record, text).map_err(at(&record))?;
            File::open(&record).and_then(|file| file.sync_all()).map_err(at(&record))?;
            sync_folder(self.folder.path())?;
            let draft = self.folder.keep();
            // A rename never replaces a folder that has something in it: two backups of one name cannot mix.
            fs::rename(&draft, &self.target).map_err(|error| {
                let _ = fs::remove_dir_all(&draft);
                at(&self.target)(error)
            })?;
            sync_folder(self.target.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new(".")))?;
            Ok(manifest)
        });
        blocking.await.map_err(|_| Error::Store(super::Error::Panicked))?
    }
}

/// What a copy holds.
struct Looked {
    schema_version: i64,
    rows: BTreeMap<String, u64>,
    trained: Vec<Model>,
}

/// Opens a copy, checks every page of it and counts its rows. Nothing is written.
async fn look_at(database: &Path) -> Result<Looked, Error> {
    refuse_foreign(database).await?;
    let options = SqliteConnectOptions::new().filename(database).read_only(true).immutable(true);
    let mut connection = SqliteConnection::connect_with(&options).await?;
    let findings: Vec<(String,)> = sqlx::query_as("pragma integrity_check(5)").fetch_all(&mut connection).await?;
    if findings.iter().any(|(finding,)| finding != "ok") {
        let reason = findings.into_iter().map(|(finding,)| finding).collect::<Vec<_>>().join("; ");
        return Err(Error::Damaged { path: database.to_owned(), reason });
    }
    let tables: Vec<(String,)> = sqlx::query_as(
        "select name from sqlite_schema where type = 'table' and name not like 'sqlite_%' order by name",
    )
    .fetch_all(&mut connection)
    .await?;
    let mut rows = BTreeMap::new();
    for (table,) in tables {
        let count = format!("select count(*) from \"{}\"", table.replace('"', "\"\""));
        let (count,): (i64,) = sqlx::query_as(sqlx::AssertSqlSafe(count)).fetch_one(&mut connection).await?;
        rows.insert(table, count.unsigned_abs());
    }
    // A file that is empty, or from before the first migration, has no schema yet.
    let schema_version = if rows.contains_key("_sqlx_migrations") {
        let (version,): (i64,) =
            sqlx::query_as("select coalesce(max(version), 0) from _sqlx_migrations").fetch_one(&mut connection).await?;
        version
    } else {
        0
    };
    let mut trained = Vec::new();
    if rows.contains_key("trained_baseline") {
        let stored: Vec<(String, String)> = sqlx::query_as("select structure_id, model_digest from trained_baseline")
            .fetch_all(&mut connection)
            .await?;
        let model = |(structure, digest)| Model { structure, digest, kept_in: "database".to_owned() };
        trained = stored.into_iter().map(model).collect();
    }
    connection.close().await?;
    Ok(Looked { schema_version, rows, trained })
}

/// Reads the record of a backup.
///
/// # Errors
/// [`Error::Manifest`].
pub fn read_manifest(backup: &Path) -> Result<Manifest, Error> {
    let path = backup.join(MANIFEST_FILE);
    let wrong = |reason: String| Error::Manifest { path: path.clone(), reason };
    let text = fs::read(&path).map_err(|e| wrong(e.to_string()))?;
    let manifest: Manifest = serde_json::from_slice(&text).map_err(|e| wrong(e.to_string()))?;
    if manifest.format != FORMAT {
        return Err(wrong(format!("it has format {}, this program reads {FORMAT}", manifest.format)));
    }
    // The name comes from a file: it must not lead out of the backup.
    if Path::new(&manifest.database).file_name() != Some(std::ffi::OsStr::new(&manifest.database)) {
        return Err(wrong(format!("{} is no file name", crate::quantity::shown(&manifest.database))));
    }
    Ok(manifest)
}

/// Checks a backup: SHA-256, every page, schema, rows.
///
/// # Errors
/// [`Error::Manifest`], [`Error::Damaged`], [`Error::TooNew`].
pub async fn verify(backup: &Path) -> Result<Manifest, Error> {
    let manifest = read_manifest(backup)?;
    check_copy(&backup.join(&manifest.database), &manifest).await?;
    Ok(manifest)
}

async fn check_copy(database: &Path, manifest: &Manifest) -> Result<(), Error> {
    let damaged = |reason: String| Error::Damaged { path: database.to_owned(), reason };
    if manifest.schema_version > newest() {
        return Err(Error::TooNew { found: manifest.schema_version, known: newest() });
    }
    let file = database.to_owned();
    let found = tokio::task::spawn_blocking(move || sha256(&file)).await;
    let found = found.map_err(|_| Error::Store(super::Error::Panicked))??;
    if found != manifest.sha256 {
        return Err(damaged(format!("its SHA-256 is {found}, the record says {}", manifest.sha256)));
    }
    let looked = look_at(database).await?;
    if looked.schema_version != manifest.schema_version {
        let (found, said) = (looked.schema_version, manifest.schema_version);
        return Err(damaged(format!("its schema is {found}, the record says {said}")));
    }
    if looked.rows != manifest.rows {
        return Err(damaged("it has other numbers of rows than the record says".to_owned()));
    }
    Ok(())
}

/// Puts the database of a backup into a data folder that no service has open, whole or not at all.
///
/// With `replace`, a database that is there is kept beside the new one under a name that says when.
///
/// # Errors
/// [`Error::NotEmpty`] without `replace`; [`Error::Damaged`], [`Error::TooNew`]; [`super::Error::Locked`].
pub async fn restore(backup: &Path, data_dir: &Path, replace: bool) -> Result<Restored, Error> {
    let manifest = verify(backup).await?;
    fs::create_dir_all(data_dir).map_err(at(data_dir))?;
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
    let draft = tempfile::Builder::new().prefix(".restore-").tempdir_in(data_dir).map_err(at(data_dir))?;
    let copy = draft.path().join(DATABASE_FILE);
    let (from, to) = (backup.join(&manifest.database), copy.clone());
    let copied = tokio::task::spawn_blocking(move || {
        fs::copy(&from, &to).map_err(at(&from))?;
        // A backup may be kept read-only; a database must be writable.
        let mut permissions = fs::metadata(&to).map_err(at(&to))?.permissions();
        make_writable(&mut permissions);
        fs::set_permissions(&to, permissions).map_err(at(&to))?;
        File::options().write(true).open(&to).and_then(|file| file.sync_all()).map_err(at(&to))
    });
    copied.await.map_err(|_| Error::Store(super::Error::Panicked))??;
    // What lies in the data folder now is checked, not what was read from.
    check_copy(&copy, &manifest).await?;
    let kept_aside = if there { Some(keep_aside(&database).await?) } else { None };
    for beside in ["-wal", "-shm"] {
        let path = with_suffix(&database, beside);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(at(&path)(error)),
            _ => {}
        }
    }
    // At every moment there is a whole database under the name: the old one until here, the new one from here on.
    fs::rename(&copy, &database).map_err(at(&database))?;
    sync_folder(data_dir)?;
    Ok(Restored { manifest, kept_aside })
}

/// Gives the present database a second name that stays when the first is taken over.
async fn keep_aside(database: &Path) -> Result<PathBuf, Error> {
    // Written back, the log is empty and the file is all there is. A damaged one may refuse; its log is kept with it then.
    if let Ok(mut connection) =
        SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(database).create_if_missing(false)).await
    {
        let _ = sqlx::query("pragma wal_checkpoint(truncate)").execute(&mut connection).await;
        let _ = connection.close().await;
    }
    let aside = with_suffix(database, &format!(".before-restore-{}", name_of_now()));
    for suffix in ["-wal", ""] {
        let (from, to) = (with_suffix(database, suffix), with_suffix(&aside, suffix));
        if from.exists() && fs::hard_link(&from, &to).is_err() {
            // Some file systems have no links.
            fs::copy(&from, &to).map_err(at(&to))?;
            File::open(&to).and_then(|file| file.sync_all()).map_err(at(&to))?;
        }
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

/// SHA-256 of a file, read in pieces: a database may be larger than the memory.
fn sha256(path: &Path) -> Result<String, Error> {
    let mut file = File::open(path).map_err(at(path))?;
    let (mut hasher, mut chunk) = (Sha256::new(), vec![0; CHUNK]);
    loop {
        match file.read(&mut chunk).map_err(at(path))? {
            0 => break,
            read => hasher.update(&chunk[..read]),
        }
    }
    Ok(HEXLOWER.encode(&hasher.finalize()))
}

/// A rename is on disk only when its folder is.
fn sync_folder(folder: &Path) -> Result<(), Error> {
    File::open(folder).and_then(|file| file.sync_all()).map_err(at(folder))
}
