//! Diagnoses and extensions as one list of jobs.

use std::collections::BTreeSet;

use modalwatch::quantity::{Digest, StructureId};
use modalwatch::store::{DiagnosisTrigger, JobEnd, JobKind, JobState, LatestDiagnoses, NewDiagnosis, NewTraining};

use super::{at, bridge, open};

#[tokio::test]
async fn jobs_are_listed_newest_first_and_extensions_have_a_time_of_their_own() {
    let (store, _folder) = open().await;
    let digest = Digest::of(&[b"v1"]);
    for (id, time) in [("d1", 10), ("d2", 20), ("d3", 30)] {
        let automatic = id == "d2";
        let new = NewDiagnosis {
            id: id.to_owned(),
            structure: bridge(),
            structure_digest: digest.clone(),
            request: "{}".to_owned(),
            trigger: if automatic { DiagnosisTrigger::RejectedEpisode } else { DiagnosisTrigger::Requested },
            alarm: automatic.then_some(3),
        };
        store.diagnoses().insert_diagnosis(new, at(time)).await.unwrap();
    }
    let found = r#"{"verdict": "temperature", "summary": "k2 softens with temperature_c"}"#.to_owned();
    store.diagnoses().finish_diagnosis("d1", JobEnd::Done((found, None)), at(15)).await.unwrap();
    store.diagnoses().finish_diagnosis("d2", JobEnd::Failed("no data".to_owned()), at(25)).await.unwrap();
    assert!(store.diagnoses().begin_extension("d1", "{}".to_owned(), at(40)).await.unwrap());
    let jobs = store.diagnoses().jobs(None, 100).await.unwrap();
    let of = |kind: JobKind, id: &str| jobs.iter().find(|job| job.kind == kind && job.id == id).unwrap().clone();
    let order: Vec<(&str, JobKind)> = jobs.iter().map(|job| (job.id.as_str(), job.kind)).collect();
    let (diagnosis, extension) = (JobKind::Diagnosis, JobKind::Extension);
    assert_eq!(order, [("d1", extension), ("d3", diagnosis), ("d2", diagnosis), ("d1", diagnosis)]);
    let running = of(extension, "d1");
    assert_eq!((running.state, running.created_at, running.finished_at), (JobState::Running, at(40), None));
    let done = of(diagnosis, "d1");
    assert_eq!((done.verdict.as_deref(), done.finished_at), (Some("temperature"), Some(at(15))));
    assert_eq!(done.summary.as_deref(), Some("k2 softens with temperature_c"));
    let failed = of(diagnosis, "d2");
    assert_eq!(jobs.iter().map(|job| job.trigger).collect::<Vec<_>>(), {
        let requested = Some(DiagnosisTrigger::Requested);
        [None, requested, Some(DiagnosisTrigger::RejectedEpisode), requested]
    });
    let latest = async |until| store.diagnoses().latest(&bridge(), at(until)).await.unwrap();
    let started = LatestDiagnoses { any: Some(at(30)), automatic: Some(at(20)) };
    assert_eq!(latest(31).await, started);
    // A start in the future was noted while the clock was wrong.
    assert_eq!(latest(20).await, LatestDiagnoses { any: Some(at(10)), automatic: None });
    assert_eq!((failed.state, failed.failure.as_deref(), failed.summary), (JobState::Failed, Some("no data"), None));

    let added = r#"{"added": ["k2 by temperature_c", "k1 by wind"], "left_out": []}"#.to_owned();
    store.diagnoses().finish_extension("d1", JobEnd::Done(added), at(50)).await.unwrap();
    let newest = store.diagnoses().jobs(None, 2).await.unwrap().remove(0);
    assert_eq!((newest.kind, newest.state, newest.finished_at), (extension, JobState::Done, Some(at(50))));
    assert_eq!(newest.summary.as_deref(), Some("k2 by temperature_c; k1 by wind"));
    // However many newer ones have ended, one that has not is listed.
    let listed = async |structures: Option<&BTreeSet<StructureId>>, limit| {
        let jobs = store.diagnoses().jobs(structures, limit).await.unwrap();
        jobs.into_iter().map(|job| (job.id, job.kind)).collect::<Vec<_>>()
    };
    assert_eq!(listed(None, 1).await, [("d3".to_owned(), diagnosis)]);
    // The limit is one for the structures that are asked for.
    let tower = StructureId::parse("tower").unwrap();
    store.structures().put_structure(&tower, "{}", &digest, at(1)).await.unwrap();
    let new = NewTraining {
        id: "t1".to_owned(),
        structure: tower.clone(),
        structure_digest: digest,
        request: "{}".to_owned(),
    };
    store.trainings().insert(new, at(5)).await.unwrap();
    let both = BTreeSet::from([tower.clone(), bridge()]);
    assert_eq!(listed(Some(&BTreeSet::from([tower])), 1).await, [("t1".to_owned(), JobKind::Training)]);
    assert_eq!(listed(Some(&both), 100).await.len(), 5);
    assert_eq!(listed(Some(&BTreeSet::new()), 100).await, []);
}

