//! Time series of a hundred thousand batches: what the reduction keeps, and how long it takes.

use std::time::Instant;

use modalwatch::assessment::NewCharts;
use modalwatch::damage::QuantityKind;
use modalwatch::store::{AssessedSeries, Extent, SeriesWindow, WritePriority};
use modalwatch::trust::{FindingCode, TrustVerdict};
use sqlx::{AssertSqlSafe, Connection as _};
use sqlx_sqlite::{SqliteConnectOptions, SqliteConnection};

use super::super::database::IS_FILE;
use super::{assessment, at, batch, bridge, open, undamaged};

const MANY: i64 = 100_000;
/// Seconds from one batch to the next.
const EVERY_S: i64 = 600;
/// The batch with an unusual frequency.
const SPIKE: i64 = 77_777;
/// The batch that is rejected.
const REJECTED: i64 = 12_345;
/// The first batch after a day without batches.
const AFTER_THE_GAP: i64 = 50_000;

const ALL: SeriesWindow = SeriesWindow { from: None, to: None, points: 1_000 };

async fn connection(folder: &tempfile::TempDir) -> SqliteConnection {
    let options = SqliteConnectOptions::new().filename(folder.path().join("modalwatch.sqlite"));
    SqliteConnection::connect_with(&options).await.unwrap()
}

fn blob(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

/// Fills the tables with [`MANY`] assessed batches of one measurement each, as the service would store them.
async fn fill(folder: &tempfile::TempDir) {
    let mut connection = connection(folder).await;
    let mut transaction = connection.begin_with("begin immediate").await.unwrap();
    let start = at(0).micros();
    let number = format!(
        "with recursive n (i, at, name) as (
             select 0, {start}, printf('b%06d', 0) union all
             select i + 1, {start} + ((i + 1) * {EVERY_S} + (i + 1 >= {AFTER_THE_GAP}) * 86400) * 1000000,
                    printf('b%06d', i + 1) from n where i < {MANY} - 1)"
    );
    let trust = |verdict: &str| {
        format!(
            r#"{{"verdict":"{verdict}","p_value":0.25,"distance":1.1,"degrees_of_freedom":2,"findings":[
                {{"code":"outlier","effect":"note","message":"one of them, far from the others","measurements":[2]}},
                {{"code":"outlier","effect":"note","message":"another one of them","measurements":[3]}}]}}"#
        )
    };
    for statement in [
        "insert into measurement_batch select 'bridge', name, 'logger', null, 'digest', at, at, at, 1, 'assessed', null, null from n",
        "insert into measurement select 'bridge', name, 0, 'logger', at, iif(i = ?5, ?2, iif(i % 10 = 3, ?3, ?1)), null,
             printf('{\"temperature_c\":%.2f,\"wind_m_per_s\":3.5,\"operator\":\"A\"}', 10 + i % 7), '{}', null from n",
        "insert into assessment select 'bridge', name, ?4, 1, 'v1', 1, 10, 1, 0, 0, x'', at, 40.0,
             iif(i = ?6, ?8, ?7), null, null from n",
        "insert into quantity_assessment
         select 'bridge', name, ?4, 1, k.value, k.key, 'N/m', 'parameter', 4.0 + iif(i = ?5, 1.5, i % 13 * 0.01), 0.1, 0.01,
                0.01, 0.0, 3.5, iif(i = ?6, null, 0.01 * (i % 5)), 0, 0.0, 3.9, 4.1, 0.1, 0.2, 4.0, 0.1,
                iif(i = ?6, null, 0.0), iif(i = ?6, null, 0.1), 0.02, -0.1, 0.1, null
         from n, json_each('[\"k1\",\"k2\",\"k3\",\"k4\"]') k",
        "insert into chart_point
         select 'bridge', iif(k.value like '%:%', 0, 1), k.value, at, name, iif(i = ?5, 9.0, 0.1 * (i % 9)), 3.0, 1.0, 0.3, 0, 0.2,
                0, iif(i = ?5, 'alarming', 'normal'), null from n, json_each('[\"k1\",\"k2\",\"k3\",\"k4\",\"simulation:fit\"]') k",
    ] {
        let (usual, missing) = ([1.0, 2.0, 3.0, 4.0, 5.0], [1.0, 2.0, f64::NAN, 4.0, 5.0]);
        sqlx::query(AssertSqlSafe(format!("{number} {statement}")))
            .bind(blob(&usual))
            .bind(blob(&[1.0, 2.0, 3.9, 4.0, 5.0]))
            .bind(blob(&missing))
            .bind("m".repeat(64))
            .bind(SPIKE)
            .bind(REJECTED)
            .bind(trust("accepted"))
            .bind(trust("rejected"))
            .execute(&mut *transaction)
            .await
            .unwrap();
    }
    transaction.commit().await.unwrap();
}

