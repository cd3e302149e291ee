//! The two sides of a move: reading the tables of either database, and writing to either.

use std::path::{Path, PathBuf};

use futures_util::StreamExt as _;
use sqlx::{Arguments as _, AssertSqlSafe, Connection as _, Row as _};
use sqlx_postgres::{PgArguments, PgConnection, PgRow};
use sqlx_sqlite::{SqliteArguments, SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqliteRow};

use super::super::error::Error;
use super::super::file::{self, prepare_folder, refuse_foreign, take_lock, DATABASE_FILE};
use super::super::server::{self, Reserved};
use super::super::sql::Value;
use super::error::TransferError;
use super::location::Location;
use super::table::{quoted, Kind, Rows, Table, Values};

/// Ending of a SQLite file into which data are being moved; it gets its name when the move is complete.
const UNFINISHED: &str = ".moving";

/// Most parameters of a statement, below the limits of both databases (32,766 and 65,535).
const MOST_PARAMETERS: usize = 30_000;

/// A connection of either database.
pub(super) enum Connection {
    File(SqliteConnection),
    Server(PgConnection),
}

/// The side that is read, in one transaction.
pub(super) struct Source {
    connection: Connection,
    /// Of the data folder, unless a service has it open.
    lock: Option<std::fs::File>,
    rehearsal: bool,
}

/// The side that is written, with a connection for what it already has.
pub(super) struct Target {
    reading: Connection,
    writing: Connection,
    /// Kept until the end: no service may use the target in the meantime.
    place: TargetPlace,
}

enum TargetPlace {
    File {
        unfinished: PathBuf,
        path: PathBuf,
        _lock: std::fs::File,
        /// Name and definition of each.
        triggers: Vec<(String, String)>,
    },
    /// The session that holds the lock of the service.
    Server { _reserved: Reserved },
}

impl Source {
    /// Opens a place for reading, as one state of its data.
    pub(super) async fn open(place: &Location) -> Result<Self, TransferError> {
        match place {
            Location::Folder(folder) => {
                let path = folder.join(DATABASE_FILE);
                if !path.exists() {
                    return Err(TransferError::NoSource(folder.display().to_string()));
                }
                let lock = match take_lock(folder) {
                    Ok(lock) => Some(lock),
                    Err(Error::Locked(_)) => None,
                    Err(error) => return Err(error.into()),
                };
                refuse_foreign(&path).await?;
                let options = SqliteConnectOptions::new().filename(&path).read_only(true);
                let mut connection = SqliteConnection::connect_with(&options).await?;
                file::check_version(&mut connection, &path).await?;
                sqlx::query("begin").execute(&mut connection).await?;
                let rehearsal = lock.is_none();
                Ok(Self { connection: Connection::File(connection), lock, rehearsal })
            }
            Location::Server(url) => {
                let (mut connection, rehearsal) = server::for_reading(url).await?;
                sqlx::query("begin isolation level repeatable read read only").execute(&mut connection).await?;
                Ok(Self { connection: Connection::Server(connection), lock: None, rehearsal })
            }
        }
    }

    pub(super) fn server(&mut self) -> Option<&mut PgConnection> {
        self.connection.server()
    }

    pub(super) fn file(&mut self) -> Option<&mut SqliteConnection> {
        self.connection.file()
    }

    /// The rows of a table, in the order of its primary key.
    pub(super) fn rows<'c>(&'c mut self, table: &'c Table) -> Rows<'c> {
        self.connection.rows(table)
    }

    /// Ends the reading. Returns whether a service was using the source.
    pub(super) async fn close(self) -> bool {
        self.connection.close().await;
        drop(self.lock);
        self.rehearsal
    }
}

