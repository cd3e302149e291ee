//! Alarm charts and episodes: batches that arrive late, twice, at the same time, or during maintenance.

use modalwatch::alarm::chart::ChartPoint;
use modalwatch::alarm::AlarmSettings;
use modalwatch::assessment::{ChartRules, NewChartPoint, NewCharts};
use modalwatch::store::{
    Acknowledgement, Episode, EpisodeQuery, EventFilter, MaintenanceWindow, Secret, Store, WebhookRecord,
};

use super::{assessment, at, batch, bridge, open, undamaged};

/// Stores a batch that ends at `time` with one point of k1 on a chart with limit 3.
pub async fn chart(store: &Store, id: &str, time: i64, shift: f64) {
    let given = batch(id, time, 1);
    let measured = given.time_span();
    store.batches().insert_batch(&given, id, at(time)).await.unwrap();
    assess(store, id, measured, shift).await;
}

fn settings() -> AlarmSettings {
    AlarmSettings { ewma_weight: 0.0, recovery: 2, ..AlarmSettings::default() }
}

pub async fn assess(
    store: &Store,
    id: &str,
    measured: (modalwatch::quantity::Timestamp, modalwatch::quantity::Timestamp),
    shift: f64,
) {
    assess_with(store, id, measured, shift, 1).await;
}

/// Assesses a batch by a version of the undamaged reference.
pub async fn assess_with(
    store: &Store,
    id: &str,
    measured: (modalwatch::quantity::Timestamp, modalwatch::quantity::Timestamp),
    shift: f64,
    undamaged_version: u32,
) {
    let settings = settings();
    let point = ChartPoint { shift, limit: 3.0, ewma_limit: f64::INFINITY, slow: None, held: false };
    let series = "k1".to_owned();
    let point =
        NewChartPoint { series, undamaged_version, point, probability_limit: Some(0.3), settings, raises_alarms: true };
    store
        .assessments()
        .insert_assessment(
            &bridge(),
            id,
            &assessment("m", Some(undamaged_version), measured.1),
            NewCharts { points: vec![point], ..NewCharts::default() },
        )
        .await
        .unwrap();
}

pub async fn opened() -> (Store, tempfile::TempDir) {
    let (store, folder) = open().await;
    store.batches().insert_batch(&batch("first", -5_000, 1), "b0", at(0)).await.unwrap();
    let model = modalwatch::quantity::Digest::of(&[b"m"]);
    store.reference().insert_undamaged(&bridge(), &undamaged(), &model, &["b0".to_owned()], at(0)).await.unwrap();
    (store, folder)
}

pub async fn episodes(store: &Store) -> Vec<Episode> {
    store
        .alarms()
        .episodes(&bridge(), EpisodeQuery { before: None, open_only: false, superseded: true, limit: 100 })
        .await
        .unwrap()
}

async fn states(store: &Store) -> Vec<String> {
    store.alarms().charts(&bridge(), 100).await.unwrap().into_iter().map(|p| p.state).collect()
}

#[tokio::test]
async fn one_alarm_is_one_episode_from_its_first_batch_to_its_recovery() {
    let (store, _folder) = opened().await;
    for (i, shift) in [0.0, 4.0, 5.0, 0.5, 6.0, 0.0, 0.0, 0.1].into_iter().enumerate() {
        chart(&store, &format!("b{}", i + 1), 1_000 * (i as i64 + 1), shift).await;
    }
    let expected = ["normal", "alarming", "alarming", "recovering", "alarming", "recovering", "normal", "normal"];
    assert_eq!(states(&store).await, expected);
    let [episode] = &episodes(&store).await[..] else { panic!("one episode") };
    assert_eq!((episode.kind.as_str(), episode.series.as_str()), ("damage", "k1"));
    assert_eq!(episode.opened_batch.as_deref(), Some("b2"));
    assert_eq!(episode.opened_at, batch("b2", 2_000, 1).time_span().1);
    assert_eq!(episode.ended_at, Some(batch("b7", 7_000, 1).time_span().1));
    assert!((episode.peak_shift - 6.0).abs() < 1e-12 && !episode.withdrawn);
}

