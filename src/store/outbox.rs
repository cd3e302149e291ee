//! The outbox: messages to webhooks, with one delivery for each webhook that subscribes to the event. SQL triggers fill it
//! (migration 0005).
//!
//! A message may be sent if no older message about the same alarm waits for the same webhook. The messages of an alarm are thus
//! sent in order, and a refused message does not delay those of other alarms.

use sqlx::FromRow;

use super::column::{bad_row, timestamp};
use super::damaged::Page;
use super::database::Database;
use super::error::Error;
use super::sql::{self, Whole};
use super::webhook::{WebhookRecord, WebhookRow};
use crate::quantity::{StructureId, Timestamp};

/// State of a delivery.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeliveryState {
    /// It waits for its next attempt.
    Pending,
    /// The receiver has accepted it.
    Delivered,
    /// All attempts failed and it was given up.
    Dead,
}

impl DeliveryState {
    /// All states.
    pub const ALL: [Self; 3] = [Self::Pending, Self::Delivered, Self::Dead];

    /// Its name, as stored and as answered.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Pending => "pending",
            Self::Delivered => "delivered",
            Self::Dead => "dead",
        }
    }
}

/// A change of an alarm.
#[derive(Debug, Clone, PartialEq)]
pub struct OutboxEvent {
    /// Id of the message, the same at every attempt.
    pub message_id: String,
    /// Kind of the event, such as `alarm.opened`.
    pub kind: String,
    /// The structure.
    pub structure: StructureId,
    /// Number of the alarm within the structure.
    pub alarm: i64,
    /// The properties of the alarm at that time, JSON.
    pub facts: String,
    /// When it happened.
    pub created_at: Timestamp,
}

/// A message to one webhook.
#[derive(Debug, Clone, PartialEq)]
pub struct Delivery {
    /// Its number.
    pub id: i64,
    /// The event.
    pub event: OutboxEvent,
    /// Its state.
    pub state: DeliveryState,
    /// Attempts so far.
    pub attempts: u32,
    /// Beginning of the retry schedule.
    pub started_at: Timestamp,
    /// Next attempt, while pending.
    pub next_at: Timestamp,
    /// Last attempt.
    pub last_at: Option<Timestamp>,
    /// HTTP status of the last answer.
    pub last_status: Option<u16>,
    /// Why the last attempt failed.
    pub last_error: Option<String>,
}

/// The outcome of an attempt.
#[derive(Debug, Clone, PartialEq)]
pub struct Settlement {
    /// The state after it.
    pub state: DeliveryState,
    /// Time of the attempt.
    pub at: Timestamp,
    /// Time of the next attempt; ignored unless the state is pending.
    pub next_at: Timestamp,
    /// HTTP status, if there was an answer.
    pub status: Option<u16>,
    /// Why it failed.
    pub error: Option<String>,
}

/// The webhooks with messages to send.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Turns {
    /// Webhooks with a message that is due.
    pub due: Vec<String>,
    /// When the next message of the other webhooks is due.
    pub next_at: Option<Timestamp>,
    /// Number of webhooks with a waiting message that has failed before.
    pub failing: u64,
    /// Number of waiting messages.
    pub pending: u64,
    /// Number of messages that were given up.
    pub dead: u64,
}

#[derive(FromRow)]
struct DeliveryRow {
    delivery_id: i64,
    state: String,
    attempts: Whole<u32>,
    started_at_us: i64,
    next_at_us: i64,
    last_at_us: Option<i64>,
    last_status: Option<Whole<u16>>,
    last_error: Option<String>,
    message_id: String,
    kind: String,
    structure_id: String,
    episode: i64,
    facts: String,
    created_at_us: i64,
}

const DELIVERY_COLUMNS: &str =
    "d.delivery_id, d.state, d.attempts, d.started_at_us, d.next_at_us, d.last_at_us, d.last_status, d.last_error,
     e.message_id, e.kind, e.structure_id, e.episode, e.facts, e.created_at_us";

/// Condition that a delivery `d` is due at $1, or was scheduled after $2, which happens only if the clock was set back since.
const DUE: &str = "d.state = 'pending' and (d.next_at_us <= $1 or d.next_at_us > $2)";

/// Condition that no older message about the alarm of a delivery `d` of an event `e` waits for the same webhook.
const FIRST_OF_ITS_ALARM: &str =
    "not exists (select 1 from outbox_event older join webhook_delivery waiting using (event_id)
         where older.structure_id = e.structure_id and older.episode = e.episode and older.event_id < e.event_id
           and waiting.webhook_id = d.webhook_id and waiting.state = 'pending')";

