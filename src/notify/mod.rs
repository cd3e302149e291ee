//! The messenger: tells other programs of alarms, by webhooks.
//!
//! The store's triggers write what there is to tell, in the transaction that changes the alarm. From there on a message is
//! sent at least once: until its receiver takes it, or until it has been tried for days and becomes a dead letter. A receiver
//! that is slow or down delays nobody else. The messages of an alarm come in their order; one that is refused holds back those
//! of its own alarm only.

pub mod address;
mod backoff;
mod deliver;
mod message;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use base64::Engine as _;
use rand::rngs::OsRng;
use rand::TryRngCore as _;
use reqwest::{header, redirect, Certificate, Client, ClientBuilder, Url};
use serde::{Deserialize, Serialize};

use crate::quantity::Timestamp;
use crate::store::{OutboxEvent, Secret, Store, WebhookRecord};
use address::{Guard, GuardedResolver};
use message::Message;
pub use message::EVENT_KINDS;

/// Bytes of a secret: the Standard Webhooks ask for 24 to 64.
const SECRET_BYTES: usize = 32;

/// Most characters of an error that are kept.
const LONGEST_ERROR: usize = 300;

/// How messages are sent.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NotifySettings {
    /// Where people reach this service, such as `https://shm.example.org`; stands before the paths in messages.
    pub public_url: String,
    /// Longest time for a receiver's answer, seconds.
    pub timeout_s: u64,
    /// Pause before the second attempt, seconds; each further one is three times as long. A receiver gets no other message in
    /// the time after a failure either.
    pub first_retry_s: u64,
    /// Longest pause between attempts, seconds.
    pub longest_retry_s: u64,
    /// A message that nobody took for so long becomes a dead letter, seconds.
    pub give_up_after_s: u64,
    /// After a new secret, the one before signs too for so long, seconds.
    pub secret_overlap_s: u64,
    /// Delivered messages are listed for so long, days.
    pub keep_delivered_days: u64,
    /// Private addresses that webhooks may reach all the same: `10.0.0.0/8`, `192.168.1.7`, `127.0.0.1:9999`.
    pub allow_private_targets: Vec<String>,
}

impl Default for NotifySettings {
    fn default() -> Self {
        Self {
            public_url: String::new(),
            timeout_s: 10,
            first_retry_s: 5,
            longest_retry_s: 1_800,
            give_up_after_s: 3 * 86_400,
            secret_overlap_s: 86_400,
            keep_delivered_days: 30,
            allow_private_targets: Vec::new(),
        }
    }
}

impl NotifySettings {
    /// The first setting that is out of range, its value, and what would be right.
    pub fn problem(&self) -> Option<(&'static str, String, &'static str)> {
        let seconds = [
            ("notify.timeout_s", self.timeout_s, 120, "from 1 to 120"),
            ("notify.first_retry_s", self.first_retry_s, self.longest_retry_s, "from 1 to notify.longest_retry_s"),
            ("notify.longest_retry_s", self.longest_retry_s, 86_400, "from 1 to 86400"),
            ("notify.give_up_after_s", self.give_up_after_s, 30 * 86_400, "from 1 to 2592000"),
            ("notify.secret_overlap_s", self.secret_overlap_s, 30 * 86_400, "from 1 to 2592000"),
            ("notify.keep_delivered_days", self.keep_delivered_days, 3_650, "from 1 to 3650"),
        ];
        if let Some((key, value, _, must)) =
            seconds.into_iter().find(|(_, value, most, _)| !(1..=*most).contains(value))
        {
            return Some((key, value.to_string(), must));
        }
        let web = |url: &Url| ["http", "https"].contains(&url.scheme());
        if !self.public_url.is_empty() && !Url::parse(&self.public_url).is_ok_and(|url| web(&url)) {
            return Some(("notify.public_url", self.public_url.clone(), "empty or a URL with http or https"));
        }
        let target = Guard::new(&self.allow_private_targets).err()?;
        Some(("notify.allow_private_targets", target, "addresses, address:port or networks, such as 10.0.0.0/8"))
    }
}

/// One attempt to deliver a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Attempt {
    /// HTTP status, if there was an answer.
    pub status: Option<u16>,
    /// How long it took.
    pub took: Duration,
    /// Why the receiver has not taken it; `None` when it has.
    pub error: Option<String>,
}

/// The messenger: a cheap handle.
#[derive(Clone)]
pub struct Notifier {
    store: Store,
    guard: Arc<Guard>,
    settings: Arc<NotifySettings>,
    /// Webhooks that do not take their messages, and dead letters, at the last look.
    trouble: Arc<Mutex<(u64, u64)>>,
    /// One for each port, since what an address may be asked depends on it.
    clients: Arc<Mutex<BTreeMap<u16, Client>>>,
}

