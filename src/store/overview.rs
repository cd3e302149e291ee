//! Summary of all structures.

use std::collections::BTreeMap;

use serde::Deserialize;
use sqlx::FromRow;

use super::alarm::{open_damage, OpenAlarms};
use super::chart_point::{state_of, CHARTS};
use super::column::{bad_row, timestamp};
use super::current::IS_CURRENT;
use super::database::Database;
use super::error::Error;
use super::snapshot::Snapshot;
use super::sql::{self, Whole};
use crate::alarm::machine::State;
use crate::process::lasting::LastingChange;
use crate::quantity::{Digest, StructureId, Timestamp};
use crate::trust::{FindingEffect, TrustVerdict};

/// Summary of a structure.
#[derive(Debug, Clone, PartialEq)]
pub struct StructureOverview {
    /// Its id.
    pub id: StructureId,
    /// Number of stored batches.
    pub batches: u64,
    /// Time of its latest measurement.
    pub last_measured_at: Option<Timestamp>,
    /// When its newest batch arrived.
    pub last_received_at: Option<Timestamp>,
    /// The assessed batch that was measured last.
    pub latest: Option<LatestAssessment>,
    /// Number of open alarms.
    pub open_alarms: u64,
    /// Number of open alarms that are not acknowledged.
    pub unacknowledged_alarms: u64,
    /// True while an alarm about missing data is open.
    pub silent: bool,
    /// Whether the newest batches cannot be judged, which an open alarm states.
    pub failing: bool,
    /// Version of its newest undamaged reference.
    pub undamaged_version: Option<u32>,
    /// Digest of the trained baseline with which that reference was made.
    pub undamaged_model: Option<Digest>,
    /// Present states of its alarm charts for the newest undamaged reference, by series.
    pub charts: BTreeMap<String, State>,
    /// The change that the newest batch on the process of that reference shows, whether it is large enough for an alarm or not.
    pub change: Option<LastingChange>,
    /// Number of its batches that have no assessment yet.
    pub waiting: u64,
    /// When the first of them was received.
    pub waiting_since: Option<Timestamp>,
}

/// Summary of the assessed batch that was measured last.
#[derive(Debug, Clone, PartialEq)]
pub struct LatestAssessment {
    /// The batch.
    pub batch_id: String,
    /// Verdict of the trust.
    pub verdict: TrustVerdict,
    /// Number of findings.
    pub findings: usize,
    /// Why it moves no damage chart: the most serious of its findings; `None` if it does.
    pub unjudged: Option<String>,
    /// Whether a probability of damage exceeds that of the undamaged reference.
    pub exceeds: bool,
    /// The largest probability of damage and its quantity.
    pub worst: Option<(f64, String)>,
    /// Relative changes of the quantities with an open damage alarm.
    pub changes: Vec<RelativeChange>,
}

/// Relative difference of a quantity from its mean in the undamaged reference.
#[derive(Debug, Clone, PartialEq)]
pub struct RelativeChange {
    /// The quantity.
    pub quantity: String,
    /// Its estimate.
    pub change: f64,
    /// Its interval of 90 %, if it is known.
    pub interval: Option<[f64; 2]>,
}

#[derive(FromRow)]
struct OverviewRow {
    structure_id: String,
    batches: i64,
    last_measured_us: Option<i64>,
    last_received_us: Option<i64>,
    open_alarms: i64,
    unacknowledged: i64,
    silent: bool,
    failing: bool,
    undamaged_version: Option<Whole<u32>>,
    undamaged_model: Option<String>,
    changes: Option<String>,
    waiting: i64,
    waiting_since_us: Option<i64>,
}

#[derive(FromRow)]
struct ChangeRow {
    quantity: String,
    relative_change: f64,
    change_low: Option<f64>,
    change_high: Option<f64>,
}

#[derive(FromRow)]
struct LatestRow {
    structure_id: String,
    batch_id: String,
    trust: Option<String>,
    exceeds: bool,
    probability_of_damage: Option<f64>,
    quantity: Option<String>,
    alarming: bool,
}

/// The part of a stored trust that the overview contains.
#[derive(Deserialize)]
struct OverviewTrust {
    verdict: TrustVerdict,
    findings: Vec<OverviewFinding>,
}

#[derive(Deserialize)]
struct OverviewFinding {
    effect: FindingEffect,
    message: String,
}

/// The open alarms of a structure `s`.
const OPEN: &str =
    "from alarm_episode e where e.structure_id = s.structure_id and ended_at_us is null and withdrawn = 0";

