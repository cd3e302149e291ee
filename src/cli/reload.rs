//! SIGHUP: the configuration read again, checked as a whole, and taken over as far as a running service can.

use std::path::PathBuf;

use tokio::signal::unix::{signal, Signal, SignalKind};
use tracing::{error, info, warn};

use crate::config::{Config, Flags};
use crate::monitor::Monitor;
use crate::telemetry::{self, Log};

/// Keys that change at once; all others wait for a restart.
const AT_ONCE: [&str; 5] =
    ["log.level", "retention.every_s", "retention.measurements_days", "store.max_wal_bytes", "store.min_free_bytes"];

/// Where the configuration came from, and what can be changed with it.
pub struct Reloading {
    /// `--config`
    pub file: Option<PathBuf>,
    /// Other flags.
    pub flags: Flags,
    /// The log, whose level can be changed.
    pub log: Log,
}

impl Reloading {
    /// Catches SIGHUP from now on, which would else end the process.
    ///
    /// # Errors
    /// When the process may not handle signals.
    pub fn hangups() -> std::io::Result<Signal> {
        signal(SignalKind::hangup())
    }

    /// Follows `hangups` for as long as the process runs.
    pub fn follow(self, mut hangups: Signal, monitor: Monitor, started_with: Config) {
        let mut in_force = started_with;
        tokio::spawn(async move {
            while hangups.recv().await.is_some() {
                match Config::read(self.file.as_deref(), &self.flags).map_err(|e| e.to_string()).and_then(checked) {
                    Ok(config) => in_force = self.take_over(&monitor, in_force, config),
                    Err(problem) => {
                        error!("SIGHUP: kept the configuration in force, the new one is refused: {problem}");
                    }
                }
            }
        });
    }

    /// Takes over what can be changed; the configuration in force afterwards.
    fn take_over(&self, monitor: &Monitor, before: Config, new: Config) -> Config {
        let changed = before.differing_keys(&new);
        let (now, later): (Vec<String>, Vec<String>) =
            changed.into_iter().partition(|key| AT_ONCE.contains(&key.as_str()));
        if let Err(problem) = self.log.set_level(&new.log.level) {
            error!("SIGHUP: kept the configuration in force: {problem}");
            return before;
        }
        monitor.upkeep().retention().set(new.retention);
        monitor.store().file().set_limits(&new.store);
        info!(changed = ?now, "SIGHUP: took over {}", if now.is_empty() { "nothing new".to_owned() } else { now.join(", ") });
        if !later.is_empty() {
            warn!(waiting = ?later, "SIGHUP: {} change at the next start", later.join(", "));
        }
        // What waits is compared again next time.
        let mut in_force = before;
        in_force.log.level = new.log.level;
        in_force.retention = new.retention;
        in_force.store.min_free_bytes = new.store.min_free_bytes;
        in_force.store.max_wal_bytes = new.store.max_wal_bytes;
        in_force
    }
}

/// The level is a filter, which only its parser knows.
fn checked(config: Config) -> Result<Config, String> {
    telemetry::filter(&config.log.level).map(|_| config)
}
