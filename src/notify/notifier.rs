//! The notifier: signs a message and posts it to a webhook.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use base64::Engine as _;
use rand::rngs::OsRng;
use rand::TryRngCore as _;
use reqwest::{header, redirect, Certificate, Client, ClientBuilder};
use tokio::sync::Notify;
use tracing::warn;

use super::address::{Guard, GuardedResolver};
use super::backoff::later;
use super::message::{seconds, Message};
use super::settings::NotifySettings;
use crate::alarm::severity::SeverityLimits;
use crate::clock;
use crate::quantity::Timestamp;
use crate::store::{Error, OutboxEvent, Secret, Store, WebhookRecord};

/// Length of a secret in bytes. Standard Webhooks requires 24 to 64.
const SECRET_BYTES: usize = 32;

/// Maximum length of a stored error, characters.
const LONGEST_ERROR: usize = 300;

/// One attempt to deliver a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Attempt {
    /// HTTP status, if there was an answer.
    pub status: Option<u16>,
    /// How long it took.
    pub took: Duration,
    /// Why the delivery failed; `None` if the receiver accepted the message.
    pub error: Option<String>,
}

/// Sends the messages of the outbox. Cloning is cheap.
#[derive(Clone)]
pub struct Notifier {
    pub(super) store: Store,
    guard: Arc<Guard>,
    pub(super) settings: Arc<NotifySettings>,
    /// Number of failing webhooks and of dead letters at the last check.
    pub(super) trouble: Arc<Mutex<(u64, u64)>>,
    limits: SeverityLimits,
    /// Woken when something was written, for the mailer.
    pub(super) wake: Arc<Notify>,
    /// One client for each port, because the allowed addresses depend on the port.
    clients: Arc<Mutex<BTreeMap<u16, Client>>>,
}

impl Notifier {
    /// A notifier for the outbox of a store, which wakes `wake` when something was written.
    ///
    /// # Errors
    /// The entry of `allow_private_targets` that is not an address or network.
    pub fn new(
        store: Store,
        settings: NotifySettings,
        limits: SeverityLimits,
        wake: Arc<Notify>,
    ) -> Result<Self, String> {
        let guard = Arc::new(Guard::new(&settings.allow_private_targets)?);
        let settings = Arc::new(settings);
        Ok(Self { store, guard, settings, trouble: Arc::default(), limits, wake, clients: Arc::default() })
    }

    /// Disables webhooks that cannot be read, which would keep alarms from being stored.
    ///
    /// # Errors
    /// What keeps the database from being written.
    pub async fn prepare(store: &Store) -> Result<(), Error> {
        let disabled = store.webhooks().disable_unreadable().await?;
        if disabled > 0 {
            warn!("Disabled {disabled} webhooks of which stored data cannot be read: delete them and make them again");
        }
        // Reading them all has the health of the service name those that cannot be read.
        store.webhooks().list().await.map(drop)
    }

    /// The addresses that webhooks may reach.
    pub fn guard(&self) -> &Guard {
        &self.guard
    }

    /// Finding for `/readyz`; `None` if every message is delivered. Alarms are raised independently of it, so the
    /// service is degraded but ready.
    pub fn finding(&self) -> Option<String> {
        let (failing, dead) = *self.trouble.lock().expect("no holder of this lock panics");
        (failing + dead > 0).then(|| {
            format!(
                "{failing} webhook(s) do not accept their messages at present, {dead} message(s) were given up: see \
                 GET /v1/webhooks/{{id}}/deliveries?state=dead"
            )
        })
    }

    /// Until when the previous secret signs if a new one is created now.
    pub fn overlap_until(&self, now: Timestamp) -> Timestamp {
        later(now, self.settings.secret_overlap_s)
    }

    /// Sends a test message.
    pub async fn test(&self, webhook: &WebhookRecord) -> Attempt {
        let id = format!("msg_{}", uuid::Uuid::now_v7().simple());
        self.attempt(webhook, &Message::test(&id, &self.settings.public_url, clock::now())).await
    }

    /// Sends a message of the outbox.
    pub(super) async fn send(&self, webhook: &WebhookRecord, event: &OutboxEvent) -> Attempt {
        match Message::of_event(event, self.limits, &self.settings.public_url) {
            Ok(message) => self.attempt(webhook, &message).await,
            Err(error) => Attempt { status: None, took: Duration::ZERO, error: Some(error.to_string()) },
        }
    }