/// The batches of a structure `s` without an assessment.
const WAITING: &str = "from measurement_batch w where w.structure_id = s.structure_id and w.state = 'received'";

/// The compared quantities of an assessment `a`.
const COMPARED: &str = "from quantity_assessment q
     where q.structure_id = a.structure_id and q.batch_id = a.batch_id and q.model_digest = a.model_digest
       and q.undamaged_version = a.undamaged_version and q.threshold is not null and q.exceeds is not null
       and q.relative_change is not null and q.probability_of_damage is not null";

/// Summary of all structures.
#[derive(Clone, Copy)]
pub struct Overview<'s> {
    pub(super) database: &'s Database,
}

impl Overview<'_> {
    /// All structures by id, and their open damage alarms at the same moment, with four statements for all of them and one for each with an
    /// open damage alarm. The caller must not be dropped before the end: the statements are one transaction.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn structures(self) -> Result<(Vec<StructureOverview>, OpenAlarms), Error> {
        let mut snapshot = self.database.reader.snapshot().await?;
        let structures = self.structures_at(&mut snapshot).await?;
        let open = open_damage(self.database, &mut snapshot).await?;
        snapshot.end().await?;
        Ok((structures, open))
    }

    async fn structures_at(self, snapshot: &mut Snapshot) -> Result<Vec<StructureOverview>, Error> {
        let select = format!(
            "select s.structure_id, coalesce(c.batches, 0) as batches, c.last_measured_us,
                    -- The ids of batches are in the order of their arrival.
                    (select received_at_us from measurement_batch b where b.structure_id = s.structure_id
                     order by batch_id desc limit 1) as last_received_us,
                    (select count(*) {OPEN}) as open_alarms,
                    (select count(*) {OPEN} and acknowledged_at_us is null) as unacknowledged,
                    exists (select 1 {OPEN} and kind = 'silence') as silent,
                    exists (select 1 {OPEN} and kind = 'not_assessed') as failing,
                    (select max(version) from undamaged_state u where u.structure_id = s.structure_id)
                        as undamaged_version,
                    (select model_digest from undamaged_state u where u.structure_id = s.structure_id
                     order by version desc limit 1) as undamaged_model,
                    (select changes from process_point p where p.structure_id = s.structure_id and held = 0 and p.undamaged_version =
                         (select max(version) from undamaged_state u where u.structure_id = s.structure_id)
                     order by measured_to_us desc, batch_id desc limit 1) as changes,
                    (select count(*) {WAITING}) as waiting,
                    (select min(received_at_us) {WAITING}) as waiting_since_us
             from structure s left join structure_summary c using (structure_id)
             where not exists (select 1 from structure_deletion d where d.structure_id = s.structure_id) order by s.structure_id"
        );
        let statement = sql::query_as(sqlx::AssertSqlSafe(select));
        let mut latest = self.latest_assessments(snapshot).await?;
        let mut charts = self.chart_states(snapshot).await?;
        let what = "structure";
        let overview = |row: OverviewRow| {
            Ok(StructureOverview {
                id: StructureId::parse(&row.structure_id).map_err(|e| bad_row(what)(&e))?,
                batches: row.batches.unsigned_abs(),
                last_measured_at: row.last_measured_us.map(|at| timestamp(what, at)).transpose()?,
                last_received_at: row.last_received_us.map(|at| timestamp(what, at)).transpose()?,
                latest: latest.remove(&row.structure_id),
                open_alarms: row.open_alarms.unsigned_abs(),
                unacknowledged_alarms: row.unacknowledged.unsigned_abs(),
                silent: row.silent,
                failing: row.failing,
                undamaged_version: row.undamaged_version.map(|version| version.0),
                undamaged_model: row.undamaged_model.map(Digest::from_stored),
                charts: charts.remove(&row.structure_id).unwrap_or_default(),
                change: row.changes.and_then(|text| self.change(&row.structure_id, &text)),
                waiting: row.waiting.unsigned_abs(),
                waiting_since: row.waiting_since_us.map(|at| timestamp(what, at)).transpose()?,
            })
        };
        self.database.damaged.leave_out(statement, snapshot, 1, overview).await
    }

    /// The change that the text of a batch on a process states; `None` if it is damaged, which is remembered.
    fn change(self, structure: &str, text: &str) -> Option<LastingChange> {
        let read: Result<BTreeMap<String, LastingChange>, _> = serde_json::from_str(text);
        let damaged = |error: &serde_json::Error| {
            let name = format!("the newest change of {structure}");
            self.database.damaged.note(&name, &bad_row("process point")(error));
        };
        read.inspect_err(damaged).ok()?.into_values().next()
    }

    /// The current assessment of the assessed batch that was measured last, by structure.
    async fn latest_assessments(self, snapshot: &mut Snapshot) -> Result<BTreeMap<String, LatestAssessment>, Error> {
        let select = format!(
            "with latest as materialized (
                 select s.structure_id,
                        (select batch_id from measurement_batch b
                         where b.structure_id = s.structure_id and state = 'assessed'
                         order by measured_from_us desc, batch_id desc limit 1) as batch_id
                 from structure s)
             select a.structure_id, a.batch_id, a.trust, exists (select 1 {COMPARED} and q.exceeds = 1) as exceeds,
                    (select q.probability_of_damage {COMPARED}
                     order by q.probability_of_damage desc, q.position desc limit 1) as probability_of_damage,
                    (select q.quantity {COMPARED}
                     order by q.probability_of_damage desc, q.position desc limit 1) as quantity,
                    exists (select 1 from alarm_episode e where e.structure_id = a.structure_id and e.kind = 'damage'
                        and e.ended_at_us is null and e.withdrawn = 0) as alarming
             from latest l cross join assessment a
             where a.structure_id = l.structure_id and a.batch_id = l.batch_id and {IS_CURRENT}"
        );
        let rows: Vec<LatestRow> = sql::query_as(sqlx::AssertSqlSafe(select)).fetch_all(&mut *snapshot).await?;
        let mut all = BTreeMap::new();
        for row in rows {
            let trust = match row.trust.as_deref().map(serde_json::from_str).transpose() {
                Ok(trust) => trust,
                // Without it, the batch is as if it had not been assessed.
                Err(error) => {
                    let name = format!("batch {} of {}", row.batch_id, row.structure_id);
                    self.database.damaged.note(&name, &bad_row("assessment")(&error));
                    continue;
                }
            };
            // Assessments of early versions have no trust.
            let unknown = || OverviewTrust { verdict: TrustVerdict::Accepted, findings: Vec::new() };
            let trust: OverviewTrust = trust.unwrap_or_else(unknown);
            let latest = LatestAssessment {
                changes: if row.alarming { self.changes(&row, snapshot).await? } else { Vec::new() },
                batch_id: row.batch_id,
                verdict: trust.verdict,
                findings: trust.findings.len(),
                unjudged: {
                    let held = trust.findings.into_iter().filter(|finding| finding.effect != FindingEffect::Note);
                    held.max_by_key(|finding| finding.effect).map(|finding| finding.message)
                },
                exceeds: row.exceeds,
                worst: row.probability_of_damage.zip(row.quantity),
            };
            all.insert(row.structure_id, latest);
        }
        Ok(all)
    }

    /// Relative changes of the quantities with an open damage alarm, in the current assessment of a batch.
    async fn changes(self, latest: &LatestRow, snapshot: &mut Snapshot) -> Result<Vec<RelativeChange>, Error> {
        let select = format!(
            "select q.quantity, q.relative_change, q.change_low, q.change_high
             from assessment a join quantity_assessment q using (structure_id, batch_id, model_digest, undamaged_version)
             where a.structure_id = $1 and a.batch_id = $2 and {IS_CURRENT} and q.relative_change is not null
               and exists (select 1 from alarm_episode e where e.structure_id = a.structure_id and e.kind = 'damage'
                   and e.series = q.quantity and e.ended_at_us is null and e.withdrawn = 0)
             order by q.position"
        );
        let rows: Vec<ChangeRow> = sql::query_as(sqlx::AssertSqlSafe(select))
            .bind(&latest.structure_id)
            .bind(&latest.batch_id)
            .fetch_all(snapshot)
            .await?;
        let change = |row: ChangeRow| RelativeChange {
            quantity: row.quantity,
            change: row.relative_change,
            interval: row.change_low.zip(row.change_high).map(<[f64; 2]>::from),
        };
        Ok(rows.into_iter().map(change).collect())
    }

    /// The states after the last points of the charts for the newest undamaged reference, by structure and series.
    async fn chart_states(self, snapshot: &mut Snapshot) -> Result<BTreeMap<String, BTreeMap<String, State>>, Error> {
        let select = format!(
            "with recursive whose (structure_id, version) as (
                 select structure_id, max(version) from undamaged_state group by structure_id
                 union select structure_id, 0 from structure),
             {CHARTS}
             select structure_id, series,
                    (select state from chart_point p where p.structure_id = chart.structure_id
                     and p.undamaged_version = chart.version and p.series = chart.series
                     order by measured_to_us desc, batch_id desc limit 1)
             from chart where series is not null"
        );
        let rows: Vec<(String, String, String)> =
            sql::query_as(sqlx::AssertSqlSafe(select)).fetch_all(snapshot).await?;
        let mut states: BTreeMap<String, BTreeMap<String, State>> = BTreeMap::new();
        for (structure, series, state) in rows {
            match state_of(&state) {
                Ok(state) => {
                    states.entry(structure).or_default().insert(series, state);
                }
                Err(error) => self.database.damaged.remember(&format!("chart {series} of {structure}"), error)?,
            }
        }
        Ok(states)
    }
}

