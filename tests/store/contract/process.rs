//! Charts of the process behind an undamaged reference: the order in which batches arrive has no influence, and a reference keeps its
//! process.

use std::sync::Arc;

use modalwatch::alarm::chart::process_settings;
use modalwatch::alarm::AlarmSettings;
use modalwatch::assessment::{ChartRules, NewCharts, NewProcessPoint};
use modalwatch::damage::UndamagedReference;
use modalwatch::process::direction::ChangeDirection;
use modalwatch::process::estimate::BatchEstimate;
use modalwatch::process::fit::Quantities;
use modalwatch::process::reference::ReferenceProcess;
use modalwatch::quantity::Digest;
use modalwatch::store::{EpisodeQuery, Store, StoredChartPoint};
use rand::seq::SliceRandom as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use super::{assessment, at, batch, bridge, open, undamaged};

const HOUR: i64 = 3_600;
const REFERENCE: usize = 60;

/// Hourly estimates of two stiffnesses with common weather; the second falls by 8 % at `onset`.
fn estimates(count: usize, onset: usize) -> Vec<BatchEstimate> {
    let mut stream = ChaCha8Rng::seed_from_u64(11);
    let mut weather = 0.0;
    let one = |t: usize| {
        let mut normal = || stream.sample::<f64, _>(StandardNormal);
        weather = 0.8 * weather + 0.6 * normal();
        let lost = if t >= onset { 0.92 } else { 1.0 };
        let mean = [1.0 + 0.03 * weather + 0.005 * normal(), lost * (2.0 + 0.04 * weather + 0.01 * normal())];
        BatchEstimate {
            at: batch("sensor", t as i64 * HOUR, 2).time_span().1,
            mean: mean.map(Some).to_vec(),
            covariance: vec![1e-5, 0.0, 0.0, 4e-5],
            covariates: Vec::new(),
        }
    };
    (0..count).map(one).collect()
}

fn reference(estimates: &[BatchEstimate]) -> UndamagedReference {
    let quantities = Quantities {
        names: ["k1", "k2"].map(str::to_owned).to_vec(),
        units: vec!["N/m".to_owned(); 2],
        directions: vec![ChangeDirection::Decrease; 2],
        misfit: None,
    };
    let process = ReferenceProcess::new(&quantities, &[], estimates.to_vec(), 200.0, [1.0; 2]).unwrap();
    UndamagedReference { process: Some(Arc::new(process)), ..undamaged() }
}

async fn opened(reference: &UndamagedReference) -> (Store, tempfile::TempDir) {
    let (store, folder) = open().await;
    store.batches().insert_batch(&batch("first", -5_000, 1), "b0", at(0)).await.unwrap();
    let model = Digest::of(&[b"m"]);
    store.reference().insert_undamaged(&bridge(), reference, &model, &["b0".to_owned()], at(0)).await.unwrap();
    (store, folder)
}

/// Stores batch `t` with its estimate.
async fn chart(store: &Store, reference: &UndamagedReference, estimates: &[BatchEstimate], t: usize) {
    let id = format!("b{t}");
    let given = batch("sensor", t as i64 * HOUR, 2);
    store.batches().insert_batch(&given, &id, at(0)).await.unwrap();
    let process = NewProcessPoint {
        reference: Arc::clone(reference.process.as_ref().unwrap()),
        undamaged_version: 1,
        estimate: estimates[t].clone(),
        held: false,
        settings: process_settings(&AlarmSettings::default()),
    };
    let charts = NewCharts { process: Some(process), ..NewCharts::default() };
    let assessed = assessment("m", Some(1), given.time_span().1);
    store.assessments().insert_assessment(&bridge(), &id, &assessed, charts).await.unwrap();
}

async fn points(store: &Store) -> Vec<StoredChartPoint> {
    store.alarms().charts(&bridge(), 1_000).await.unwrap()
}