impl Target {
    /// Opens a place for writing, with the schema of this program.
    pub(super) async fn open(place: &Location, replace: bool) -> Result<Self, TransferError> {
        match place {
            Location::Folder(folder) => {
                let path = folder.join(DATABASE_FILE);
                if path.exists() {
                    return Err(TransferError::NotEmpty(folder.clone()));
                }
                let unfinished = folder.join(format!("{DATABASE_FILE}{UNFINISHED}"));
                let lock = prepare_folder(folder, &unfinished)?;
                let opened = file::open(&unfinished).await?;
                opened.reader.close().await;
                opened.writer.close().await;
                let connect = || async {
                    let options = SqliteConnectOptions::new().filename(&unfinished).foreign_keys(true);
                    SqliteConnection::connect_with(&options.journal_mode(SqliteJournalMode::Wal)).await
                };
                let (reading, writing, triggers) = (connect().await?, connect().await?, file::triggers().await?);
                let place = TargetPlace::File { unfinished, path, _lock: lock, triggers };
                Ok(Self { reading: Connection::File(reading), writing: Connection::File(writing), place })
            }
            Location::Server(url) => {
                let reserved = Reserved::for_move(url).await?;
                if reserved.has_data() && !replace {
                    return Err(TransferError::InUse(url.to_string()));
                }
                let (reading, writing) = (server::connection(url).await?, server::connection(url).await?);
                let place = TargetPlace::Server { _reserved: reserved };
                Ok(Self { reading: Connection::Server(reading), writing: Connection::Server(writing), place })
            }
        }
    }

    pub(super) fn server(&mut self) -> Option<&mut PgConnection> {
        self.reading.server()
    }

    pub(super) fn file(&mut self) -> Option<&mut SqliteConnection> {
        self.reading.file()
    }

    /// The connection that reads, and the one that writes.
    pub(super) fn both(&mut self) -> (&mut Connection, &mut Connection) {
        (&mut self.reading, &mut self.writing)
    }

    /// Switches off what the database does by itself with new rows: messages about alarms must not be sent a second time, and the summaries
    /// are moved as they are. From now on no service can use the target.
    pub(super) async fn begin(&mut self) -> Result<(), TransferError> {
        match (&mut self.writing, &self.place) {
            (Connection::Server(connection), _) => {
                let mut open = connection.begin().await?;
                sqlx::query("update application set moving = true").execute(&mut *open).await?;
                for table in server::tables_with_triggers(&mut open).await? {
                    let disable = format!("alter table {} disable trigger user", quoted(&table));
                    sqlx::query(AssertSqlSafe(disable)).execute(&mut *open).await?;
                }
                open.commit().await?;
            }
            (Connection::File(connection), TargetPlace::File { triggers, .. }) => {
                for (name, _) in triggers {
                    let drop = format!("drop trigger if exists {}", quoted(name));
                    sqlx::query(AssertSqlSafe(drop)).execute(&mut *connection).await?;
                }
            }
            (Connection::File(_), TargetPlace::Server { .. }) => {}
        }
        Ok(())
    }

    /// Switches on again what [`Self::begin`] has switched off, and makes the target usable.
    pub(super) async fn finish(self, tables: &[Table]) -> Result<(), TransferError> {
        self.reading.close().await;
        match (self.writing, self.place) {
            (Connection::Server(mut connection), _) => {
                let mut open = connection.begin().await?;
                for table in tables {
                    for column in table.columns.iter().filter(|column| column.numbered) {
                        let (name, column) = (table.name(), &column.name);
                        let next = format!(
                            "select setval(pg_get_serial_sequence('{name}', '{column}'),
                                 (select coalesce(max({column}), 0) + 1 from {name}), false)"
                        );
                        sqlx::query(AssertSqlSafe(next)).execute(&mut *open).await?;
                    }
                }
                for table in server::tables_with_triggers(&mut open).await? {
                    let enable = format!("alter table {} enable trigger user", quoted(&table));
                    sqlx::query(AssertSqlSafe(enable)).execute(&mut *open).await?;
                }
                sqlx::query("update application set moving = false").execute(&mut *open).await?;
                open.commit().await?;
                // The planner of the server knows nothing of the tables yet.
                sqlx::query("analyze").execute(&mut connection).await?;
                connection.close().await?;
            }
            (Connection::File(mut connection), TargetPlace::File { unfinished, path, _lock, triggers }) => {
                for (_, definition) in triggers {
                    sqlx::query(AssertSqlSafe(definition)).execute(&mut connection).await?;
                }
                sqlx::query("pragma wal_checkpoint(truncate)").execute(&mut connection).await?;
                connection.close().await?;
                publish(&unfinished, &path)?;
            }
            (Connection::File(_), TargetPlace::Server { .. }) => {}
        }
        Ok(())
    }
}

