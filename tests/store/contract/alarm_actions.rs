//! What people do with alarms, and notes: nothing is lost, and an alarm that continues another shows its actions.

use modalwatch::alarm::severity::Grade;
use modalwatch::store::{
    ActionKind, ActionOutcome, ClosingReason, Handling, MaintenanceWindow, NewAction, Note, Store, MOST_ACTIONS,
};

use super::alarms::{assess, chart, episodes, messages, opened, opened_with_a_webhook};
use super::{at, batch, bridge, undamaged};

fn action(kind: ActionKind, author: &str, seen: Option<i64>) -> NewAction {
    NewAction { kind, at: at(9_000), author: author.to_owned(), seen }
}

fn comment(text: &str) -> NewAction {
    action(ActionKind::Comment { text: text.to_owned() }, "Ann", None)
}

fn closing(reason: ClosingReason) -> NewAction {
    action(ActionKind::Closing { reason, text: Some("see report 7".to_owned()) }, "Ben", None)
}

fn assignment(name: Option<&str>, seen: Option<i64>) -> NewAction {
    action(ActionKind::Assignment { assignee: name.map(str::to_owned) }, "Ben", seen)
}

async fn act(store: &Store, alarm: i64, new: NewAction) -> ActionOutcome {
    store.alarm_actions().add(&bridge(), alarm, new).await.unwrap()
}

async fn handling(store: &Store, alarm: i64) -> Handling {
    store.alarm_actions().of(&bridge(), &[alarm]).await.unwrap().remove(&alarm).unwrap()
}

fn texts(found: &Handling) -> Vec<&str> {
    found.actions.iter().filter_map(|a| a.kind.text()).collect()
}

