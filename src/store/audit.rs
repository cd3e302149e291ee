//! The audit: who changed what, and when. Entries are added, given their status once, and never changed again.

use std::future::Future;

use sqlx::FromRow;

use super::{timestamp, Error, Store};
use crate::quantity::Timestamp;

/// Status of a command that did what it was asked.
const COMMAND_DONE: u16 = 200;
/// Status of a command that failed.
const COMMAND_FAILED: u16 = 500;

/// A change that somebody is about to try.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewAuditEntry {
    /// When.
    pub at: Timestamp,
    /// Id of the token, or `local`.
    pub actor: String,
    /// Name of the token.
    pub actor_name: Option<String>,
    /// Address of the client.
    pub peer: Option<String>,
    /// Id of the request.
    pub request_id: Option<String>,
    /// Method and route, or the command.
    pub action: String,
    /// The structure it is about.
    pub structure: Option<String>,
    /// Path of what is changed.
    pub subject: Option<String>,
}

impl NewAuditEntry {
    /// A change by a command or by the service itself: a clean-up, a backup.
    pub fn local(action: impl Into<String>, subject: Option<String>) -> Self {
        Self {
            at: Timestamp::now(),
            actor: "local".to_owned(),
            actor_name: None,
            peer: None,
            request_id: None,
            action: action.into(),
            structure: None,
            subject,
        }
    }
}

/// A stored entry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AuditEntry {
    /// Its number: later entries have higher ones.
    pub number: i64,
    /// What was tried.
    pub entry: NewAuditEntry,
    /// What came of it, as HTTP status; `None` while it runs, and when the program ended in between.
    pub status: Option<u16>,
}

/// Which entries of the audit.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AuditQuery {
    /// Not before.
    pub from: Option<Timestamp>,
    /// Before.
    pub to: Option<Timestamp>,
    /// Only entries older than this number.
    pub before: Option<i64>,
    /// Most entries.
    pub limit: usize,
}

#[derive(FromRow)]
struct AuditRow {
    entry_id: i64,
    at_us: i64,
    actor: String,
    actor_name: Option<String>,
    peer: Option<String>,
    request_id: Option<String>,
    action: String,
    structure_id: Option<String>,
    subject: Option<String>,
    status: Option<i64>,
}

impl Store {
    /// Writes down that a change is about to be tried; returns the entry's number.
    ///
    /// # Errors
    /// [`Error::Sqlite`]: then the change must not be tried.
    pub async fn begin_audit(&self, entry: NewAuditEntry) -> Result<i64, Error> {
        self.write(move |connection| {
            Box::pin(async move {
                let inserted = sqlx::query(
                    "insert into audit_entry (at_us, actor, actor_name, peer, request_id, action, structure_id, subject)
                     values (?, ?, ?, ?, ?, ?, ?, ?)",
                )
                .bind(entry.at.micros())
                .bind(&entry.actor)
                .bind(&entry.actor_name)
                .bind(&entry.peer)
                .bind(&entry.request_id)
                .bind(&entry.action)
                .bind(&entry.structure)
                .bind(&entry.subject)
                .execute(&mut *connection)
                .await?;
                Ok(inserted.last_insert_rowid())
            })
        })
        .await
    }

    /// Adds what came of a change, and the path of what it made.
    ///
    /// # Errors
    /// [`Error::Sqlite`]: the entry then stays without a status.
    pub async fn end_audit(&self, number: i64, status: u16, made: Option<String>) -> Result<(), Error> {
        self.write(move |connection| {
            Box::pin(async move {
                sqlx::query(
                    "update audit_entry set status = ?, subject = coalesce(?, subject)
                     where entry_id = ? and status is null",
                )
                .bind(status)
                .bind(made)
                .bind(number)
                .execute(&mut *connection)
                .await?;
                Ok(())
            })
        })
        .await
    }

    /// Runs a change that comes by no request, with its entry before and its status after.
    ///
    /// # Errors
    /// Those of the change; [`Error::Sqlite`] when the entry cannot be written, before the change is tried.
    pub async fn audited<T, E: From<Error>>(
        &self,
        entry: NewAuditEntry,
        change: impl Future<Output = Result<T, E>>,
    ) -> Result<T, E> {
        let number = self.begin_audit(entry).await?;
        let result = change.await;
        let status = if result.is_ok() { COMMAND_DONE } else { COMMAND_FAILED };
        self.end_audit(number, status, None).await?;
        result
    }

    /// Entries, newest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn audit(&self, query: &AuditQuery) -> Result<Vec<AuditEntry>, Error> {
        let rows: Vec<AuditRow> = sqlx::query_as(
            "select entry_id, at_us, actor, actor_name, peer, request_id, action, structure_id, subject, status
             from audit_entry
             where (?1 is null or at_us >= ?1) and (?2 is null or at_us < ?2) and (?3 is null or entry_id < ?3)
             order by entry_id desc limit ?4",
        )
        .bind(query.from.map(Timestamp::micros))
        .bind(query.to.map(Timestamp::micros))
        .bind(query.before)
        .bind(query.limit as i64)
        .fetch_all(&self.reader)
        .await?;
        let entry = |row: AuditRow| {
            Ok(AuditEntry {
                number: row.entry_id,
                status: row.status.map(|status| status as u16),
                entry: NewAuditEntry {
                    at: timestamp("audit entry", row.at_us)?,
                    actor: row.actor,
                    actor_name: row.actor_name,
                    peer: row.peer,
                    request_id: row.request_id,
                    action: row.action,
                    structure: row.structure_id,
                    subject: row.subject,
                },
            })
        };
        rows.into_iter().map(entry).collect()
    }
}