#[cfg(test)]
mod tests {
    use crate::assessment::NewCharts;
    use proptest::prelude::*;

    use super::super::tests::{assessment, at, batch, bridge, open};
    use super::super::Store;

    /// The stored summaries, and the same counted from the batches.
    async fn both(store: &Store) -> [Vec<(String, i64, Option<i64>)>; 2] {
        let kept = "select structure_id, batches, last_measured_us from structure_summary
                    where batches > 0 or last_measured_us is not null";
        let counted = "select structure_id, count(*), max(measured_to_us) from measurement_batch group by structure_id";
        let ask = async |select: &'static str| {
            crate::store::sql::query_as(select).fetch_all(&store.database.reader).await.unwrap()
        };
        [ask(kept).await, ask(counted).await]
    }

    /// Batches arrive in any order, some of them twice, and old ones are deleted.
    async fn check(steps: Vec<(i64, bool)>) {
        let (store, _folder) = open().await;
        for (number, (start, expire)) in steps.into_iter().enumerate() {
            let id = format!("b{number:03}");
            // Batches with an even start share a source, so that some of them repeat stored ones.
            let source = if start % 2 == 0 { "s".to_owned() } else { format!("s{number}") };
            let _ = store.batches().insert_batch(&batch(&source, start, None), &id, at(0)).await.unwrap();
            let _ = store
                .assessments()
                .insert_assessment(&bridge(), &id, &assessment("m", None, at(1)), NewCharts::default())
                .await;
            if expire {
                store.retention().delete_expired(&bridge(), at(start), 3).await.unwrap();
            }
            let [kept, counted] = both(&store).await;
            assert_eq!(kept, counted);
        }
        store.retention().delete_expired(&bridge(), at(1_000_000), 1_000).await.unwrap();
        let [kept, counted] = both(&store).await;
        assert!(kept.is_empty() && counted.is_empty(), "{kept:?} {counted:?}");
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 8, ..ProptestConfig::default() })]

        #[test]
        fn summaries_are_the_recount(steps in prop::collection::vec((0_i64..60, prop::bool::weighted(0.2)), 1..40)) {
            tokio::runtime::Runtime::new().unwrap().block_on(check(steps));
        }
    }

    #[tokio::test]
    async fn the_latest_of_the_overview_is_the_current_assessment_of_the_batch_measured_last() {
        let (store, _folder) = open().await;
        for (number, start) in [3, 9, 5].into_iter().enumerate() {
            let id = format!("b{number}");
            store.batches().insert_batch(&batch(&id, start, None), &id, at(0)).await.unwrap();
        }
        let overview = async || store.overview().structures().await.unwrap().0.remove(0);
        assert_eq!(overview().await.latest, None);
        let mut other = assessment("later", Some(1), at(3));
        other.quantities[1].damage.as_mut().unwrap().probability_of_damage = 0.7;
        for (id, given) in
            [("b0", assessment("m", Some(1), at(1))), ("b1", assessment("m", None, at(2))), ("b1", other)]
        {
            store.assessments().insert_assessment(&bridge(), id, &given, NewCharts::default()).await.unwrap();
            let found = overview().await.latest.unwrap();
            let expected = store.assessments().assessment(&bridge(), &found.batch_id).await.unwrap().unwrap();
            let damages = || expected.quantities.iter().filter_map(|q| Some((q.damage.as_ref()?, q.name.clone())));
            assert_eq!(found.batch_id, id);
            assert_eq!((found.verdict, found.findings), (expected.trust.verdict, expected.trust.findings.len()));
            assert_eq!(found.exceeds, damages().any(|(damage, _)| damage.exceeds));
            let worst = damages().map(|(damage, name)| (damage.probability_of_damage, name));
            assert_eq!(found.worst, worst.max_by(|a, b| a.0.total_cmp(&b.0)));
        }
    }
}
