//! Section `mqtt` of the configuration.

use std::path::{Path, PathBuf};
use std::time::Duration;

use reqwest::Url;
use rumqttc::{MqttOptions, TlsConfiguration, Transport};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::CertificateDer;
use rustls::{ClientConfig, RootCertStore};
use serde::{Deserialize, Serialize};

use super::topic::{Topic, PLACEHOLDER};

/// Maximum packet size of the protocol. The service refuses large messages itself: with a lower limit here, the
/// connection would be closed each time the broker sends such a message again.
const LARGEST_PACKET: usize = 268_435_460;

/// Keep-alive interval of the connection. Messages that are larger than what may wait in memory keep the answer to a ping waiting.
const KEEP_ALIVE: Duration = Duration::from_mins(1);

/// Settings of the MQTT broker.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MqttSettings {
    /// `mqtt://host:1883` or `mqtts://host:8883`; empty for no broker.
    pub url: String,
    /// Client id, under which the broker keeps messages; it must be unique among the clients of the broker.
    pub client_id: String,
    /// Topic of the batches; the level `{structure}` is replaced by the structure id.
    pub topic: String,
    /// User name at the broker; empty for none.
    pub username: String,
    /// File with the password.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub password_file: Option<PathBuf>,
    /// File with the certificates (PEM) to trust instead of those of Mozilla.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ca_file: Option<PathBuf>,
    /// Maximum payload in bytes; a larger one is quarantined.
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

/// An invalid setting.
#[derive(Debug, thiserror::Error)]
#[error("{key} is {value}: it must be {must}")]
pub struct SettingError {
    /// The key.
    pub key: &'static str,
    /// Its value.
    pub value: String,
    /// Values that are allowed.
    pub must: String,
}

fn wrong(key: &'static str, value: impl Into<String>, must: impl Into<String>) -> SettingError {
    SettingError { key, value: value.into(), must: must.into() }
}

impl MqttSettings {
    /// Whether no broker is configured.
    pub fn is_off(&self) -> bool {
        self.url.is_empty()
    }

    /// Checks the settings without reading files.
    ///
    /// # Errors
    /// [`SettingError`] for the first invalid setting.
    pub fn check(&self) -> Result<(), SettingError> {
        if self.is_off() {
            return Ok(());
        }
        self.broker()?;
        self.topic()?;
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
        // A password in the URL must not be logged, also where another mistake keeps it from being read.
        let shown = if self.url.contains(['@', '?']) { "a URL with a user or a query" } else { &self.url };
        let url = Url::parse(&self.url).map_err(|_| wrong("mqtt.url", shown, must))?;
        let encrypted = url.scheme() == "mqtts";
        let plain = url.username().is_empty()
            && url.password().is_none()
            && ["", "/"].contains(&url.path())
            && url.query().is_none();
        match url.host_str() {
            Some(host) if ["mqtt", "mqtts"].contains(&url.scheme()) && plain && !host.is_empty() => {
                let host = host.trim_start_matches('[').trim_end_matches(']').to_owned();
                Ok((host, url.port().unwrap_or(if encrypted { 8883 } else { 1883 }), encrypted))
            }
            _ => Err(wrong("mqtt.url", shown, must)),
        }
    }

    /// The topic of the batches.
    pub(super) fn topic(&self) -> Result<Topic, SettingError> {
        let must = "levels between slashes, one of them {structure}, without + and #";
        Topic::new(&self.topic).ok_or_else(|| wrong("mqtt.topic", &self.topic, must))
    }

    /// The options of the connection to the broker.
    pub(super) fn options(&self) -> Result<MqttOptions, SettingError> {
        self.check()?;
        let (host, port, encrypted) = self.broker()?;
        let mut options = MqttOptions::new(&self.client_id, host, port);
        options.set_keep_alive(KEEP_ALIVE);
        // The broker keeps messages while the service is not connected, and sends unacknowledged messages again.
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
            let mut roots = RootCertStore::empty();
            if let Some(path) = &self.ca_file {
                for certificate in certificates(&read("mqtt.ca_file", path)?, path)? {
                    roots.add(certificate).map_err(|e| {
                        let must = format!("certificates of an authority ({e})");
                        wrong("mqtt.ca_file", path.display().to_string(), must)
                    })?;
                }
            } else {
                roots.add_parsable_certificates(webpki_root_certs::TLS_SERVER_ROOT_CERTS.iter().cloned());
            }
            // Not `TlsConfiguration::Simple`, which reads certificates by a package that is no longer maintained.
            let tls = ClientConfig::builder().with_root_certificates(roots).with_no_client_auth();
            options.set_transport(Transport::tls_with_config(TlsConfiguration::from(tls)));
        }
        Ok(options)
    }
}

/// The certificates of a PEM file, at least one.
fn certificates(pem: &[u8], path: &Path) -> Result<Vec<CertificateDer<'static>>, SettingError> {
    let must = |why: &str| {
        let must = format!(
            "a file with certificates between lines -----BEGIN CERTIFICATE----- and -----END CERTIFICATE----- ({why})"
        );
        wrong("mqtt.ca_file", path.display().to_string(), must)
    };
    let found: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem).collect();
    let found = found.map_err(|e| must(&e.to_string()))?;
    if found.is_empty() {
        return Err(must("there is none"));
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_broker_is_a_host_and_nothing_else() {
        let of = |url: &str| MqttSettings { url: url.to_owned(), ..MqttSettings::default() }.broker();
        assert_eq!(of("mqtt://broker").unwrap(), ("broker".to_owned(), 1883, false));
        assert_eq!(of("mqtts://[::1]:9").unwrap(), ("::1".to_owned(), 9, true));
        for wrong in [
            "broker",
            "http://broker",
            "mqtt://",
            "mqtt://u:secret@broker",
            "mqtt://u:secret@broker:port",
            "mqtt://broker?password=secret",
            "mqtt://broker/path",
        ] {
            let error = of(wrong).unwrap_err().to_string();
            assert!(error.contains("mqtt.url") && !error.contains("secret"), "{wrong}: {error}");
        }
    }

    #[test]
    fn a_file_without_a_certificate_is_refused_at_the_start() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ca.pem");
        let begin = "-----BEGIN CERTIFICATE-----\n";
        for (text, why) in [
            (String::new(), "there is none"),
            ("-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n".to_owned(), "there is none"),
            (format!("{begin}AAAA"), "-----BEGIN CERTIFICATE-----"),
            (format!("{begin}AAAA\n-----END CERTIFICATE-----\n"), "certificates of an authority"),
        ] {
            std::fs::write(&path, &text).unwrap();
            let url = "mqtts://broker".to_owned();
            let settings = MqttSettings { url, ca_file: Some(path.clone()), ..MqttSettings::default() };
            let refused = settings.options().unwrap_err().to_string();
            assert!(refused.contains("mqtt.ca_file") && refused.contains(why), "{text}: {refused}");
        }
    }
}
