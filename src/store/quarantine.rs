//! Messages from the broker that can never become a batch, and why.

use sqlx::FromRow;

use super::{timestamp, Error, Store};
use crate::quantity::{Digest, Timestamp};

/// Most bytes of a payload that are kept.
const KEPT_BYTES: usize = 64 * 1024;

/// Most messages that are kept: a gateway that sends nothing but nonsense must not fill the disk.
const KEPT_MESSAGES: i64 = 1_000;

/// A message that was put aside.
#[derive(Debug, Clone, PartialEq, Eq, FromRow)]
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

/// A message that was put aside.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct QuarantinedMessage {
    /// Its number.
    pub number: i64,
    /// Where it was published.
    pub topic: String,
    /// SHA-256 of the whole payload.
    pub digest: Digest,
    /// The payload's beginning, at most 64 KiB.
    pub payload: Vec<u8>,
    /// Bytes of the whole payload.
    pub payload_bytes: u64,
    /// Why it is no batch.
    pub reason: String,
    /// How often it was tried, over all its arrivals.
    pub tries: u64,
    /// When it came first.
    pub first_at: Timestamp,
    /// When it came last.
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

impl Store {
    /// Puts a message aside; one that is there already is counted. Beyond a thousand the oldest go.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn quarantine(
        &self,
        topic: &str,
        payload: &[u8],
        reason: &str,
        tries: u32,
        now: Timestamp,
    ) -> Result<(), Error> {
        let (topic, reason, digest) = (topic.to_owned(), reason.to_owned(), Digest::of_file(payload).to_string());
        let (kept, bytes) = (payload[..payload.len().min(KEPT_BYTES)].to_vec(), payload.len() as i64);
        self.write(move |connection| {
            Box::pin(async move {
                sqlx::query(
                    "insert into quarantine (topic, digest, payload, payload_bytes, reason, tries, first_at_us, last_at_us)
                     values (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?7)
                     on conflict (topic, digest) do update set
                         reason = excluded.reason, tries = tries + excluded.tries, last_at_us = excluded.last_at_us",
                )
                .bind(topic)
                .bind(digest)
                .bind(kept)
                .bind(bytes)
                .bind(reason)
                .bind(tries)
                .bind(now.micros())
                .execute(&mut *connection)
                .await?;
                sqlx::query(
                    "delete from quarantine where message <=
                         (select message from quarantine order by message desc limit 1 offset ?)",
                )
                .bind(KEPT_MESSAGES)
                .execute(&mut *connection)
                .await?;
                Ok(())
            })
        })
        .await
    }

    /// Messages that were put aside, newest first; behind number `before`, if given.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn quarantined(&self, before: Option<i64>, limit: usize) -> Result<Vec<QuarantinedMessage>, Error> {
        let rows: Vec<QuarantineRow> =
            sqlx::query_as("select * from quarantine where message < ? order by message desc limit ?")
                .bind(before.unwrap_or(i64::MAX))
                .bind(limit as i64)
                .fetch_all(&self.reader)
                .await?;
        rows.into_iter().map(quarantined).collect()
    }

    /// Removes a message that was put aside. Whether there was one.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn delete_quarantined(&self, number: i64) -> Result<bool, Error> {
        self.write(move |connection| {
            Box::pin(async move {
                let deleted = sqlx::query("delete from quarantine where message = ?");
                Ok(deleted.bind(number).execute(&mut *connection).await?.rows_affected() > 0)
            })
        })
        .await
    }
}
