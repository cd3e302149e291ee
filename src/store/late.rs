//! Batches that arrive late: what was measured after them is assessed again, where they can change its assessment.
//!
//! An assessment depends on what was measured before its batch: repetitions and copies of it are left out, and a frequency that the measurement
//! before shows as well is not set aside. The order of arrival must not decide that. A batch that was measured before others which are assessed
//! therefore makes those of them wait again whose assessment it can change, in the transaction in which it is stored. An assessment that was
//! begun before and ends later is not stored (`Before`).

use std::collections::BTreeMap;

use sqlx::FromRow;

use super::comparison::assess_again;
use super::earlier::{earlier, readable, rows_of, Row};
use super::error::Error;
use super::sql;
use super::transaction::Transaction;
use crate::assessment::{Assessment, BatchState, Earlier};
use crate::measurement::MeasurementBatch;
use crate::quantity::Hertz;

/// Fewest measurements whose wrong frequencies are found without the measurement before them.
const FEWEST: usize = 3;

/// What was stored before a batch when its assessment was begun.
#[derive(Debug, Clone, PartialEq)]
pub struct Before {
    /// What was measured before it.
    pub earlier: Earlier,
    /// Id of the batch of its structure that was stored last; empty if there was none.
    pub(super) newest: String,
}

/// Where a batch is among the others: its source, the time of its first measurement in µs, and the number of its measurements.
pub(super) type Place = (String, i64, usize);

impl Before {
    /// Whether what was stored since then can change the assessment `a` of a batch.
    pub(super) async fn is_outdated(
        &self,
        transaction: &mut Transaction<'_>,
        (structure, batch): (&str, &str),
        (source, from_us, measurements): &Place,
        a: &Assessment,
    ) -> Result<bool, Error> {
        let now = earlier(&mut *transaction, structure, source, (*from_us, *measurements)).await?;
        if now == self.earlier {
            return Ok(false);
        }
        let rows = rows_of(transaction, structure, &[batch]).await?.remove(batch).unwrap_or_default();
        let change = Change {
            previous: [self.earlier.previous.as_ref(), now.previous.as_ref()],
            windows: [&self.earlier.rows, &now.rows],
        };
        let looks_back = a.undamaged_version.is_some() && a.measurements_used < FEWEST;
        Ok(change.matters(&rows, looks_back))
    }
}

/// What was measured before a batch, without what arrived late and with it.
struct Change<'r> {
    /// The last measurement of the same source.
    previous: [Option<&'r Row>; 2],
    /// The measurements that it is compared with, of any source.
    windows: [&'r [Row]; 2],
}

impl Change<'_> {
    /// Whether it can change the assessment of a batch with the measurements `rows`. `looks_back`: whether frequencies of the batch are
    /// compared with the measurement before.
    fn matters(&self, rows: &[Row], looks_back: bool) -> bool {
        let repeats = |other: &Row| rows.iter().any(|own| contains(own, other));
        let [without, with] = self.previous;
        if without != with && (looks_back || self.previous.into_iter().flatten().any(repeats)) {
            return true;
        }
        let [without, with] = self.windows;
        without != with
            && (stands_still(rows)
                || self.windows.into_iter().any(|window| window.iter().any(repeats) || goes_on(window, rows)))
    }
}

/// Whether a measurement has all frequencies of another one. Modes may be missing in the other one, or have been taken for each other.
fn contains(own: &[Option<Hertz>], other: &[Option<Hertz>]) -> bool {
    other.iter().any(Option::is_some) && other.iter().flatten().all(|frequency| own.contains(&Some(*frequency)))
}

/// Whether the last frequency of a mode before a batch is one of the batch, so that the mode may stand still.
fn goes_on(before: &[Row], rows: &[Row]) -> bool {
    let modes = rows.first().map_or(0, Vec::len);
    let newest = |mode: usize| before.iter().rev().filter(|row| row.len() == modes).find_map(|row| row[mode]);
    (0..modes).filter_map(newest).any(|frequency| rows.iter().any(|own| own.contains(&Some(frequency))))
}

/// Whether a mode has the same frequency in all measurements that have it, two at least.
fn stands_still(rows: &[Row]) -> bool {
    let modes = rows.first().map_or(0, Vec::len);
    let stands = |mode: usize| {
        let values: Vec<_> = rows.iter().filter_map(|row| row.get(mode).copied().flatten()).collect();
        values.len() > 1 && values.iter().all(|value| *value == values[0])
    };
    (0..modes).any(stands)
}

