//! Delivery: finds the webhooks with a due message, and sends to each one in a separate task.
//!
//! A webhook receives one request at a time. Each message is retried on its own schedule; in addition, after any
//! failure the webhook receives no message for the shortest delay between attempts. A failing receiver therefore gets
//! at most one request in that time, however many messages wait for it, and a receiver that refuses only some messages
//! gets the others with at most that delay: messages that were never tried are sent first.

use std::collections::BTreeMap;
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::{Id, JoinSet};
use tracing::{debug, error, info, warn};

use super::backoff::{after_failure, jitter, later, Next};
use super::notifier::{Attempt, Notifier};
use crate::clock;
use crate::quantity::Timestamp;
use crate::store::{Delivery, DeliveryState, Error, Settlement, WebhookRecord};

/// Maximum time between two checks for due messages, so that a jump of the clock is noticed.
const LONGEST_WAIT: Duration = Duration::from_mins(1);

/// Minimum time between two checks for due messages, so that a burst of batches causes one check.
const SHORTEST_WAIT: Duration = Duration::from_millis(200);

/// Delay after an error of the store. A message that was sent but not recorded as such will be sent again, so not
/// immediately.
const PAUSE_AFTER_FAILURE: Duration = Duration::from_secs(10);

/// Time limit for attempts in progress when the service stops.
const GRACE: Duration = Duration::from_secs(3);

/// Interval of the removal of old events.
const PRUNE_EVERY: Duration = Duration::from_hours(1);

impl Notifier {
    /// Delivers messages until `stop` becomes true.
    pub async fn run(self, mut stop: watch::Receiver<bool>) {
        let mut turns = JoinSet::new();
        let mut busy: BTreeMap<Id, String> = BTreeMap::new();
        let mut prune = tokio::time::interval(PRUNE_EVERY);
        loop {
            let wait = match self.start_turns(&mut turns, &mut busy, &stop).await {
                Ok(wait) => wait,
                Err(failure) => {
                    error!(error = %failure, "Could not look for messages to send: {failure}");
                    PAUSE_AFTER_FAILURE
                }
            };
            tokio::select! {
                () = stopped(&mut stop) => break,
                () = self.store.outbox().written() => {
                    self.wake.notify_one();
                    tokio::time::sleep(SHORTEST_WAIT).await;
                }
                Some(ended) = turns.join_next_with_id() => {
                    let id = ended.map_or_else(|panicked| panicked.id(), |(id, ())| id);
                    busy.remove(&id);
                }
                _ = prune.tick() => self.prune().await,
                () = tokio::time::sleep(wait) => {}
            }
        }
        let rest = async { while turns.join_next().await.is_some() {} };
        if tokio::time::timeout(GRACE, rest).await.is_err() {
            debug!("Stopped with deliveries in progress: they are sent again after the next start");
        }
    }

    /// Starts a task for each webhook that has a due message and no running task; returns the time until the next
    /// message is due.
    async fn start_turns(
        &self,
        turns: &mut JoinSet<()>,
        busy: &mut BTreeMap<Id, String>,
        stop: &watch::Receiver<bool>,
    ) -> Result<Duration, Error> {
        let now = clock::now();
        let found = self.store.outbox().webhook_turns(now, self.latest(now)).await?;
        metrics::gauge!("modalwatch_webhook_pending").set(found.pending as f64);
        metrics::gauge!("modalwatch_webhook_dead").set(found.dead as f64);
        *self.trouble.lock().expect("no holder of this lock panics") = (found.failing, found.dead);
        for webhook in found.due {
            if !busy.values().any(|id| *id == webhook) {
                let (notifier, id, stop) = (self.clone(), webhook.clone(), stop.clone());
                let task = turns.spawn(async move { notifier.take_turn(&id, stop).await });
                busy.insert(task.id(), webhook);
            }
        }
        let until = |next: Timestamp| Duration::from_micros((next.micros() - now.micros()).max(0).unsigned_abs());
        Ok(found.next_at.map_or(LONGEST_WAIT, until).clamp(SHORTEST_WAIT, LONGEST_WAIT))
    }

