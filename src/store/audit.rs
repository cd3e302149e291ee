//! The audit log: who changed what, and when. An entry is added before the change and receives its status once.

use std::future::Future;

use sqlx::FromRow;

use super::column::timestamp;
use super::damaged::Page;
use super::database::Database;
use super::error::Error;
use super::sql;
use crate::quantity::Timestamp;

/// Status of a command that succeeded.
const COMMAND_DONE: u16 = 200;
/// Status of a command that failed.
const COMMAND_FAILED: u16 = 500;

/// An attempted change.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewAuditEntry {
    /// When it was attempted.
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
    /// The structure concerned.
    pub structure: Option<String>,
    /// Path of the changed resource.
    pub subject: Option<String>,
}

impl NewAuditEntry {
    /// A change by a command of the command line or by the service itself, such as a backup.
    pub fn local(at: Timestamp, action: impl Into<String>, subject: Option<String>) -> Self {
        Self {
            at,
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
    /// Its number; later entries have higher numbers.
    pub number: i64,
    /// The attempted change.
    pub entry: NewAuditEntry,
    /// Its outcome as an HTTP status; `None` while it runs, or if the program ended before it was known.
    pub status: Option<u16>,
}

/// Selects entries of the audit log.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AuditQuery {
    /// Entries at or after this time.
    pub from: Option<Timestamp>,
    /// Entries before this time.
    pub to: Option<Timestamp>,
    /// Entries with a lower number than this.
    pub before: Option<i64>,
    /// Largest number of entries.
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

/// The audit log.
#[derive(Clone, Copy)]
pub struct Audit<'s> {
    pub(super) database: &'s Database,
    /// Whether the changes take something away, so that their entries are added below the minimum of free space as well.
    pub(super) takes_away: bool,
}

impl Audit<'_> {
    /// The audit log for changes that take rights away or make room: they are recorded, and so made, below the minimum of free space as
    /// well.
    #[must_use]
    pub fn without_floor(self) -> Self {
        Self { takes_away: true, ..self }
    }

    /// Adds an entry before a change is attempted and returns its number.
    ///
    /// # Errors
    /// [`Error::DiskFull`], [`Error::Sqlite`]; the change must then not be attempted.
    pub async fn begin_audit(self, entry: NewAuditEntry) -> Result<i64, Error> {
        self.database
            .write_or_take_away(self.takes_away, move |transaction| {
                Box::pin(async move {
                    let (number,): (i64,) = sql::query_as(
                    "insert into audit_entry (at_us, actor, actor_name, peer, request_id, action, structure_id, subject)
                     values ($1, $2, $3, $4, $5, $6, $7, $8) returning entry_id",
                )
                .bind(entry.at.micros())
                .bind(&entry.actor)
                .bind(&entry.actor_name)
                .bind(&entry.peer)
                .bind(&entry.request_id)
                .bind(&entry.action)
                .bind(&entry.structure)
                .bind(&entry.subject)
                .fetch_one(&mut *transaction)
                .await?;
                    Ok(number)
                })
            })
            .await
    }

    /// Stores the outcome of a change, and the path of the created resource. It completes an entry that is there, so that it needs no room
    /// and is stored below the minimum of free space as well.
    ///
    /// # Errors
    /// [`Error::Sqlite`]; the entry then keeps no status.
    pub async fn end_audit(self, number: i64, status: u16, made: Option<String>) -> Result<(), Error> {
        self.database
            .write_without_floor(move |transaction| {
                Box::pin(async move {
                    sql::query(
                        "update audit_entry set status = $1, subject = coalesce($2, subject)
                     where entry_id = $3 and status is null",
                    )
                    .bind(status)
                    .bind(made)
                    .bind(number)
                    .execute(&mut *transaction)
                    .await?;
                    Ok(())
                })
            })
            .await
    }

    /// Runs a change that was not requested over HTTP, and stores its entry before and its status after it.
    ///
    /// # Errors
    /// Those of the change; [`Error::Sqlite`] if the entry cannot be stored, in which case the change is not attempted.
    pub async fn audited<T, E: From<Error>>(
        self,
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
    pub async fn list(self, query: &AuditQuery) -> Result<Vec<AuditEntry>, Error> {
        let page = Page { limit: query.limit, behind: query.before.unwrap_or(i64::MAX), names: 1 };
        let select =
            "select entry_id, at_us, actor, actor_name, peer, request_id, action, structure_id, subject, status
             from audit_entry
             where ($1 is null or at_us >= $1) and ($2 is null or at_us < $2) and entry_id < $3
             order by entry_id desc limit $4";
        let statement = |before: &i64, limit: i64| {
            sql::query_as(select)
                .bind(query.from.map(Timestamp::micros))
                .bind(query.to.map(Timestamp::micros))
                .bind(*before)
                .bind(limit)
        };
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
        self.database.damaged.page(&self.database.reader, page, statement, |row| row.get(0), entry).await
    }
}