/// A batch that was measured after a late one.
#[derive(FromRow)]
struct Following {
    batch_id: String,
    measured_from_us: i64,
    measurement_count: i64,
    state: String,
    /// Whether it was compared with a reference, and so few of its measurements were used that they are compared with the one before.
    looks_back: bool,
}

impl Following {
    fn is_assessed(&self) -> bool {
        self.state != BatchState::Received.as_str()
    }
}

/// Columns of [`Following`] of a batch `b`.
fn columns() -> String {
    format!(
        "b.batch_id, b.measured_from_us, b.measurement_count, b.state,
         exists (select 1 from assessment a where a.structure_id = b.structure_id and a.batch_id = b.batch_id
             and a.undamaged_version > 0 and a.measurements_used < {FEWEST}) as looks_back"
    )
}

/// A batch that was just stored, and was measured before others.
struct Late<'b> {
    batch: &'b MeasurementBatch,
    batch_id: &'b str,
    structure: &'b str,
    from_us: i64,
}

impl Late<'_> {
    /// The batches after it, in their order, in whose windows it may be.
    async fn following(&self, transaction: &mut Transaction<'_>) -> Result<Vec<Following>, Error> {
        let select = format!(
            "select {} from measurement_batch b
             where b.structure_id = $1 and b.measured_from_us >= $2 and (b.measured_from_us > $2 or b.source > $3)
             order by b.measured_from_us, b.source limit $4",
            columns()
        );
        let found: Vec<Following> = sql::query_as(sqlx::AssertSqlSafe(select))
            .bind(self.structure)
            .bind(self.from_us)
            .bind(&self.batch.source)
            // Each has one measurement at least, and is compared with no more than these.
            .bind(Earlier::compared_with(usize::MAX) as i64)
            .fetch_all(&mut *transaction)
            .await?;
        let mut between = 0;
        let is_near = |following: &Following| {
            let near = between < Earlier::compared_with(usize::MAX);
            between += following.measurement_count.unsigned_abs() as usize;
            near
        };
        Ok(found.into_iter().filter(is_near).collect())
    }

    /// The batches of its source that begin after its first measurement and before the second measurement after its last one: the measurement
    /// before them may be one of it.
    async fn successors(&self, transaction: &mut Transaction<'_>) -> Result<Vec<Following>, Error> {
        let (_, to) = self.batch.time_span();
        let select = format!(
            "select {} from (select distinct m.batch_id from measurement m
                     where m.structure_id = $1 and m.source = $2 and m.measured_at_us > $3 and m.measured_at_us <= coalesce(
                         (select n.measured_at_us from measurement n where n.structure_id = $1 and n.source = $2
                              and n.measured_at_us > $4 order by n.measured_at_us limit 1), $4)) s
                 cross join measurement_batch b
             where b.structure_id = $1 and b.batch_id = s.batch_id and b.measured_from_us > $3",
            columns()
        );
        let found = sql::query_as(sqlx::AssertSqlSafe(select))
            .bind(self.structure)
            .bind(&self.batch.source)
            .bind(self.from_us)
            .bind(to.micros())
            .fetch_all(&mut *transaction)
            .await?;
        Ok(found)
    }

    /// The measurements of its source before `at_us`, the last one without it and the last one with it, if these differ.
    async fn previous(&self, transaction: &mut Transaction<'_>, at_us: i64) -> Result<Option<[Option<Row>; 2]>, Error> {
        let own = self.batch.measurements.iter().filter(|m| m.measured_at.micros() < at_us);
        let Some(own) = own.max_by_key(|m| m.measured_at) else { return Ok(None) };
        let other: Option<(i64, Vec<u8>)> = sql::query_as(
            "select measured_at_us, frequency_hz from measurement
             where structure_id = $1 and source = $2 and measured_at_us < $3 and batch_id <> $4
             order by measured_at_us desc limit 1",
        )
        .bind(self.structure)
        .bind(&self.batch.source)
        .bind(at_us)
        .bind(self.batch_id)
        .fetch_optional(&mut *transaction)
        .await?;
        if other.as_ref().is_some_and(|(other_us, _)| *other_us > own.measured_at.micros()) {
            return Ok(None);
        }
        Ok(Some([other.and_then(|(_, blob)| readable(&blob)), Some(own.frequencies_hz.clone())]))
    }

    /// Its measurements in the order of time.
    fn rows(&self) -> Vec<Row> {
        let mut own: Vec<_> = self.batch.measurements.iter().collect();
        own.sort_by_key(|m| m.measured_at);
        own.into_iter().map(|m| m.frequencies_hz.clone()).collect()
    }
}

