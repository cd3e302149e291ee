//! The letter box: batches from an MQTT broker.
//!
//! A message is acknowledged after its batch was committed, or after it was put into quarantine because it can never become
//! one. Until then the broker keeps it, so neither a crash here nor one of the broker loses it. It may come twice; the
//! database knows a batch by its content and a measurement by source and time, so it counts once.

mod connection;
mod message;

use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use reqwest::Url;
use rumqttc::tokio_rustls::rustls::{ClientConfig, RootCertStore};
use rumqttc::{MqttOptions, TlsConfiguration, Transport};
use serde::{Deserialize, Serialize};

pub use connection::run;

/// Stands for the structure's id in a topic.
const PLACEHOLDER: &str = "{structure}";

/// Largest packet of the protocol. One that is too large for us is refused by us: a limit below would end the connection
/// each time the broker sends it again, for ever.
const LARGEST_PACKET: usize = 268_435_460;

/// Between two signs of life.
const KEEP_ALIVE: Duration = Duration::from_secs(30);

/// Where batches come from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MqttSettings {
    /// `mqtt://host:1883` or `mqtts://host:8883`; empty for none.
    pub url: String,
    /// Name of this service at the broker, which keeps messages under it; no two clients may share it.
    pub client_id: String,
    /// Topic of the batches; the level `{structure}` is the structure's id.
    pub topic: String,
    /// User at the broker; empty for none.
    pub username: String,
    /// File with the user's password.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub password_file: Option<PathBuf>,
    /// File with the certificates (PEM) to trust instead of Mozilla's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ca_file: Option<PathBuf>,
    /// Larger payloads go into quarantine, bytes.
    pub max_payload_bytes: usize,
}

impl Default for MqttSettings {
    fn default() -> Self {
        Self {
            url: String::new(),
            client_id: "modalwatch".to_owned(),
            topic: format!("modalwatch/{PLACEHOLDER}/batches"),
            username: String::new(),
            password_file: None,
            ca_file: None,
            max_payload_bytes: 4 << 20,
        }
    }
}

/// Why the broker's settings cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{key} is {value}: it must be {must}")]
pub struct SettingError {
    /// The key.
    pub key: &'static str,
    /// Its value.
    pub value: String,
    /// What would be right.
    pub must: String,
}

fn wrong(key: &'static str, value: impl Into<String>, must: impl Into<String>) -> SettingError {
    SettingError { key, value: value.into(), must: must.into() }
}

impl MqttSettings {
    /// Whether there is a broker at all.
    pub fn is_off(&self) -> bool {
        self.url.is_empty()
    }

    /// The first setting that is wrong without a look at files.
    ///
    /// # Errors
    /// [`SettingError`].
    pub fn check(&self) -> Result<(), SettingError> {
        if self.is_off() {
            return Ok(());
        }
        self.broker()?;
        Topic::new(&self.topic)?;
        if self.client_id.is_empty()
            || self.client_id.len() > 64
            || !self.client_id.bytes().all(|b| b.is_ascii_graphic())
        {
            return Err(wrong("mqtt.client_id", &self.client_id, "1 to 64 visible ASCII characters"));
        }
        if self.password_file.is_some() && self.username.is_empty() {
            return Err(wrong("mqtt.username", "empty", "given with mqtt.password_file"));
        }
        let most = LARGEST_PACKET - 65_536;
        if !(1..=most).contains(&self.max_payload_bytes) {
            let value = self.max_payload_bytes.to_string();
            return Err(wrong("mqtt.max_payload_bytes", value, format!("from 1 to {most}")));
        }
        Ok(())
    }

    /// Host, port, and whether the connection is encrypted.
    fn broker(&self) -> Result<(String, u16, bool), SettingError> {
        let must = "mqtt://host:port or mqtts://host:port, without user and path";
        let url = Url::parse(&self.url).map_err(|_| wrong("mqtt.url", &self.url, must))?;
        let encrypted = url.scheme() == "mqtts";
        let plain = url.username().is_empty() && url.password().is_none() && ["", "/"].contains(&url.path());
        match url.host_str() {
            Some(host) if ["mqtt", "mqtts"].contains(&url.scheme()) && plain && !host.is_empty() => {
                let host = host.trim_start_matches('[').trim_end_matches(']').to_owned();
                Ok((host, url.port().unwrap_or(if encrypted { 8883 } else { 1883 }), encrypted))
            }
            // A password in it must not get into a log.
            _ if !url.username().is_empty() || url.password().is_some() => {
                Err(wrong("mqtt.url", "a URL with a user", must))
            }
            _ => Err(wrong("mqtt.url", &self.url, must)),
        }
    }