impl Notifier {
    /// A messenger for the outbox of a store.
    ///
    /// # Errors
    /// The entry of `allow_private_targets` that is no address and no network.
    pub fn new(store: Store, settings: NotifySettings) -> Result<Self, String> {
        let guard = Arc::new(Guard::new(&settings.allow_private_targets)?);
        Ok(Self { store, guard, settings: Arc::new(settings), trouble: Arc::default(), clients: Arc::default() })
    }

    /// What may be reached.
    pub fn guard(&self) -> &Guard {
        &self.guard
    }

    /// What is wrong, for a report; `None` when every message arrives. Alarms are raised all the same: a degraded service, not
    /// one that is not ready.
    pub fn finding(&self) -> Option<String> {
        let (failing, dead) = *self.trouble.lock().expect("no holder of this lock panics");
        (failing + dead > 0).then(|| {
            format!(
                "{failing} webhook(s) do not take their messages at present, {dead} message(s) were given up: see \
                 GET /v1/webhooks/{{id}}/deliveries?state=dead"
            )
        })
    }

    /// Until when the secret before a new one signs too.
    pub fn overlap_until(&self, now: Timestamp) -> Timestamp {
        later(now, self.settings.secret_overlap_s)
    }

    /// Sends a message that only says that it is a test.
    pub async fn test(&self, webhook: &WebhookRecord) -> Attempt {
        let id = format!("msg_{}", uuid::Uuid::now_v7().simple());
        self.attempt(webhook, &Message::test(&id, &self.settings.public_url, Timestamp::now())).await
    }

    /// Sends a message of the outbox.
    async fn send(&self, webhook: &WebhookRecord, event: &OutboxEvent) -> Attempt {
        match Message::of_event(event, &self.settings.public_url) {
            Ok(message) => self.attempt(webhook, &message).await,
            Err(error) => Attempt { status: None, took: Duration::ZERO, error: Some(error.to_string()) },
        }
    }

    /// One attempt; it never lasts longer than the timeout.
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

    /// Posts a message; the answer's status. Its body is not read: it could be of any size, and of anything.
    async fn post(&self, webhook: &WebhookRecord, message: &Message) -> Result<u16, String> {
        let url = self.guard.check_url(&webhook.url)?;
        let now = Timestamp::now();
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
            // A proxy would resolve names itself, behind the guard.
            .no_proxy()
            // A connection for each message: the guard sees every address, and none is found closed when it matters.
            .pool_max_idle_per_host(0)
            .user_agent(concat!("modalwatch/", env!("CARGO_PKG_VERSION")))
            .build()
            .map_err(causes)?;
        clients.insert(port, client.clone());
        Ok(client)
    }
}

/// Makes `ring` the TLS implementation of this process. Every call after the first changes nothing.
///
/// An HTTP client that is built before the first call panics.
pub fn install_tls_provider() {
    // An error means that a provider is installed already.
    let _ = rustls::crypto::ring::default_provider().install_default();
}

/// A builder of HTTP clients that trust the system's certificates and Mozilla's: without the latter there would be no client at
/// all, not even for http, where the system has none, as in small container images.
pub fn client_builder() -> ClientBuilder {
    install_tls_provider();
    let certificates = webpki_root_certs::TLS_SERVER_ROOT_CERTS.iter();
    Client::builder().tls_certs_merge(certificates.filter_map(|der| Certificate::from_der(der).ok()))
}

/// A new secret, `whsec_` and 32 random bytes in Base64.
///
/// # Errors
/// The operating system gives no random numbers.
pub fn new_secret() -> Result<Secret, rand::rand_core::OsError> {
    let mut bytes = [0; SECRET_BYTES];
    OsRng.try_fill_bytes(&mut bytes)?;
    Ok(Secret::new(format!("whsec_{}", base64::engine::general_purpose::STANDARD.encode(bytes))))
}

/// Why an answer is none that takes the message.
fn refusal(status: u16) -> Option<String> {
    match status {
        200..=299 => None,
        300..=399 => Some(format!("{status}: redirects are not followed; give the webhook the address they lead to")),
        _ => Some(format!("the receiver answered {status}")),
    }
}

/// An error with its causes, and without the URL, which may hold a secret.
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

fn seconds(at: Timestamp) -> i64 {
    at.micros().div_euclid(1_000_000)
}

/// `at` plus seconds; settings keep them far from the end of the calendar.
fn later(at: Timestamp, seconds: u64) -> Timestamp {
    Timestamp::from_micros(at.micros() + seconds as i64 * 1_000_000).unwrap_or(at)
}
