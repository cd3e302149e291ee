//! Delivery of mails: one after the other, each on its own schedule of retries.
//!
//! All mails go to one server, so after a failure nothing is sent for the shortest delay between attempts. A mail that the server has
//! accepted is recorded before the next one is sent. If the process is killed between the two, the mail is sent again under the same
//! Message-ID.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use lettre::message::Mailbox;
use lettre::{AsyncSmtpTransport, AsyncTransport as _, Tokio1Executor};
use tokio::sync::{watch, Notify};
use tracing::{error, info, warn};

use super::backoff::{after_failure, jitter, later, Next};
use super::email_settings::{EmailSettingError, EmailSettings};
use super::facts::Facts;
use super::mail;
use super::settings::NotifySettings;
use crate::alarm::severity::SeverityLimits;
use crate::clock;
use crate::quantity::Timestamp;
use crate::store::{DueMail, Error, MailFigures, MailState, Store};

/// Maximum time between two checks for due mails.
const LONGEST_WAIT: Duration = Duration::from_mins(1);

/// Minimum time between two checks for due mails.
const SHORTEST_WAIT: Duration = Duration::from_millis(200);

/// Delay after an error of the store.
const PAUSE_AFTER_FAILURE: Duration = Duration::from_secs(10);

/// Maximum length of a stored error, characters.
const LONGEST_ERROR: usize = 300;

/// The connection to the server with the sender.
struct Server {
    transport: AsyncSmtpTransport<Tokio1Executor>,
    sender: Mailbox,
}

/// Sends the mails of the outbox. Cloning is cheap.
#[derive(Clone)]
pub struct Mailer {
    store: Store,
    /// `None` without a server in the configuration.
    server: Option<Arc<Server>>,
    settings: Arc<EmailSettings>,
    notify: Arc<NotifySettings>,
    limits: SeverityLimits,
    figures: Arc<Mutex<MailFigures>>,
    /// Woken when an event may have been stored.
    wake: Arc<Notify>,
}

impl Mailer {
    /// A mailer for the outbox of a store, woken by `wake`.
    ///
    /// # Errors
    /// [`EmailSettingError`], also for a password or certificate that cannot be read.
    pub fn new(
        store: Store,
        settings: EmailSettings,
        notify: NotifySettings,
        limits: SeverityLimits,
        wake: Arc<Notify>,
    ) -> Result<Self, EmailSettingError> {
        settings.check()?;
        let server = if settings.is_off() {
            None
        } else {
            let transport = settings.transport(Duration::from_secs(notify.timeout_s))?;
            Some(Arc::new(Server { transport, sender: settings.sender()? }))
        };
        let figures = Arc::default();
        Ok(Self { store, server, settings: Arc::new(settings), notify: Arc::new(notify), limits, figures, wake })
    }

