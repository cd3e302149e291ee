//! Batches on the charts of the process behind an undamaged reference.
//!
//! What a batch shows depends on the batches before it. Each stored batch keeps its estimate and what was known about the process after
//! it, so that a new batch continues from there; one that arrives late is inserted at its time, and the later ones are computed again.

use std::collections::BTreeMap;

use sqlx::FromRow;

use super::chart_episode::Charted;
use super::chart_point::ChartPosition;
use super::coincidence::Coincidences;
use super::column::{bad_row, from_blob, to_blob};
use super::error::Error;
use super::rows::{parts, RowStatements};
use super::sql;
use super::transaction::Transaction;
use crate::alarm::chart::ChartPoint;
use crate::assessment::{NewChartPoint, NewProcessPoint};
use crate::process::change::WINDOW;
use crate::process::estimate::BatchEstimate;
use crate::process::filter::{Filter, Known};
use crate::process::followed::Memory;
use crate::process::reference::{Chain, ProcessPoint, ReferenceProcess};
use crate::quantity::Timestamp;

/// Later batches that are computed again at most when one arrives late.
const MOST_LATER: usize = 17 * PAGE;

/// Later batches that are read at a time. The influence of a late batch has mostly faded after the window of the test.
const PAGE: usize = 2 * WINDOW;

/// States that differ by less than this in standardised units are equal: the influence of a late batch has faded.
const FADED: f64 = 1e-6;

/// The points of a batch on the charts of its process.
pub(super) struct OnProcess {
    pub points: Vec<NewChartPoint>,
    /// The last position of a later batch that was computed again; `None` if there is none.
    pub changed_to: Option<ChartPosition>,
}

#[derive(FromRow)]
struct ProcessRow {
    measured_to_us: i64,
    batch_id: String,
    estimate: String,
    held: bool,
    known: Vec<u8>,
    memory: Option<String>,
}

impl ProcessRow {
    fn estimate(&self) -> Result<BatchEstimate, Error> {
        serde_json::from_str(&self.estimate).map_err(|e| bad_row("process point")(&e))
    }

    fn known(&self) -> Result<Known, Error> {
        Known::from_numbers(&from_blob("process point", &self.known)?)
            .ok_or_else(|| bad_row("process point")(&"the states"))
    }

    fn memory(&self) -> Result<Memory, Error> {
        Memory::from_json(self.memory.as_deref()).map_err(|e| bad_row("process point")(&e))
    }

    fn at(&self) -> Result<Timestamp, Error> {
        super::column::timestamp("process point", self.measured_to_us)
    }
}

/// Inserts a batch into the chain of its reference, computes the later ones again, and returns its points on the charts.
pub(super) async fn follow(
    transaction: &mut Transaction<'_>,
    batch: &Charted<'_>,
    new: &NewProcessPoint,
) -> Result<OnProcess, Error> {
    let reference: &ReferenceProcess = &new.reference;
    let filter = Filter::of(&reference.process);
    let before = before(transaction, batch, new.undamaged_version).await?;
    let chain = match before.first() {
        Some(first) if before.len() == WINDOW => {
            let mut chain = Chain::resume(reference, &filter, first.known()?, first.at()?);
            for row in &before[1..] {
                chain.pass(&row.estimate()?);
            }
            chain
        }
        // All batches of the chain are here: it begins with the first of them.
        first => {
            let mut chain = Chain::start(reference, &filter, first.map_or(Ok(new.estimate.at), ProcessRow::at)?);
            for row in &before {
                chain.pass(&row.estimate()?);
            }
            chain
        }
    };
    let mut chain = chain
        .remembering(before.last().map(ProcessRow::memory).transpose()?.unwrap_or_default())
        .alarming_from(new.settings.smallest_percent.unwrap_or(0.0));
    let held = new.held || batch.maintained;
    // A batch that is held is compared with the chain but does not become part of it.
    let mut point = if held { chain.clone().take(&new.estimate) } else { chain.take(&new.estimate) };
    let mut coincidences = Coincidences::default();
    coincidences.name(transaction, batch.structure, point.as_mut().and_then(|p| p.change.as_mut())).await?;
    write(transaction, batch, new, held, (&chain, point.as_ref())).await?;
    let mut changed_to = None;
    let mut unchanged = 0;
    let mut later = Later::default();
    let (mut from, mut left) = (batch.position.clone(), MOST_LATER);
    'pages: while left > 0 {
        let page = after(transaction, batch.structure, new.undamaged_version, &from).await?;
        left = if page.len() < PAGE { 0 } else { left.saturating_sub(PAGE) };
        for row in page {
            from = (row.measured_to_us, row.batch_id.clone());
            if row.held {
                continue;
            }
            let mut again = chain.take(&row.estimate()?);
            coincidences.name(transaction, batch.structure, again.as_mut().and_then(|p| p.change.as_mut())).await?;
            let old = row.known()?;
            // A change that is followed adds up all batches since its onset, so that the influence of a late one does not fade.
            let remembers = *chain.memory() != Memory::default() || row.memory.is_some();
            let same = !remembers && (&old.mean - &chain.known().mean).amax() < FADED;
            unchanged = if same { unchanged + 1 } else { 0 };
            later.follow(reference, &from, (&chain, again.as_ref()))?;
            changed_to = Some(from.clone());
            // The window of the test reaches back over the batches whose states were different.
            if unchanged > WINDOW {
                break 'pages;
            }
        }
    }
    later.write(transaction, batch.structure, new.undamaged_version).await?;
    let points = point.map_or_else(Vec::new, |point| points(new, &point));
    Ok(OnProcess { points, changed_to })
}

