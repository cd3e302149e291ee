//! Backups of the database and of the trained baselines in use.

use std::sync::Arc;
use std::time::Instant;

use tokio::sync::Mutex;
use tracing::{error, info};

use super::error::{BackupError, Error};
use super::own_task::in_own_task;
use super::structures::ActiveStructures;
use crate::clock;
use crate::store::{backup, Store};

/// Makes and lists backups.
#[derive(Clone)]
pub struct Backups {
    store: Store,
    structures: Arc<ActiveStructures>,
    running: Arc<Mutex<()>>,
}

impl Backups {
    pub(super) fn new(store: Store, structures: Arc<ActiveStructures>) -> Self {
        Self { store, structures, running: Arc::default() }
    }

    /// Makes a backup under a name, or under one derived from the time; the secrets of webhooks are left out unless they are asked for.
    ///
    /// # Errors
    /// [`BackupError`].
    pub async fn make(&self, name: Option<String>, with_secrets: bool) -> Result<backup::Manifest, BackupError> {
        let backups = self.clone();
        in_own_task(async move { backups.make_here(name, with_secrets).await }).await
    }

    async fn make_here(&self, name: Option<String>, with_secrets: bool) -> Result<backup::Manifest, BackupError> {
        let _turn = self.running.try_lock().map_err(|_| BackupError::Running)?;
        let now = clock::now();
        let name = name.unwrap_or_else(|| backup::name_of(now));
        let started = Instant::now();
        let content = backup::Content { models: self.models_in_use().await, with_secrets };
        let made = self.store.file().backup(&name, content, now).await;
        let outcome = if made.is_ok() { "done" } else { "failed" };
        metrics::counter!("modalwatch_backups_total", "outcome" => outcome).increment(1);
        match &made {
            Ok(manifest) => {
                let duration_ms = started.elapsed().as_secs_f64() * 1e3;
                let now_s = clock::now().micros() as f64 / 1e6;
                metrics::gauge!("modalwatch_last_backup_timestamp_seconds").set(now_s);
                info!(backup = %manifest.name, bytes = manifest.bytes, duration_ms, "Made backup {name}");
            }
            Err(error) => error!(backup = %name, %error, "Could not make backup {name}: {error}"),
        }
        Ok(made?)
    }

    /// The backups made by the service, newest first, and the names of unreadable ones.
    ///
    /// # Errors
    /// [`BackupError::Failed`] when the folder cannot be listed.
    pub async fn list(&self) -> Result<(Vec<backup::Manifest>, Vec<String>), BackupError> {
        let store = self.store.clone();
        let listed = tokio::task::spawn_blocking(move || store.file().backups()).await.map_err(|_| Error::Panicked)?;
        Ok(listed?)
    }

    /// The trained baselines in use that are not in the database.
    async fn models_in_use(&self) -> Vec<backup::BackupModel> {
        let (in_use, library) = (self.structures.models_in_use(), self.structures.library());
        // Reads and hashes files, which must not block an async thread.
        let found = tokio::task::spawn_blocking(move || {
            let model = |(structure, digest): (crate::quantity::StructureId, crate::quantity::Digest)| {
                let files = library.files_of(&digest).ok().flatten()?;
                let structure = structure.to_string();
                Some(backup::BackupModel { structure, digest: digest.to_string(), kept_in: files.kept_in })
            };
            in_use.into_iter().filter_map(model).collect()
        });
        found.await.unwrap_or_default()
    }
}