/// Lets the batches wait for another assessment that are assessed and whose assessment a batch can change that was just stored. Returns
/// whether there are any.
pub(super) async fn outdate(
    transaction: &mut Transaction<'_>,
    batch: &MeasurementBatch,
    batch_id: &str,
) -> Result<bool, Error> {
    let structure = batch.structure.as_str();
    let late = Late { batch, batch_id, structure, from_us: batch.time_span().0.micros() };
    let (following, successors) = (late.following(transaction).await?, late.successors(transaction).await?);
    if !following.iter().chain(&successors).any(Following::is_assessed) {
        return Ok(false);
    }
    let mut previous = BTreeMap::new();
    for after in successors.iter().filter(|after| after.is_assessed()) {
        if let Some(changed) = late.previous(transaction, after.measured_from_us).await? {
            previous.insert(after.batch_id.as_str(), changed);
        }
    }
    let ids: Vec<&str> = following.iter().chain(&successors).map(|after| after.batch_id.as_str()).collect();
    let rows = rows_of(transaction, structure, &ids).await?;
    let mut without = earlier(&mut *transaction, structure, &batch.source, (late.from_us, usize::MAX)).await?.rows;
    let mut with = [without.clone(), late.rows()].concat();
    let mut outdated = Vec::new();
    let nothing = Vec::new();
    for after in &following {
        let own = rows.get(&after.batch_id).unwrap_or(&nothing);
        let count = Earlier::compared_with(after.measurement_count.unsigned_abs() as usize);
        let [one, other] = previous.remove(after.batch_id.as_str()).unwrap_or_default();
        let windows = [last(&without, count), last(&with, count)];
        let change = Change { previous: [one.as_ref(), other.as_ref()], windows };
        if after.is_assessed() && change.matters(own, after.looks_back) {
            outdated.push(after);
        }
        without.extend_from_slice(own);
        with.extend_from_slice(own);
    }
    // The others are so far behind it that it is in none of their windows.
    for after in &successors {
        let Some([one, other]) = previous.remove(after.batch_id.as_str()) else { continue };
        let change = Change { previous: [one.as_ref(), other.as_ref()], windows: [&[], &[]] };
        if change.matters(rows.get(&after.batch_id).unwrap_or(&nothing), after.looks_back) {
            outdated.push(after);
        }
    }
    let mut any = false;
    for after in outdated {
        any |= assess_again(transaction, (structure, &after.batch_id), &after.state).await?;
    }
    Ok(any)
}

/// The last of some measurements.
fn last(rows: &[Row], count: usize) -> &[Row] {
    &rows[rows.len().saturating_sub(count)..]
}

#[cfg(test)]
mod tests {
    use super::super::tests::{assessment, at, batch, bridge, open};
    use super::super::{ComparedWith, InsertBatch, Store, WritePriority};
    use super::*;
    use crate::assessment::NewCharts;

    /// Frequencies of a measurement, Hz; 0 is a missing mode.
    fn row(frequencies_hz: [f64; 2]) -> Row {
        frequencies_hz.into_iter().map(|f| Hertz::new(f).ok()).collect()
    }

