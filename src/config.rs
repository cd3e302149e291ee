//! The settings of all modules, and where they are read from: defaults < file < environment < flags.

use std::path::{Path, PathBuf};

use figment::providers::{Env, Format as _, Serialized, Toml};
use figment::Figment;
use serde::{Deserialize, Serialize};

use crate::http::HttpSettings;
use crate::monitor::MonitorSettings;
use crate::telemetry::LogSettings;

/// Prefix of the environment variables; `__` stands between section and key.
const ENVIRONMENT: &str = "MODALWATCH__";

/// The commented defaults, as a file.
pub const DEFAULT_FILE: &str = include_str!("config.default.toml");

/// All settings of the service.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Folder of the database.
    pub data_dir: PathBuf,
    /// Folder of the user's own structures and trained baselines.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub models_dir: Option<PathBuf>,
    /// Towards clients.
    pub http: HttpSettings,
    /// How batches are taken and assessed.
    pub monitor: MonitorSettings,
    /// Logs.
    pub log: LogSettings,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            data_dir: PathBuf::from("modalwatch-data"),
            models_dir: None,
            http: HttpSettings::default(),
            monitor: MonitorSettings::default(),
            log: LogSettings::default(),
        }
    }
}

/// Flags that go over everything else.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Flags {
    /// `--data-dir`
    #[serde(skip_serializing_if = "Option::is_none")]
    pub data_dir: Option<PathBuf>,
    /// `--models`
    #[serde(skip_serializing_if = "Option::is_none")]
    pub models_dir: Option<PathBuf>,
    /// `--listen`
    #[serde(skip_serializing_if = "HttpFlags::is_empty")]
    pub http: HttpFlags,
}

/// Flags of the section `http`.
#[derive(Debug, Clone, Default, Serialize)]
pub struct HttpFlags {
    /// `--listen`
    #[serde(skip_serializing_if = "Option::is_none")]
    pub listen: Option<String>,
}

impl HttpFlags {
    fn is_empty(&self) -> bool {
        self.listen.is_none()
    }
}

/// Why there is no configuration.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file given by `--config` cannot be read.
    #[error("the configuration file {path} cannot be read: {source}")]
    File {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// An unknown key or a value of the wrong type; the message names key and origin.
    #[error("configuration: {0}")]
    Value(Box<figment::Error>),
    /// A value out of range.
    #[error("configuration: {key} is {value}: it must be {must}")]
    Range {
        /// The key.
        key: &'static str,
        /// Its value.
        value: String,
        /// What would be right.
        must: &'static str,
    },
}

impl Config {
    /// Reads the configuration from all its places.
    ///
    /// # Errors
    /// [`Error`] naming file, key or value.
    pub fn read(file: Option<&Path>, flags: &Flags) -> Result<Self, Error> {
        let mut figment = Figment::from(Serialized::defaults(Self::default()));
        if let Some(path) = file {
            let text = std::fs::read_to_string(path).map_err(|source| Error::File { path: path.to_owned(), source })?;
            figment = figment.merge(Toml::string(&text));
        }
        figment = figment.merge(Env::prefixed(ENVIRONMENT).split("__")).merge(Serialized::defaults(flags));
        let config: Self = figment.extract().map_err(|e| Error::Value(Box::new(e)))?;
        config.check()?;
        Ok(config)
    }

    fn check(&self) -> Result<(), Error> {
        let positive = [
            ("http.max_body_bytes", self.http.max_body_bytes as u64),
            ("http.header_timeout_s", self.http.header_timeout_s),
            ("http.body_timeout_s", self.http.body_timeout_s),
            ("http.max_connections", self.http.max_connections as u64),
            ("monitor.draws_per_measurement", self.monitor.draws_per_measurement as u64),
            ("monitor.draws_for_population", self.monitor.draws_for_population as u64),
            ("monitor.max_measurements", self.monitor.max_measurements as u64),
            ("monitor.compute.queue", self.monitor.compute.queue as u64),
        ];
        if let Some(&(key, value)) = positive.iter().find(|(_, value)| *value == 0) {
            return Err(Error::Range { key, value: value.to_string(), must: "at least 1" });
        }
        let draws = [
            ("monitor.draws_per_measurement", self.monitor.draws_per_measurement),
            ("monitor.draws_for_population", self.monitor.draws_for_population),
        ];
        if let Some((key, value)) = draws.into_iter().find(|(_, value)| *value > 10_000) {
            return Err(Error::Range { key, value: value.to_string(), must: "at most 10000" });
        }
        if let Some((key, value, must)) = self.monitor.alarm.problem() {
            return Err(Error::Range { key, value, must });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_commented_file_holds_exactly_the_defaults() {
        let parsed: Config = toml::from_str(DEFAULT_FILE).unwrap();
        assert_eq!(parsed, Config::default());
    }

    #[test]
    fn an_unknown_key_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("config.toml");
        std::fs::write(&path, "[http]\nlisten = \"127.0.0.1:1\"\nlistn = 3\n").unwrap();
        let error = Config::read(Some(&path), &Flags::default()).unwrap_err().to_string();
        assert!(error.contains("listn"), "{error}");
    }

    #[test]
    fn flags_go_over_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("config.toml");
        std::fs::write(&path, "data_dir = \"a\"\n[http]\nlisten = \"127.0.0.1:1\"\n").unwrap();
        let flags = Flags { http: HttpFlags { listen: Some("127.0.0.1:2".to_owned()) }, ..Flags::default() };
        let config = Config::read(Some(&path), &flags).unwrap();
        assert_eq!((config.http.listen.as_str(), config.data_dir.to_str()), ("127.0.0.1:2", Some("a")));
    }
}
