//! Computations that the service which serves a PostgreSQL database shares with other processes.
//!
//! The service offers *pieces*: the waiting batches of a structure that were measured in one month. A worker *claims* a piece. The claim has
//! a number, the *fence*, which is larger than those of all claims before, and holds until its lease ends by the clock of the server, unless
//! the worker renews it. Results are written with the fence of their claim; the statement writes nothing if the piece was claimed again in
//! the meantime. The service takes the results and stores them as its own.
//!
//! The workers write by single statements (`claim`). What the service writes goes through its write queue, on the connection that holds its
//! lock.

use std::time::Duration;

use sqlx::FromRow;
use sqlx_postgres::PgPool;

use super::column::{bad_row, elements, list};
use super::database::Database;
use super::error::Error;
use super::sql::{self, Whole};
use crate::quantity::{Digest, StructureId};

/// Waiting batches of a structure, the first by arrival, among which pieces are looked for.
const MOST_SCANNED: i64 = 20_000;

/// What a piece is computed with. Two processes for which it is equal get equal results, bit for bit.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ComputedWith {
    /// What must be equal of the program and its machine.
    pub program: String,
    /// Digest of the version of the structure.
    pub structure_digest: Digest,
    /// Digest of the trained baseline.
    pub model_digest: Digest,
    /// Posterior samples of each measurement in the pool.
    pub draws_per_measurement: usize,
    /// Posterior samples of each measurement for the population.
    pub draws_for_population: usize,
}

/// The result of a computation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ComputedResult {
    /// The batch.
    pub batch_id: String,
    /// Digest of all that the result depends on.
    pub inputs: Digest,
    /// The assessment as text, or why it failed.
    pub outcome: Result<String, String>,
}

/// What other processes do about a waiting batch.
#[derive(Debug, Clone, PartialEq)]
pub struct Awaited {
    /// The batch.
    pub batch_id: String,
    /// Its result, if there is one.
    pub result: Option<ComputedResult>,
    /// Who computes it.
    pub piece: PieceState,
}

/// Who computes a piece.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PieceState {
    /// Nobody: it is not offered.
    NotOffered,
    /// A worker whose lease has not ended.
    Held,
    /// Nobody yet, or nobody any more, for this time.
    Free(Duration),
}

/// The workers that were heard of within a lease.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LiveWorkers {
    /// Those in other processes.
    pub others: usize,
    /// Those that hold no piece, this process included.
    pub idle: usize,
}

#[derive(FromRow)]
struct AwaitedRow {
    batch_id: String,
    inputs: Option<String>,
    failed: Option<bool>,
    content: Option<String>,
    offered: bool,
    held: bool,
    free_s: Option<f64>,
}

/// Computations that are shared with other processes.
#[derive(Clone, Copy)]
pub struct Computations<'s> {
    pub(super) database: &'s Database,
    pub(super) pool: &'s PgPool,
}

