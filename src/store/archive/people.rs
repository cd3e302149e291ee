//! Actions on alarms and notes in an archive.

use tokio::sync::mpsc::Sender;

use super::super::alarm_action::{insert_action, kind_of_row, NewAction};
use super::super::column::{bad_row, timestamp};
use super::super::error::Error;
use super::super::note::{Note, Notes};
use super::export::{receiver_dropped, Archive};
use super::record::{ArchivedAction, ArchivedNote, Record};
use crate::quantity::{StructureId, Timestamp};

impl Archive<'_> {
    /// Sends the actions on alarms and the notes of a structure. Of a withdrawn alarm only the comments are sent: its closing must not
    /// close another alarm.
    pub(super) async fn export_people(self, structure: &StructureId, records: &Sender<Record>) -> Result<(), Error> {
        let rows = sqlx::query(
            "select e.kind, e.series, e.opened_batch, e.opened_at_us, e.ended_at_us, a.uid, a.kind, a.at_us, a.author, a.text, a.reason,
                    a.assignee
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

    /// Stores an action with its alarm: the alarm of the same series that the same batch opened, otherwise the newest one that overlaps it
    /// in time, because only the alarms of the newest undamaged reference are computed again. Returns whether the action is stored and
    /// was new; `None` if there is no such alarm here.
    ///
    /// # Errors
    /// [`Error::Row`] if a time or the kind cannot be read.
    pub async fn import_action(self, structure: &StructureId, action: ArchivedAction) -> Result<Option<bool>, Error> {
        let time = |text: &str| Timestamp::parse(text).map_err(|e| bad_row("action of the archive")(&e));
        let (opened, at) = (time(&action.opened_at)?, time(&action.at)?);
        let ended = action.ended_at.as_deref().map(time).transpose()?;
        let kind = kind_of_row(&action.kind, action.text, action.reason.as_deref(), action.assignee)?;
        let new = NewAction { kind, at, author: action.author, seen: None };
        let structure = structure.to_string();
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let alarm: Option<(i64,)> = sqlx::query_as(
                        "select episode from alarm_episode
                         where structure_id = $1 and kind = $2 and series = $3 and withdrawn = 0
                           and (opened_batch = $4 or opened_at_us <= $6 and coalesce(ended_at_us, 9e18) >= $5)
                         order by opened_batch = $4 desc, episode desc limit 1",
                    )
                    .bind(&structure)
                    .bind(&action.alarm_kind)
                    .bind(&action.series)
                    .bind(&action.opened_batch)
                    .bind(opened.micros())
                    .bind(ended.map_or(i64::MAX, Timestamp::micros))
                    .fetch_optional(transaction.connection())
                    .await?;
                    let Some((alarm,)) = alarm else { return Ok(None) };
                    Ok(Some(insert_action(transaction, (&structure, alarm), &action.uid, &new, true).await?))
                })
            })
            .await
    }

    /// Stores a note unless it is stored already. Returns whether it was new.
    ///
    /// # Errors
    /// [`Error::Row`] if a time cannot be parsed.
    pub async fn import_note(self, structure: &StructureId, note: ArchivedNote) -> Result<bool, Error> {
        let time = |text: &str| Timestamp::parse(text).map_err(|e| bad_row("note of the archive")(&e));
        let note = Note {
            from: time(&note.from)?,
            to: note.to.as_deref().map(time).transpose()?,
            created_at: time(&note.created_at)?,
            id: note.note,
            text: note.text,
            author: note.author,
        };
        if note.to.is_some_and(|to| to <= note.from) {
            return Err(bad_row("note of the archive")(&"its end is not after its beginning"));
        }
        Notes { database: self.database }.insert(structure, note).await
    }
}

fn action(row: &sqlx::sqlite::SqliteRow) -> Result<ArchivedAction, Error> {
    use sqlx::Row as _;
    let time = |column: usize| timestamp("alarm action", row.try_get(column)?).map(|at| at.to_string());
    let ended: Option<i64> = row.try_get(4)?;
    Ok(ArchivedAction {
        alarm_kind: row.try_get(0)?,
        series: row.try_get(1)?,
        opened_batch: row.try_get(2)?,
        opened_at: time(3)?,
        ended_at: ended.map(|at| timestamp("alarm action", at).map(|at| at.to_string())).transpose()?,
        uid: row.try_get(5)?,
        kind: row.try_get(6)?,
        at: time(7)?,
        author: row.try_get(8)?,
        text: row.try_get(9)?,
        reason: row.try_get(10)?,
        assignee: row.try_get(11)?,
    })
}
