//! The configuration: the settings of all modules, read from defaults, file, environment and flags; later ones take
//! precedence.

use std::path::{Path, PathBuf};

use figment::providers::{Env, Format, Serialized};
use figment::Figment;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::access::AccessSettings;
use crate::http::HttpSettings;
use crate::monitor::automatic_diagnoses::DiagnosisSettings;
use crate::monitor::retention::RetentionSettings;
use crate::monitor::{MonitorSettings, Roles};
use crate::mqtt::MqttSettings;
use crate::notify::{EmailSettingError, EmailSettings, NotifySettings};
use crate::quantity::shown;
use crate::store::StoreSettings;
use crate::telemetry::LogSettings;

/// Prefix of the environment variables; `__` separates section and key.
const ENVIRONMENT: &str = "MODALWATCH__";

/// Variable with the path of the admin token file.
const ADMIN_TOKEN_FILE: &str = "MODALWATCH_ADMIN_TOKEN_FILE";

/// Configuration file with the commented defaults.
pub const DEFAULT_FILE: &str = include_str!("config.default.toml");

/// All settings of the service.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Folder of the database.
    pub data_dir: PathBuf,
    /// Folder of the user's own structures and trained models.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub models_dir: Option<PathBuf>,
    /// What this process does for a database of a PostgreSQL server.
    pub roles: Roles,
    /// HTTP server.
    pub http: HttpSettings,
    /// Access to the service.
    pub access: AccessSettings,
    /// Storing and assessing batches.
    pub monitor: MonitorSettings,
    /// Diagnoses that the service starts by itself.
    pub diagnosis: DiagnosisSettings,
    /// Webhooks.
    pub notify: NotifySettings,
    /// Mails about alarms.
    pub email: EmailSettings,
    /// MQTT broker.
    pub mqtt: MqttSettings,
    /// Requirements on the file system of the database.
    pub store: StoreSettings,
    /// Retention of batches.
    pub retention: RetentionSettings,
    /// Logs and traces.
    pub log: LogSettings,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            data_dir: PathBuf::from("modalwatch-data"),
            models_dir: None,
            roles: Roles::ALL,
            http: HttpSettings::default(),
            access: AccessSettings::default(),
            monitor: MonitorSettings::default(),
            diagnosis: DiagnosisSettings::default(),
            notify: NotifySettings::default(),
            email: EmailSettings::default(),
            mqtt: MqttSettings::default(),
            store: StoreSettings::default(),
            retention: RetentionSettings::default(),
            log: LogSettings::default(),
        }
    }
}

/// Command-line flags, which take precedence over all other sources.
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
    /// `--roles`
    #[serde(skip_serializing_if = "Option::is_none")]
    pub roles: Option<String>,
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

/// Why the configuration cannot be used.
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
    /// An invalid setting of the MQTT broker.
    #[error("configuration: {0}")]
    Mqtt(#[from] crate::mqtt::SettingError),
    /// An invalid setting of the mails.
    #[error("configuration: {0}")]
    Email(#[from] EmailSettingError),
    /// A `--data-dir` that does not exist.
    #[error(
        "--data-dir {} does not exist: correct the path; only `modalwatch serve` and `modalwatch demo` create a data folder (or create an \
         empty one with mkdir)",
        .0.display()
    )]
    NoFolder(PathBuf),
    /// A value out of range.
    #[error("configuration: {key} is {value}: it must be {must}")]
    Range {
        /// The key.
        key: &'static str,
        /// Its value.
        value: String,
        /// Values that are allowed.
        must: &'static str,
    },
}

/// TOML for figment. Its own feature `toml` would bring an older version of the parser into the build.
struct Toml;

impl Format for Toml {
    type Error = toml::de::Error;

    const NAME: &'static str = "TOML";

    fn from_str<T: DeserializeOwned>(text: &str) -> Result<T, Self::Error> {
        toml::from_str(text)
    }
}

impl Config {
    /// Reads the configuration from all sources.
    ///
    /// # Errors
    /// [`Error`], which names file, key or value.
    pub fn read(file: Option<&Path>, flags: &Flags) -> Result<Self, Error> {
        let mut figment = Figment::from(Serialized::defaults(Self::default()));
        if let Some(path) = file {
            let text = std::fs::read_to_string(path).map_err(|source| Error::File { path: path.to_owned(), source })?;
            figment = figment.merge(Toml::string(&text));
        }
        // A separate, shorter variable for the path of a secret.
        let admin_file = Env::raw().only(&[ADMIN_TOKEN_FILE]).map(|_| "access.admin_token_file".into());
        figment =
            figment.merge(admin_file).merge(Env::prefixed(ENVIRONMENT).split("__")).merge(Serialized::defaults(flags));
        // A port alone is a number in a file or in the environment.
        let number = |value: figment::value::Value| {
            value.to_u128().map(|port| port.to_string()).or_else(|| value.to_i128().map(|port| port.to_string()))
        };
        if let Some(port) = figment.find_value("http.listen").ok().and_then(number) {
            figment = figment.merge(Serialized::default("http.listen", port));
        }
        let mut config: Self = figment.extract().map_err(|e| Error::Value(Box::new(e)))?;
        config.http.listen = listen_address(&config.http.listen)?;
        config.check()?;
        Ok(config)
    }