#[tokio::test]
async fn assessing_a_batch_again_changes_no_alarm() {
    let (store, _folder) = opened().await;
    chart(&store, "b1", 1_000, 4.0).await;
    chart(&store, "b2", 2_000, 5.0).await;
    let before = episodes(&store).await;
    assess(&store, "b1", batch("b1", 1_000, 1).time_span(), 4.0).await;
    assess(&store, "b2", batch("b2", 2_000, 1).time_span(), 5.0).await;
    assert_eq!(episodes(&store).await, before);
}

#[tokio::test]
async fn a_batch_that_arrives_late_moves_the_alarm_and_keeps_its_acknowledgement() {
    let (store, _folder) = opened().await;
    chart(&store, "b3", 3_000, 0.0).await;
    chart(&store, "b5", 5_000, 4.0).await;
    let seen = Acknowledgement { at: at(6_000), by: "night shift".to_owned(), note: None };
    store.alarms().acknowledge(&bridge(), 1, seen.clone()).await.unwrap().unwrap();
    let second = Acknowledgement { by: "somebody else".to_owned(), ..seen.clone() };
    assert_eq!(
        store.alarms().acknowledge(&bridge(), 1, second).await.unwrap().unwrap().acknowledgement,
        Some(seen.clone())
    );
    chart(&store, "b4", 4_000, 4.5).await;
    let [episode] = &episodes(&store).await[..] else { panic!("one episode") };
    assert_eq!((episode.opened_batch.as_deref(), episode.acknowledgement.clone()), (Some("b4"), Some(seen)));
    assert_eq!(states(&store).await, ["normal", "alarming", "alarming"]);
    assert!(store
        .alarms()
        .acknowledge(&bridge(), 9, Acknowledgement { at: at(1), by: "x".into(), note: None })
        .await
        .unwrap()
        .is_none());
}

#[tokio::test]
async fn an_alarm_that_a_corrected_batch_takes_back_is_withdrawn() {
    let (store, _folder) = opened().await;
    chart(&store, "b1", 1_000, 4.0).await;
    chart(&store, "b2", 2_000, 0.0).await;
    assess(&store, "b1", batch("b1", 1_000, 1).time_span(), 1.0).await;
    assert!(episodes(&store).await[0].withdrawn);
    assert_eq!(states(&store).await, ["normal", "normal"]);
    assert!(store
        .alarms()
        .episodes(&bridge(), EpisodeQuery { before: None, open_only: true, superseded: true, limit: 10 })
        .await
        .unwrap()
        .is_empty());
}

#[tokio::test]
async fn a_batch_that_is_rejected_when_it_is_assessed_again_leaves_its_chart() {
    let (store, _folder) = opened().await;
    for (i, shift) in [0.0, 4.0, 0.0, 0.0].into_iter().enumerate() {
        chart(&store, &format!("b{}", i + 1), 1_000 * (i as i64 + 1), shift).await;
    }
    assert_eq!(states(&store).await, ["normal", "alarming", "recovering", "normal"]);
    let rejected =
        NewCharts { rules: Some(ChartRules { settings: settings(), process: None }), ..NewCharts::default() };
    let given = assessment("m", Some(1), at(2_000));
    store.assessments().insert_assessment(&bridge(), "b2", &given, rejected).await.unwrap();
    assert_eq!(store.alarms().chart_points(&bridge(), "b2").await.unwrap(), []);
    assert_eq!(states(&store).await, ["normal"; 3]);
    let found = episodes(&store).await;
    assert!(found.len() == 1 && found[0].withdrawn, "{found:?}");
}

#[tokio::test]
async fn two_batches_of_the_same_time_share_one_alarm() {
    let (store, _folder) = opened().await;
    chart(&store, "b1", 1_000, 4.0).await;
    chart(&store, "b2", 1_000, 5.0).await;
    chart(&store, "b3", 2_000, 5.0).await;
    let found = episodes(&store).await;
    assert_eq!((found.len(), found[0].withdrawn, found[0].ended_at), (1, false, None));
}

