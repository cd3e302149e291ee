//! Messages by mail: the recipients of the configuration, and one delivery for each event that a recipient wants. SQL triggers fill the
//! deliveries in the transaction of the event (migration 0017).

use super::column::{list, timestamp};
use super::database::Database;
use super::error::Error;
use super::outbox::OutboxEvent;
use super::sql::{self, Whole};
use crate::quantity::{StructureId, Timestamp};

/// State of a mail after an attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MailState {
    /// It waits for its next attempt.
    Pending,
    /// The server has accepted it.
    Delivered,
    /// The alarm is below the least severity of the configuration.
    Skipped,
    /// All attempts failed and it was given up.
    Dead,
}

impl MailState {
    /// Its name, as stored.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Pending => "pending",
            Self::Delivered => "delivered",
            Self::Skipped => "skipped",
            Self::Dead => "dead",
        }
    }
}

/// A mail that is due.
#[derive(Debug, Clone, PartialEq)]
pub struct DueMail {
    /// Its number.
    pub id: i64,
    /// Address of the recipient.
    pub address: String,
    /// The event.
    pub event: OutboxEvent,
    /// Attempts so far.
    pub attempts: u32,
    /// Beginning of the retry schedule.
    pub started_at: Timestamp,
}

/// The mails that wait, and those that were given up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MailFigures {
    /// Mails that wait.
    pub pending: u64,
    /// Waiting mails that have failed before.
    pub failing: u64,
    /// Mails that were given up.
    pub dead: u64,
    /// The next attempt of a waiting mail.
    pub next_at: Option<Timestamp>,
}

/// Columns of a due mail: number, address, attempts, start; message id, kind, structure, alarm, facts and time of its event.
type MailRow = (i64, String, Whole<u32>, i64, String, String, String, i64, String, i64);

/// Mails about alarms.
#[derive(Clone, Copy)]
pub struct Mails<'s> {
    pub(super) database: &'s Database,
}

impl Mails<'_> {
    /// Makes these the recipients. Waiting mails to other addresses are dropped. Nothing is written if these are the recipients already, so
    /// that a service on a full disk starts.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn set_recipients(
        self,
        addresses: Vec<String>,
        events: Vec<String>,
        alarm_kinds: Vec<String>,
    ) -> Result<(), Error> {
        let mut addresses = addresses;
        addresses.sort_unstable();
        addresses.dedup();
        let present: Vec<(String, String, String)> =
            sql::query_as("select address, events, alarm_kinds from mail_recipient order by address")
                .fetch_all(&self.database.reader)
                .await?;
        let (listed_events, listed_kinds) = (list(&events), list(&alarm_kinds));
        if present.iter().map(|row| &row.0).eq(&addresses)
            && present.iter().all(|row| row.1 == listed_events && row.2 == listed_kinds)
        {
            return Ok(());
        }
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    sql::query("delete from mail_recipient").execute(&mut *transaction).await?;
                    for address in addresses {
                        sql::query("insert into mail_recipient values ($1, $2, $3) on conflict do nothing")
                            .bind(address)
                            .bind(&listed_events)
                            .bind(&listed_kinds)
                            .execute(&mut *transaction)
                            .await?;
                    }
                    sql::query(
                        "delete from mail_delivery where state in ('pending', 'dead')
                           and address not in (select address from mail_recipient)",
                    )
                    .execute(&mut *transaction)
                    .await?;
                    Ok(())
                })
            })
            .await
    }

    /// The mail that has been due longest, without those that wait for an older mail about the same alarm to the same address. A mail
    /// planned for after `latest` was planned before the clock was set back, and is due.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn due(self, now: Timestamp, latest: Timestamp) -> Result<Option<DueMail>, Error> {
        let row: Option<MailRow> = sql::query_as(
            "select d.delivery_id, d.address, d.attempts, d.started_at_us, e.message_id, e.kind, e.structure_id, e.episode, e.facts,
                    e.created_at_us
             from mail_delivery d join outbox_event e using (event_id)
             where d.state = 'pending' and (d.next_at_us <= $1 or d.next_at_us > $2)
               and not exists (select 1 from outbox_event older join mail_delivery waiting using (event_id)
                   where older.structure_id = e.structure_id and older.episode = e.episode and older.event_id < e.event_id
                     and waiting.address = d.address and waiting.state = 'pending')
             order by d.next_at_us, d.delivery_id limit 1",
        )
        .bind(now.micros())
        .bind(latest.micros())
        .fetch_optional(&self.database.reader)
        .await?;
        let what = "mail";
        row.map(|(id, address, Whole(attempts), started, message_id, kind, structure, alarm, facts, created)| {
            Ok(DueMail {
                id,
                address,
                attempts,
                started_at: timestamp(what, started)?,
                event: OutboxEvent {
                    message_id,
                    kind,
                    structure: StructureId::parse(&structure).map_err(|e| super::column::bad_row(what)(&e))?,
                    alarm,
                    facts,
                    created_at: timestamp(what, created)?,
                },
            })
        })
        .transpose()
    }

    /// Stores the outcome of an attempt.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn settle(
        self,
        id: i64,
        state: MailState,
        (now, next_at): (Timestamp, Timestamp),
        error: Option<String>,
    ) -> Result<(), Error> {
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    sql::query(
                        "update mail_delivery set state = $1, attempts = attempts + 1, last_at_us = $2, next_at_us = $3,
                             last_error = $4 where delivery_id = $5",
                    )
                    .bind(state.as_str())
                    .bind(now.micros())
                    .bind(next_at.micros())
                    .bind(error)
                    .bind(id)
                    .execute(&mut *transaction)
                    .await?;
                    Ok(())
                })
            })
            .await
    }

    /// How many mails wait, and when the next one is due.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn figures(self) -> Result<MailFigures, Error> {
        let (pending, failing, next, dead): (i64, i64, Option<i64>, i64) = sql::query_as(
            "select count(*), count(*) filter (where attempts > 0), min(next_at_us),
                    (select count(*) from mail_delivery where state = 'dead')
             from mail_delivery where state = 'pending'",
        )
        .fetch_one(&self.database.reader)
        .await?;
        Ok(MailFigures {
            pending: pending.unsigned_abs(),
            failing: failing.unsigned_abs(),
            dead: dead.unsigned_abs(),
            next_at: next.and_then(|at| Timestamp::from_micros(at).ok()),
        })
    }
}