#[tokio::test]
async fn a_reduced_series_of_a_hundred_thousand_batches_keeps_unusual_values() {
    if !IS_FILE {
        return;
    }
    let (store, folder) = open().await;
    store
        .reference()
        .insert_undamaged(&bridge(), &undamaged(), &modalwatch::quantity::Digest::of(&[b"m"]), &[], at(0))
        .await
        .unwrap();
    fill(&folder).await;
    let covariates = ["temperature_c".to_owned(), "operator".to_owned()];

    let started = Instant::now();
    let extent = store.series().extent(&bridge(), ALL).await.unwrap();
    println!("extent of {MANY} batches: {:?}", started.elapsed());
    assert_eq!((extent.batches, extent.measurements, extent.stride()), (MANY as u64, MANY as u64, 1));
    let time_of = |i: i64| at(i * EVERY_S + i64::from(i >= AFTER_THE_GAP) * 86_400).micros();

    let started = Instant::now();
    let (measured, _) = store.series().frequency_series(&bridge(), ALL, &extent, 5, &covariates).await.unwrap();
    println!("frequencies of {MANY} measurements: {:?}, {} rows left", started.elapsed(), measured.rows.len());
    assert!(measured.reduced && measured.rows.len() <= 2 * ALL.points * 7, "{} rows", measured.rows.len());
    let spike = measured.rows.iter().find(|row| row.time_us == time_of(SPIKE)).unwrap();
    let expected = [1.0, 2.0, 3.9, 4.0, 5.0, 10.0 + (SPIKE % 7) as f64];
    assert!(spike.values.iter().zip(expected).all(|(value, expected)| (value - expected).abs() < 1e-12), "{spike:?}");
    assert!(spike.values[6].is_nan(), "text is not a value");
    assert!(
        measured.rows.iter().filter(|row| row.values[2].is_nan()).count() > 300,
        "the series contains missing modes"
    );
    let [(middle, behind)] = measured.gaps[..] else { panic!("{} gaps", measured.gaps.len()) };
    assert!(time_of(AFTER_THE_GAP - 1) < middle && middle < time_of(AFTER_THE_GAP));
    assert_eq!(measured.rows[behind].time_us, time_of(AFTER_THE_GAP), "the rows beside the gap are kept");
    assert_eq!(measured.rows[behind - 1].time_us, time_of(AFTER_THE_GAP - 1));

    let started = Instant::now();
    let AssessedSeries { quantities, trust, .. } =
        store.series().assessed_series(&bridge(), ALL, &extent).await.unwrap();
    println!("4 quantities and trust of {MANY} batches: {:?}", started.elapsed());
    assert_eq!(quantities.iter().map(|q| q.name.as_str()).collect::<Vec<_>>(), ["k1", "k2", "k3", "k4"]);
    for quantity in &quantities {
        assert_eq!((quantity.unit.as_str(), quantity.kind), ("N/m", QuantityKind::Parameter));
        let rows = &quantity.batches.rows;
        let largest = rows.iter().max_by(|a, b| a.values[0].total_cmp(&b.values[0])).unwrap();
        assert_eq!((largest.tag.batch.as_str(), largest.values[0]), ("b077777", 5.5));
        let rejected = rows.iter().find(|row| row.time_us == time_of(REJECTED)).unwrap();
        assert!(rejected.values[1].is_nan() && rejected.tag.probability_interval == [None, None], "{rejected:?}");
        assert_eq!(rejected.tag.mean_interval, [Some(3.9), Some(4.1)]);
        assert!(rows.iter().any(|row| (row.values[1] - 0.04).abs() < 1e-12));
    }

    let started = Instant::now();
    let charts = store.series().chart_series(&bridge(), ALL, &extent).await.unwrap();
    println!("5 charts of {MANY} points: {:?}", started.elapsed());
    assert_eq!(charts.len(), 5);
    for chart in &charts {
        let alarming: Vec<&str> =
            chart.points.rows.iter().filter(|r| r.tag.state == "alarming").map(|r| r.tag.batch.as_str()).collect();
        assert_eq!(alarming, ["b077777"], "{}", chart.chart);
    }

    let rejected: Vec<_> = trust.rows.iter().filter(|row| row.tag.verdict == TrustVerdict::Rejected).collect();
    assert_eq!(rejected.len(), 1);
    assert_eq!(
        (rejected[0].tag.batch.as_str(), rejected[0].tag.findings.as_slice()),
        ("b012345", &[FindingCode::Outlier][..])
    );

    let started = Instant::now();
    let (overview, _) = store.overview().structures().await.unwrap();
    println!("overview of a structure with {MANY} batches: {:?}", started.elapsed());
    let latest = overview[0].latest.as_ref().unwrap();
    assert_eq!((overview[0].batches, latest.batch_id.as_str()), (MANY as u64, "b099999"));
    assert_eq!(overview[0].last_measured_at.unwrap().micros(), time_of(MANY - 1));
    assert_eq!(overview[0].charts.len(), 5);

    // Of too many measurements, every third is read.
    let too_many = Extent { measurements: 1_200_000, ..extent };
    assert_eq!(too_many.stride(), 3);
    let started = Instant::now();
    let (thinned, _) = store.series().frequency_series(&bridge(), ALL, &too_many, 5, &covariates).await.unwrap();
    println!("every third of {MANY} measurements: {:?}", started.elapsed());
    let looked_at: Vec<i64> = (0..MANY).step_by(3).map(time_of).collect();
    assert!(thinned.rows.len() > 400 && thinned.rows.iter().all(|row| looked_at.binary_search(&row.time_us).is_ok()));

    // A window costs as much as the batches in it, and its bounds are respected.
    let window = SeriesWindow { from: Some(at(600_000)), to: Some(at(606_000)), points: 1_000 };
    let started = Instant::now();
    let extent = store.series().extent(&bridge(), window).await.unwrap();
    let (measured, _) = store.series().frequency_series(&bridge(), window, &extent, 5, &covariates).await.unwrap();
    let AssessedSeries { quantities, .. } = store.series().assessed_series(&bridge(), window, &extent).await.unwrap();
    println!("a window of ten batches: {:?}", started.elapsed());
    assert_eq!((extent.batches, measured.rows.len(), quantities[0].batches.rows.len()), (10, 10, 10));
    assert!(!measured.reduced && !quantities[0].batches.reduced);
}