#[tokio::test]
async fn order_of_arrival_does_not_matter() {
    let shifts = [0.0, 4.0, 0.0, 0.0, 3.5, 2.0, 4.0, 0.0, 0.0, 0.0];
    let mut found = Vec::new();
    for order in [[0, 1, 2, 3, 4, 5, 6, 7, 8, 9], [9, 8, 7, 6, 5, 4, 3, 2, 1, 0], [4, 0, 8, 2, 6, 1, 9, 3, 7, 5]] {
        let (store, _folder) = opened().await;
        for i in order {
            chart(&store, &format!("b{}", i + 1), 1_000 * (i as i64 + 1), shifts[i]).await;
        }
        let lasting = episodes(&store).await.into_iter().filter(|e| !e.withdrawn);
        let mut lasting: Vec<_> = lasting.map(|e| (e.opened_at, e.opened_batch, e.ended_at)).collect();
        lasting.sort();
        found.push((states(&store).await, lasting));
    }
    assert!(found.windows(2).all(|pair| pair[0] == pair[1]), "{found:#?}");
    assert_eq!(found[0].1.len(), 2);
}

#[tokio::test]
async fn a_batch_in_maintenance_moves_nothing_and_a_new_undamaged_reference_begins_anew() {
    let (store, _folder) = opened().await;
    let window = MaintenanceWindow { from: at(1_500), to: at(2_500), reason: "bolts".to_owned() };
    store.alarms().insert_maintenance(&bridge(), window.clone(), at(0)).await.unwrap();
    assert_eq!(store.alarms().maintenance(&bridge()).await.unwrap(), [window]);
    chart(&store, "b1", 1_000, 0.0).await;
    chart(&store, "b2", 2_000, 9.0).await;
    assert!(episodes(&store).await.is_empty());
    chart(&store, "b3", 3_000, 9.0).await;
    assert_eq!(episodes(&store).await.len(), 1);
    let model = modalwatch::quantity::Digest::of(&[b"m"]);
    store.reference().insert_undamaged(&bridge(), &undamaged(), &model, &["b1".to_owned()], at(4_000)).await.unwrap();
    assert_eq!(episodes(&store).await[0].ended_at, Some(at(4_000)));
    assert_eq!(
        store.batches().pending(&bridge(), 9).await.unwrap(),
        ["b0", "b2", "b3"],
        "b0 was never compared, and all after the undamaged batch come again"
    );
    // Computed before the new reference and stored after it, a point must not reopen an alarm that has ended.
    assess(&store, "b3", batch("b3", 3_000, 1).time_span(), 8.0).await;
    assert_eq!(
        store
            .alarms()
            .episodes(&bridge(), EpisodeQuery { before: None, open_only: true, superseded: true, limit: 10 })
            .await
            .unwrap(),
        []
    );
}

#[tokio::test]
async fn missing_data_are_one_alarm_until_a_batch_arrives() {
    let (store, _folder) = opened().await;
    assert!(store.alarms().set_silent(&bridge(), Some(at(10)), at(99)).await.unwrap());
    assert!(!store.alarms().set_silent(&bridge(), Some(at(10)), at(100)).await.unwrap());
    assert!(store.alarms().set_silent(&bridge(), None, at(120)).await.unwrap());
    let [episode] = &episodes(&store).await[..] else { panic!("one episode") };
    assert_eq!((episode.kind.as_str(), episode.opened_at, episode.ended_at), ("silence", at(10), Some(at(120))));
}

/// The messages in the outbox for a webhook that selects all events, oldest first.
pub async fn messages(store: &Store) -> Vec<String> {
    let mut found = store.outbox().deliveries("hook", None, None, 100).await.unwrap();
    found.reverse();
    found.into_iter().map(|d| format!("{} {}", d.event.kind, d.event.alarm)).collect()
}

