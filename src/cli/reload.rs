//! SIGHUP: reads and checks the configuration again, and applies the keys that can change in a running service.

use std::path::PathBuf;

use tokio::signal::unix::{signal, Signal, SignalKind};
use tracing::{error, info, warn};

use crate::config::{Config, Flags};
use crate::monitor::Monitor;
use crate::telemetry::{self, Log};

/// Keys that take effect immediately; all others take effect at the next start.
const IMMEDIATE: [&str; 5] =
    ["log.level", "retention.every_s", "retention.measurements_days", "store.max_wal_bytes", "store.min_free_bytes"];

/// The sources of the configuration, and the log.
pub struct Reloading {
    /// `--config`
    pub file: Option<PathBuf>,
    /// Other flags.
    pub flags: Flags,
    /// The log, whose level can be changed.
    pub log: Log,
}

impl Reloading {
    /// Handles SIGHUP from now on; without a handler it would end the process.
    ///
    /// # Errors
    /// If no signal handler can be installed.
    pub fn hangups() -> std::io::Result<Signal> {
        signal(SignalKind::hangup())
    }

    /// Reads the configuration at each signal of `hangups`, until the process ends.
    pub fn follow(self, mut hangups: Signal, monitor: Monitor, started_with: Config) {
        let mut in_force = started_with;
        tokio::spawn(async move {
            while hangups.recv().await.is_some() {
                match Config::read(self.file.as_deref(), &self.flags).map_err(|e| e.to_string()).and_then(checked) {
                    Ok(config) => in_force = self.apply(&monitor, in_force, config),
                    Err(problem) => {
                        error!("SIGHUP: the new configuration is refused, the old one stays in force: {problem}");
                    }
                }
            }
        });
    }

    /// Applies the keys that can be changed. Returns the configuration in force afterwards.
    fn apply(&self, monitor: &Monitor, before: Config, new: Config) -> Config {
        let changed = before.differing_keys(&new);
        let (now, later): (Vec<String>, Vec<String>) =
            changed.into_iter().partition(|key| IMMEDIATE.contains(&key.as_str()));
        if let Err(problem) = self.log.set_level(&new.log.level) {
            error!("SIGHUP: the old configuration stays in force: {problem}");
            return before;
        }
        monitor.upkeep().retention().set(new.retention);
        monitor.store().file().set_limits(&new.store);
        info!(changed = ?now, "SIGHUP: applied {}", if now.is_empty() { "no changes".to_owned() } else { now.join(", ") });
        if !later.is_empty() {
            warn!(waiting = ?later, "SIGHUP: changes of {} take effect at the next start", later.join(", "));
        }
        // Changes that wait for the next start are reported again at the next signal.
        let mut in_force = before;
        in_force.log.level = new.log.level;
        in_force.retention = new.retention;
        in_force.store.min_free_bytes = new.store.min_free_bytes;
        in_force.store.max_wal_bytes = new.store.max_wal_bytes;
        in_force
    }
}

/// Checks the filter of the log level, which the configuration holds as text.
fn checked(config: Config) -> Result<Config, String> {
    telemetry::filter(&config.log.level).map(|_| config)
}
