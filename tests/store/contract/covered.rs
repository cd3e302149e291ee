//! One event is one alarm: the alarm of all parameters together beside that of a single one.

use modalwatch::alarm::chart::ChartPoint;
use modalwatch::alarm::AlarmSettings;
use modalwatch::assessment::{NewChartPoint, NewCharts};
use modalwatch::store::{EpisodeQuery, Store};

use super::alarms::{episodes, messages, opened_with_a_webhook};
use super::{assessment, at, batch, bridge};

const JOINT: &str = "structure:joint";

/// Stores a batch that ends at `time` with a point of k1 and one of all parameters together, each above its limit or not.
async fn chart(store: &Store, time: i64, k1: bool, joint: bool) {
    let (id, given) = (format!("b{time}"), batch(&format!("b{time}"), time, 1));
    store.batches().insert_batch(&given, &id, at(time)).await.unwrap();
    assess(store, time, k1, joint).await;
}

/// Assesses a stored batch.
async fn assess(store: &Store, time: i64, k1: bool, joint: bool) {
    let (id, measured_to) = (format!("b{time}"), batch(&format!("b{time}"), time, 1).time_span().1);
    let settings = AlarmSettings { ewma_weight: 0.0, recovery: 2, ..AlarmSettings::default() };
    let point = |series: &str, above: bool| NewChartPoint {
        series: series.to_owned(),
        undamaged_version: 1,
        point: ChartPoint {
            shift: if above { 9.0 } else { 0.0 },
            limit: 3.0,
            ewma_limit: f64::INFINITY,
            slow: None,
            held: false,
        },
        probability_limit: Some(0.3),
        settings,
    };
    let charts = NewCharts { points: vec![point(JOINT, joint), point("k1", k1)], process: None };
    store
        .assessments()
        .insert_assessment(&bridge(), &id, &assessment("m", Some(1), measured_to), charts)
        .await
        .unwrap();
}

/// The listed alarms, with their states.
async fn listed(store: &Store) -> Vec<String> {
    let query = EpisodeQuery { before: None, open_only: false, superseded: false, limit: 100 };
    let found = store.alarms().episodes(&bridge(), query).await.unwrap();
    found.into_iter().map(|e| format!("{} {}", e.series, e.state())).collect()
}

/// The numbers of open alarms in the overview and in the figures of the store.
async fn counted(store: &Store) -> (u64, u64) {
    let overview = store.overview().structures().await.unwrap().0.remove(0);
    assert_eq!(overview.open_alarms, overview.unacknowledged_alarms);
    let figures = store.overview().figures().await.unwrap();
    (overview.open_alarms, figures.open_alarms.iter().map(|(_, open, _)| open).sum())
}

#[tokio::test]
async fn an_event_on_both_charts_is_listed_counted_and_announced_once() {
    let (store, _folder) = opened_with_a_webhook().await;
    chart(&store, 1_000, true, true).await;
    assert_eq!(listed(&store).await, ["k1 open"]);
    assert_eq!(counted(&store).await, (1, 1));
    let all = episodes(&store).await;
    let [k1, joint] = ["k1", JOINT].map(|series| all.iter().find(|e| e.series == series).unwrap());
    assert_eq!((joint.state(), joint.covered_by, k1.covered_by), ("covered", Some(k1.number), None));
    let k1 = k1.number;
    assert_eq!(messages(&store).await, [format!("alarm.opened {k1}")]);
    for time in [2_000, 3_000] {
        chart(&store, time, false, false).await;
    }
    assert_eq!((listed(&store).await, counted(&store).await), (vec!["k1 ended".to_owned()], (0, 0)));
    assert_eq!(messages(&store).await, [format!("alarm.opened {k1}"), format!("alarm.ended {k1}")]);
}

#[tokio::test]
async fn the_alarm_of_a_parameter_takes_the_place_of_the_earlier_one_of_all_together() {
    let (store, _folder) = opened_with_a_webhook().await;
    chart(&store, 1_000, false, true).await;
    assert_eq!((listed(&store).await, counted(&store).await), (vec![format!("{JOINT} open")], (1, 1)));
    chart(&store, 2_000, true, true).await;
    assert_eq!((listed(&store).await, counted(&store).await), (vec!["k1 open".to_owned()], (1, 1)));
    // What was announced is also announced to have ended.
    for time in [3_000, 4_000] {
        chart(&store, time, true, false).await;
    }
    assert_eq!(messages(&store).await, ["alarm.opened 1", "alarm.opened 2", "alarm.ended 1"]);
    assert_eq!(listed(&store).await, ["k1 open"]);
}

#[tokio::test]
async fn an_open_alarm_of_all_together_is_listed_and_announced_once_that_of_the_parameter_has_ended_or_was_wrong() {
    let (store, _folder) = opened_with_a_webhook().await;
    chart(&store, 1_000, true, true).await;
    let of_k1 = episodes(&store).await.into_iter().find(|e| e.series == "k1").unwrap().number;
    let of_all = 3 - of_k1;
    for time in [2_000, 3_000] {
        chart(&store, time, false, true).await;
    }
    assert_eq!(counted(&store).await, (1, 1));
    assert!(listed(&store).await.contains(&format!("{JOINT} open")));
    let mut expected =
        vec![format!("alarm.opened {of_k1}"), format!("alarm.ended {of_k1}"), format!("alarm.opened {of_all}")];
    assert_eq!(messages(&store).await, expected);
    // The batch is assessed again, and k1 was not above its limit.
    assess(&store, 1_000, false, true).await;
    expected.push(format!("alarm.withdrawn {of_k1}"));
    assert_eq!(messages(&store).await, expected);
    assert_eq!(counted(&store).await, (1, 1));
}

#[tokio::test]
async fn alarms_at_different_times_are_different_events() {
    let (store, _folder) = opened_with_a_webhook().await;
    for (time, k1, joint) in [(1, true, false), (2, false, false), (3, false, false), (4, false, true)] {
        chart(&store, 1_000 * time, k1, joint).await;
    }
    assert_eq!(listed(&store).await, [format!("{JOINT} open"), "k1 ended".to_owned()]);
    assert_eq!(messages(&store).await, ["alarm.opened 1", "alarm.ended 1", "alarm.opened 2"]);
}
