//! Assessments of batches: one for each pair of trained baseline and undamaged reference.

use std::future::Future;

use sqlx::FromRow;

use super::chart::{chart, ChartOutcome};
use super::chart_episode::Charted;
use super::chart_point::StoredChartPoint;
use super::chart_removal::{take_out, Present};
use super::column::{bad_row, timestamp, to_blob};
use super::comparison::{settle_kept, wait_for_comparison};
use super::database::Database;
use super::error::Error;
use super::failed::{end_alarm, open_alarm};
use super::late::{Before, Place};
use super::plotted;
use super::rows::{parts, RowStatements};
use super::sql::{self, Statements, Whole};
use super::transaction::Transaction;
use super::write_queue::WritePriority;
use crate::alarm::chart::FIT_SERIES;
use crate::assessment::{Assessment, NewCharts};
use crate::damage::QuantityKind;
use crate::quantity::{StructureId, Timestamp};

/// The result of storing an assessment.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredAssessment {
    /// The time with which it was stored.
    pub assessed_at: Timestamp,
    /// The points of its batch on the alarm charts.
    pub charts: Vec<StoredChartPoint>,
    /// Whether an alarm was opened, changed or withdrawn.
    pub alarms_changed: bool,
    /// Version of the newest undamaged reference of the structure when it was stored; 0 if there is none.
    pub newest_undamaged: u32,
    /// Whether the same result was stored already, and its batch did not wait for another one: nothing has changed.
    pub repeated: bool,
}

/// What a batch was compared with in its assessment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ComparedWith {
    /// What the assessment says, whatever is stored.
    Given,
    /// The newest undamaged reference at the time of the computation, of this version; 0 if there was none.
    Newest(u32),
    /// The first of the undamaged references that the batch keeps, of this version; 0: none.
    Kept(u32),
}

/// Statements that insert quantities. The first four columns are the same in all rows.
static INSERT_QUANTITIES: RowStatements = RowStatements::new("insert into quantity_assessment ", 29, &[0, 1, 2, 3]);

/// Assessments of batches.
#[derive(Clone, Copy)]
pub struct Assessments<'s> {
    pub(super) database: &'s Database,
}