    /// Sends the due messages of a webhook until none is left.
    async fn take_turn(&self, webhook: &str, mut stop: watch::Receiver<bool>) {
        loop {
            let pause = match self.send_due(webhook).await {
                Ok(None) => return,
                Ok(Some(DeliveryState::Delivered)) => Duration::ZERO,
                Ok(Some(DeliveryState::Pending | DeliveryState::Dead)) => {
                    Duration::from_secs(self.settings.first_retry_s)
                }
                Err(failure) => {
                    error!(webhook.id = %webhook, error = %failure, "Could not read or update a delivery: {failure}");
                    PAUSE_AFTER_FAILURE
                }
            };
            if tokio::time::timeout(pause, stopped(&mut stop)).await.is_ok() {
                return;
            }
        }
    }

    /// Sends the next due message of a webhook; returns its new state, or `None` if no message is due.
    async fn send_due(&self, webhook: &str) -> Result<Option<DeliveryState>, Error> {
        let now = clock::now();
        let Some((hook, delivery)) = self.store.outbox().due_delivery(webhook, now, self.latest(now)).await? else {
            return Ok(None);
        };
        let attempt = self.send(&hook, &delivery.event).await;
        let settlement = self.settlement(&delivery, &attempt, clock::now());
        report(&hook, &delivery, &attempt, settlement.state);
        let state = settlement.state;
        self.store.outbox().settle_delivery(delivery.id, settlement).await?;
        Ok(Some(state))
    }

    fn settlement(&self, delivery: &Delivery, attempt: &Attempt, now: Timestamp) -> Settlement {
        let failures = delivery.attempts + 1;
        let failed = || after_failure(&self.settings, failures, delivery.started_at, now, jitter());
        let (state, next_at) = match attempt.error.as_ref().map(|_| failed()) {
            None => (DeliveryState::Delivered, now),
            Some(Next::At(at)) => (DeliveryState::Pending, at),
            Some(Next::GiveUp) => (DeliveryState::Dead, now),
        };
        Settlement { state, at: now, next_at, status: attempt.status, error: attempt.error.clone() }
    }

    /// Latest possible time of an attempt. An attempt planned for later was planned before the clock was set back.
    fn latest(&self, now: Timestamp) -> Timestamp {
        later(now, 2 * self.settings.longest_retry_s)
    }

    async fn prune(&self) {
        let days = self.settings.keep_delivered_days as i64;
        let Ok(before) = Timestamp::from_micros(clock::now().micros() - days * 86_400_000_000) else { return };
        match self.store.outbox().prune_outbox(before).await {
            Ok(0) => {}
            Ok(events) => info!(events, "Deleted {events} old events of the outbox"),
            Err(failure) => error!(error = %failure, "Could not delete old events of the outbox: {failure}"),
        }
    }
}

/// Completes when the service stops.
async fn stopped(stop: &mut watch::Receiver<bool>) {
    // Without a sender no stop signal can come, and the service has ended.
    let _ = stop.wait_for(|stopped| *stopped).await;
}

fn report(webhook: &WebhookRecord, delivery: &Delivery, attempt: &Attempt, state: DeliveryState) {
    let outcome = match state {
        DeliveryState::Delivered => "delivered",
        DeliveryState::Pending => "retry",
        DeliveryState::Dead => "dead",
    };
    metrics::counter!("modalwatch_webhook_deliveries_total", "outcome" => outcome).increment(1);
    let (id, message, kind) = (&webhook.id, &delivery.event.message_id, &delivery.event.kind);
    let (duration_ms, attempts) = (attempt.took.as_secs_f64() * 1e3, delivery.attempts + 1);
    match &attempt.error {
        None => info!(webhook.id = %id, message, duration_ms, attempts, "Delivered {kind} to webhook {id}"),
        Some(error) if state == DeliveryState::Dead => {
            warn!(webhook.id = %id, message, attempts, error, "Gave up the delivery of {kind} to webhook {id}: {error}");
        }
        Some(error) => {
            warn!(webhook.id = %id, message, attempts, error, "Could not deliver {kind} to webhook {id}: {error}");
        }
    }
}
