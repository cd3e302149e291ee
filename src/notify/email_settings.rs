//! Section `email` of the configuration.

use std::path::{Path, PathBuf};
use std::time::Duration;

use lettre::message::Mailbox;
use lettre::transport::smtp::authentication::Credentials;
use lettre::transport::smtp::client::{Certificate, CertificateStore, Tls, TlsParameters};
use lettre::{Address, AsyncSmtpTransport, Tokio1Executor};
use serde::{Deserialize, Serialize};

use super::message::EVENT_KINDS;
use crate::alarm::severity::Grade;
use crate::alarm::ALARM_KINDS;

/// Variable with the password, if there is no password file.
const PASSWORD: &str = "MODALWATCH_EMAIL_PASSWORD";

/// Maximum number of recipients.
const MOST_RECIPIENTS: usize = 100;

/// How the connection to the server is encrypted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Encryption {
    /// It begins in clear and must be encrypted before anything is sent; port 587.
    Starttls,
    /// It is encrypted from the start; port 465.
    Implicit,
    /// It is never encrypted; port 25.
    None,
}

/// Settings of the mails about alarms.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EmailSettings {
    /// Name or address of the SMTP server; empty for no mails.
    pub host: String,
    /// Port; 0 for the usual one of `tls`.
    pub port: u16,
    /// How the connection is encrypted.
    pub tls: Encryption,
    /// Whether `tls = "none"` is accepted for a server that is not on this machine.
    pub allow_unencrypted: bool,
    /// User name at the server; empty for none.
    pub username: String,
    /// File with the password; without it, the variable `MODALWATCH_EMAIL_PASSWORD`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub password_file: Option<PathBuf>,
    /// File with the certificates (PEM) to trust instead of those of the system and of Mozilla.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ca_file: Option<PathBuf>,
    /// Sender, `name@example.org` or `Name <name@example.org>`.
    pub from: String,
    /// Addresses of the recipients; each receives a mail of its own.
    pub recipients: Vec<String>,
    /// Alarms below this severity send no mail.
    pub least_severity: Grade,
    /// Kinds of events that send a mail.
    pub events: Vec<String>,
    /// Kinds of alarms that send a mail; empty for all.
    pub alarm_kinds: Vec<String>,
}

impl Default for EmailSettings {
    fn default() -> Self {
        let events = ["alarm.opened", "alarm.worsened", "alarm.reopened", "alarm.ended"];
        Self {
            host: String::new(),
            port: 0,
            tls: Encryption::Starttls,
            allow_unencrypted: false,
            username: String::new(),
            password_file: None,
            ca_file: None,
            from: String::new(),
            recipients: Vec::new(),
            least_severity: Grade::Moderate,
            events: events.map(str::to_owned).to_vec(),
            alarm_kinds: Vec::new(),
        }
    }
}

/// An invalid setting.
#[derive(Debug, thiserror::Error)]
#[error("{key} is {value}: it must be {must}")]
pub struct EmailSettingError {
    /// The key.
    pub key: &'static str,
    /// Its value.
    pub value: String,
    /// Values that are allowed.
    pub must: String,
}

fn wrong(key: &'static str, value: impl Into<String>, must: impl Into<String>) -> EmailSettingError {
    EmailSettingError { key, value: value.into(), must: must.into() }
}

impl EmailSettings {
    /// Whether no mails are sent.
    pub fn is_off(&self) -> bool {
        self.host.is_empty()
    }

    /// Checks the settings without reading files.
    ///
    /// # Errors
    /// [`EmailSettingError`] for the first invalid setting.
    pub fn check(&self) -> Result<(), EmailSettingError> {
        let listed = |key, values: &[String], allowed: &[&str]| {
            let unknown = values.iter().find(|value| !allowed.contains(&value.as_str()));
            unknown.map_or(Ok(()), |value| Err(wrong(key, value, format!("a list of {}", allowed.join(", ")))))
        };
        listed("email.events", &self.events, &EVENT_KINDS)?;
        listed("email.alarm_kinds", &self.alarm_kinds, &ALARM_KINDS)?;
        if self.is_off() {
            let given = !self.recipients.is_empty() || !self.from.is_empty();
            return if given { Err(wrong("email.host", "empty", "given with recipients or from")) } else { Ok(()) };
        }
        if !self.host.chars().all(|c| c.is_ascii_alphanumeric() || ".-_:".contains(c)) {
            return Err(wrong(
                "email.host",
                &self.host,
                "the name or address of an SMTP server, without port and scheme",
            ));
        }
        if self.tls == Encryption::None && !self.allow_unencrypted && !self.is_loopback() {
            let must = "starttls or implicit for a server on another machine, unless email.allow_unencrypted is true";
            return Err(wrong("email.tls", "none", must));
        }
        self.sender()?;
        if self.recipients.is_empty() || self.recipients.len() > MOST_RECIPIENTS {
            let value = format!("{} addresses", self.recipients.len());
            return Err(wrong("email.recipients", value, format!("1 to {MOST_RECIPIENTS} addresses")));
        }
        for address in &self.recipients {
            if address.parse::<Address>().is_err() {
                return Err(wrong("email.recipients", address, "an address such as name@example.org"));
            }
        }
        if self.events.is_empty() {
            return Err(wrong("email.events", "empty", format!("at least one of {}", EVENT_KINDS.join(", "))));
        }
        if self.password_file.is_some() && self.username.is_empty() {
            return Err(wrong("email.username", "empty", "given with email.password_file"));
        }
        Ok(())
    }