/// Gives a complete file its name.
fn publish(unfinished: &Path, path: &Path) -> Result<(), TransferError> {
    let failed = |source| TransferError::File { path: path.to_owned(), source };
    std::fs::File::open(unfinished).and_then(|file| file.sync_all()).map_err(failed)?;
    std::fs::rename(unfinished, path).map_err(failed)?;
    let folder = path.parent().unwrap_or(Path::new("."));
    std::fs::File::open(folder).and_then(|folder| folder.sync_all()).map_err(failed)
}

impl Connection {
    fn server(&mut self) -> Option<&mut PgConnection> {
        match self {
            Self::Server(connection) => Some(connection),
            Self::File(_) => None,
        }
    }

    fn file(&mut self) -> Option<&mut SqliteConnection> {
        match self {
            Self::File(connection) => Some(connection),
            Self::Server(_) => None,
        }
    }

    /// The rows of a table, in the order of its primary key.
    pub(super) fn rows<'c>(&'c mut self, table: &'c Table) -> Rows<'c> {
        let select =
            format!("select {} from {} order by {}", table.column_list(), quoted(table.name()), table.key_list());
        let query = AssertSqlSafe(select);
        match self {
            Self::File(connection) => sqlx::query(query).fetch(connection).map(|row| of_file(&row?, table)).boxed(),
            Self::Server(connection) => sqlx::query(query).fetch(connection).map(|row| of_server(&row?, table)).boxed(),
        }
        .peekable()
    }

    /// Removes rows, in one transaction.
    pub(super) async fn remove(&mut self, table: &Table, rows: &[Values]) -> Result<(), TransferError> {
        let condition: Vec<String> = table
            .key
            .iter()
            .enumerate()
            .map(|(i, &c)| format!("{} = ${}", quoted(&table.columns[c].name), i + 1))
            .collect();
        let delete = format!("delete from {} where {}", quoted(table.name()), condition.join(" and "));
        match self {
            Self::File(connection) => {
                let mut open = connection.begin().await?;
                for row in rows {
                    let arguments = file_arguments(table.key.iter().map(|&i| &row[i]))?;
                    sqlx::query_with(AssertSqlSafe(delete.clone()), arguments).execute(&mut *open).await?;
                }
                open.commit().await?;
            }
            Self::Server(connection) => {
                let mut open = connection.begin().await?;
                for row in rows {
                    let arguments = server_arguments(table.key.iter().map(|&i| &row[i]))?;
                    sqlx::query_with(AssertSqlSafe(delete.clone()), arguments).execute(&mut *open).await?;
                }
                open.commit().await?;
            }
        }
        Ok(())
    }

    /// Writes rows, in one transaction; a row with the same primary key is replaced.
    pub(super) async fn write(&mut self, table: &Table, rows: &[Values]) -> Result<(), TransferError> {
        let at_a_time = (MOST_PARAMETERS / table.columns.len()).max(1);
        match self {
            Self::File(connection) => {
                let mut open = connection.begin().await?;
                for part in rows.chunks(at_a_time) {
                    let arguments = file_arguments(part.iter().flatten())?;
                    let insert = AssertSqlSafe(upsert(table, part.len(), |_| "?".to_owned()));
                    sqlx::query_with(insert, arguments).persistent(false).execute(&mut *open).await?;
                }
                open.commit().await?;
            }
            Self::Server(connection) => {
                let mut open = connection.begin().await?;
                for part in rows.chunks(at_a_time) {
                    let arguments = server_arguments(part.iter().flatten())?;
                    let insert = AssertSqlSafe(upsert(table, part.len(), |number| format!("${number}")));
                    sqlx::query_with(insert, arguments).persistent(false).execute(&mut *open).await?;
                }
                open.commit().await?;
            }
        }
        Ok(())
    }

