//! Actions on alarms and notes in an archive.

use tokio::sync::mpsc::Sender;

use super::super::alarm_action::{insert_action, kind_of_row, NewAction};
use super::super::column::{bad_row, timestamp};
use super::super::error::Error;
use super::super::note::{Note, Notes};
use super::super::sql::{self, Whole};
use super::super::transaction::Transaction;
use super::export::{receiver_dropped, Archive};
use super::record::{Acknowledged, ArchivedAction, ArchivedNote, Record};
use crate::quantity::{StructureId, Timestamp};

impl Archive<'_> {
    /// Sends the actions on alarms and the notes of a structure. Of a withdrawn alarm only the comments are sent: its closing must not
    /// close another alarm.
    pub(super) async fn export_people(self, structure: &StructureId, records: &Sender<Record>) -> Result<(), Error> {
        let rows = sql::query(
            "select e.kind, e.series, e.opened_batch, e.opened_at_us, e.ended_at_us, a.uid, a.kind, a.at_us, a.author, a.text, a.reason,
                    a.assignee, e.undamaged_version
             from alarm_action a join alarm_episode e using (structure_id, episode)
             where a.structure_id = $1 and e.opened_batch is not null and (e.withdrawn = 0 or a.kind = 'comment') order by a.action_id",
        )
        .bind(structure.as_str())
        .fetch_all(&self.database.reader)
        .await?;
        for row in rows {
            let record = action(&row)?;
            records.send(Record::AlarmAction(record)).await.map_err(receiver_dropped)?;
        }
        let mut notes = Notes { database: self.database }.list(structure).await?;
        notes.reverse();
        for Note { id, from, to, text, author, created_at } in notes {
            let record = ArchivedNote {
                note: id,
                from: from.to_string(),
                to: to.map(|to| to.to_string()),
                text,
                author,
                created_at: created_at.to_string(),
            };
            records.send(Record::Note(record)).await.map_err(receiver_dropped)?;
        }
        Ok(())
    }

    /// Stores the acknowledgements and other actions of an archive with their alarms, once its batches are assessed.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn settle_actions(self, structure: &StructureId) -> Result<ImportedActions, Error> {
        let (any,): (bool,) = sql::query_as("select exists (select 1 from imported_action where structure_id = $1)")
            .bind(structure.as_str())
            .fetch_one(&self.database.reader)
            .await?;
        if !any {
            return Ok(ImportedActions::default());
        }
        let structure = structure.to_string();
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let records: Vec<(String,)> =
                        sql::query_as("select record from imported_action where structure_id = $1 order by position")
                            .bind(&structure)
                            .fetch_all(&mut *transaction)
                            .await?;
                    let mut done = ImportedActions::default();
                    for (record,) in records {
                        match serde_json::from_str(&record).map_err(|e| bad_row("action of an archive")(&e))? {
                            Record::Acknowledgement(note) => {
                                done.acknowledgements += u64::from(acknowledge(transaction, &structure, note).await?);
                            }
                            Record::AlarmAction(action) => {
                                match import_action(transaction, &structure, action).await? {
                                    Some(new) => done.actions += u64::from(new),
                                    None => done.without_alarm += 1,
                                }
                            }
                            _ => {}
                        }
                    }
                    sql::query("delete from imported_action where structure_id = $1")
                        .bind(&structure)
                        .execute(&mut *transaction)
                        .await?;
                    Ok(done)
                })
            })
            .await
    }
}

/// What people did with the alarms of an archive, as it was stored here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ImportedActions {
    /// Acknowledgements whose alarm exists and was not acknowledged before.
    pub acknowledgements: u64,
    /// Comments, assignments, closings and reopenings that were new.
    pub actions: u64,
    /// Those without an alarm here.
    pub without_alarm: u64,
}

impl Acknowledged {
    /// Checks that it can be stored.
    ///
    /// # Errors
    /// [`Error::Row`] with what is wrong.
    pub fn check(&self) -> Result<(), Error> {
        Timestamp::parse(&self.at).map(drop).map_err(|e| bad_row("acknowledgement of the archive")(&e))
    }
}

impl ArchivedAction {
    /// Checks that it can be stored.
    ///
    /// # Errors
    /// [`Error::Row`] with what is wrong.
    pub fn check(&self) -> Result<(), Error> {
        let time = |text: &str| Timestamp::parse(text).map(drop).map_err(|e| bad_row("action of the archive")(&e));
        time(&self.opened_at)?;
        time(&self.at)?;
        self.ended_at.as_deref().map(time).transpose()?;
        uuid::Uuid::parse_str(&self.uid).map_err(|e| bad_row("action of the archive")(&e))?;
        kind_of_row(&self.kind, self.text.clone(), self.reason.as_deref(), self.assignee.clone()).map(drop)
    }
}