fn points(new: &NewProcessPoint, point: &ProcessPoint) -> Vec<NewChartPoint> {
    let alarm_series = new.reference.alarm_series();
    let of_series = |series: String| {
        let (evidence, limits) = (point.of_series(&new.reference, &series)?, new.reference.limits_of(&series));
        Some(NewChartPoint {
            point: ChartPoint {
                shift: evidence.fast,
                limit: limits.fast,
                ewma_limit: limits.slow,
                slow: Some(evidence.slow),
                held: new.held,
            },
            raises_alarms: alarm_series.as_ref() == Some(&series),
            series,
            undamaged_version: new.undamaged_version,
            probability_limit: None,
            settings: new.settings,
        })
    };
    new.reference.series().into_iter().filter_map(of_series).collect()
}

/// The last batches of the chain before a position, the oldest first.
async fn before(
    transaction: &mut Transaction<'_>,
    batch: &Charted<'_>,
    version: u32,
) -> Result<Vec<ProcessRow>, Error> {
    let mut rows: Vec<ProcessRow> = sql::query_as(
        "select measured_to_us, batch_id, estimate, held, known, memory from process_point
         where structure_id = $1 and undamaged_version = $2 and (measured_to_us, batch_id) < ($3, $4) and held = 0
         order by measured_to_us desc, batch_id desc limit $5",
    )
    .bind(batch.structure)
    .bind(version)
    .bind(batch.position.0)
    .bind(&batch.position.1)
    .bind(WINDOW as i64)
    .fetch_all(&mut *transaction)
    .await?;
    rows.reverse();
    Ok(rows)
}

/// The batches of the chain after a position, held ones too, [`PAGE`] of them at most.
async fn after(
    transaction: &mut Transaction<'_>,
    structure: &str,
    version: u32,
    (measured_to_us, batch_id): &ChartPosition,
) -> Result<Vec<ProcessRow>, Error> {
    Ok(sql::query_as(
        "select measured_to_us, batch_id, estimate, held, known, memory from process_point
         where structure_id = $1 and undamaged_version = $2 and (measured_to_us, batch_id) > ($3, $4)
         order by measured_to_us, batch_id limit $5",
    )
    .bind(structure)
    .bind(version)
    .bind(*measured_to_us)
    .bind(batch_id)
    .bind(PAGE as i64)
    .fetch_all(&mut *transaction)
    .await?)
}

/// What a chain remembers as it is stored; `None` if there is nothing.
fn memory(chain: &Chain<'_>) -> Result<Option<String>, Error> {
    chain.memory().to_json().map_err(|e| bad_row("process point")(&e))
}

/// The change of a point as it is stored, by the series that raises alarms; `None` without any.
fn change(reference: &ReferenceProcess, point: Option<&ProcessPoint>) -> Result<Option<String>, Error> {
    let change = point.and_then(|point| point.change.as_ref()).zip(reference.alarm_series());
    let by_series = change.map(|(change, series)| BTreeMap::from([(series, change)]));
    by_series.map(|change| serde_json::to_string(&change).map_err(|e| bad_row("process point")(&e))).transpose()
}