#[tokio::test]
async fn an_alarm_is_commented_assigned_closed_and_reopened_and_each_step_is_kept() {
    let (store, _folder) = opened_with_a_webhook().await;
    chart(&store, "b1", 1_000, 4.0).await;
    assert_eq!(act(&store, 2, comment("none")).await, ActionOutcome::UnknownAlarm);
    assert_eq!(
        act(&store, 1, action(ActionKind::Reopening { text: None }, "Ann", None)).await,
        ActionOutcome::NotClosed
    );
    for new in [comment("a crack"), assignment(Some("Cid"), None), closing(ClosingReason::Repaired)] {
        assert_eq!(act(&store, 1, new).await, ActionOutcome::Stored);
    }
    assert_eq!(act(&store, 1, closing(ClosingReason::FalseAlarm)).await, ActionOutcome::AlreadyClosed);
    let found = handling(&store, 1).await;
    assert_eq!((found.actions.len(), found.assignee.as_deref()), (3, Some("Cid")));
    assert_eq!(found.closing.unwrap().kind.reason(), Some(ClosingReason::Repaired));
    // The measurements decide about the state; who closes an alarm has seen it.
    let episode = episodes(&store).await.remove(0);
    assert_eq!((episode.state(), episode.acknowledgement.unwrap().by.as_str()), ("open", "Ben"));
    assert_eq!(act(&store, 1, action(ActionKind::Reopening { text: None }, "Ann", None)).await, ActionOutcome::Stored);
    assert_eq!(act(&store, 1, assignment(None, None)).await, ActionOutcome::Stored);
    let found = handling(&store, 1).await;
    assert_eq!((found.actions.len(), found.assignee, found.closing), (5, None, None));
    let kinds = [
        "alarm.opened 1",
        "alarm.commented 1",
        "alarm.assigned 1",
        "alarm.closed 1",
        "alarm.acknowledged 1",
        "alarm.reopened 1",
        "alarm.assigned 1",
    ];
    assert_eq!(messages(&store).await, kinds);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn people_who_act_at_the_same_time_lose_nothing() {
    let (store, _folder) = opened().await;
    chart(&store, "b1", 1_000, 4.0).await;
    let seen = handling(&store, 1).await.actions.last().map_or(0, |a| a.number);
    let mut tasks = Vec::new();
    for i in 0..20 {
        let store = store.clone();
        tasks.push(tokio::spawn(async move { act(&store, 1, comment(&format!("comment {i}"))).await }));
    }
    let mut assignments = Vec::new();
    for i in 0..5 {
        let store = store.clone();
        let new = assignment(Some(&format!("person {i}")), Some(seen));
        assignments.push(tokio::spawn(async move { (i, act(&store, 1, new).await) }));
    }
    for task in tasks {
        assert_eq!(task.await.unwrap(), ActionOutcome::Stored);
    }
    let mut stored = Vec::new();
    for task in assignments {
        match task.await.unwrap() {
            (i, ActionOutcome::Stored) => stored.push(i),
            (_, outcome) => assert_eq!(outcome, ActionOutcome::Changed),
        }
    }
    let found = handling(&store, 1).await;
    assert_eq!((stored.len(), found.actions.len()), (1, 21), "{stored:?}");
    assert_eq!(found.assignee, Some(format!("person {}", stored[0])));
}

#[tokio::test]
async fn the_number_of_actions_is_bounded() {
    let (store, _folder) = opened().await;
    chart(&store, "b1", 1_000, 4.0).await;
    for i in 0..MOST_ACTIONS {
        assert_eq!(act(&store, 1, comment("x")).await, ActionOutcome::Stored, "{i}");
    }
    assert_eq!(act(&store, 1, comment("x")).await, ActionOutcome::TooMany);
}

#[tokio::test]
async fn an_alarm_of_a_new_reference_continues_with_the_actions_of_the_old_one() {
    let (store, _folder) = opened().await;
    chart(&store, "b1", 1_000, 0.0).await;
    chart(&store, "b2", 2_000, 4.0).await;
    act(&store, 1, comment("a crack")).await;
    act(&store, 1, assignment(Some("Cid"), None)).await;
    act(&store, 1, closing(ClosingReason::DamageConfirmed)).await;
    let model = modalwatch::quantity::Digest::of(&[b"m"]);
    store.reference().insert_undamaged(&bridge(), &undamaged(), &model, &["b0".to_owned()], at(5_000)).await.unwrap();
    super::alarms::assess_with(&store, "b2", batch("b2", 2_000, 1).time_span(), 5.0, 2).await;
    let found = episodes(&store).await;
    assert_eq!((found.len(), found[0].number, found[0].continues), (2, 2, Some(1)), "{found:#?}");
    let continued = handling(&store, 2).await;
    assert_eq!(texts(&continued), ["a crack", "see report 7"]);
    assert!(continued.actions.iter().all(|a| a.alarm == 1));
    assert_eq!(continued.assignee.as_deref(), Some("Cid"));
    assert_eq!(continued.closing.unwrap().alarm, 1);
    // Its own actions count from now on; those on the old alarm stay as they were.
    assert_eq!(act(&store, 2, action(ActionKind::Reopening { text: None }, "Ann", None)).await, ActionOutcome::Stored);
    assert_eq!(act(&store, 2, assignment(Some("Dot"), None)).await, ActionOutcome::Stored);
    let (old, new) = (handling(&store, 1).await, handling(&store, 2).await);
    assert_eq!((old.assignee.as_deref(), old.closing.is_some()), (Some("Cid"), true));
    assert_eq!((new.assignee.as_deref(), new.closing.is_none(), new.actions.len()), (Some("Dot"), true, 5));
}

#[tokio::test]
async fn alarms_that_late_data_join_keep_the_comments_of_both_and_the_closing_of_none_but_their_own() {
    let (store, _folder) = opened().await;
    for (id, time, shift) in [("b1", 1_000, 4.0), ("b3", 3_000, 0.0), ("b4", 4_000, 0.0), ("b6", 6_000, 5.0)] {
        chart(&store, id, time, shift).await;
    }
    assert_eq!(episodes(&store).await.len(), 2);
    act(&store, 1, comment("the first")).await;
    act(&store, 2, comment("the second")).await;
    act(&store, 2, closing(ClosingReason::SensorFault)).await;
    // The batches in between turn out to be damaged as well: one alarm from the first to the last.
    assess(&store, "b3", batch("b3", 3_000, 1).time_span(), 6.0).await;
    assess(&store, "b4", batch("b4", 4_000, 1).time_span(), 6.0).await;
    let found = episodes(&store).await;
    let (kept, withdrawn): (Vec<_>, Vec<_>) = found.iter().partition(|e| !e.withdrawn);
    assert_eq!((kept.len(), withdrawn.len()), (1, 1), "{found:#?}");
    let joined = handling(&store, kept[0].number).await;
    assert!(texts(&joined).contains(&"the first") && texts(&joined).contains(&"the second"), "{joined:?}");
    assert_eq!(joined.closing.is_some(), kept[0].number == 2);
}

#[tokio::test]
async fn an_alarm_that_becomes_more_severe_is_news_once() {
    let (store, _folder) = opened_with_a_webhook().await;
    chart(&store, "b1", 1_000, 4.0).await;
    for grade in [Grade::Moderate, Grade::Moderate, Grade::Severe, Grade::Slight, Grade::Severe] {
        store.alarms().raise_grades(&bridge(), vec![(1, grade)]).await.unwrap();
    }
    assert_eq!(messages(&store).await, ["alarm.opened 1", "alarm.worsened 1"]);
    assert_eq!(episodes(&store).await[0].highest_grade, Some(Grade::Severe));
}

#[tokio::test]
async fn notes_are_listed_by_their_time_and_deleted_one_by_one() {
    let (store, _folder) = opened().await;
    let window = MaintenanceWindow { from: at(1), to: at(2), reason: "bolts".to_owned() };
    store.alarms().insert_maintenance(&bridge(), window, at(0)).await.unwrap();
    let note = |id: &str, from: i64, to: Option<i64>| Note {
        id: id.to_owned(),
        from: at(from),
        to: to.map(at),
        text: format!("note {id}"),
        author: "Ann".to_owned(),
        created_at: at(7),
    };
    for new in [note("a", 10, None), note("b", 30, Some(40)), note("c", 20, None)] {
        assert!(store.notes().insert(&bridge(), new).await.unwrap());
    }
    assert!(!store.notes().insert(&bridge(), note("a", 50, None)).await.unwrap(), "the same id is stored once");
    let ids = |found: Vec<Note>| found.into_iter().map(|n| n.id).collect::<Vec<_>>();
    assert_eq!(ids(store.notes().list(&bridge()).await.unwrap()), ["b", "c", "a"]);
    assert!(store.notes().delete(&bridge(), "c").await.unwrap());
    assert!(!store.notes().delete(&bridge(), "c").await.unwrap());
    assert_eq!(store.notes().list(&bridge()).await.unwrap()[0], note("b", 30, Some(40)));
}