#[tokio::test]
async fn after_a_stop_jobs_begin_again_unless_the_program_keeps_ending_during_them() {
    let (store, _folder) = open().await;
    let digest = Digest::of(&[b"v1"]);
    for id in ["d1", "d2"] {
        let (structure, request) = (bridge(), "{}".to_owned());
        let (trigger, id) = (DiagnosisTrigger::Requested, id.to_owned());
        let new = NewDiagnosis { id, structure, structure_digest: digest.clone(), request, trigger, alarm: None };
        store.diagnoses().insert_diagnosis(new, at(10)).await.unwrap();
    }
    let end = JobEnd::Done(("{}".to_owned(), None));
    store.diagnoses().finish_diagnosis("d1", end, at(20)).await.unwrap();
    assert!(store.diagnoses().begin_extension("d1", "the request".to_owned(), at(30)).await.unwrap());
    let training =
        NewTraining { id: "t1".to_owned(), structure: bridge(), structure_digest: digest, request: "{}".to_owned() };
    store.trainings().insert(training, at(40)).await.unwrap();
    let stop = async || store.diagnoses().end_interrupted_jobs(at(70)).await.unwrap();
    let begin = async || {
        for (id, kind) in [("d2", JobKind::Diagnosis), ("d1", JobKind::Extension), ("t1", JobKind::Training)] {
            store.diagnoses().note_begun(id, kind).await.unwrap();
        }
    };
    let unfinished = async || store.trainings().unfinished().await.unwrap().len();

    for _ in 0..5 {
        // Jobs that only wait are not the reason why the program ends.
        assert_eq!((stop().await.failed, unfinished().await), (0, 1));
    }
    begin().await;
    let first = stop().await;
    assert_eq!((first.failed, unfinished().await), (0, 1));
    assert_eq!(first.diagnoses, ["d2"]);
    assert_eq!(first.extensions, [("d1".to_owned(), "the request".to_owned())]);
    for _ in 0..5 {
        // Orderly stops are no reason to give up.
        begin().await;
        store.diagnoses().note_orderly_stop().await.unwrap();
        assert_eq!((stop().await.failed, unfinished().await), (0, 1));
    }
    for _ in 0..2 {
        begin().await;
        assert_eq!(stop().await.failed, 0);
    }
    begin().await;
    let last = stop().await;
    assert_eq!((last.failed, last.diagnoses.len(), last.extensions.len(), unfinished().await), (3, 0, 0, 0));
    let jobs = store.diagnoses().jobs(None, 100).await.unwrap();
    for job in jobs.iter().filter(|job| job.id != "d1" || job.kind == JobKind::Extension) {
        assert_eq!((job.state, job.finished_at), (JobState::Failed, Some(at(70))), "{job:?}");
    }
    assert!(store.diagnoses().begin_extension("d1", "{}".to_owned(), at(80)).await.unwrap());
    store.diagnoses().finish_extension("d1", JobEnd::Cancelled, at(90)).await.unwrap();
    let cancelled = store.diagnoses().jobs(None, 1).await.unwrap().remove(0);
    assert_eq!((cancelled.kind, cancelled.state, cancelled.failure), (JobKind::Extension, JobState::Cancelled, None));
    assert_eq!(store.diagnoses().structure_of_job("t1").await.unwrap().as_deref(), Some("bridge"));
}
