//! Webhooks: who is told of alarms.

use std::fmt;

use sqlx::FromRow;

use super::{bad_row, timestamp, Error, Store};
use crate::quantity::Timestamp;

/// A signing secret; it shows itself only to those who ask for its text.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(String);

impl Secret {
    /// A secret of its text, `whsec_…`.
    pub fn new(text: String) -> Self {
        Self(text)
    }

    /// The text: for signing, and for the one answer that gives it out.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret(…)")
    }
}

/// Which events a webhook wants; an empty list stands for all.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct EventFilter {
    /// Kinds of events, such as `alarm.opened`.
    pub events: Vec<String>,
    /// Kinds of alarms, such as `damage`.
    pub alarm_kinds: Vec<String>,
    /// Ids of structures.
    pub structures: Vec<String>,
}

/// A stored webhook.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WebhookRecord {
    /// Its id, a UUIDv7.
    pub id: String,
    /// Where messages go.
    pub url: String,
    /// Signs messages.
    pub secret: Secret,
    /// Signs them too, until a time.
    pub previous_secret: Option<(Secret, Timestamp)>,
    /// What it wants.
    pub filter: EventFilter,
    /// False: nothing is put into its outbox, nothing is sent.
    pub enabled: bool,
    /// When it was made.
    pub created_at: Timestamp,
    /// When it was last changed.
    pub updated_at: Timestamp,
}

#[derive(FromRow)]
pub(super) struct WebhookRow {
    webhook_id: String,
    url: String,
    secret: String,
    previous_secret: Option<String>,
    previous_until_us: Option<i64>,
    events: String,
    alarm_kinds: String,
    structures: String,
    enabled: bool,
    created_at_us: i64,
    updated_at_us: i64,
}

impl WebhookRow {
    pub(super) fn into_record(self) -> Result<WebhookRecord, Error> {
        let what = "webhook";
        let list = |text: &str| serde_json::from_str(text).map_err(|e| bad_row(what)(&e));
        let previous_secret = match (self.previous_secret, self.previous_until_us) {
            (Some(secret), Some(until)) => Some((Secret(secret), timestamp(what, until)?)),
            _ => None,
        };
        Ok(WebhookRecord {
            id: self.webhook_id,
            url: self.url,
            secret: Secret(self.secret),
            previous_secret,
            filter: EventFilter {
                events: list(&self.events)?,
                alarm_kinds: list(&self.alarm_kinds)?,
                structures: list(&self.structures)?,
            },
            enabled: self.enabled,
            created_at: timestamp(what, self.created_at_us)?,
            updated_at: timestamp(what, self.updated_at_us)?,
        })
    }
}

/// A list as the triggers read it.
fn json(list: &[String]) -> String {
    serde_json::to_string(list).expect("a list of texts is plain data")
}

impl Store {
    /// Stores a new webhook, unless there are `most` already. Whether it was stored.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn insert_webhook(&self, webhook: WebhookRecord, most: usize) -> Result<bool, Error> {
        self.write(move |connection| {
            Box::pin(async move {
                let (found,): (i64,) =
                    sqlx::query_as("select count(*) from webhook").fetch_one(&mut *connection).await?;
                if found >= most as i64 {
                    return Ok(false);
                }
                sqlx::query("insert into webhook values (?, ?, ?, null, null, ?, ?, ?, ?, ?, ?)")
                    .bind(webhook.id)
                    .bind(webhook.url)
                    .bind(webhook.secret.0)
                    .bind(json(&webhook.filter.events))
                    .bind(json(&webhook.filter.alarm_kinds))
                    .bind(json(&webhook.filter.structures))
                    .bind(webhook.enabled)
                    .bind(webhook.created_at.micros())
                    .bind(webhook.updated_at.micros())
                    .execute(&mut *connection)
                    .await?;
                Ok(true)
            })
        })
        .await
    }

    /// Gives a webhook another address, filter or switch; its secrets stay. Whether there is such a webhook.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn update_webhook(
        &self,
        id: &str,
        url: &str,
        filter: EventFilter,
        enabled: bool,
        now: Timestamp,
    ) -> Result<bool, Error> {
        let (id, url) = (id.to_owned(), url.to_owned());
        self.write(move |connection| {
            Box::pin(async move {
                let updated = sqlx::query(
                    "update webhook set url = ?, events = ?, alarm_kinds = ?, structures = ?, enabled = ?,
                         updated_at_us = ? where webhook_id = ?",
                )
                .bind(url)
                .bind(json(&filter.events))
                .bind(json(&filter.alarm_kinds))
                .bind(json(&filter.structures))
                .bind(enabled)
                .bind(now.micros())
                .bind(id)
                .execute(&mut *connection)
                .await?;
                Ok(updated.rows_affected() > 0)
            })
        })
        .await
    }

    /// Makes `secret` the one that signs; the one before signs too until `previous_until`. Whether there is such a webhook.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn rotate_secret(
        &self,
        id: &str,
        secret: Secret,
        previous_until: Timestamp,
        now: Timestamp,
    ) -> Result<bool, Error> {
        let id = id.to_owned();
        self.write(move |connection| {
            Box::pin(async move {
                let updated = sqlx::query(
                    "update webhook set previous_secret = secret, previous_until_us = ?, secret = ?, updated_at_us = ?
                     where webhook_id = ?",
                )
                .bind(previous_until.micros())
                .bind(secret.0)
                .bind(now.micros())
                .bind(id)
                .execute(&mut *connection)
                .await?;
                Ok(updated.rows_affected() > 0)
            })
        })
        .await
    }

    /// Removes a webhook with its outbox. Whether there was such a webhook.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn delete_webhook(&self, id: &str) -> Result<bool, Error> {
        let id = id.to_owned();
        self.write(move |connection| {
            Box::pin(async move {
                let deleted = sqlx::query("delete from webhook where webhook_id = ?");
                Ok(deleted.bind(id).execute(&mut *connection).await?.rows_affected() > 0)
            })
        })
        .await
    }

    /// One webhook.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn webhook(&self, id: &str) -> Result<Option<WebhookRecord>, Error> {
        let row: Option<WebhookRow> =
            sqlx::query_as("select * from webhook where webhook_id = ?").bind(id).fetch_optional(&self.reader).await?;
        row.map(WebhookRow::into_record).transpose()
    }

    /// All webhooks, oldest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn webhooks(&self) -> Result<Vec<WebhookRecord>, Error> {
        let rows: Vec<WebhookRow> =
            sqlx::query_as("select * from webhook order by webhook_id").fetch_all(&self.reader).await?;
        rows.into_iter().map(WebhookRow::into_record).collect()
    }
}