impl ArchivedNote {
    /// The note, checked.
    ///
    /// # Errors
    /// [`Error::Row`] with what is wrong.
    pub fn check(&self) -> Result<Note, Error> {
        let bad = bad_row("note of the archive");
        let time = |text: &str| Timestamp::parse(text).map_err(|e| bad(&e));
        uuid::Uuid::parse_str(&self.note).map_err(|e| bad(&e))?;
        let note = Note {
            from: time(&self.from)?,
            to: self.to.as_deref().map(time).transpose()?,
            created_at: time(&self.created_at)?,
            id: self.note.clone(),
            text: self.text.clone(),
            author: self.author.clone(),
        };
        if note.to.is_some_and(|to| to <= note.from) {
            return Err(bad(&"its end is not after its beginning"));
        }
        Ok(note)
    }
}

/// Stores an acknowledgement with its alarm. Returns whether something changed, which it does not if the alarm does not exist here or is
/// acknowledged already.
async fn acknowledge(transaction: &mut Transaction<'_>, structure: &str, note: Acknowledged) -> Result<bool, Error> {
    let at = Timestamp::parse(&note.at).map_err(|e| bad_row("acknowledgement of the archive")(&e))?;
    let updated = sql::query(
        "update alarm_episode set acknowledged_at_us = $1, acknowledged_by = $2, acknowledgement_note = $3
         where structure_id = $4 and kind = $5 and series in ($6, 'structure:joint') and opened_batch = $7 and withdrawn = 0
           and acknowledged_at_us is null and ($8 is null or undamaged_version = $8)",
    )
    .bind(at.micros())
    .bind(&note.by)
    .bind(&note.note)
    .bind(structure)
    .bind(&note.kind)
    .bind(&note.series)
    .bind(&note.opened_batch)
    .bind(note.undamaged_version)
    .execute(&mut *transaction)
    .await?;
    Ok(updated.rows_affected() > 0)
}

/// Stores an action with its alarm, of the same series or of all parameters together: the one that the same batch opened with the same
/// undamaged reference, otherwise one that the same batch opened, otherwise the newest one that overlaps it in time. Returns whether the
/// action is stored and was new; `None` if there is no such alarm here.
async fn import_action(
    transaction: &mut Transaction<'_>,
    structure: &str,
    action: ArchivedAction,
) -> Result<Option<bool>, Error> {
    let time = |text: &str| Timestamp::parse(text).map_err(|e| bad_row("action of the archive")(&e));
    let (opened, at) = (time(&action.opened_at)?, time(&action.at)?);
    let ended = action.ended_at.as_deref().map(time).transpose()?;
    let kind = kind_of_row(&action.kind, action.text, action.reason.as_deref(), action.assignee)?;
    let new = NewAction { kind, at, author: action.author, seen: None };
    let alarm: Option<(i64,)> = sql::query_as(
        "select episode from alarm_episode
         where structure_id = $1 and kind = $2 and series in ($3, 'structure:joint') and withdrawn = 0
           and (opened_batch = $4 or opened_at_us <= $6 and coalesce(ended_at_us, 9e18) >= $5)
         order by undamaged_version is not distinct from $7 and opened_batch = $4 desc, opened_batch = $4 desc,
                  undamaged_version is not distinct from $7 desc, series = $3 desc, episode desc
         limit 1",
    )
    .bind(structure)
    .bind(&action.alarm_kind)
    .bind(&action.series)
    .bind(&action.opened_batch)
    .bind(opened.micros())
    .bind(ended.map_or(i64::MAX, Timestamp::micros))
    .bind(action.undamaged_version)
    .fetch_optional(&mut *transaction)
    .await?;
    let Some((alarm,)) = alarm else { return Ok(None) };
    Ok(Some(insert_action(transaction, (structure, alarm), &action.uid, &new, true).await?))
}

fn action(row: &sql::Row) -> Result<ArchivedAction, Error> {
    let time = |column: usize| timestamp("alarm action", row.get(column)?).map(|at| at.to_string());
    let ended: Option<i64> = row.get(4)?;
    Ok(ArchivedAction {
        alarm_kind: row.get(0)?,
        series: row.get(1)?,
        opened_batch: row.get(2)?,
        opened_at: time(3)?,
        ended_at: ended.map(|at| timestamp("alarm action", at).map(|at| at.to_string())).transpose()?,
        uid: row.get(5)?,
        kind: row.get(6)?,
        at: time(7)?,
        author: row.get(8)?,
        text: row.get(9)?,
        reason: row.get(10)?,
        assignee: row.get(11)?,
        undamaged_version: Some(row.get::<Whole<u32>>(12)?.0),
    })
}