async fn write(
    transaction: &mut Transaction<'_>,
    batch: &Charted<'_>,
    new: &NewProcessPoint,
    held: bool,
    (chain, point): (&Chain<'_>, Option<&ProcessPoint>),
) -> Result<(), Error> {
    let estimate = serde_json::to_string(&new.estimate).map_err(|e| bad_row("process point")(&e))?;
    sql::query(
        "insert into process_point
             (structure_id, undamaged_version, measured_to_us, batch_id, estimate, held, known, changes, memory)
         values ($1, $2, $3, $4, $5, $6, $7, $8, $9)
         on conflict (structure_id, undamaged_version, measured_to_us, batch_id) do update
         set estimate = excluded.estimate, held = excluded.held, known = excluded.known, changes = excluded.changes,
             memory = excluded.memory",
    )
    .bind(batch.structure)
    .bind(new.undamaged_version)
    .bind(batch.position.0)
    .bind(&batch.position.1)
    .bind(estimate)
    .bind(held)
    .bind(to_blob(chain.known().to_numbers().into_iter()))
    .bind(change(&new.reference, point)?)
    .bind(memory(chain)?)
    .execute(&mut *transaction)
    .await?;
    Ok(())
}

/// Statements that write what is known after stored batches of a chain. Structure and version are the same in all rows.
static NEW_KNOWN: RowStatements = RowStatements::with_clause(
    "update process_point set known = given.column5, changes = given.column6, memory = given.column7 from (",
    7,
    &[0, 1],
    ") as given where structure_id = given.column1 and undamaged_version = given.column2 and measured_to_us = given.column3
         and batch_id = given.column4",
);

/// Statements that write the evidence of stored points of a process. Structure and version are the same in all rows.
static NEW_EVIDENCE: RowStatements = RowStatements::with_clause(
    "update chart_point set shift = given.column6, slow = given.column7 from (",
    7,
    &[0, 1],
    ") as given where structure_id = given.column1 and undamaged_version = given.column2 and series = given.column3
         and measured_to_us = given.column4 and batch_id = given.column5",
);

/// What follows from a late batch for the batches after it. There may be hundreds, and a server is slow to be asked one by one.
#[derive(Default)]
struct Later {
    states: Vec<LaterState>,
    evidence: Vec<LaterEvidence>,
}

/// What is known after a later batch.
struct LaterState {
    position: ChartPosition,
    known: Vec<u8>,
    changes: Option<String>,
    memory: Option<String>,
}

/// The point of a later batch on a chart.
struct LaterEvidence {
    series: String,
    position: ChartPosition,
    shift: f64,
    slow: f64,
}

impl Later {
    /// Adds what follows for the batch at a position.
    fn follow(
        &mut self,
        reference: &ReferenceProcess,
        position: &ChartPosition,
        (chain, point): (&Chain<'_>, Option<&ProcessPoint>),
    ) -> Result<(), Error> {
        self.states.push(LaterState {
            position: position.clone(),
            known: to_blob(chain.known().to_numbers().into_iter()),
            changes: change(reference, point)?,
            memory: memory(chain)?,
        });
        for series in reference.series() {
            let Some(evidence) = point.and_then(|point| point.of_series(reference, &series)) else { continue };
            let (shift, slow) = (evidence.fast, evidence.slow);
            self.evidence.push(LaterEvidence { series, position: position.clone(), shift, slow });
        }
        Ok(())
    }

    async fn write(self, transaction: &mut Transaction<'_>, structure: &str, version: u32) -> Result<(), Error> {
        for part in parts(self.states.len()) {
            let mut update = sql::query(NEW_KNOWN.of(part.len())).bind(structure).bind(version);
            for LaterState { position: (measured_to_us, batch_id), known, changes, memory } in &self.states[part] {
                update = update.bind(*measured_to_us).bind(batch_id).bind(known).bind(changes).bind(memory);
            }
            update.execute(&mut *transaction).await?;
        }
        for part in parts(self.evidence.len()) {
            let mut update = sql::query(NEW_EVIDENCE.of(part.len())).bind(structure).bind(version);
            for LaterEvidence { series, position: (measured_to_us, batch_id), shift, slow } in &self.evidence[part] {
                update = update.bind(series).bind(*measured_to_us).bind(batch_id).bind(*shift).bind(*slow);
            }
            update.execute(&mut *transaction).await?;
        }
        Ok(())
    }
}