impl Assessments<'_> {
    /// Stores an assessment with its points on the alarm charts and marks its batch as assessed. What is stored
    /// last is the current one. Returns `None` without storing it if it was made for a version of the structure that is no longer
    /// the present one; the batch then waits for an assessment for the present version.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub fn insert_assessment(
        self,
        structure: &StructureId,
        batch_id: &str,
        assessment: &Assessment,
        charted: NewCharts,
    ) -> impl Future<Output = Result<Option<StoredAssessment>, Error>> + Send + 'static {
        let charted = (charted, ComparedWith::Given, None);
        self.insert_computed(structure, batch_id, assessment, charted, WritePriority::Prompt)
    }

    /// As [`Self::insert_assessment`], with what the batch was compared with, what was stored before it, and the priority of the write. If the
    /// batch was compared with the newest reference and there is a newer one now, with which it can be compared, or if it keeps further
    /// references, it continues to wait for an assessment: whatever happens to the caller, it gets one. Returns `None` without storing the
    /// assessment also if batches that were stored since it was begun can change it.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub fn insert_computed(
        self,
        structure: &StructureId,
        batch_id: &str,
        assessment: &Assessment,
        (charted, compared, before): (NewCharts, ComparedWith, Option<Before>),
        priority: WritePriority,
    ) -> impl Future<Output = Result<Option<StoredAssessment>, Error>> + Send + 'static {
        let (structure, id, a) = (structure.to_string(), batch_id.to_owned(), assessment.clone());
        self.database.write_as(priority, move |transaction| {
            Box::pin(async move {
                let Some(slot) = slot_of(transaction, (&structure, &id), &a, before.as_ref()).await? else {
                    return Ok(None);
                };
                if let Some(before) = before.filter(|_| slot.may_be_outdated) {
                    if before.is_outdated(transaction, (&structure, &id), &slot.place, &a).await? {
                        return Ok(None);
                    }
                }
                let assessed_at = timestamp("assessment", slot.assessed_at_us)?;
                if slot.own != Own::Absent {
                    remove(transaction, &structure, &id, &a).await?;
                }
                if let ComparedWith::Kept(version) = compared {
                    settle_kept(transaction, (&structure, &id), version).await?;
                }
                insert(transaction, &structure, &id, &a, slot.assessed_at_us).await?;
                if matches!(compared, ComparedWith::Newest(seen) if seen != slot.newest_undamaged) {
                    wait_for_comparison(transaction, &structure, &id, &a).await?;
                }
                let batch = Charted {
                    structure: &structure,
                    position: (slot.measured_to_us, id.clone()),
                    now: assessed_at,
                    maintained: slot.maintained,
                    undamaged_version: match compared {
                        ComparedWith::Kept(_) => a.undamaged_version.unwrap_or(0),
                        ComparedWith::Newest(_) | ComparedWith::Given => slot.newest_undamaged,
                    },
                    succeeded_at_us: slot.succeeded_at_us,
                };
                let (rules, on_process) = (charted.rules.clone(), charted.process.is_some());
                let ChartOutcome { points: charts, alarms_changed } = chart(transaction, &batch, charted).await?;
                let taken_out = match rules.filter(|_| slot.own != Own::Absent) {
                    Some(rules) => {
                        let compared = a.undamaged_version.filter(|version| *version == batch.undamaged_version);
                        let present = Present { compared, points: &charts, on_process };
                        take_out(transaction, &batch, present, &rules).await?
                    }
                    None => false,
                };
                let newest_undamaged = slot.newest_undamaged;
                let judged = charts.iter().any(|point| point.series != FIT_SERIES && !point.held);
                let not_judged_changed = match (slot.failing, judged) {
                    (true, _) => end_alarm(transaction, &structure, assessed_at).await?,
                    (false, false) if newest_undamaged > 0 && a.undamaged_version == Some(newest_undamaged) => {
                        open_alarm(transaction, &structure).await?
                    }
                    (false, _) => false,
                };
                let alarms_changed = not_judged_changed || taken_out || alarms_changed;
                let repeated = slot.own == Own::Current;
                Ok(Some(StoredAssessment { assessed_at, charts, alarms_changed, newest_undamaged, repeated }))
            })
        })
    }
}

/// What must be known of a batch to store its assessment.
struct Slot {
    /// The time to store, µs: after the times of all other assessments of the batch, even if the clock stands still or was set back,
    /// because the newest assessment is the current one. A batch that is posted just as waiting batches are assessed may be computed twice,
    /// with the same result: the second one has the time of the first, which was answered already.
    assessed_at_us: i64,
    /// The stored assessment for the same trained baseline and undamaged reference.
    own: Own,
    /// Time of the last measurement of the batch, µs.
    measured_to_us: i64,
    /// Whether the batch overlaps a maintenance window.
    maintained: bool,
    /// Version of the newest undamaged reference; 0 if there is none.
    newest_undamaged: u32,
    /// When the reference after the one of the assessment was declared, µs.
    succeeded_at_us: Option<i64>,
    /// Whether the alarm is open that batches of the structure cannot be judged.
    failing: bool,
    /// Where the batch is among the others.
    place: Place,
    /// Whether batches that were not measured after it were stored since its assessment was begun.
    may_be_outdated: bool,
}

/// A stored assessment of a batch for the same trained baseline and undamaged reference as a new one.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Own {
    /// There is none.
    Absent,
    /// Another one was stored after it, or the batch waits for a new one: it is replaced.
    Superseded,
    /// It is the current one.
    Current,
}

#[derive(FromRow)]
#[expect(clippy::struct_excessive_bools, reason = "a row has the columns of its statement")]
struct SlotRow {
    /// Time of the stored assessment for the same trained baseline and undamaged reference, µs.
    own_us: Option<i64>,
    /// Time of the newest other assessment, µs.
    others_us: Option<i64>,
    /// Whether the batch has an assessment and does not wait for another one.
    settled: bool,
    measured_to_us: i64,
    maintained: bool,
    newest_undamaged: Whole<u32>,
    succeeded_at_us: Option<i64>,
    failing: bool,
    source: String,
    measured_from_us: i64,
    measurement_count: i64,
    may_be_outdated: bool,
}