#[tokio::test]
async fn batches_in_any_order_give_the_same_charts_and_alarms() {
    // More batches than are read at a time when a late one is inserted.
    let all = estimates(200, 180);
    let reference = reference(&all[..REFERENCE]);
    let (in_order, _first) = opened(&reference).await;
    for t in REFERENCE..200 {
        chart(&in_order, &reference, &all, t).await;
    }
    let (shuffled, _second) = opened(&reference).await;
    let mut order: Vec<usize> = (REFERENCE..200).collect();
    order.shuffle(&mut ChaCha8Rng::seed_from_u64(1));
    for t in order {
        chart(&shuffled, &reference, &all, t).await;
    }
    let (expected, found) = (points(&in_order).await, points(&shuffled).await);
    assert_eq!(expected.len(), 3 * 140, "two stiffnesses and both together");
    assert_eq!(found.len(), expected.len());
    for (a, b) in expected.iter().zip(&found) {
        assert_eq!((&a.batch_id, &a.series, &a.state), (&b.batch_id, &b.series, &b.state));
        // States that differ by less than 1e-6 count as equal when a late batch is inserted.
        assert!((a.shift - b.shift).abs() < 1e-4 && (a.ewma - b.ewma).abs() < 1e-4, "{a:?} {b:?}");
    }
    let episodes = |store: Store| async move {
        let all = store
            .alarms()
            .episodes(&bridge(), EpisodeQuery { before: None, open_only: false, superseded: true, limit: 100 })
            .await
            .unwrap();
        let mut open: Vec<_> = all.into_iter().filter(|e| !e.withdrawn).collect();
        open.sort_by(|a, b| (&a.series, a.opened_at).cmp(&(&b.series, b.opened_at)));
        open
    };
    let (expected, found) = (episodes(in_order).await, episodes(shuffled).await);
    let facts = |e: &modalwatch::store::Episode| (e.series.clone(), e.opened_batch.clone(), e.ended_at);
    assert_eq!(expected.iter().map(facts).collect::<Vec<_>>(), found.iter().map(facts).collect::<Vec<_>>());
    let [alarm] = found.as_slice() else { panic!("one event is one alarm: {found:?}") };
    assert_eq!((alarm.series.as_str(), alarm.parameters()), ("structure:joint", vec!["k2".to_owned()]), "{alarm:?}");
    let change = alarm.change.as_ref().expect("the alarm says what has changed");
    let onset = batch("sensor", 180 * HOUR, 2).time_span().1;
    assert!(change.onset_interval[0] <= onset && onset <= change.onset_interval[1], "{change:?}");
    let percent = change.changes[0].percent(change.changes[0].change);
    assert!(change.changes[0].name == "k2" && (-10.5..-5.5).contains(&percent), "{change:?}");
}

#[tokio::test]
async fn a_batch_that_is_rejected_when_it_is_assessed_again_leaves_the_charts_of_the_process() {
    const REJECTED: usize = 70;
    let all = estimates(100, 80);
    let reference = reference(&all[..REFERENCE]);
    let (with, _first) = opened(&reference).await;
    let (without, _second) = opened(&reference).await;
    for t in REFERENCE..all.len() {
        chart(&with, &reference, &all, t).await;
        if t != REJECTED {
            chart(&without, &reference, &all, t).await;
        }
    }
    let rules = Some(ChartRules { settings: AlarmSettings::default(), process: reference.process.clone() });
    let (id, given) = (format!("b{REJECTED}"), assessment("m", Some(1), all[REJECTED].at));
    let rejected = NewCharts { rules, ..NewCharts::default() };
    with.assessments().insert_assessment(&bridge(), &id, &given, rejected).await.unwrap();
    let (expected, found) = (points(&without).await, points(&with).await);
    assert_eq!(found.len(), expected.len());
    for (a, b) in expected.iter().zip(&found) {
        assert_eq!((&a.batch_id, &a.series, &a.state), (&b.batch_id, &b.series, &b.state));
        assert!((a.shift - b.shift).abs() < 1e-4 && (a.ewma - b.ewma).abs() < 1e-4, "{a:?} {b:?}");
    }
}

#[tokio::test]
async fn a_reference_keeps_its_process_or_why_it_has_none() {
    let reference = reference(&estimates(REFERENCE, usize::MAX));
    let (store, _folder) = opened(&reference).await;
    let read = store.reference().undamaged(&bridge()).await.unwrap().unwrap();
    assert_eq!(read.state.process, reference.process);
    let without = UndamagedReference { without_process: Some("3 batches".to_owned()), ..undamaged() };
    let model = Digest::of(&[b"m"]);
    store.reference().insert_undamaged(&bridge(), &without, &model, &["b0".to_owned()], at(9)).await.unwrap();
    let read = store.reference().undamaged(&bridge()).await.unwrap().unwrap();
    assert_eq!((read.state.process.as_ref(), read.state.without_process.as_deref()), (None, Some("3 batches")));
}
