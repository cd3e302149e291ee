//! Checking a copy of the database, and writing files durably.

use data_encoding::HEXLOWER;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use sha2::{Digest as _, Sha256};
use sqlx::Connection as _;
use sqlx_sqlite::{SqliteConnectOptions, SqliteConnection};

use super::super::error::Error as StoreError;
use super::super::file::{foreign_objects, refuse_foreign, schema_version};
use super::error::{at, Error};
use super::manifest::{read_manifest, BackupModel, Manifest};

/// Bytes read at a time.
const CHUNK: usize = 1 << 20;

/// The contents of a copy.
pub(super) struct Contents {
    pub schema_version: i64,
    pub rows: BTreeMap<String, u64>,
    pub trained: Vec<BackupModel>,
    /// Webhooks whose secret was left out.
    pub webhooks_without_secret: u64,
}

/// Checks every page of a copy and counts its rows, without writing to it.
pub(super) async fn read_contents(database: &Path) -> Result<Contents, Error> {
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
    // An empty file, or one from before the first migration, has no schema.
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
        let model = |(structure, digest)| BackupModel { structure, digest, kept_in: "database".to_owned() };
        trained = stored.into_iter().map(model).collect();
    }
    let mut webhooks_without_secret = 0;
    if rows.contains_key("webhook") {
        let (without,): (i64,) =
            sqlx::query_as("select count(*) from webhook where secret = ''").fetch_one(&mut connection).await?;
        webhooks_without_secret = without.unsigned_abs();
    }
    let foreign = foreign_objects(&mut connection, schema_version).await?;
    connection.close().await?;
    if !foreign.is_empty() {
        return Err(Error::Foreign { path: database.to_owned(), reason: foreign.join("; ") });
    }
    Ok(Contents { schema_version, rows, trained, webhooks_without_secret })
}

/// Checks a backup: SHA-256, every page, schema version and row counts.
///
/// # Errors
/// [`Error::Manifest`], [`Error::Damaged`], [`Error::TooNew`].
pub async fn verify(backup: &Path) -> Result<Manifest, Error> {
    let manifest = read_manifest(backup)?;
    check_copy(&backup.join(&manifest.database), &manifest).await?;
    Ok(manifest)
}

/// Checks that a copy is what its manifest says.
pub(super) async fn check_copy(database: &Path, manifest: &Manifest) -> Result<Contents, Error> {
    let damaged = |reason: String| Error::Damaged { path: database.to_owned(), reason };
    if manifest.schema_version > schema_version() {
        return Err(Error::TooNew { found: manifest.schema_version, known: schema_version() });
    }
    let file = database.to_owned();
    let found = tokio::task::spawn_blocking(move || sha256(&file)).await;
    let found = found.map_err(|_| Error::Store(StoreError::Panicked))??;
    if found != manifest.sha256 {
        return Err(damaged(format!("its SHA-256 is {found}, but the manifest says {}", manifest.sha256)));
    }
    let contents = read_contents(database).await?;
    if contents.schema_version != manifest.schema_version {
        let (found, expected) = (contents.schema_version, manifest.schema_version);
        return Err(damaged(format!("its schema version is {found}, but the manifest says {expected}")));
    }
    if contents.rows != manifest.rows {
        return Err(damaged("its numbers of rows differ from those of the manifest".to_owned()));
    }
    Ok(contents)
}

/// SHA-256 of a file. It is read in chunks, because a database may be larger than the memory.
pub(super) fn sha256(path: &Path) -> Result<String, Error> {
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

/// Syncs a folder, without which a rename in it is not durable.
pub(super) fn sync_folder(folder: &Path) -> Result<(), Error> {
    File::open(folder).and_then(|file| file.sync_all()).map_err(at(folder))
}
