//! Messages from the MQTT broker that cannot become a batch, with the reason.

use sqlx::FromRow;

use super::column::timestamp;
use super::damaged::Page;
use super::database::Database;
use super::error::Error;
use super::sql;
use crate::quantity::{Digest, Timestamp};

/// Largest number of bytes of a payload that is kept.
const KEPT_BYTES: usize = 64 * 1024;

/// Largest number of messages that is kept, so that a faulty gateway cannot fill the disk.
const KEPT_MESSAGES: i64 = 1_000;

#[derive(FromRow)]
struct QuarantineRow {
    message: i64,
    topic: String,
    digest: String,
    payload: Vec<u8>,
    payload_bytes: i64,
    reason: String,
    tries: i64,
    first_at_us: i64,
    last_at_us: i64,
}

/// A quarantined message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct QuarantinedMessage {
    /// Its number.
    pub number: i64,
    /// Its topic.
    pub topic: String,
    /// SHA-256 of the whole payload.
    pub digest: Digest,
    /// The beginning of the payload, at most 64 KiB.
    pub payload: Vec<u8>,
    /// Size of the whole payload, bytes.
    pub payload_bytes: u64,
    /// Why it is not a batch.
    pub reason: String,
    /// Number of attempts to store it, over all its arrivals.
    pub tries: u64,
    /// When it arrived first.
    pub first_at: Timestamp,
    /// When it arrived last.
    pub last_at: Timestamp,
}

fn quarantined(row: QuarantineRow) -> Result<QuarantinedMessage, Error> {
    let what = "quarantined message";
    Ok(QuarantinedMessage {
        number: row.message,
        topic: row.topic,
        digest: Digest::from_stored(row.digest),
        payload: row.payload,
        payload_bytes: row.payload_bytes.unsigned_abs(),
        reason: row.reason,
        tries: row.tries.unsigned_abs(),
        first_at: timestamp(what, row.first_at_us)?,
        last_at: timestamp(what, row.last_at_us)?,
    })
}

/// Messages that could not become a batch.
#[derive(Clone, Copy)]
pub struct Quarantine<'s> {
    pub(super) database: &'s Database,
}

impl Quarantine<'_> {
    /// Stores a message, or counts another arrival of a stored one. Only the newest thousand messages are kept.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn insert(
        self,
        topic: &str,
        payload: &[u8],
        reason: &str,
        tries: u32,
        now: Timestamp,
    ) -> Result<(), Error> {
        let (topic, reason, digest) = (topic.to_owned(), reason.to_owned(), Digest::of_file(payload).to_string());
        let (kept, bytes) = (payload[..payload.len().min(KEPT_BYTES)].to_vec(), payload.len() as i64);
        self.database.write(move |transaction| {
            Box::pin(async move {
                sql::query(
                    "insert into quarantine (topic, digest, payload, payload_bytes, reason, tries, first_at_us, last_at_us)
                     values ($1, $2, $3, $4, $5, $6, $7, $7)
                     on conflict (topic, digest) do update set
                         reason = excluded.reason, tries = quarantine.tries + excluded.tries, last_at_us = excluded.last_at_us",
                )
                .bind(topic)
                .bind(digest)
                .bind(kept)
                .bind(bytes)
                .bind(reason)
                .bind(tries)
                .bind(now.micros())
                .execute(&mut *transaction)
                .await?;
                sql::query(
                    "delete from quarantine where message <=
                         (select message from quarantine order by message desc limit 1 offset $1)",
                )
                .bind(KEPT_MESSAGES)
                .execute(&mut *transaction)
                .await?;
                Ok(())
            })
        })
        .await
    }

    /// Quarantined messages, newest first: those with numbers below `before`, if given.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn quarantined(self, before: Option<i64>, limit: usize) -> Result<Vec<QuarantinedMessage>, Error> {
        let page = Page { limit, behind: before.unwrap_or(i64::MAX), names: 1 };
        let statement = |before: &i64, limit: i64| {
            sql::query_as("select * from quarantine where message < $1 order by message desc limit $2")
                .bind(*before)
                .bind(limit)
        };
        self.database.damaged.page(&self.database.reader, page, statement, |row| row.get(0), quarantined).await
    }

    /// Deletes a quarantined message, below the minimum of free space as well. Returns whether it existed.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn delete_quarantined(self, number: i64) -> Result<bool, Error> {
        self.database
            .write_without_floor(move |transaction| {
                Box::pin(async move {
                    let deleted = sql::query("delete from quarantine where message = $1");
                    Ok(deleted.bind(number).execute(&mut *transaction).await?.rows_affected() > 0)
                })
            })
            .await
    }
}