    /// The options of a connection.
    fn options(&self) -> Result<MqttOptions, SettingError> {
        self.check()?;
        let (host, port, encrypted) = self.broker()?;
        let mut options = MqttOptions::new(&self.client_id, host, port);
        options.set_keep_alive(KEEP_ALIVE);
        // The broker keeps what arrives while we are away, and sends again what was not acknowledged.
        options.set_clean_session(false);
        options.set_manual_acks(true);
        options.set_max_packet_size(LARGEST_PACKET, LARGEST_PACKET);
        let read = |key, path: &PathBuf| {
            let must = "a file that can be read";
            std::fs::read(path).map_err(|e| wrong(key, path.display().to_string(), format!("{must} ({e})")))
        };
        if !self.username.is_empty() {
            let password = self.password_file.as_ref().map(|path| read("mqtt.password_file", path)).transpose()?;
            let password = String::from_utf8(password.unwrap_or_default())
                .map_err(|_| wrong("mqtt.password_file", "not UTF-8", "a text file"))?;
            options.set_credentials(&self.username, password.trim_end_matches(['\r', '\n']));
        }
        if encrypted {
            let tls = if let Some(path) = &self.ca_file {
                TlsConfiguration::Simple { ca: read("mqtt.ca_file", path)?, alpn: None, client_auth: None }
            } else {
                let mut roots = RootCertStore::empty();
                roots.add_parsable_certificates(webpki_root_certs::TLS_SERVER_ROOT_CERTS.iter().cloned());
                TlsConfiguration::from(ClientConfig::builder().with_root_certificates(roots).with_no_client_auth())
            };
            options.set_transport(Transport::tls_with_config(tls));
        }
        Ok(options)
    }
}

/// The topic of batches.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Topic {
    levels: Vec<String>,
}

impl Topic {
    fn new(template: &str) -> Result<Self, SettingError> {
        let levels: Vec<String> = template.split('/').map(str::to_owned).collect();
        let once = levels.iter().filter(|level| *level == PLACEHOLDER).count() == 1;
        let plain = |level: &String| level == PLACEHOLDER || !level.contains(['+', '#', '{', '}', '\0']);
        if once && levels.iter().all(plain) && template.len() <= 500 && !template.starts_with('$') {
            return Ok(Self { levels });
        }
        let must = "levels between slashes, one of them {structure}, without + and #";
        Err(wrong("mqtt.topic", template, must))
    }

    /// What to subscribe to.
    fn filter(&self) -> String {
        let level = |level: &String| if level == PLACEHOLDER { "+".to_owned() } else { level.clone() };
        self.levels.iter().map(level).collect::<Vec<_>>().join("/")
    }

    /// The structure's id in a topic; `None` for one that is not of this form.
    fn structure<'t>(&self, topic: &'t str) -> Option<&'t str> {
        let found: Vec<&str> = topic.split('/').collect();
        let same = |(own, found): (&String, &&str)| own == PLACEHOLDER || own == *found;
        if found.len() != self.levels.len() || !self.levels.iter().zip(&found).all(same) {
            return None;
        }
        self.levels.iter().zip(found).find(|(own, _)| *own == PLACEHOLDER).map(|(_, found)| found)
    }
}

/// How the connection to the broker is: a cheap handle for those who report it.
#[derive(Debug, Clone, Default)]
pub struct MqttStatus {
    inner: Arc<Mutex<Inner>>,
}

#[derive(Debug, Clone, Default)]
struct Inner {
    used: bool,
    connected: bool,
    trouble: Option<String>,
}

impl MqttStatus {
    /// Whether batches can arrive: connected and subscribed.
    pub fn connected(&self) -> bool {
        self.lock().connected
    }

    /// What is wrong, for a report; `None` when there is no broker or all is well. Batches over HTTP are taken all the same,
    /// and it heals by itself: a degraded service, not one that is not ready.
    pub fn finding(&self) -> Option<String> {
        let inner = self.lock().clone();
        (inner.used && !inner.connected).then(|| {
            let trouble = inner.trouble.unwrap_or_else(|| "not connected yet".to_owned());
            format!("no batches from the MQTT broker: {trouble}")
        })
    }

    fn set(&self, connected: bool, trouble: Option<String>) {
        *self.lock() = Inner { used: true, connected, trouble };
        metrics::gauge!("modalwatch_mqtt_connected").set(f64::from(u8::from(connected)));
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Inner> {
        self.inner.lock().expect("no holder of this lock panics")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_topic_names_its_structure() {
        let topic = Topic::new("site/{structure}/batches").unwrap();
        assert_eq!(topic.filter(), "site/+/batches");
        assert_eq!(topic.structure("site/bridge-7/batches"), Some("bridge-7"));
        for other in ["site/batches", "site/a/b/batches", "other/a/batches", "site/a/batches/"] {
            assert_eq!(topic.structure(other), None, "{other}");
        }
        for wrong in ["batches", "a/{structure}/{structure}", "a/+/{structure}", "{structure}/#", "a/x{structure}", ""]
        {
            assert!(Topic::new(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_broker_is_a_host_and_nothing_else() {
        let of = |url: &str| MqttSettings { url: url.to_owned(), ..MqttSettings::default() }.broker();
        assert_eq!(of("mqtt://broker").unwrap(), ("broker".to_owned(), 1883, false));
        assert_eq!(of("mqtts://[::1]:9").unwrap(), ("::1".to_owned(), 9, true));
        for wrong in ["broker", "http://broker", "mqtt://", "mqtt://u:secret@broker", "mqtt://broker/path"] {
            let error = of(wrong).unwrap_err().to_string();
            assert!(error.contains("mqtt.url") && !error.contains("secret"), "{wrong}: {error}");
        }
    }

    #[test]
    fn without_a_broker_there_is_nothing_to_report() {
        let status = MqttStatus::default();
        assert_eq!(status.finding(), None);
        status.set(false, None);
        assert!(status.finding().unwrap().contains("not connected yet"));
        status.set(true, None);
        assert_eq!(status.finding(), None);
    }
}
