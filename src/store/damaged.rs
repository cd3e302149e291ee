//! Rows that cannot be read, while the service runs. Lists leave them out, so that one damaged row does not keep everything else from
//! being read, and they are remembered, so that the health of the service names them.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use futures_util::TryStreamExt as _;
use tracing::warn;

use super::error::Error;
use super::reader::Reader;
use super::sql::{On, QueryAs, Readable, Row};
use crate::quantity::shown;

/// Number of rows that are remembered.
const MOST_REMEMBERED: usize = 100;

/// How long a row is remembered after it was last met: it may have been removed or restored since.
const REMEMBERED_FOR: Duration = Duration::from_hours(1);

/// Rows that could not be read, as sentences, with the time at which each was last met.
#[derive(Default)]
pub(super) struct DamagedRows {
    met: Mutex<BTreeMap<String, Instant>>,
}

/// Which rows of a long list are read: so many that can be read, behind a place. The values of the first `names` columns name a row that
/// cannot be read.
pub(super) struct Page<C> {
    pub limit: usize,
    pub behind: C,
    pub names: usize,
}

impl DamagedRows {
    /// Remembers a row that cannot be read, which `name` identifies.
    ///
    /// # Errors
    /// The given error, if it is not about the row.
    pub fn remember(&self, name: &str, error: Error) -> Result<(), Error> {
        if !matches!(error, Error::Row { .. }) {
            return Err(error);
        }
        self.note(name, &error);
        Ok(())
    }

    /// Remembers a row that cannot be read; other errors are not remembered.
    pub fn note(&self, name: &str, error: &Error) {
        if !matches!(error, Error::Row { .. }) {
            return;
        }
        let mut met = self.met.lock().expect("no holder of this lock panics");
        met.retain(|_, at| at.elapsed() < REMEMBERED_FOR);
        let sentence = format!("{name}: {error}");
        if met.len() >= MOST_REMEMBERED && !met.contains_key(&sentence) {
            return;
        }
        if met.insert(sentence, Instant::now()).is_none() {
            warn!("Stored data of {name} are left out of answers: {error}");
        }
    }

    /// The remembered rows.
    pub fn remembered(&self) -> Vec<String> {
        let mut met = self.met.lock().expect("no holder of this lock panics");
        met.retain(|_, at| at.elapsed() < REMEMBERED_FOR);
        met.keys().cloned().collect()
    }

    /// The rows of a statement that can be read; `read` decodes one. The others are left out and remembered; the values of their first
    /// `names` columns name them.
    pub async fn leave_out<'c, R: Readable, T>(
        &self,
        statement: QueryAs<R>,
        on: impl Into<On<'c>>,
        names: usize,
        mut read: impl FnMut(R) -> Result<T, Error>,
    ) -> Result<Vec<T>, Error> {
        let mut rows = statement.rows(on);
        let mut all = Vec::new();
        while let Some(row) = rows.try_next().await? {
            self.keep(&row, names, &mut read, &mut all)?;
        }
        Ok(all)
    }

    /// A page of the rows that can be read, as [`Self::leave_out`]. It is shorter than its limit only if no row follows: `statement` selects
    /// so many rows behind a place, and `place` is that of a row.
    pub async fn page<R: Readable, C: Clone + PartialEq, T>(
        &self,
        on: &Reader,
        Page { limit, mut behind, names }: Page<C>,
        statement: impl Fn(&C, i64) -> QueryAs<R>,
        place: impl Fn(&Row) -> Result<C, sqlx::Error>,
        mut read: impl FnMut(R) -> Result<T, Error>,
    ) -> Result<Vec<T>, Error> {
        let mut all = Vec::new();
        loop {
            let asked = limit - all.len();
            let (mut given, mut last) = (0, behind.clone());
            let mut rows = statement(&behind, asked as i64).rows(on);
            while let Some(row) = rows.try_next().await? {
                given += 1;
                last = place(&row)?;
                self.keep(&row, names, &mut read, &mut all)?;
            }
            if given < asked || all.len() >= limit || last == behind {
                return Ok(all);
            }
            behind = last;
        }
    }

    fn keep<R: Readable, T>(
        &self,
        row: &Row,
        names: usize,
        read: &mut impl FnMut(R) -> Result<T, Error>,
        all: &mut Vec<T>,
    ) -> Result<(), Error> {
        match row.read().map_err(Error::from).and_then(read) {
            Ok(value) => {
                all.push(value);
                Ok(())
            }
            Err(error) => self.remember(&name_of(row, names), error),
        }
    }
}

/// The values of the first columns of a row.
fn name_of(row: &Row, columns: usize) -> String {
    let value = |column: usize| {
        let number = || row.get::<i64>(column).map(|number| number.to_string());
        shown(&row.get::<String>(column).or_else(|_| number()).unwrap_or_else(|_| "?".to_owned()))
    };
    (0..columns).map(value).collect::<Vec<_>>().join(" ")
}
