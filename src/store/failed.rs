//! Batches that cannot be judged, because they cannot be assessed, are rejected, or move no damage chart, and the alarm about them: while
//! they come, a loss would not be seen.

use std::future::Future;

use super::alarm::{insert_episode, NOT_ASSESSED_SERIES};
use super::batch::Batches;
use super::error::Error;
use super::sql;
use super::structure::is_present;
use super::transaction::Transaction;
use super::write_queue::WritePriority;
use crate::clock;
use crate::quantity::{Digest, StructureId, Timestamp};

/// Number of the newest batches, by their arrival, that raise an alarm if none of them can be judged. One or two may be a passing mistake of
/// their sender.
const IN_A_ROW: i64 = 3;

/// The same of batches that are rejected because they repeat themselves or earlier ones: no passing mistake sends two of them.
const REPEATED_IN_A_ROW: i64 = 2;

/// Whether a batch `b` was judged, or needs no judgement: it has moved a damage chart, is part of an undamaged reference, or was measured
/// during maintenance.
macro_rules! judged {
    () => {
        "(exists (select 1 from chart_point p where p.structure_id = b.structure_id and p.batch_id = b.batch_id
              and p.series <> 'simulation:fit' and p.held = 0)
          or exists (select 1 from undamaged_batch u where u.structure_id = b.structure_id and u.batch_id = b.batch_id)
          or exists (select 1 from maintenance_window m where m.structure_id = b.structure_id
              and m.from_us <= b.measured_to_us and m.to_us > b.measured_from_us))"
    };
}

/// A batch that was marked as failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MarkedFailed {
    /// Whether it has opened an alarm.
    pub alarm_opened: bool,
}

impl Batches<'_> {
    /// Marks a batch whose assessment failed, unless the structure has another version now: then `None`. If it is the last of some batches in
    /// a row that could not be judged, an alarm is opened.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub fn mark_failed(
        self,
        structure: &StructureId,
        batch_id: &str,
        version: &Digest,
        reason: &str,
        priority: WritePriority,
    ) -> impl Future<Output = Result<Option<MarkedFailed>, Error>> + Send + 'static {
        let (structure, id, reason) = (structure.to_string(), batch_id.to_owned(), reason.to_owned());
        let version = version.clone();
        self.database.write_as(priority, move |transaction| {
            Box::pin(async move {
                if !is_present(transaction, &structure, &version).await? {
                    return Ok(None);
                }
                sql::query(
                    "update measurement_batch set state = 'failed', failure = $1 where structure_id = $2 and batch_id = $3",
                )
                .bind(reason)
                .bind(&structure)
                .bind(&id)
                .execute(&mut *transaction)
                .await?;
                let alarm_opened = open_alarm(transaction, &structure).await?;
                Ok(Some(MarkedFailed { alarm_opened }))
            })
        })
    }
}

/// Opens the alarm if it is due: none of the newest batches could be judged, and no open alarm says so or that the simulation does not fit.
/// Returns whether it was.
pub(super) async fn open_alarm(transaction: &mut Transaction<'_>, structure: &str) -> Result<bool, Error> {
    let due: Option<(String, i64)> = sql::query_as(concat!(
        "select batch_id, measured_to_us from measurement_batch
         where structure_id = $1
           and ($2 = (select count(*) from
               (select * from measurement_batch where structure_id = $1 order by batch_id desc limit $2) b
               where not ",
        judged!(),
        " and (b.state = 'failed' or b.state = 'assessed' and exists (select 1 from undamaged_quantity q
                   where q.structure_id = $1 and q.threshold is not null)))
             or $3 = (select count(*) from
               (select * from measurement_batch where structure_id = $1 order by batch_id desc limit $3) b
               where b.state = 'assessed' and not ",
        judged!(),
        " and exists (select 1 from undamaged_quantity q where q.structure_id = $1 and q.threshold is not null)
                 and exists (select 1 from assessment a where a.structure_id = b.structure_id and a.batch_id = b.batch_id
                   and a.trust like '{\"verdict\":\"rejected\"%\"code\":\"no_scatter\"%')))
           and not exists (select 1 from alarm_episode
               where structure_id = $1 and kind in ('not_assessed', 'simulation_does_not_fit') and ended_at_us is null and withdrawn = 0)
         order by batch_id desc limit 1"
    ))
    .bind(structure)
    .bind(IN_A_ROW)
    .bind(REPEATED_IN_A_ROW)
    .fetch_optional(&mut *transaction)
    .await?;
    let Some((batch_id, measured_to_us)) = due else { return Ok(false) };
    let row = (0, measured_to_us, Some(batch_id.as_str()), None, 0.0);
    insert_episode(transaction, structure, NOT_ASSESSED_SERIES, row, clock::now()).await?;
    Ok(true)
}

/// Ends the alarm if the newest batch was judged, or if there is nothing with which it could be compared. Returns whether it was open.
pub(super) async fn end_alarm(
    transaction: &mut Transaction<'_>,
    structure: &str,
    now: Timestamp,
) -> Result<bool, Error> {
    let ended = sql::query(concat!(
        "update alarm_episode set ended_at_us = $2
         where structure_id = $1 and kind = 'not_assessed' and ended_at_us is null and withdrawn = 0
           and exists (select 1 from
               (select * from measurement_batch where structure_id = $1 order by batch_id desc limit 1) b
               where b.state <> 'failed' and (",
        judged!(),
        " or not exists (select 1 from undamaged_quantity q where q.structure_id = $1 and q.threshold is not null)))"
    ))
    .bind(structure)
    .bind(now.micros())
    .execute(&mut *transaction)
    .await?;
    Ok(ended.rows_affected() > 0)
}
