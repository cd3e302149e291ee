//! Statements that run on either database, SQLite or PostgreSQL, and their rows.
//!
//! A statement is one text for both. What the two write differently is either avoided, or made the same in PostgreSQL by the functions and
//! operators of `migrations/postgres`. Numbers are `bigint` or `double precision` there, truth values `boolean`, blobs `bytea`.

use std::borrow::Cow;
use std::marker::PhantomData;

use futures_util::stream::BoxStream;
use futures_util::{StreamExt as _, TryStreamExt as _};
use sqlx::{FromRow, Row as _, SqlSafeStr, SqlStr};
use sqlx_postgres::Postgres;
use sqlx_postgres::{PgArguments, PgConnection, PgPool, PgRow};
use sqlx_sqlite::Sqlite;
use sqlx_sqlite::{SqliteArguments, SqliteConnection, SqlitePool, SqliteRow};

use super::error::over_network;

/// The value of a parameter; `None` is null.
#[derive(Debug, Clone)]
pub(super) enum Value {
    Integer(Option<i64>),
    Real(Option<f64>),
    Text(Option<String>),
    Blob(Option<Vec<u8>>),
    Truth(Option<bool>),
}

/// A whole number of a column, which both databases hold in 64 bits, as a smaller type.
#[derive(Debug, Clone, Copy)]
pub(super) struct Whole<T>(pub T);

impl<DB, T> sqlx::Type<DB> for Whole<T>
where
    DB: sqlx::Database,
    i64: sqlx::Type<DB>,
{
    fn type_info() -> DB::TypeInfo {
        <i64 as sqlx::Type<DB>>::type_info()
    }

    fn compatible(ty: &DB::TypeInfo) -> bool {
        <i64 as sqlx::Type<DB>>::compatible(ty)
    }
}

impl<'r, DB, T> sqlx::Decode<'r, DB> for Whole<T>
where
    DB: sqlx::Database,
    i64: sqlx::Decode<'r, DB>,
    T: TryFrom<i64>,
    T::Error: std::error::Error + Send + Sync + 'static,
{
    fn decode(value: DB::ValueRef<'r>) -> Result<Self, sqlx::error::BoxDynError> {
        let number = <i64 as sqlx::Decode<'r, DB>>::decode(value)?;
        Ok(Self(T::try_from(number)?))
    }
}

macro_rules! values {
    ($($from:ty => $variant:ident by $convert:expr;)*) => {$(
        impl From<$from> for Value {
            fn from(value: $from) -> Self {
                Self::$variant(Some($convert(value)))
            }
        }

        impl From<Option<$from>> for Value {
            fn from(value: Option<$from>) -> Self {
                Self::$variant(value.map($convert))
            }
        }
    )*};
}

values! {
    i64 => Integer by std::convert::identity;
    i32 => Integer by i64::from;
    u32 => Integer by i64::from;
    u16 => Integer by i64::from;
    u8 => Integer by i64::from;
    f64 => Real by std::convert::identity;
    bool => Truth by std::convert::identity;
    String => Text by std::convert::identity;
    &String => Text by String::clone;
    &str => Text by str::to_owned;
    Cow<'_, str> => Text by Cow::into_owned;
    Vec<u8> => Blob by std::convert::identity;
    &[u8] => Blob by <[u8]>::to_vec;
    &Vec<u8> => Blob by Vec::clone;
}

impl<T> From<&Option<T>> for Value
where
    T: Clone,
    Self: From<Option<T>>,
{
    fn from(value: &Option<T>) -> Self {
        value.clone().into()
    }
}

impl From<&u32> for Value {
    fn from(value: &u32) -> Self {
        (*value).into()
    }
}