/// Reads what must be known to store an assessment. `None` if it was made for a version of the structure that is not the present
/// one, or if there is no such batch.
async fn slot_of(
    transaction: &mut Transaction<'_>,
    (structure, batch_id): (&str, &str),
    a: &Assessment,
    before: Option<&Before>,
) -> Result<Option<Slot>, Error> {
    let found: Option<SlotRow> = sql::query_as(
        "select own_us, others_us, state = 'assessed' as settled, measured_to_us,
                exists (select 1 from maintenance_window where structure_id = $1 and from_us <= measured_to_us
                    and to_us > measured_from_us) as maintained,
                (select coalesce(max(version), 0) from undamaged_state where structure_id = $1) as newest_undamaged,
                (select coalesce(cast(case when json_valid(origin) = 1 then origin ->> '$.declared_at_us' end as bigint), created_at_us)
                    from undamaged_state
                    where structure_id = $1 and version > $4 order by version limit 1) as succeeded_at_us,
                exists (select 1 from alarm_episode where structure_id = $1 and kind = 'not_assessed' and ended_at_us is null
                    and withdrawn = 0) as failing,
                source, measured_from_us, measurement_count,
                exists (select 1 from measurement_batch l where l.structure_id = $1 and l.batch_id > $6 and l.batch_id <> $2
                    and l.measured_from_us <= b.measured_from_us) as may_be_outdated
         from (select max(assessed_at_us) filter (where model_digest = $3 and undamaged_version = $4) as own_us,
                      max(assessed_at_us) filter (where not (model_digest = $3 and undamaged_version = $4)) as others_us
               from assessment where structure_id = $1 and batch_id = $2) a, measurement_batch b
         where structure_id = $1 and batch_id = $2
             and exists (select 1 from structure where structure_id = $1 and digest = $5)",
    )
    .bind(structure)
    .bind(batch_id)
    .bind(a.model_digest.as_str())
    .bind(a.undamaged_version.unwrap_or(0))
    .bind(a.structure_digest.as_str())
    .bind(before.map(|before| before.newest.as_str()))
    .fetch_optional(&mut *transaction)
    .await?;
    let Some(found) = found else { return Ok(None) };
    let earliest = found.others_us.map_or(i64::MIN, |latest| latest + 1);
    let first_us = found.own_us.filter(|own| found.settled && *own >= earliest);
    let own = match (found.own_us, first_us) {
        (None, _) => Own::Absent,
        (Some(_), None) => Own::Superseded,
        (Some(_), Some(_)) => Own::Current,
    };
    Ok(Some(Slot {
        assessed_at_us: first_us.unwrap_or_else(|| a.assessed_at.micros().max(earliest)),
        own,
        measured_to_us: found.measured_to_us,
        maintained: found.maintained,
        newest_undamaged: found.newest_undamaged.0,
        succeeded_at_us: found.succeeded_at_us,
        failing: found.failing,
        place: (found.source, found.measured_from_us, found.measurement_count.unsigned_abs() as usize),
        may_be_outdated: found.may_be_outdated,
    }))
}

/// Removes the stored assessment for the same trained baseline and undamaged reference.
async fn remove(
    transaction: &mut Transaction<'_>,
    structure: &str,
    batch_id: &str,
    a: &Assessment,
) -> Result<(), Error> {
    for table in ["quantity_assessment", "assessment"] {
        let delete = format!(
            "delete from {table}
             where structure_id = $1 and batch_id = $2 and model_digest = $3 and undamaged_version = $4"
        );
        sql::query(sqlx::AssertSqlSafe(delete))
            .bind(structure)
            .bind(batch_id)
            .bind(a.model_digest.as_str())
            .bind(a.undamaged_version.unwrap_or(0))
            .execute(&mut *transaction)
            .await?;
    }
    Ok(())
}