    /// [`Self::read`] for a command that uses an existing data folder: a `--data-dir` that does not exist is a typing mistake, not a
    /// wish for a new folder.
    ///
    /// # Errors
    /// As [`Self::read`], and [`Error::NoFolder`].
    pub fn read_for_existing(file: Option<&Path>, flags: &Flags) -> Result<Self, Error> {
        match &flags.data_dir {
            Some(folder) if !folder.is_dir() => Err(Error::NoFolder(folder.clone())),
            _ => Self::read(file, flags),
        }
    }

    /// Keys whose values differ from those of `other`, such as `http.listen`.
    pub fn differing_keys(&self, other: &Self) -> Vec<String> {
        let flat = |config: &Self| {
            let value = serde_json::to_value(config).expect("settings are plain data");
            let mut keys = std::collections::BTreeMap::new();
            flatten(String::new(), &value, &mut keys);
            keys
        };
        let (here, there) = (flat(self), flat(other));
        let all: std::collections::BTreeSet<&String> = here.keys().chain(there.keys()).collect();
        all.into_iter().filter(|key| here.get(*key) != there.get(*key)).cloned().collect()
    }

    fn check(&self) -> Result<(), Error> {
        if self.store.url.is_none() && self.roles != Roles::ALL {
            return Err(Error::Range {
                key: "roles",
                value: self.roles.to_string(),
                must: "api,worker with a SQLite file, which belongs to one process: only with a PostgreSQL database (store.url) can \
                       another process do the rest",
            });
        }
        let positive = [
            ("http.max_body_bytes", self.http.max_body_bytes as u64),
            ("http.max_bulk_bytes", self.http.max_bulk_bytes as u64),
            ("http.header_timeout_s", self.http.header_timeout_s),
            ("http.body_timeout_s", self.http.body_timeout_s),
            ("http.write_timeout_s", self.http.write_timeout_s),
            ("http.max_connections", self.http.max_connections as u64),
            ("http.max_connections_per_address", self.http.max_connections_per_address as u64),
            ("monitor.draws_per_measurement", self.monitor.draws_per_measurement as u64),
            ("monitor.draws_for_population", self.monitor.draws_for_population as u64),
            ("monitor.max_measurements", self.monitor.max_measurements as u64),
            ("monitor.compute.queue", self.monitor.compute.queue as u64),
            ("store.max_wal_bytes", self.store.max_wal_bytes),
            ("retention.every_s", self.retention.every_s),
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
        if let Some(value) = self.store.node_url.as_ref().filter(|url| !is_node_url(url)) {
            let must = "the address at which other nodes reach this one, with http:// or https:// and without a path, such as \
                        http://bridge-2.example:8080";
            return Err(Error::Range { key: "store.node_url", value: shown(value), must });
        }
        if let Some((key, value, must)) = self.notify.problem() {
            return Err(Error::Range { key, value, must });
        }
        self.mqtt.check()?;
        self.email.check()?;
        if self.retention.measurements_days > 36_500 {
            let value = self.retention.measurements_days.to_string();
            return Err(Error::Range { key: "retention.measurements_days", value, must: "at most 36500" });
        }
        if let Some((key, value, must)) = self
            .monitor
            .alarm
            .problem()
            .or_else(|| self.monitor.severity.problem())
            .or_else(|| self.diagnosis.problem())
        {
            return Err(Error::Range { key, value, must });
        }
        Ok(())
    }
}

/// Whether a text is an address of a node: scheme, host and port, and nothing else.
fn is_node_url(text: &str) -> bool {
    reqwest::Url::parse(text).is_ok_and(|url| {
        matches!(url.scheme(), "http" | "https")
            && url.host_str().is_some_and(|host| !matches!(host, "0.0.0.0" | "[::]"))
            && url.path() == "/"
            && url.query().is_none()
            && url.fragment().is_none()
            && url.username().is_empty()
            && url.password().is_none()
    })
}

/// The address to listen on: `text` itself, or the port `text` of this machine alone.
fn listen_address(text: &str) -> Result<String, Error> {
    let text = text.trim();
    let wrong = || {
        Error::Range {
        key: "http.listen (--listen)",
        value: shown(text),
        must: "an address and a port from 0 to 65535, such as 127.0.0.1:8080 (this machine only) or 0.0.0.0:8080 (reachable from \
               others), or a port alone, such as 8080, for this machine only",
    }
    };
    if text.parse::<u16>().is_ok() {
        return Ok(format!("127.0.0.1:{text}"));
    }
    let (host, port) = text.rsplit_once(':').ok_or_else(wrong)?;
    let bracketed = host.starts_with('[') && host.ends_with(']');
    let named = !host.is_empty() && !host.contains([':', '/', ' ', '[', ']']);
    if port.parse::<u16>().is_err() || !(bracketed || named) {
        return Err(wrong());
    }
    Ok(text.to_owned())
}

/// Collects the leaves of a tree of settings by their keys.
fn flatten(path: String, value: &serde_json::Value, keys: &mut std::collections::BTreeMap<String, serde_json::Value>) {
    let serde_json::Value::Object(members) = value else {
        keys.insert(path, value.clone());
        return;
    };
    for (name, member) in members {
        let below = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
        flatten(below, member, keys);
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
    fn an_unknown_key_is_reported_by_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("config.toml");
        std::fs::write(&path, "[http]\nlisten = \"127.0.0.1:1\"\nlistn = 3\n").unwrap();
        let error = Config::read(Some(&path), &Flags::default()).unwrap_err().to_string();
        assert!(error.contains("listn"), "{error}");
    }

    #[test]
    fn an_address_for_other_nodes_has_a_host_and_no_path() {
        for (text, good) in [
            ("http://bridge-2.example:8080", true),
            ("https://[2001:db8::2]", true),
            ("http://192.0.2.7:8080/", true),
            ("bridge-2.example:8080", false),
            ("ftp://bridge-2", false),
            ("http://bridge-2/v1", false),
            ("http://me:secret@bridge-2", false),
            ("http://0.0.0.0:8080", false),
            ("", false),
        ] {
            let mut config = Config::default();
            config.store.node_url = Some(text.to_owned());
            let checked = config.check().map_err(|error| error.to_string());
            assert_eq!(checked.is_ok(), good, "{text}: {checked:?}");
            assert!(checked.err().is_none_or(|error| error.contains("store.node_url")), "{text}");
        }
    }

    #[test]
    fn changed_settings_are_reported_by_their_keys() {
        let before = Config::default();
        let mut after = before.clone();
        assert_eq!(before.differing_keys(&after), Vec::<String>::new());
        after.log.level = "debug".to_owned();
        after.retention.measurements_days = 5;
        after.models_dir = Some(PathBuf::from("models"));
        assert_eq!(before.differing_keys(&after), ["log.level", "models_dir", "retention.measurements_days"]);
    }

    #[test]
    fn a_port_alone_is_one_of_this_machine_and_a_wrong_address_gets_a_sentence() {
        let read = |listen: &str| {
            let flags = Flags { http: HttpFlags { listen: Some(listen.to_owned()) }, ..Flags::default() };
            Config::read(None, &flags).map(|config| config.http.listen).map_err(|e| e.to_string())
        };
        for (given, understood) in [
            ("8080", "127.0.0.1:8080"),
            (" 0 ", "127.0.0.1:0"),
            ("0.0.0.0:80", "0.0.0.0:80"),
            ("localhost:8080", "localhost:8080"),
            ("[::1]:8080", "[::1]:8080"),
        ] {
            assert_eq!(read(given).as_deref(), Ok(understood));
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("config.toml");
        std::fs::write(&path, "[http]\nlisten = 8081\n").unwrap();
        assert_eq!(Config::read(Some(&path), &Flags::default()).unwrap().http.listen, "127.0.0.1:8081");
        for wrong in ["localhost", "", ":8080", "70000", "127.0.0.1:99999", "::1", "http://127.0.0.1:8080", "80 80"] {
            let said = read(wrong).unwrap_err();
            assert!(said.contains(&shown(wrong.trim())) && said.contains("a port alone, such as 8080"), "{said}");
        }
    }

    #[test]
    fn flags_take_precedence_over_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("config.toml");
        std::fs::write(&path, "data_dir = \"a\"\n[http]\nlisten = \"127.0.0.1:1\"\n").unwrap();
        let flags = Flags { http: HttpFlags { listen: Some("127.0.0.1:2".to_owned()) }, ..Flags::default() };
        let config = Config::read(Some(&path), &flags).unwrap();
        assert_eq!((config.http.listen.as_str(), config.data_dir.to_str()), ("127.0.0.1:2", Some("a")));
    }
}