#[tokio::test]
async fn only_the_current_assessment_of_a_batch_that_waits_for_none_is_drawn() {
    let (store, _folder) = open().await;
    for (i, id) in ["b1", "b2", "b3"].into_iter().enumerate() {
        store.batches().insert_batch(&batch(id, 1_000 * i as i64, 2), id, at(0)).await.unwrap();
    }
    let mut old = assessment("m1", Some(1), at(1));
    old.quantities.iter_mut().for_each(|q| q.mean = 9.9);
    store.assessments().insert_assessment(&bridge(), "b1", &old, NewCharts::default()).await.unwrap();
    store
        .assessments()
        .insert_assessment(&bridge(), "b1", &assessment("m2", None, at(2)), NewCharts::default())
        .await
        .unwrap();
    store
        .assessments()
        .insert_assessment(&bridge(), "b2", &assessment("m1", Some(1), at(1)), NewCharts::default())
        .await
        .unwrap();
    let version = modalwatch::quantity::Digest::of(&[b"v1"]);
    let reason = "it failed under the new model";
    store.batches().mark_failed(&bridge(), "b2", &version, reason, WritePriority::Prompt).await.unwrap();
    let extent = store.series().extent(&bridge(), ALL).await.unwrap();
    assert_eq!((extent.batches, extent.measurements), (3, 6));
    let AssessedSeries { quantities, trust, .. } =
        store.series().assessed_series(&bridge(), ALL, &extent).await.unwrap();
    assert_eq!(quantities.len(), 2);
    for quantity in quantities {
        let [row] = &quantity.batches.rows[..] else { panic!("one batch: {quantity:?}") };
        assert_eq!((row.tag.batch.as_str(), row.values[0]), ("b1", 3.6));
        assert!(row.values[1].is_nan(), "not compared with a reference under the new model: {row:?}");
    }
    assert_eq!(trust.rows.len(), 1);
    assert_eq!(trust.rows[0].tag.findings, [FindingCode::Outlier]);
}

#[tokio::test]
async fn the_packed_column_for_plots_agrees_with_the_rows() {
    if !IS_FILE {
        return;
    }
    let (store, folder) = open().await;
    for i in 0..60 {
        let id = format!("b{i:02}");
        store.batches().insert_batch(&batch(&id, 1_000 * i, 2), &id, at(0)).await.unwrap();
        let mut given = assessment(["m1", "m2"][i as usize % 2], (i % 3 > 0).then_some(1), at(i));
        if i % 7 == 0 {
            given.trust.verdict = TrustVerdict::Rejected;
            given.trust.p_value = None;
        }
        for (position, quantity) in given.quantities.iter_mut().enumerate() {
            quantity.mean += 0.01 * (i * (1 + position as i64)) as f64;
            if i % 5 == 0 {
                quantity.mean_interval = None;
            }
        }
        if i % 2 == 1 {
            // Another trained model has other quantities in another order.
            given.quantities.reverse();
            given.quantities[0].name = "k9".to_owned();
        }
        store.assessments().insert_assessment(&bridge(), &id, &given, NewCharts::default()).await.unwrap();
    }
    // More batches than points, so that the series is reduced.
    let window = SeriesWindow { points: 20, ..ALL };
    let extent = store.series().extent(&bridge(), window).await.unwrap();
    let by_column = store.series().assessed_series(&bridge(), window, &extent).await.unwrap();
    assert!(by_column.trust.reduced && by_column.quantities.iter().any(|quantity| quantity.batches.reduced));
    sqlx::query("update assessment set plotted = null").execute(&mut connection(&folder).await).await.unwrap();
    let by_rows = store.series().assessed_series(&bridge(), window, &extent).await.unwrap();
    // The texts are compared, because NaN is not equal to itself.
    assert_eq!(format!("{by_column:?}"), format!("{by_rows:?}"));
}
