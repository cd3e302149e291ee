//! The service that holds a database: the lock of its session, and the end of a session that is no longer heard of.

use std::time::Duration;

use sqlx::Connection as _;
use sqlx_postgres::PgConnection;

use super::super::error::{over_network, Error};
use super::connect::Place;

/// Number of the lock, among those that applications give a meaning of their own: "modalw" in ASCII. The server knows it by two halves.
pub(super) const LOCK: i64 = 0x6d6f_6461_6c77;

/// Condition on the row `l` of `pg_locks` by which it is the lock of this database; there is at most one such row.
pub(super) const IS_LOCK: &str = "l.locktype = 'advisory' and l.granted and l.objsubid = 1
       and l.classid::bigint = $1 >> 32 and l.objid::bigint = $1 & 4294967295
       and l.database = (select oid from pg_database where datname = current_database())";

/// The session that holds the lock, with what it does.
const HOLDER: &str = "from pg_locks l join pg_stat_activity a on a.pid = l.pid where";

/// Notes that a process holds the lock, after its session has taken it for the first time.
pub(super) async fn note(connection: &mut PgConnection, process: &str) -> Result<(), Error> {
    sqlx::query("update application set held_by = $1").bind(process).execute(connection).await.map_err(over_network)?;
    Ok(())
}

/// Checks that no other process has held the lock since this one did, after its session has taken it again.
///
/// # Errors
/// [`Error::ServedElsewhere`]: what this process knows of the data is out of date, although nobody serves them now.
pub(super) async fn check(connection: &mut PgConnection, process: &str, place: &Place) -> Result<(), Error> {
    let (last,): (Option<String>,) =
        sqlx::query_as("select held_by from application").fetch_one(connection).await.map_err(over_network)?;
    if last.as_deref() == Some(process) {
        return Ok(());
    }
    let place = place.name();
    Err(Error::ServedElsewhere(format!(
        "another service has served {place} while this one was suspended or cut off: start it again"
    )))
}

/// Takes the lock for the session of a connection; returns the number of the session, which is that of its process in the server.
///
/// # Errors
/// [`Error::ServedElsewhere`], which names the holder.
pub(super) async fn take(connection: &mut PgConnection, place: &Place) -> Result<i32, Error> {
    let (taken, session): (bool, i32) = sqlx::query_as("select pg_try_advisory_lock($1), pg_backend_pid()")
        .bind(LOCK)
        .fetch_one(&mut *connection)
        .await
        .map_err(over_network)?;
    if taken {
        return Ok(session);
    }
    let select = format!("select a.application_name, a.client_addr::text {HOLDER} {IS_LOCK}");
    let holder: Option<(Option<String>, Option<String>)> = sqlx::query_as(sqlx::AssertSqlSafe(select))
        .bind(LOCK)
        .fetch_optional(connection)
        .await
        .map_err(over_network)?;
    let holder = match holder {
        Some((Some(name), address)) => {
            let address = address.map(|address| format!(", from {address}")).unwrap_or_default();
            format!("{name}{address}")
        }
        _ => "another service".to_owned(),
    };
    Err(Error::ServedElsewhere(format!(
        "{} is served by {holder}: stop that service, or let this one wait for it by store.standby = true",
        place.name()
    )))
}

/// Ends the session of a holder that has not been heard of for `limit`: it is suspended, or was cut off from the server. A living one sends
/// a statement every second.
pub(super) async fn end_silent(place: &Place, limit: Duration) -> Result<(), Error> {
    let mut connection = place.connect().await?;
    // A session with a running statement is at work, for which the server itself is responsible.
    let end = format!(
        "select a.application_name, pg_terminate_backend(a.pid) {HOLDER} {IS_LOCK} and a.state <> 'active'
           and extract(epoch from clock_timestamp() - greatest(a.state_change, a.query_start)) > $2"
    );
    let ended: Vec<(Option<String>, bool)> = sqlx::query_as(sqlx::AssertSqlSafe(end))
        .bind(LOCK)
        .bind(limit.as_secs_f64())
        .fetch_all(&mut connection)
        .await
        .map_err(over_network)?;
    for (name, _) in ended {
        let name = name.unwrap_or_default();
        tracing::warn!("{name} has not been heard of for {} s: taking over from it", limit.as_secs());
    }
    connection.close().await.map_err(over_network)?;
    Ok(())
}