/// Where a statement runs.
pub(super) enum On<'c> {
    SqlitePool(&'c SqlitePool),
    Sqlite(&'c mut SqliteConnection),
    PostgresPool(&'c PgPool),
    Postgres(&'c mut PgConnection),
    /// A reading statement that a unit test makes fail.
    #[cfg(test)]
    Failing(sqlx::Error),
}

impl<'c> From<&'c mut SqliteConnection> for On<'c> {
    fn from(connection: &'c mut SqliteConnection) -> Self {
        Self::Sqlite(connection)
    }
}

/// A row of either database.
pub(super) enum Row {
    Sqlite(SqliteRow),
    Postgres(PgRow),
}

/// What can be read from a row of either database.
pub(super) trait Readable: for<'r> FromRow<'r, SqliteRow> + for<'r> FromRow<'r, PgRow> {}

impl<T> Readable for T where T: for<'r> FromRow<'r, SqliteRow> + for<'r> FromRow<'r, PgRow> {}

impl Row {
    /// The value of a column, counted from 0.
    pub(super) fn get<'r, T>(&'r self, column: usize) -> Result<T, sqlx::Error>
    where
        T: sqlx::Decode<'r, Sqlite> + sqlx::Decode<'r, Postgres> + sqlx::Type<Postgres>,
    {
        match self {
            // SQLite has no types of columns to compare with.
            Self::Sqlite(row) => row.try_get_unchecked(column),
            Self::Postgres(row) => row.try_get(column),
        }
    }

    /// The row as a `T`.
    pub(super) fn read<T: Readable>(&self) -> Result<T, sqlx::Error> {
        match self {
            Self::Sqlite(row) => T::from_row(row),
            Self::Postgres(row) => T::from_row(row),
        }
    }
}

/// Number of rows that a statement has written.
#[derive(Debug, Clone, Copy)]
pub(super) struct Written(u64);

impl Written {
    pub(super) const fn rows_affected(self) -> u64 {
        self.0
    }
}

/// A statement with its parameters.
#[must_use = "a statement runs when it is executed or fetched"]
pub(super) struct Query {
    text: SqlStr,
    values: Vec<Value>,
}

/// A statement whose rows are read as `T`.
#[must_use = "a statement runs when it is fetched"]
pub(super) struct QueryAs<T> {
    query: Query,
    row: PhantomData<fn() -> T>,
}

/// A statement. Its parameters are `$1`, `$2` …
pub(super) fn query(text: impl SqlSafeStr) -> Query {
    Query { text: text.into_sql_str(), values: Vec::new() }
}

/// A statement whose rows are read as `T`.
pub(super) fn query_as<T: Readable>(text: impl SqlSafeStr) -> QueryAs<T> {
    QueryAs { query: query(text), row: PhantomData }
}

/// A text that PostgreSQL can compare and store: it refuses the character U+0000, which an id in a request may have. No text that is checked
/// at the door has it, so that nothing that is stored is equal to the result.
fn storable(text: String) -> String {
    if text.contains('\0') {
        text.replace('\0', "\u{fffd}")
    } else {
        text
    }
}

type Statement<DB, A> = sqlx::query::Query<'static, DB, A>;

impl Query {
    /// Gives the next parameter its value.
    pub(super) fn bind(mut self, value: impl Into<Value>) -> Self {
        self.values.push(value.into());
        self
    }

    fn of_sqlite(self) -> Statement<Sqlite, SqliteArguments> {
        let mut statement = sqlx::query(self.text);
        for value in self.values {
            statement = match value {
                Value::Integer(value) => statement.bind(value),
                Value::Real(value) => statement.bind(value),
                Value::Text(value) => statement.bind(value),
                Value::Blob(value) => statement.bind(value),
                Value::Truth(value) => statement.bind(value),
            };
        }
        statement
    }

    fn of_postgres(self) -> Statement<Postgres, PgArguments> {
        let mut statement = sqlx::query(self.text);
        for value in self.values {
            statement = match value {
                Value::Integer(value) => statement.bind(value),
                Value::Real(value) => statement.bind(value.filter(|value| !value.is_nan())),
                Value::Text(value) => statement.bind(value.map(storable)),
                Value::Blob(value) => statement.bind(value),
                Value::Truth(value) => statement.bind(value),
            };
        }
        statement
    }

    /// Runs the statement.
    pub(super) async fn execute<'c>(self, on: impl Into<On<'c>>) -> Result<Written, sqlx::Error> {
        let rows = match on.into() {
            On::SqlitePool(pool) => self.of_sqlite().execute(pool).await?.rows_affected(),
            On::Sqlite(connection) => self.of_sqlite().execute(connection).await?.rows_affected(),
            On::PostgresPool(pool) => self.of_postgres().execute(pool).await.map_err(over_network)?.rows_affected(),
            On::Postgres(connection) => {
                self.of_postgres().execute(connection).await.map_err(over_network)?.rows_affected()
            }
            #[cfg(test)]
            On::Failing(error) => return Err(error),
        };
        Ok(Written(rows))
    }

    /// The rows, one after another.
    pub(super) fn fetch<'c>(self, on: impl Into<On<'c>>) -> BoxStream<'c, Result<Row, sqlx::Error>> {
        match on.into() {
            On::SqlitePool(pool) => self.of_sqlite().fetch(pool).map_ok(Row::Sqlite).boxed(),
            On::Sqlite(connection) => self.of_sqlite().fetch(connection).map_ok(Row::Sqlite).boxed(),
            On::PostgresPool(pool) => {
                self.of_postgres().fetch(pool).map_ok(Row::Postgres).map_err(over_network).boxed()
            }
            On::Postgres(connection) => {
                self.of_postgres().fetch(connection).map_ok(Row::Postgres).map_err(over_network).boxed()
            }
            #[cfg(test)]
            On::Failing(error) => futures_util::stream::iter([Err(error)]).boxed(),
        }
    }

    /// All rows.
    pub(super) async fn fetch_all<'c>(self, on: impl Into<On<'c>>) -> Result<Vec<Row>, sqlx::Error> {
        self.fetch(on).try_collect().await
    }

    /// The first row, if there is one.
    pub(super) async fn fetch_optional<'c>(self, on: impl Into<On<'c>>) -> Result<Option<Row>, sqlx::Error> {
        Ok(match on.into() {
            On::SqlitePool(pool) => self.of_sqlite().fetch_optional(pool).await?.map(Row::Sqlite),
            On::Sqlite(connection) => self.of_sqlite().fetch_optional(connection).await?.map(Row::Sqlite),
            On::PostgresPool(pool) => {
                self.of_postgres().fetch_optional(pool).await.map_err(over_network)?.map(Row::Postgres)
            }
            On::Postgres(connection) => {
                self.of_postgres().fetch_optional(connection).await.map_err(over_network)?.map(Row::Postgres)
            }
            #[cfg(test)]
            On::Failing(error) => return Err(error),
        })
    }
}

