//! Notes on the time line of a structure.

use super::column::timestamp;
use super::database::Database;
use super::error::Error;
use super::sql;
use super::transaction::Transaction;
use crate::quantity::{StructureId, Timestamp};

/// Maximum number of notes of a structure.
pub const MOST_NOTES: usize = 1_000;

/// A note about a moment or a period.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Note {
    /// Its id, a UUIDv7.
    pub id: String,
    /// The moment, or the beginning of the period.
    pub from: Timestamp,
    /// End of the period; `None` for a moment.
    pub to: Option<Timestamp>,
    /// The text.
    pub text: String,
    /// Who wrote it.
    pub author: String,
    /// When it was written.
    pub created_at: Timestamp,
}

/// Columns of a note: id, beginning, end, text, author, creation.
type NoteRow = (String, i64, Option<i64>, String, String, i64);

/// Notes on time lines.
#[derive(Clone, Copy)]
pub struct Notes<'s> {
    pub(super) database: &'s Database,
}

impl Notes<'_> {
    /// Stores a note unless its id is stored already or the structure has [`MOST_NOTES`] notes. Returns whether it was stored.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn insert(self, structure: &StructureId, note: Note) -> Result<bool, Error> {
        let structure = structure.to_string();
        self.database
            .write(move |transaction| Box::pin(async move { insert_note(transaction, &structure, note).await }))
            .await
    }

    /// Notes of a structure, by their beginning, the newest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn list(self, structure: &StructureId) -> Result<Vec<Note>, Error> {
        let statement = sql::query_as(
            "select note_id, from_us, to_us, text, author, created_at_us from note where structure_id = $1
             order by from_us desc, note_id desc",
        )
        .bind(structure.as_str());
        let what = "note";
        let note = |(id, from, to, text, author, created): NoteRow| {
            let to = to.map(|to| timestamp(what, to)).transpose()?;
            Ok(Note { id, from: timestamp(what, from)?, to, text, author, created_at: timestamp(what, created)? })
        };
        self.database.damaged.leave_out(statement, &self.database.reader, 1, note).await
    }

    /// Deletes a note, below the minimum of free space as well. Returns whether it existed.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn delete(self, structure: &StructureId, id: &str) -> Result<bool, Error> {
        let (structure, id) = (structure.to_string(), id.to_owned());
        self.database
            .write_without_floor(move |transaction| {
                Box::pin(async move {
                    let deleted = sql::query("delete from note where structure_id = $1 and note_id = $2");
                    let deleted = deleted.bind(structure).bind(id).execute(&mut *transaction).await?;
                    Ok(deleted.rows_affected() > 0)
                })
            })
            .await
    }
}

/// Stores a note unless its id is stored already or the structure has [`MOST_NOTES`] notes. Returns whether it was stored.
pub(super) async fn insert_note(transaction: &mut Transaction<'_>, structure: &str, note: Note) -> Result<bool, Error> {
    let inserted = sql::query(
        "insert into note select $1, $2, $3, $4, $5, $6, $7
         where (select count(*) from note where structure_id = $2) < $8 on conflict do nothing",
    )
    .bind(note.id)
    .bind(structure)
    .bind(note.from.micros())
    .bind(note.to.map(Timestamp::micros))
    .bind(note.text)
    .bind(note.author)
    .bind(note.created_at.micros())
    .bind(MOST_NOTES as i64)
    .execute(&mut *transaction)
    .await?;
    Ok(inserted.rows_affected() > 0)
}