/// Marks a batch as assessed, unless it waits for its comparison with a further reference.
fn mark_assessed(structure: &str, batch_id: &str) -> sql::Query {
    let update = "update measurement_batch set failure = null,
             state = case when exists (select 1 from kept_comparison where structure_id = $1 and batch_id = $2) then 'received'
                     else 'assessed' end
         where structure_id = $1 and batch_id = $2";
    sql::query(update).bind(structure).bind(batch_id)
}

/// Inserts an assessment and marks its batch as assessed.
async fn insert(
    transaction: &mut Transaction<'_>,
    structure: &str,
    batch_id: &str,
    a: &Assessment,
    assessed_at_us: i64,
) -> Result<(), Error> {
    let version = a.undamaged_version.unwrap_or(0);
    let trust = serde_json::to_string(&a.trust).map_err(|e| bad_row("assessment")(&e))?;
    let joint = a.joint.as_ref().map(serde_json::to_string).transpose().map_err(|e| bad_row("assessment")(&e))?;
    let insert =
        "insert into assessment values ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, $14, $15, $16)";
    let insert = sql::query(insert)
        .bind(structure)
        .bind(batch_id)
        .bind(a.model_digest.as_str())
        .bind(version)
        .bind(a.structure_digest.as_str())
        .bind(a.seed.cast_signed())
        .bind(a.draws_per_measurement as i64)
        .bind(a.measurements_used as i64)
        .bind(a.measurements_left_out as i64)
        .bind(a.measurements_outside as i64)
        .bind(to_blob(a.misfit_percent.iter().map(|misfit| misfit.unwrap_or(f64::NAN))))
        .bind(assessed_at_us)
        .bind(a.effective_sample_size)
        .bind(trust)
        .bind(plotted::pack(a))
        .bind(joint);
    let mut statements = Statements::default().and(insert).and(mark_assessed(structure, batch_id));
    for rows in parts(a.quantities.len()) {
        let mut insert = sql::query(INSERT_QUANTITIES.of(rows.len()))
            .bind(structure)
            .bind(batch_id)
            .bind(a.model_digest.as_str())
            .bind(version);
        for position in rows {
            let q = &a.quantities[position];
            let damage = q.damage.as_ref();
            insert = insert
                .bind(&q.name)
                .bind(position as i64)
                .bind(&q.unit)
                .bind(kind_name(q.kind))
                .bind(q.mean)
                .bind(q.std)
                .bind(q.pooled.within)
                .bind(q.pooled.between)
                .bind(q.prior_bound_mass)
                .bind(damage.map(|d| d.threshold))
                .bind(damage.map(|d| d.probability_of_damage))
                .bind(damage.map(|d| d.exceeds))
                .bind(damage.map(|d| d.relative_change))
                .bind(q.mean_interval.map(|i| i[0]))
                .bind(q.mean_interval.map(|i| i[1]))
                .bind(q.std_interval.map(|i| i[0]))
                .bind(q.std_interval.map(|i| i[1]))
                .bind(q.pooled.mean)
                .bind(q.pooled.std)
                .bind(damage.and_then(|d| d.probability_interval).map(|i| i[0]))
                .bind(damage.and_then(|d| d.probability_interval).map(|i| i[1]))
                .bind(damage.map(|d| d.pooled_probability))
                .bind(damage.and_then(|d| d.relative_change_interval).map(|i| i[0]))
                .bind(damage.and_then(|d| d.relative_change_interval).map(|i| i[1]))
                .bind(&q.group);
        }
        statements = statements.and(insert);
    }
    statements.execute(transaction).await?;
    Ok(())
}

fn kind_name(kind: QuantityKind) -> &'static str {
    match kind {
        QuantityKind::Parameter => "parameter",
        QuantityKind::SpringStiffness => "spring_stiffness",
        QuantityKind::Group => "group",
    }
}

pub(super) fn kind_of(name: &str) -> Result<QuantityKind, Error> {
    let kinds = [QuantityKind::Parameter, QuantityKind::SpringStiffness, QuantityKind::Group];
    kinds.into_iter().find(|kind| kind_name(*kind) == name).ok_or_else(|| bad_row("quantity")(&name))
}