/// Statements of which none depends on what another one does. A server gets them as one, because each statement is a way there and back.
#[must_use = "statements run when they are executed"]
#[derive(Default)]
pub(super) struct Statements(Vec<Query>);

impl Statements {
    /// Adds a statement that writes.
    pub(super) fn and(mut self, statement: Query) -> Self {
        self.0.push(statement);
        self
    }

    /// Runs the statements.
    pub(super) async fn execute<'c>(self, on: impl Into<On<'c>>) -> Result<(), sqlx::Error> {
        match on.into() {
            On::Sqlite(connection) => {
                for statement in self.0 {
                    statement.execute(&mut *connection).await?;
                }
            }
            On::SqlitePool(pool) => {
                for statement in self.0 {
                    statement.execute(On::SqlitePool(pool)).await?;
                }
            }
            server => {
                if let Some(statement) = self.together() {
                    statement.execute(server).await?;
                }
            }
        }
        Ok(())
    }

    /// All of them as one: all but the last as parts of a `with`, the parameters numbered on.
    fn together(self) -> Option<Query> {
        let (mut text, mut values) = (String::new(), Vec::new());
        let count = self.0.len();
        for (number, statement) in self.0.into_iter().enumerate() {
            let own = numbered_on(statement.text.as_str(), values.len());
            let opening = if number == 0 { "with " } else { ", " };
            match (number + 1 == count, number) {
                (false, _) => text.extend([opening, "part", &number.to_string(), " as (", &own, ")"]),
                (true, 0) => text.push_str(&own),
                (true, _) => text.extend([" ", &own]),
            }
            values.extend(statement.values);
        }
        (count > 0).then(|| Query { text: sqlx::AssertSqlSafe(text).into_sql_str(), values })
    }
}

/// A statement with all its parameters numbered by `offset` higher.
fn numbered_on(text: &str, offset: usize) -> String {
    let mut parts = text.split('$');
    let mut numbered = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let digits = part.bytes().take_while(u8::is_ascii_digit).count();
        match part[..digits].parse::<usize>() {
            Ok(number) => numbered.extend(["$", &(number + offset).to_string(), &part[digits..]]),
            // The path of a member of JSON, as in '$.reason'.
            Err(_) => numbered.extend(["$", part]),
        }
    }
    numbered
}

impl<T: Readable> QueryAs<T> {
    /// Gives the next parameter its value.
    pub(super) fn bind(self, value: impl Into<Value>) -> Self {
        Self { query: self.query.bind(value), row: PhantomData }
    }

    /// The rows before they are read, one after another.
    pub(super) fn rows<'c>(self, on: impl Into<On<'c>>) -> BoxStream<'c, Result<Row, sqlx::Error>> {
        self.query.fetch(on)
    }

    /// All rows.
    pub(super) async fn fetch_all<'c>(self, on: impl Into<On<'c>>) -> Result<Vec<T>, sqlx::Error> {
        let mut rows = self.query.fetch(on);
        let mut all = Vec::new();
        while let Some(row) = rows.try_next().await? {
            all.push(row.read()?);
        }
        Ok(all)
    }

    /// The first row, if there is one.
    pub(super) async fn fetch_optional<'c>(self, on: impl Into<On<'c>>) -> Result<Option<T>, sqlx::Error> {
        self.query.fetch_optional(on).await?.map(|row| row.read()).transpose()
    }

    /// The first row.
    ///
    /// # Errors
    /// [`sqlx::Error::RowNotFound`] if there is none.
    pub(super) async fn fetch_one<'c>(self, on: impl Into<On<'c>>) -> Result<T, sqlx::Error> {
        self.fetch_optional(on).await?.ok_or(sqlx::Error::RowNotFound)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statements_for_a_server_are_one_with_their_own_parameters() {
        let insert = |table: &'static str| query(table).bind(1_i64).bind("two");
        let one = Statements::default().and(insert("insert into a values ($1, $2)")).together().unwrap();
        assert_eq!(one.text.as_str(), "insert into a values ($1, $2)");
        let all = Statements::default()
            .and(insert("insert into a values ($1, $2)"))
            .and(query("update b set c = d ->> '$.e' where f = $1").bind(3_i64))
            .and(insert("insert into g values ($2, $1, $2)"))
            .together()
            .unwrap();
        assert_eq!(
            all.text.as_str(),
            "with part0 as (insert into a values ($1, $2)), part1 as (update b set c = d ->> '$.e' where f = $3) \
             insert into g values ($5, $4, $5)"
        );
        assert_eq!(all.values.len(), 5);
        assert!(Statements::default().together().is_none());
    }
}
