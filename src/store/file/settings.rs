//! Settings of the database.

use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};

use super::super::url::DatabaseUrl;

/// Where the database is, and how much disk space it needs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StoreSettings {
    /// A database of a PostgreSQL server, instead of the file in the data folder.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub url: Option<DatabaseUrl>,
    /// Wait while another service serves the database of the server, and take over when it ends.
    pub standby: bool,
    /// A standby takes over when the service that holds the database has not been heard of for so many seconds.
    pub takeover_s: u64,
    /// Address under which other nodes of the server's database reach this one, such as `http://bridge-2.example:8080`; without it, it follows
    /// from the address that the service listens on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub node_url: Option<String>,
    /// Open a database on NFS, SMB or another network file system nevertheless.
    pub allow_network_filesystem: bool,
    /// Free bytes below which nothing is written; 0 = write until the disk is full.
    pub min_free_bytes: u64,
    /// Bytes of the write-ahead log above which `/readyz` warns.
    pub max_wal_bytes: u64,
}

impl Default for StoreSettings {
    fn default() -> Self {
        Self {
            url: None,
            standby: false,
            takeover_s: 10,
            node_url: None,
            allow_network_filesystem: false,
            min_free_bytes: 64 << 20,
            max_wal_bytes: 256 << 20,
        }
    }
}

impl StoreSettings {
    /// The settings for a command, which does not wait until a service ends.
    #[must_use]
    pub fn without_waiting(&self) -> Self {
        Self { standby: false, ..self.clone() }
    }
}

/// Limits that can be changed while the store is open.
pub(in super::super) struct Limits {
    min_free_bytes: AtomicU64,
    max_wal_bytes: AtomicU64,
}

impl Limits {
    /// The limits of settings.
    pub const fn of(settings: &StoreSettings) -> Self {
        Self {
            min_free_bytes: AtomicU64::new(settings.min_free_bytes),
            max_wal_bytes: AtomicU64::new(settings.max_wal_bytes),
        }
    }

    /// Adopts the limits of changed settings.
    pub fn set(&self, settings: &StoreSettings) {
        self.min_free_bytes.store(settings.min_free_bytes, Ordering::Relaxed);
        self.max_wal_bytes.store(settings.max_wal_bytes, Ordering::Relaxed);
    }

    /// Free bytes below which nothing is written.
    pub fn min_free_bytes(&self) -> u64 {
        self.min_free_bytes.load(Ordering::Relaxed)
    }

    /// Bytes of the write-ahead log above which `/readyz` warns.
    pub fn max_wal_bytes(&self) -> u64 {
        self.max_wal_bytes.load(Ordering::Relaxed)
    }
}