fn delivery(row: DeliveryRow) -> Result<Delivery, Error> {
    let what = "webhook delivery";
    let state = DeliveryState::ALL.into_iter().find(|state| state.as_str() == row.state);
    Ok(Delivery {
        id: row.delivery_id,
        event: OutboxEvent {
            message_id: row.message_id,
            kind: row.kind,
            structure: StructureId::parse(&row.structure_id).map_err(|e| bad_row(what)(&e))?,
            alarm: row.episode,
            facts: row.facts,
            created_at: timestamp(what, row.created_at_us)?,
        },
        state: state.ok_or_else(|| bad_row(what)(&row.state))?,
        attempts: row.attempts.0,
        started_at: timestamp(what, row.started_at_us)?,
        next_at: timestamp(what, row.next_at_us)?,
        last_at: row.last_at_us.map(|at| timestamp(what, at)).transpose()?,
        last_status: row.last_status.map(|status| status.0),
        last_error: row.last_error,
    })
}

/// Messages to webhooks.
#[derive(Clone, Copy)]
pub struct Outbox<'s> {
    pub(super) database: &'s Database,
}

impl Outbox<'_> {
    /// Completes when something was written since the last call. It must have one caller only.
    pub async fn written(self) {
        self.database.writer.written.notified().await;
    }

    /// The webhooks with a message that may be sent and is due: its next attempt is not after `now`, or is after `latest`, which
    /// happens only if the clock was set back.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn webhook_turns(self, now: Timestamp, latest: Timestamp) -> Result<Turns, Error> {
        let select = format!(
            "select w.webhook_id,
                    exists (select 1 from webhook_delivery d join outbox_event e using (event_id)
                        where d.webhook_id = w.webhook_id and {DUE} and {FIRST_OF_ITS_ALARM}),
                    exists (select 1 from webhook_delivery d
                        where d.webhook_id = w.webhook_id and d.state = 'pending' and d.attempts > 0),
                    (select min(d.next_at_us) from webhook_delivery d
                        where d.webhook_id = w.webhook_id and d.state = 'pending' and d.next_at_us > $1)
             from webhook w where w.enabled = 1"
        );
        let webhooks: Vec<(String, bool, bool, Option<i64>)> = sql::query_as(sqlx::AssertSqlSafe(select))
            .bind(now.micros())
            .bind(latest.micros())
            .fetch_all(&self.database.reader)
            .await?;
        let (pending, dead): (i64, i64) = sql::query_as(
            "select (select count(*) from webhook_delivery where state = 'pending'),
                    (select count(*) from webhook_delivery where state = 'dead')",
        )
        .fetch_one(&self.database.reader)
        .await?;
        let mut turns = Turns { pending: pending.unsigned_abs(), dead: dead.unsigned_abs(), ..Turns::default() };
        for (webhook, due, failing, next_at_us) in webhooks {
            turns.failing += u64::from(failing);
            if due {
                turns.due.push(webhook);
            } else if let Some(next_at) = next_at_us.and_then(|at| Timestamp::from_micros(at).ok()) {
                turns.next_at = Some(turns.next_at.map_or(next_at, |soonest| soonest.min(next_at)));
            }
        }
        Ok(turns)
    }

    /// The next message of a webhook: messages without an attempt come before those that failed, then the one that has been due
    /// longest; due as in [`Self::webhook_turns`]. `None` if no message is due or the webhook is disabled.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn due_delivery(
        self,
        webhook: &str,
        now: Timestamp,
        latest: Timestamp,
    ) -> Result<Option<(WebhookRecord, Delivery)>, Error> {
        let mut reader = self.database.reader.acquire().await?;
        let hook: Option<WebhookRow> = sql::query_as("select * from webhook where webhook_id = $1 and enabled = 1")
            .bind(webhook)
            .fetch_optional(&mut reader)
            .await?;
        let Some(hook) = hook else { return Ok(None) };
        // Two queries that each follow the order of an index, so that SQLite does not sort thousands of waiting messages.
        for rest in ["and d.attempts = 0 order by d.delivery_id", "order by d.next_at_us, d.delivery_id"] {
            let select = format!(
                "select {DELIVERY_COLUMNS} from webhook_delivery d join outbox_event e using (event_id)
                 where {DUE} and {FIRST_OF_ITS_ALARM} and d.webhook_id = $3 {rest} limit 1"
            );
            let row: Option<DeliveryRow> = sql::query_as(sqlx::AssertSqlSafe(select))
                .bind(now.micros())
                .bind(latest.micros())
                .bind(webhook)
                .fetch_optional(&mut reader)
                .await?;
            if let Some(row) = row {
                return Ok(Some((hook.into_record()?, delivery(row)?)));
            }
        }
        Ok(None)
    }

    /// Stores the outcome of an attempt.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn settle_delivery(self, id: i64, settlement: Settlement) -> Result<(), Error> {
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    sql::query(
                    "update webhook_delivery set state = $1, attempts = attempts + 1, next_at_us = $2, last_at_us = $3,
                         last_status = $4, last_error = $5 where delivery_id = $6",
                )
                .bind(settlement.state.as_str())
                .bind(settlement.next_at.micros())
                .bind(settlement.at.micros())
                .bind(settlement.status)
                .bind(settlement.error)
                .bind(id)
                .execute(&mut *transaction)
                .await?;
                    Ok(())
                })
            })
            .await
    }

    /// Messages of a webhook, newest first: those with numbers below `before`, if given, and only those in `state`, if given.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn deliveries(
        self,
        webhook: &str,
        state: Option<DeliveryState>,
        before: Option<i64>,
        limit: usize,
    ) -> Result<Vec<Delivery>, Error> {
        let select = format!(
            "select {DELIVERY_COLUMNS} from webhook_delivery d join outbox_event e using (event_id)
             where d.webhook_id = $1 and d.delivery_id < $2 and ($3 is null or d.state = $3)
             order by d.delivery_id desc limit $4"
        );
        let page = Page { limit, behind: before.unwrap_or(i64::MAX), names: 1 };
        let statement = |before: &i64, limit: i64| {
            sql::query_as(sqlx::AssertSqlSafe(select.clone()))
                .bind(webhook)
                .bind(*before)
                .bind(state.map(DeliveryState::as_str))
                .bind(limit)
        };
        self.database.damaged.page(&self.database.reader, page, statement, |row| row.get(0), delivery).await
    }

    /// Makes a message due now and restarts its retries, unless it was delivered. Returns the message after the change.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn retry_delivery(self, webhook: &str, id: i64, now: Timestamp) -> Result<Option<Delivery>, Error> {
        let webhook = webhook.to_owned();
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    sql::query(
                        "update webhook_delivery set state = 'pending', started_at_us = $1, next_at_us = $1
                     where webhook_id = $2 and delivery_id = $3 and state <> 'delivered'",
                    )
                    .bind(now.micros())
                    .bind(&webhook)
                    .bind(id)
                    .execute(&mut *transaction)
                    .await?;
                    let select = format!(
                        "select {DELIVERY_COLUMNS} from webhook_delivery d join outbox_event e using (event_id)
                     where d.webhook_id = $1 and d.delivery_id = $2"
                    );
                    let row: Option<DeliveryRow> = sql::query_as(sqlx::AssertSqlSafe(select))
                        .bind(&webhook)
                        .bind(id)
                        .fetch_optional(&mut *transaction)
                        .await?;
                    row.map(delivery).transpose()
                })
            })
            .await
    }

    /// Deletes delivered messages and events without messages from before a time. Waiting and dead messages are kept. Returns the
    /// number of deleted events.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn prune_outbox(self, before: Timestamp) -> Result<u64, Error> {
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    sql::query(
                        "delete from webhook_delivery where state = 'delivered'
                       and event_id in (select event_id from outbox_event where created_at_us < $1)",
                    )
                    .bind(before.micros())
                    .execute(&mut *transaction)
                    .await?;
                    sql::query(
                        "delete from mail_delivery where state in ('delivered', 'skipped')
                       and event_id in (select event_id from outbox_event where created_at_us < $1)",
                    )
                    .bind(before.micros())
                    .execute(&mut *transaction)
                    .await?;
                    let deleted = sql::query(
                        "delete from outbox_event where created_at_us < $1
                       and not exists (select 1 from webhook_delivery d where d.event_id = outbox_event.event_id)
                       and not exists (select 1 from mail_delivery d where d.event_id = outbox_event.event_id)",
                    )
                    .bind(before.micros())
                    .execute(&mut *transaction)
                    .await?;
                    Ok(deleted.rows_affected())
                })
            })
            .await
    }
}