    /// One attempt, which ends at the time limit at the latest.
    async fn attempt(&self, webhook: &WebhookRecord, message: &Message) -> Attempt {
        let started = Instant::now();
        let limit = Duration::from_secs(self.settings.timeout_s);
        let sent = tokio::time::timeout(limit, self.post(webhook, message));
        let result = sent.await.unwrap_or_else(|_| Err(format!("no answer within {} s", self.settings.timeout_s)));
        let took = started.elapsed();
        match result {
            Ok(status) => Attempt { status: Some(status), took, error: refusal(status) },
            Err(error) => Attempt { status: None, took, error: Some(error.chars().take(LONGEST_ERROR).collect()) },
        }
    }

    /// Posts a message and returns the status of the answer. The body of the answer is not read: its size and content
    /// are up to the receiver.
    async fn post(&self, webhook: &WebhookRecord, message: &Message) -> Result<u16, String> {
        let url = self.guard.check_url(&webhook.url)?;
        let now = clock::now();
        let secrets = std::iter::once(&webhook.secret)
            .chain(webhook.previous_secret.iter().filter(|(_, until)| *until > now).map(|(secret, _)| secret));
        let signature = message.signature(secrets, now).map_err(|e| format!("the message cannot be signed: {e}"))?;
        let client = self.client(url.port_or_known_default().unwrap_or_default())?;
        let request = client
            .post(url)
            .header(header::CONTENT_TYPE, "application/cloudevents+json; charset=utf-8")
            .header(standardwebhooks::HEADER_WEBHOOK_ID, message.id())
            .header(standardwebhooks::HEADER_WEBHOOK_TIMESTAMP, seconds(now))
            .header(standardwebhooks::HEADER_WEBHOOK_SIGNATURE, signature)
            .body(message.body().to_owned());
        Ok(request.send().await.map_err(causes)?.status().as_u16())
    }

    fn client(&self, port: u16) -> Result<Client, String> {
        let mut clients = self.clients.lock().expect("no holder of this lock panics");
        if let Some(client) = clients.get(&port) {
            return Ok(client.clone());
        }
        let client = client_builder()
            .dns_resolver(GuardedResolver::new(Arc::clone(&self.guard), port))
            .redirect(redirect::Policy::none())
            // A proxy would resolve names itself, so that the guard could not check the address.
            .no_proxy()
            // Each message uses a new connection, so that the guard checks every address and no closed connection is
            // reused.
            .pool_max_idle_per_host(0)
            .user_agent(concat!("modalwatch/", env!("CARGO_PKG_VERSION")))
            .build()
            .map_err(causes)?;
        clients.insert(port, client.clone());
        Ok(client)
    }
}

/// Makes `ring` the TLS implementation of this process. Calls after the first change nothing.
///
/// An HTTP client that is built before the first call panics.
pub fn install_tls_provider() {
    // An error means that a provider is installed already.
    let _ = rustls::crypto::ring::default_provider().install_default();
}

/// A builder of HTTP clients that trust the certificates of the system and of Mozilla. Small container images have no
/// certificates, and without any no client can be built, not even for http.
pub fn client_builder() -> ClientBuilder {
    install_tls_provider();
    let certificates = webpki_root_certs::TLS_SERVER_ROOT_CERTS.iter();
    Client::builder().tls_certs_merge(certificates.filter_map(|der| Certificate::from_der(der).ok()))
}

/// A new secret, `whsec_` and 32 random bytes in Base64.
///
/// # Errors
/// If the operating system provides no random numbers.
pub fn new_secret() -> Result<Secret, rand::rand_core::OsError> {
    let mut bytes = [0; SECRET_BYTES];
    OsRng.try_fill_bytes(&mut bytes)?;
    Ok(Secret::new(format!("whsec_{}", base64::engine::general_purpose::STANDARD.encode(bytes))))
}

/// Why an answer does not accept the message; `None` if it does.
fn refusal(status: u16) -> Option<String> {
    match status {
        200..=299 => None,
        300..=399 => Some(format!("{status}: redirects are not followed; set the URL of the webhook to their target")),
        _ => Some(format!("the receiver answered {status}")),
    }
}

/// An error with its causes, without the URL, which may contain a secret.
fn causes(error: reqwest::Error) -> String {
    let error = error.without_url();
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(&error);
    while let Some(next) = cause {
        text = format!("{text}: {next}");
        cause = next.source();
    }
    text
}
