//! Webhooks: receivers of messages about alarms.

use std::fmt;

use sqlx::FromRow;

use super::column::{bad_row, timestamp};
use super::database::Database;
use super::error::Error;
use super::sql;
use crate::quantity::Timestamp;

/// A signing secret, which does not appear in debug output.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(String);

impl Secret {
    /// Makes a secret from its text, `whsec_…`.
    pub fn new(text: String) -> Self {
        Self(text)
    }

    /// The text, for signing and for the response that returns it once.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret(…)")
    }
}

/// Selects the events of a webhook. An empty list selects all.
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
    /// Address of the receiver.
    pub url: String,
    /// Secret that signs messages.
    pub secret: Secret,
    /// Earlier secret that also signs messages, until a time.
    pub previous_secret: Option<(Secret, Timestamp)>,
    /// Selected events.
    pub filter: EventFilter,
    /// If false, no messages are stored for it or sent.
    pub enabled: bool,
    /// When it was created.
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

/// A list in the JSON text that the triggers of the outbox read.
fn json(list: &[String]) -> String {
    serde_json::to_string(list).expect("a list of texts is plain data")
}

/// Webhooks.
#[derive(Clone, Copy)]
pub struct Webhooks<'s> {
    pub(super) database: &'s Database,
}

impl Webhooks<'_> {
    /// Stores a new webhook unless there are `most` already. Returns whether it was stored.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn insert_webhook(self, webhook: WebhookRecord, most: usize) -> Result<bool, Error> {
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let (found,): (i64,) =
                        sql::query_as("select count(*) from webhook").fetch_one(&mut *transaction).await?;
                    if found >= most as i64 {
                        return Ok(false);
                    }
                    sql::query("insert into webhook values ($1, $2, $3, null, null, $4, $5, $6, $7, $8, $9)")
                        .bind(webhook.id)
                        .bind(webhook.url)
                        .bind(webhook.secret.0)
                        .bind(json(&webhook.filter.events))
                        .bind(json(&webhook.filter.alarm_kinds))
                        .bind(json(&webhook.filter.structures))
                        .bind(webhook.enabled)
                        .bind(webhook.created_at.micros())
                        .bind(webhook.updated_at.micros())
                        .execute(&mut *transaction)
                        .await?;
                    Ok(true)
                })
            })
            .await
    }

    /// Changes address, filter and state of a webhook; its secrets do not change. Returns whether the webhook exists.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn update_webhook(
        self,
        id: &str,
        url: &str,
        filter: EventFilter,
        enabled: bool,
        now: Timestamp,
    ) -> Result<bool, Error> {
        let (id, url) = (id.to_owned(), url.to_owned());
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let updated = sql::query(
                        "update webhook set url = $1, events = $2, alarm_kinds = $3, structures = $4, enabled = $5,
                         updated_at_us = $6 where webhook_id = $7",
                    )
                    .bind(url)
                    .bind(json(&filter.events))
                    .bind(json(&filter.alarm_kinds))
                    .bind(json(&filter.structures))
                    .bind(enabled)
                    .bind(now.micros())
                    .bind(id)
                    .execute(&mut *transaction)
                    .await?;
                    Ok(updated.rows_affected() > 0)
                })
            })
            .await
    }

    /// Makes `secret` the signing secret, below the minimum of free space as well; the earlier one also signs until `previous_until`. Returns
    /// whether the webhook exists.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn rotate_secret(
        self,
        id: &str,
        secret: Secret,
        previous_until: Timestamp,
        now: Timestamp,
    ) -> Result<bool, Error> {
        let id = id.to_owned();
        self.database.write_without_floor(move |transaction| {
            Box::pin(async move {
                let updated = sql::query(
                    "update webhook set previous_secret = nullif(secret, ''), previous_until_us = iif(secret = '', null, $1), secret = $2, updated_at_us = $3
                     where webhook_id = $4",
                )
                .bind(previous_until.micros())
                .bind(secret.0)
                .bind(now.micros())
                .bind(id)
                .execute(&mut *transaction)
                .await?;
                Ok(updated.rows_affected() > 0)
            })
        })
        .await
    }

    /// Deletes a webhook with its messages, below the minimum of free space as well. Returns whether it existed.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn delete_webhook(self, id: &str) -> Result<bool, Error> {
        let id = id.to_owned();
        self.database
            .write_without_floor(move |transaction| {
                Box::pin(async move {
                    let deleted = sql::query("delete from webhook where webhook_id = $1");
                    Ok(deleted.bind(id).execute(&mut *transaction).await?.rows_affected() > 0)
                })
            })
            .await
    }

    /// One webhook.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn webhook(self, id: &str) -> Result<Option<WebhookRecord>, Error> {
        let row: Option<WebhookRow> = sql::query_as("select * from webhook where webhook_id = $1")
            .bind(id)
            .fetch_optional(&self.database.reader)
            .await?;
        row.map(WebhookRow::into_record).transpose()
    }

    /// Disables webhooks whose selection of events cannot be read: the database could not address a message while there is one that is
    /// enabled, and could store no alarm then. Returns their number.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn disable_unreadable(self) -> Result<u64, Error> {
        let disable = "update webhook set enabled = false
             where enabled = 1 and (json_valid(events) = 0 or json_valid(alarm_kinds) = 0 or json_valid(structures) = 0)";
        self.database
            .write(move |transaction| {
                Box::pin(async move { Ok(sql::query(disable).execute(&mut *transaction).await?.rows_affected()) })
            })
            .await
    }

    /// All webhooks that can be read, oldest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn list(self) -> Result<Vec<WebhookRecord>, Error> {
        let statement = sql::query_as("select * from webhook order by webhook_id");
        self.database.damaged.leave_out(statement, &self.database.reader, 1, WebhookRow::into_record).await
    }
}