    fn is_loopback(&self) -> bool {
        self.host == "localhost" || self.host.parse::<std::net::IpAddr>().is_ok_and(|address| address.is_loopback())
    }

    /// The port.
    pub fn port(&self) -> u16 {
        match (self.port, self.tls) {
            (0, Encryption::Starttls) => 587,
            (0, Encryption::Implicit) => 465,
            (0, Encryption::None) => 25,
            (port, _) => port,
        }
    }

    /// The sender.
    pub(super) fn sender(&self) -> Result<Mailbox, EmailSettingError> {
        let must = "an address such as name@example.org or Name <name@example.org>";
        self.from
            .parse()
            .map_err(|_| wrong("email.from", if self.from.is_empty() { "empty" } else { &self.from }, must))
    }

    /// The connection to the server.
    pub(super) fn transport(&self, timeout: Duration) -> Result<AsyncSmtpTransport<Tokio1Executor>, EmailSettingError> {
        let tls = match self.tls {
            Encryption::None => Tls::None,
            Encryption::Starttls => Tls::Required(self.encryption()?),
            Encryption::Implicit => Tls::Wrapper(self.encryption()?),
        };
        let builder = AsyncSmtpTransport::<Tokio1Executor>::builder_dangerous(&self.host);
        let mut builder = builder.port(self.port()).tls(tls).timeout(Some(timeout));
        if !self.username.is_empty() {
            builder = builder.credentials(Credentials::new(self.username.clone(), self.password()?));
        }
        Ok(builder.build())
    }

    fn password(&self) -> Result<String, EmailSettingError> {
        let Some(path) = &self.password_file else {
            let must = "a file with the password, or the variable MODALWATCH_EMAIL_PASSWORD must be set";
            return std::env::var(PASSWORD).map_err(|_| wrong("email.password_file", "empty", must));
        };
        let text = String::from_utf8(read("email.password_file", path)?)
            .map_err(|_| wrong("email.password_file", "not UTF-8", "a text file"))?;
        Ok(text.trim_end_matches(['\r', '\n']).to_owned())
    }

    fn encryption(&self) -> Result<TlsParameters, EmailSettingError> {
        super::install_tls_provider();
        let mut builder = TlsParameters::builder(self.host.clone());
        if let Some(path) = &self.ca_file {
            let must = "a file with certificates (PEM)";
            let value = || path.display().to_string();
            let certificate = Certificate::from_pem(&read("email.ca_file", path)?)
                .map_err(|e| wrong("email.ca_file", value(), format!("{must} ({e})")))?;
            builder = builder.certificate_store(CertificateStore::None).add_root_certificate(certificate);
        } else {
            for der in webpki_root_certs::TLS_SERVER_ROOT_CERTS {
                if let Ok(certificate) = Certificate::from_der(der.to_vec()) {
                    builder = builder.add_root_certificate(certificate);
                }
            }
        }
        builder.build().map_err(|e| wrong("email.host", &self.host, format!("a name that TLS can verify ({e})")))
    }
}

fn read(key: &'static str, path: &Path) -> Result<Vec<u8>, EmailSettingError> {
    std::fs::read(path).map_err(|e| wrong(key, path.display().to_string(), format!("a file that can be read ({e})")))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn valid() -> EmailSettings {
        EmailSettings {
            host: "mail.example.org".to_owned(),
            from: "Watch <watch@example.org>".to_owned(),
            recipients: vec!["ann@example.org".to_owned()],
            ..EmailSettings::default()
        }
    }

    type Change = fn(&mut EmailSettings);

    #[test]
    fn each_invalid_setting_is_named() {
        assert!(EmailSettings::default().check().is_ok() && valid().check().is_ok());
        let cases: [(&str, Change); 11] = [
            ("email.host", |s| s.host.clear()),
            ("email.host", |s| "smtp://mail".clone_into(&mut s.host)),
            ("email.tls", |s| s.tls = Encryption::None),
            ("email.from", |s| s.from.clear()),
            ("email.from", |s| "a@b.org\nBcc: all@b.org".clone_into(&mut s.from)),
            ("email.recipients", |s| s.recipients.clear()),
            ("email.recipients", |s| s.recipients.push("ann".to_owned())),
            ("email.recipients", |s| s.recipients.push("ann@b.org\r\nRCPT TO:<x@y.z>".to_owned())),
            ("email.events", |s| s.events.push("alarm.opend".to_owned())),
            ("email.alarm_kinds", |s| s.alarm_kinds.push("fire".to_owned())),
            ("email.username", |s| s.password_file = Some("p".into())),
        ];
        for (key, change) in cases {
            let mut settings = valid();
            change(&mut settings);
            let said = settings.check().unwrap_err();
            assert_eq!(said.key, key, "{said}");
        }
        let local = EmailSettings { host: "127.0.0.1".to_owned(), tls: Encryption::None, ..valid() };
        assert!(local.check().is_ok() && local.port() == 25 && valid().port() == 587);
        let told = EmailSettings { tls: Encryption::None, allow_unencrypted: true, ..valid() };
        assert!(told.check().is_ok());
    }

    #[test]
    fn encrypted_connections_can_be_prepared() {
        for tls in [Encryption::Starttls, Encryption::Implicit] {
            assert!(EmailSettings { tls, ..valid() }.transport(Duration::from_secs(1)).is_ok());
        }
        let folder = tempfile::tempdir().unwrap();
        let missing = EmailSettings { ca_file: Some(folder.path().join("no.pem")), ..valid() };
        assert_eq!(missing.transport(Duration::from_secs(1)).unwrap_err().key, "email.ca_file");
    }
}