    #[test]
    fn only_what_is_repeated_or_compared_can_change_an_assessment() {
        let (own, late, other) = ([row([1.0, 2.0]), row([1.1, 2.1])], [row([1.2, 2.2])], row([1.3, 2.3]));
        let matters = |previous: [Option<&Row>; 2], windows: [&[Row]; 2], looks_back: bool| {
            Change { previous, windows }.matters(&own, looks_back)
        };
        assert!(!matters([Some(&other), Some(&late[0])], [&[], &late], false), "nothing in common");
        assert!(matters([Some(&other), Some(&late[0])], [&[], &[]], true), "the measurement before is looked at");
        assert!(!matters([Some(&other), Some(&other)], [&[], &[]], true), "it is the same");
        assert!(matters([Some(&other), Some(&own[1])], [&[], &[]], false), "repeated");
        assert!(matters([Some(&own[0]), Some(&other)], [&[], &[]], false), "not repeated any more");
        for copy in [row([1.1, 2.1]), row([2.1, 1.1]), row([0.0, 2.1])] {
            let copies = [copy, late[0].clone()];
            assert!(matters([None; 2], [&late, &copies], false) && matters([None; 2], [&copies, &late], false));
        }
        let stands = [row([1.4, 2.0])];
        assert!(matters([None; 2], [&late, &stands], false), "mode 2 may stand still");
        let moved_on = [stands[0].clone(), late[0].clone()];
        assert!(!matters([None; 2], [&late, &moved_on], false), "it has moved between them");
        assert!(!matters([None; 2], [&stands, &stands], false), "they are the same");
        assert!(!matters([None; 2], [&[], &[row([0.0, 0.0])]], false), "nothing was identified");
    }

    /// A batch of the source `s` whose first measurement repeats the last one of that which begins at second 5.
    fn repeating() -> MeasurementBatch {
        let mut given = batch("s", 10, None);
        given.measurements[0].frequencies_hz.clone_from(&batch("s", 5, None).measurements[1].frequencies_hz);
        given
    }

    async fn insert(store: &Store, given: &MeasurementBatch, id: &str) -> bool {
        match store.batches().insert_batch(given, id, at(0)).await.unwrap() {
            InsertBatch::Inserted { outdates, .. } => outdates,
            other => panic!("{other:?}"),
        }
    }

    /// Stores an assessment without a comparison, unless it is outdated.
    async fn assess(store: &Store, id: &str, compared: ComparedWith, before: Option<Before>) -> bool {
        let (given, computed) = (assessment("m", None, at(2)), (NewCharts::default(), compared, before));
        let stored = store.assessments().insert_computed(&bridge(), id, &given, computed, WritePriority::Prompt);
        stored.await.unwrap().is_some()
    }

    #[tokio::test]
    async fn a_late_batch_lets_those_wait_that_repeat_it_and_no_others() {
        let (store, _folder) = open().await;
        for (id, given) in [("b1", repeating()), ("b2", batch("s", 20, None)), ("b3", batch("t", 7, None))] {
            assert!(!insert(&store, &given, id).await);
            assert!(assess(&store, id, ComparedWith::Newest(0), None).await);
        }
        assert!(insert(&store, &batch("s", 5, None), "b4").await);
        assert_eq!(store.batches().pending(&bridge(), 9).await.unwrap(), ["b1"]);
        let kept = store.batches().batch(&bridge(), "b1").await.unwrap().unwrap().kept_reference;
        assert_eq!(kept, Some(0), "it is compared with what it was compared with");
        assert!(assess(&store, "b1", ComparedWith::Kept(0), None).await);
        assert_eq!(store.batches().pending(&bridge(), 9).await.unwrap(), ["b4"]);
        assert!(assess(&store, "b4", ComparedWith::Newest(0), None).await);
        assert!(!insert(&store, &batch("s", 15, None), "b5").await, "nothing repeats it");
        assert_eq!(store.batches().pending(&bridge(), 9).await.unwrap(), ["b5"]);
    }

    #[tokio::test]
    async fn an_assessment_is_not_stored_that_was_begun_before_a_late_batch_it_repeats() {
        let (store, _folder) = open().await;
        insert(&store, &repeating(), "b1").await;
        let before = async |from: i64| Some(store.batches().before(&bridge(), "s", (at(from), 2)).await.unwrap());
        let begun = before(10).await;
        assert!(!insert(&store, &batch("t", 0, None), "b2").await);
        let begun_later = before(10).await;
        assert!(!insert(&store, &batch("s", 5, None), "b3").await, "no batch is assessed");
        assert!(!assess(&store, "b1", ComparedWith::Newest(0), begun).await);
        assert!(!assess(&store, "b1", ComparedWith::Newest(0), begun_later).await);
        assert!(assess(&store, "b1", ComparedWith::Newest(0), before(10).await).await);
        insert(&store, &batch("s", 30, None), "b4").await;
        let begun = before(30).await;
        insert(&store, &batch("s", 25, None), "b5").await;
        assert!(
            assess(&store, "b4", ComparedWith::Newest(0), begun).await,
            "it repeats nothing of what arrived meanwhile"
        );
    }
}