    /// Stores the recipients, so that events from now on are addressed to them.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn prepare(&self) -> Result<(), Error> {
        let settings = &*self.settings;
        let addresses = if self.server.is_some() { settings.recipients.clone() } else { Vec::new() };
        let count = addresses.len();
        self.store.mails().set_recipients(addresses, settings.events.clone(), settings.alarm_kinds.clone()).await?;
        if self.server.is_some() {
            let (host, port, user) = (&settings.host, settings.port(), &settings.username);
            let as_user = if user.is_empty() { String::new() } else { format!(" as {user}") };
            info!(
                host, port, tls = ?settings.tls, recipients = count,
                "Alarms of severity {} and above are mailed to {count} recipients through {host}:{port}{as_user}",
                settings.least_severity.as_str()
            );
        }
        Ok(())
    }

    /// Finding for `/readyz`; `None` if every mail is delivered.
    pub fn finding(&self) -> Option<String> {
        let MailFigures { failing, dead, .. } = *self.figures.lock().expect("no holder of this lock panics");
        (failing + dead > 0).then(|| {
            format!(
                "{failing} mail(s) about alarms were not accepted by {}:{} yet, {dead} were given up: the log says why",
                self.settings.host,
                self.settings.port()
            )
        })
    }

    /// Delivers mails until `stop` becomes true.
    pub async fn run(self, mut stop: watch::Receiver<bool>) {
        if self.server.is_none() {
            return;
        }
        loop {
            let wait = match self.turn(&stop).await {
                Ok(wait) => wait,
                Err(failure) => {
                    error!(error = %failure, "Could not read or update a mail: {failure}");
                    PAUSE_AFTER_FAILURE
                }
            };
            tokio::select! {
                () = stopped(&mut stop) => return,
                () = self.wake.notified() => tokio::time::sleep(SHORTEST_WAIT).await,
                () = tokio::time::sleep(wait) => {}
            }
        }
    }

    /// Sends all due mails; returns the time until the next one is due.
    async fn turn(&self, stop: &watch::Receiver<bool>) -> Result<Duration, Error> {
        loop {
            let now = clock::now();
            let latest = later(now, 2 * self.notify.longest_retry_s);
            let figures = self.store.mails().figures().await?;
            metrics::gauge!("modalwatch_mail_pending").set(figures.pending as f64);
            metrics::gauge!("modalwatch_mail_dead").set(figures.dead as f64);
            *self.figures.lock().expect("no holder of this lock panics") = figures;
            let stopping = *stop.borrow();
            let due = if stopping { None } else { self.store.mails().due(now, latest).await? };
            let Some(due) = due else {
                let until = |at: Timestamp| Duration::from_micros((at.micros() - now.micros()).max(0).unsigned_abs());
                return Ok(figures.next_at.map_or(LONGEST_WAIT, until).clamp(SHORTEST_WAIT, LONGEST_WAIT));
            };
            if self.send_and_settle(&due).await? == MailState::Pending {
                let pause = Duration::from_secs(self.notify.first_retry_s);
                let mut stop = stop.clone();
                if tokio::time::timeout(pause, stopped(&mut stop)).await.is_ok() {
                    return Ok(SHORTEST_WAIT);
                }
            }
        }
    }

    /// Sends a mail and records the outcome.
    async fn send_and_settle(&self, due: &DueMail) -> Result<MailState, Error> {
        let sent = self.send(due).await;
        let now = clock::now();
        let (state, next_at, failure) = match sent {
            Ok(state) => (state, now, None),
            Err(failure) => match after_failure(&self.notify, due.attempts + 1, due.started_at, now, jitter()) {
                Next::At(at) => (MailState::Pending, at, Some(failure)),
                Next::GiveUp => (MailState::Dead, now, Some(failure)),
            },
        };
        let (kind, message, to) = (&due.event.kind, &due.event.message_id, &due.address);
        let outcome = if state == MailState::Pending { "retry" } else { state.as_str() };
        metrics::counter!("modalwatch_mail_deliveries_total", "outcome" => outcome).increment(1);
        match &failure {
            None if state == MailState::Delivered => info!(message, to, "Mailed {kind} to {to}"),
            None => {}
            Some(error) if state == MailState::Dead => {
                warn!(message, to, error, "Gave up the mail about {kind} to {to}: {error}");
            }
            Some(error) => warn!(message, to, error, "Could not mail {kind} to {to}: {error}"),
        }
        self.store.mails().settle(due.id, state, (now, next_at), failure).await?;
        Ok(state)
    }

    async fn send(&self, due: &DueMail) -> Result<MailState, String> {
        let Some(server) = &self.server else { return Err("no server is configured".to_owned()) };
        let facts: Facts =
            serde_json::from_str(&due.event.facts).map_err(|e| format!("the stored event cannot be read: {e}"))?;
        if mail::severity(&facts, self.limits).grade < self.settings.least_severity {
            return Ok(MailState::Skipped);
        }
        let letter = mail::letter(&due.event, &facts, self.limits, &self.notify.public_url);
        let message = mail::mail(due, letter, &server.sender)?;
        let limit = Duration::from_secs(self.notify.timeout_s);
        let sent = tokio::time::timeout(limit, server.transport.send(message)).await;
        match sent {
            Ok(Ok(_)) => Ok(MailState::Delivered),
            Ok(Err(error)) => Err(causes(&error)),
            Err(_) => Err(format!("the server did not answer within {} s", self.notify.timeout_s)),
        }
    }
}

/// Completes when the service stops.
async fn stopped(stop: &mut watch::Receiver<bool>) {
    // Without a sender no stop signal can come, and the service has ended.
    let _ = stop.wait_for(|stopped| *stopped).await;
}

/// An error with its causes on one line.
fn causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(next) = cause {
        text = format!("{text}: {next}");
        cause = next.source();
    }
    text.chars().map(|c| if c.is_control() { ' ' } else { c }).take(LONGEST_ERROR).collect()
}
