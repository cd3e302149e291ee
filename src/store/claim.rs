//! Claims of shared computations: the part of a worker.

use std::time::Duration;

use sqlx::FromRow;

use super::column::bad_row;
use super::computation::{Computations, ComputedResult, ComputedWith};
use super::error::{over_network, Error};
use super::sql::{self, Whole};
use crate::quantity::{Digest, StructureId};

/// A worker that has not been heard of for so long is forgotten.
const FORGOTTEN_AFTER_S: f64 = 3_600.0;

/// A piece that a worker holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Claim {
    /// The structure.
    pub structure: StructureId,
    /// Measured from this time on, µs since 1970 …
    pub from_us: i64,
    /// … and before this one.
    pub to_us: i64,
    /// Number of the claim.
    pub fence: i64,
    /// What its batches are computed with.
    pub with: ComputedWith,
}

#[derive(FromRow)]
struct ClaimRow {
    structure_id: String,
    from_us: i64,
    to_us: i64,
    fence: i64,
    program: String,
    structure_digest: String,
    model_digest: String,
    draws_per_measurement: Whole<u32>,
    draws_for_population: Whole<u32>,
}

impl Computations<'_> {
    /// Says that a worker lives.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn hear(self, worker: &str, program: &str) -> Result<(), Error> {
        let upsert = "insert into computation_worker values ($1, $2, clock_timestamp())
             on conflict (worker) do update set heard_at = excluded.heard_at";
        sqlx::query(upsert).bind(worker).bind(program).execute(self.pool).await.map_err(over_network)?;
        let forget = "delete from computation_worker where heard_at < clock_timestamp() - make_interval(secs => $1)";
        sqlx::query(forget).bind(FORGOTTEN_AFTER_S).execute(self.pool).await.map_err(over_network)?;
        Ok(())
    }

    /// Says that a worker has ended.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn leave(self, worker: &str) -> Result<(), Error> {
        let delete = sqlx::query("delete from computation_worker where worker = $1").bind(worker);
        delete.execute(self.pool).await.map_err(over_network)?;
        Ok(())
    }

    /// Claims the first piece that nobody holds, among those for this program and not for one of the `lacking` models.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn claim(
        self,
        worker: &str,
        program: &str,
        lease: Duration,
        lacking: &[Digest],
    ) -> Result<Option<Claim>, Error> {
        let lacking: Vec<&str> = lacking.iter().map(Digest::as_str).collect();
        let row: Option<ClaimRow> = sqlx::query_as(
            "update computation_piece
             set worker = $1, fence = nextval('computation_fence'), attempts = attempts + 1,
                 lease_until = clock_timestamp() + make_interval(secs => $3)
             where (structure_id, from_us) = (
                 select structure_id, from_us from computation_piece
                 where program = $2 and (lease_until is null or lease_until <= clock_timestamp())
                   and not model_digest = any ($4)
                 order by first_received_us, structure_id, from_us limit 1 for update skip locked)
             returning structure_id, from_us, to_us, fence, program, structure_digest, model_digest, draws_per_measurement,
                 draws_for_population",
        )
        .bind(worker)
        .bind(program)
        .bind(lease.as_secs_f64())
        .bind(lacking)
        .fetch_optional(self.pool)
        .await
        .map_err(over_network)?;
        row.map(ClaimRow::claim).transpose()
    }

    /// Renews the lease of a claim. Returns false if the piece was claimed again, or is not offered any more.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn renew(self, claim: &Claim, lease: Duration) -> Result<bool, Error> {
        let renewed = sqlx::query(
            "update computation_piece set lease_until = clock_timestamp() + make_interval(secs => $4)
             where structure_id = $1 and from_us = $2 and fence = $3",
        )
        .bind(claim.structure.as_str())
        .bind(claim.from_us)
        .bind(claim.fence)
        .bind(lease.as_secs_f64())
        .execute(self.pool)
        .await
        .map_err(over_network)?;
        Ok(renewed.rows_affected() == 1)
    }

    /// Batches of a claimed piece that wait and have no result yet, in the order of arrival.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn waiting(self, claim: &Claim) -> Result<Vec<String>, Error> {
        let rows: Vec<(String,)> = sql::query_as(
            "select batch_id from measurement_batch b
             where structure_id = $1 and state = 'received' and measured_from_us >= $2 and measured_from_us < $3
               and not exists (select 1 from computation_result r where r.structure_id = $1 and r.batch_id = b.batch_id)
             order by received_at_us, batch_id",
        )
        .bind(claim.structure.as_str())
        .bind(claim.from_us)
        .bind(claim.to_us)
        .fetch_all(&self.database.reader)
        .await?;
        Ok(rows.into_iter().map(|(id,)| id).collect())
    }

    /// Writes results, all or none. Returns false, and writes nothing, if the piece was claimed again since the claim, or is not offered any
    /// more.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn deliver(self, claim: &Claim, results: &[ComputedResult]) -> Result<bool, Error> {
        let ids: Vec<&str> = results.iter().map(|result| result.batch_id.as_str()).collect();
        let inputs: Vec<&str> = results.iter().map(|result| result.inputs.as_str()).collect();
        let failed: Vec<bool> = results.iter().map(|result| result.outcome.is_err()).collect();
        let contents: Vec<&str> =
            results.iter().map(|result| result.outcome.as_ref().map_or_else(String::as_str, String::as_str)).collect();
        // The lock lets a claim of the piece wait, or skip it, until the results are written.
        let written = sqlx::query(
            "insert into computation_result as old
             select p.structure_id, r.batch_id, r.inputs, p.fence, r.failed, r.content
             from computation_piece p, unnest($4::text[], $5::text[], $6::boolean[], $7::text[]) as r (batch_id, inputs, failed, content)
             where p.structure_id = $1 and p.from_us = $2 and p.fence = $3
             for share of p
             on conflict (structure_id, batch_id) do update
             set inputs = excluded.inputs, fence = excluded.fence, failed = excluded.failed, content = excluded.content
             where old.fence <= excluded.fence",
        )
        .bind(claim.structure.as_str())
        .bind(claim.from_us)
        .bind(claim.fence)
        .bind(ids)
        .bind(inputs)
        .bind(failed)
        .bind(contents)
        .execute(self.pool)
        .await
        .map_err(over_network)?;
        Ok(results.is_empty() || written.rows_affected() > 0)
    }

    /// Ends a claim: the piece is complete and not offered any more.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn complete(self, claim: &Claim) -> Result<(), Error> {
        sqlx::query("delete from computation_piece where structure_id = $1 and from_us = $2 and fence = $3")
            .bind(claim.structure.as_str())
            .bind(claim.from_us)
            .bind(claim.fence)
            .execute(self.pool)
            .await
            .map_err(over_network)?;
        Ok(())
    }

    /// Gives a piece back, for another worker.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn release(self, claim: &Claim) -> Result<(), Error> {
        sqlx::query(
            "update computation_piece set worker = null, lease_until = null, free_since = clock_timestamp()
             where structure_id = $1 and from_us = $2 and fence = $3",
        )
        .bind(claim.structure.as_str())
        .bind(claim.from_us)
        .bind(claim.fence)
        .execute(self.pool)
        .await
        .map_err(over_network)?;
        Ok(())
    }
}

impl ClaimRow {
    fn claim(self) -> Result<Claim, Error> {
        let bad = bad_row("piece of a computation");
        Ok(Claim {
            structure: StructureId::parse(&self.structure_id).map_err(|error| bad(&error))?,
            from_us: self.from_us,
            to_us: self.to_us,
            fence: self.fence,
            with: ComputedWith {
                program: self.program,
                structure_digest: Digest::from_stored(self.structure_digest),
                model_digest: Digest::from_stored(self.model_digest),
                draws_per_measurement: self.draws_per_measurement.0 as usize,
                draws_for_population: self.draws_for_population.0 as usize,
            },
        })
    }
}