    async fn close(self) {
        let _ = match self {
            Self::File(connection) => connection.close().await,
            Self::Server(connection) => connection.close().await,
        };
    }
}

/// A statement that inserts rows, or replaces those with the same primary key. `parameter` writes a parameter by its number, for SQLite
/// without one: it takes `$1` for a name, and searches all names for each of the thousands of parameters.
fn upsert(table: &Table, rows: usize, parameter: impl Fn(usize) -> String) -> String {
    let width = table.columns.len();
    let row = |row: usize| {
        let values: Vec<String> = (1..=width).map(|i| parameter(row * width + i)).collect();
        format!("({})", values.join(", "))
    };
    let values: Vec<String> = (0..rows).map(row).collect();
    let others = (0..width).filter(|i| !table.key.contains(i)).map(|i| quoted(&table.columns[i].name));
    let set: Vec<String> = others.map(|name| format!("{name} = excluded.{name}")).collect();
    let action = if set.is_empty() { "nothing".to_owned() } else { format!("update set {}", set.join(", ")) };
    format!(
        "insert into {} ({}) values {} on conflict ({}) do {action}",
        quoted(table.name()),
        table.column_list(),
        values.join(", "),
        table.key_list()
    )
}

fn of_file(row: &SqliteRow, table: &Table) -> Result<Values, sqlx::Error> {
    let value = |(i, kind): (usize, Kind)| {
        Ok(match kind {
            Kind::Integer => Value::Integer(row.try_get_unchecked(i)?),
            Kind::Real => Value::Real(row.try_get_unchecked(i)?),
            Kind::Text => Value::Text(row.try_get_unchecked(i)?),
            Kind::Blob => Value::Blob(row.try_get_unchecked(i)?),
            Kind::Truth => Value::Truth(row.try_get_unchecked(i)?),
        })
    };
    table.columns.iter().map(|column| column.kind).enumerate().map(value).collect()
}

fn of_server(row: &PgRow, table: &Table) -> Result<Values, sqlx::Error> {
    let value = |(i, kind): (usize, Kind)| {
        Ok(match kind {
            Kind::Integer => Value::Integer(row.try_get(i)?),
            Kind::Real => Value::Real(row.try_get(i)?),
            Kind::Text => Value::Text(row.try_get(i)?),
            Kind::Blob => Value::Blob(row.try_get(i)?),
            Kind::Truth => Value::Truth(row.try_get(i)?),
        })
    };
    table.columns.iter().map(|column| column.kind).enumerate().map(value).collect()
}

fn file_arguments<'v>(values: impl Iterator<Item = &'v Value>) -> Result<SqliteArguments, sqlx::Error> {
    let mut arguments = SqliteArguments::default();
    for value in values {
        match value.clone() {
            Value::Integer(value) => arguments.add(value),
            Value::Real(value) => arguments.add(value),
            Value::Text(value) => arguments.add(value),
            Value::Blob(value) => arguments.add(value),
            Value::Truth(value) => arguments.add(value),
        }
        .map_err(sqlx::Error::Encode)?;
    }
    Ok(arguments)
}

fn server_arguments<'v>(values: impl Iterator<Item = &'v Value>) -> Result<PgArguments, sqlx::Error> {
    let mut arguments = PgArguments::default();
    for value in values {
        match value.clone() {
            Value::Integer(value) => arguments.add(value),
            Value::Real(value) => arguments.add(value),
            Value::Text(value) => arguments.add(value),
            Value::Blob(value) => arguments.add(value),
            Value::Truth(value) => arguments.add(value),
        }
        .map_err(sqlx::Error::Encode)?;
    }
    Ok(arguments)
}