pub async fn opened_with_a_webhook() -> (Store, tempfile::TempDir) {
    let (store, folder) = opened().await;
    let webhook = WebhookRecord {
        id: "hook".to_owned(),
        url: "https://example.org".to_owned(),
        secret: Secret::new("whsec_AA==".to_owned()),
        previous_secret: None,
        filter: EventFilter::default(),
        enabled: true,
        created_at: at(0),
        updated_at: at(0),
    };
    assert!(store.webhooks().insert_webhook(webhook.clone(), 1).await.unwrap());
    assert!(!store.webhooks().insert_webhook(WebhookRecord { id: "second".to_owned(), ..webhook }, 1).await.unwrap());
    (store, folder)
}

#[tokio::test]
async fn each_change_of_an_alarm_is_one_message_and_storing_it_again_is_no_change() {
    let (store, _folder) = opened_with_a_webhook().await;
    chart(&store, "b1", 1_000, 0.0).await;
    chart(&store, "b3", 3_000, 4.0).await;
    assert_eq!(messages(&store).await, ["alarm.opened 1"]);
    // The alarm stays open, rises, is assessed again, and begins earlier: it remains the same alarm.
    chart(&store, "b4", 4_000, 6.0).await;
    assess(&store, "b3", batch("b3", 3_000, 1).time_span(), 4.0).await;
    assess(&store, "b3", batch("b3", 3_000, 1).time_span(), 4.5).await;
    chart(&store, "b2", 2_000, 5.0).await;
    assert_eq!(episodes(&store).await.len(), 1);
    assert_eq!(messages(&store).await, ["alarm.opened 1"]);
    let seen = Acknowledgement { at: at(6_000), by: "night shift".to_owned(), note: None };
    for _ in 0..2 {
        store.alarms().acknowledge(&bridge(), 1, seen.clone()).await.unwrap().unwrap();
    }
    chart(&store, "b5", 5_000, 0.0).await;
    chart(&store, "b6", 6_000, 0.0).await;
    let so_far = ["alarm.opened 1", "alarm.acknowledged 1", "alarm.ended 1"];
    assert_eq!(messages(&store).await, so_far);
    // Its end moves, but it was ended before and after.
    assess(&store, "b5", batch("b5", 5_000, 1).time_span(), 0.1).await;
    assert_eq!(messages(&store).await, so_far);
    // A corrected batch reopens the alarm.
    assess(&store, "b6", batch("b6", 6_000, 1).time_span(), 7.0).await;
    assert_eq!(messages(&store).await[3..], ["alarm.reopened 1"]);
    let facts = store.outbox().deliveries("hook", None, None, 1).await.unwrap().remove(0).event.facts;
    let facts: serde_json::Value = serde_json::from_str(&facts).unwrap();
    assert!(facts["ended_at_us"].is_null() && facts["peak_shift"].as_f64() == Some(7.0), "{facts}");
}

#[tokio::test]
async fn a_wrong_alarm_is_withdrawn_and_an_alarm_found_in_the_past_is_sent_with_its_end() {
    let (store, _folder) = opened_with_a_webhook().await;
    chart(&store, "b1", 1_000, 4.0).await;
    chart(&store, "b2", 2_000, 0.0).await;
    assess(&store, "b1", batch("b1", 1_000, 1).time_span(), 1.0).await;
    assert_eq!(messages(&store).await, ["alarm.opened 1", "alarm.withdrawn 1"]);
    for (i, shift) in [0.0, 0.0, 0.0, 0.0].into_iter().enumerate() {
        chart(&store, &format!("c{i}"), 10_000 + 1_000 * i as i64, shift).await;
    }
    chart(&store, "late", 9_500, 8.0).await;
    assert_eq!(messages(&store).await[2..], ["alarm.opened 2", "alarm.ended 2"]);
    assert_eq!(store.outbox().prune_outbox(at(1_000_000_000)).await.unwrap(), 0, "waiting messages are not deleted");
}

#[tokio::test]
async fn missing_data_are_reported_when_they_begin_and_when_they_end() {
    let (store, _folder) = opened_with_a_webhook().await;
    for since in [Some(at(5)), Some(at(5)), None, None] {
        store.alarms().set_silent(&bridge(), since, at(100)).await.unwrap();
    }
    assert_eq!(messages(&store).await, ["alarm.opened 1", "alarm.ended 1"]);
}