impl Computations<'_> {
    /// Workers with a program that were heard of within a lease; `own` is the one in this process.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn workers(self, program: &str, own: &str, lease: Duration) -> Result<LiveWorkers, Error> {
        let row: (Whole<u32>, Whole<u32>) = sql::query_as(
            "select count(*) filter (where worker <> $2),
                    count(*) filter (where not exists (select 1 from computation_piece p
                        where p.worker = w.worker and p.lease_until > clock_timestamp()))
             from computation_worker w where program = $1 and heard_at > clock_timestamp() - make_interval(secs => $3)",
        )
        .bind(program)
        .bind(own)
        .bind(lease.as_secs_f64())
        .fetch_one(&self.database.reader)
        .await?;
        let (Whole(others), Whole(idle)) = row;
        Ok(LiveWorkers { others: others as usize, idle: idle as usize })
    }

    /// Offers the first `most` pieces of a structure with waiting batches that have no result yet, in the order of arrival. A piece that is
    /// offered with the same already stays as it is, also if a worker holds it; one with anything else is taken from its holder.
    ///
    /// # Errors
    /// [`Error::Unreachable`], [`Error::ServedElsewhere`].
    pub async fn offer(self, structure: &StructureId, with: &ComputedWith, most: usize) -> Result<(), Error> {
        // Read beside the write queue, where it would delay others.
        let months: Vec<(i64, i64, i64)> = sql::query_as(
            "select m.from_us, m.to_us, m.first_us
             from (select (extract(epoch from month) * 1000000)::bigint as from_us,
                          (extract(epoch from month + interval '1 month') * 1000000)::bigint as to_us,
                          min(received_at_us) as first_us
                   from (select received_at_us,
                                date_trunc('month', to_timestamp(measured_from_us / 1000000) at time zone 'UTC') as month
                         from measurement_batch b
                         where structure_id = $1 and state = 'received'
                           and not exists (select 1 from computation_result r
                               where r.structure_id = $1 and r.batch_id = b.batch_id)
                         order by received_at_us limit $7) waiting
                   group by month order by first_us limit $8) m
             left join computation_piece p on p.structure_id = $1 and p.from_us = m.from_us
             where (p.program, p.structure_digest, p.model_digest, p.draws_per_measurement, p.draws_for_population)
                 is distinct from ($2, $3, $4, $5, $6)
             order by m.first_us",
        )
        .bind(structure.as_str())
        .bind(&with.program)
        .bind(with.structure_digest.as_str())
        .bind(with.model_digest.as_str())
        .bind(with.draws_per_measurement as i64)
        .bind(with.draws_for_population as i64)
        .bind(MOST_SCANNED)
        .bind(most as i64)
        .fetch_all(&self.database.reader)
        .await?;
        if months.is_empty() {
            return Ok(());
        }
        let (id, with) = (structure.to_string(), with.clone());
        let written = self.database.write(move |transaction| {
            Box::pin(async move {
                for (from_us, to_us, first_us) in months {
                    sql::query(
                        "insert into computation_piece
                         values ($1, $2, $3, $4, $5, $6, $7, $8, $9, null, nextval('computation_fence'), 0, null, clock_timestamp())
                         on conflict (structure_id, from_us) do update
                         set program = excluded.program, structure_digest = excluded.structure_digest,
                             model_digest = excluded.model_digest, draws_per_measurement = excluded.draws_per_measurement,
                             draws_for_population = excluded.draws_for_population, worker = null, fence = excluded.fence,
                             lease_until = null, free_since = excluded.free_since",
                    )
                    .bind(&id)
                    .bind(from_us)
                    .bind(to_us)
                    .bind(&with.program)
                    .bind(with.structure_digest.as_str())
                    .bind(with.model_digest.as_str())
                    .bind(with.draws_per_measurement as i64)
                    .bind(with.draws_for_population as i64)
                    .bind(first_us)
                    .execute(&mut *transaction)
                    .await?;
                }
                Ok(())
            })
        });
        written.await
    }

    /// What other processes do about some waiting batches of a structure. Batches that are not stored any more are left out.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn awaited(self, structure: &StructureId, batches: &[String]) -> Result<Vec<Awaited>, Error> {
        let rows: Vec<AwaitedRow> = sql::query_as(concat!(
            "select b.batch_id, r.inputs, r.failed, r.content, p.fence is not null as offered,
                    coalesce(p.lease_until > clock_timestamp(), false) as held,
                    extract(epoch from clock_timestamp() - greatest(p.free_since, p.lease_until))::float8 as free_s
             from ",
            elements!("$2"),
            " w join measurement_batch b on b.structure_id = $1 and b.batch_id = w.value
             left join computation_result r on r.structure_id = $1 and r.batch_id = w.value
             left join computation_piece p on p.structure_id = $1 and p.from_us <= b.measured_from_us
                 and p.to_us > b.measured_from_us
             order by w.key",
        ))
        .bind(structure.as_str())
        .bind(list(batches))
        .fetch_all(&self.database.reader)
        .await?;
        Ok(rows.into_iter().map(AwaitedRow::awaited).collect())
    }

    /// Removes results that were stored, or that do not hold any more.
    ///
    /// # Errors
    /// [`Error::Unreachable`], [`Error::ServedElsewhere`].
    pub async fn remove(self, structure: &StructureId, batches: &[String]) -> Result<(), Error> {
        let (id, batches) = (structure.to_string(), list(batches));
        let written = self.database.write(move |transaction| {
            Box::pin(async move {
                let delete = concat!(
                    "delete from computation_result where structure_id = $1 and batch_id in (select value from ",
                    elements!("$2"),
                    ")"
                );
                sql::query(delete).bind(id).bind(batches).execute(&mut *transaction).await?;
                Ok(())
            })
        });
        written.await
    }

    /// Removes the results of a structure, which do not hold any more or are not needed; with `pieces`, nothing is offered any more either.
    ///
    /// # Errors
    /// [`Error::Unreachable`], [`Error::ServedElsewhere`].
    pub async fn withdraw(self, structure: &StructureId, pieces: bool) -> Result<(), Error> {
        let id = structure.to_string();
        let written = self.database.write(move |transaction| {
            Box::pin(async move {
                if pieces {
                    let delete = "delete from computation_piece where structure_id = $1";
                    sql::query(delete).bind(&id).execute(&mut *transaction).await?;
                }
                let delete = "delete from computation_result where structure_id = $1";
                sql::query(delete).bind(&id).execute(&mut *transaction).await?;
                Ok(())
            })
        });
        written.await
    }

    /// Structures of which pieces are offered or results are there.
    ///
    /// # Errors
    /// [`Error::Unreachable`], [`Error::Row`].
    pub async fn structures(self) -> Result<Vec<StructureId>, Error> {
        let rows: Vec<(String,)> = sql::query_as(
            "select structure_id from computation_piece union select structure_id from computation_result order by 1",
        )
        .fetch_all(&self.database.reader)
        .await?;
        let parsed = rows.iter().map(|(id,)| StructureId::parse(id));
        parsed.collect::<Result<_, _>>().map_err(|error| bad_row("piece of a computation")(&error))
    }

    /// Removes what an earlier service has left behind: results of batches that do not wait any more, and pieces without a waiting batch.
    ///
    /// # Errors
    /// [`Error::Unreachable`], [`Error::ServedElsewhere`].
    pub async fn tidy(self) -> Result<(), Error> {
        let written = self.database.write(move |transaction| {
            Box::pin(async move {
                for delete in [
                    "delete from computation_result r where not exists (select 1 from measurement_batch b
                         where b.structure_id = r.structure_id and b.batch_id = r.batch_id and b.state = 'received')",
                    "delete from computation_piece p where not exists (select 1 from measurement_batch b
                         where b.structure_id = p.structure_id and b.state = 'received'
                           and b.measured_from_us >= p.from_us and b.measured_from_us < p.to_us)",
                ] {
                    sql::query(delete).execute(&mut *transaction).await?;
                }
                Ok(())
            })
        });
        written.await
    }
}

impl AwaitedRow {
    fn awaited(self) -> Awaited {
        let result = match (self.inputs, self.failed, self.content) {
            (Some(inputs), Some(failed), Some(content)) => Some(ComputedResult {
                batch_id: self.batch_id.clone(),
                inputs: Digest::from_stored(inputs),
                outcome: if failed { Err(content) } else { Ok(content) },
            }),
            _ => None,
        };
        let piece = match (self.offered, self.held) {
            (false, _) => PieceState::NotOffered,
            (true, true) => PieceState::Held,
            (true, false) => PieceState::Free(Duration::from_secs_f64(self.free_s.unwrap_or(0.0).max(0.0))),
        };
        Awaited { batch_id: self.batch_id, result, piece }
    }
}
