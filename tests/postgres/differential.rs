//! The same random history in a SQLite file and on a PostgreSQL server gives the same answers, field by field.

use std::collections::BTreeMap;
use std::time::Duration;

use reqwest::Method;
use serde_json::{json, Value};

use crate::helpers::{command, measurements, time, within, Service};
use crate::postgres::database::url_of;
use crate::postgres::server::Server;
use crate::postgres::world::{answer, answers, pending, serve};

const STRUCTURE: &str = "/v1/structures/three-dof";

/// A small generator (splitmix64), so that a seed gives the same history everywhere.
struct Dice(u64);

impl Dice {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }
}

/// An answer without what no two services have in common: ids are numbered in the order in which they appear, times of the present day,
/// ids of requests and the moving limit of the retention are left out.
struct Plain {
    today: String,
    ids: BTreeMap<String, usize>,
}

impl Plain {
    fn new() -> Self {
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap();
        // The measurements are months older.
        let today = modalwatch::quantity::Timestamp::from_micros(now.as_micros() as i64).unwrap().to_string();
        Self { today: today[..8].to_owned(), ids: BTreeMap::new() }
    }

    fn value(&mut self, value: &Value) -> Value {
        match value {
            Value::Object(members) => {
                let kept =
                    members.iter().filter(|(name, _)| !matches!(name.as_str(), "request_id" | "secret" | "before"));
                Value::Object(kept.map(|(name, value)| (self.text(name), self.value(value))).collect())
            }
            Value::Array(items) => Value::Array(items.iter().map(|item| self.value(item)).collect()),
            Value::String(text) => Value::String(self.text(text)),
            other => other.clone(),
        }
    }

    fn text(&mut self, text: &str) -> String {
        let mut plain = String::new();
        let mut rest = text;
        while let Some(first) = rest.chars().next() {
            if let Some(id) = rest.get(..36).filter(|id| is_uuid(id)) {
                let next = self.ids.len();
                let number = *self.ids.entry(id.to_owned()).or_insert(next);
                plain.extend(["id-", &number.to_string()]);
                rest = &rest[36..];
            } else if rest.starts_with(&self.today) {
                plain += "today";
                rest = rest.find('Z').map_or("", |end| &rest[end + 1..]);
            } else {
                plain.push(first);
                rest = &rest[first.len_utf8()..];
            }
        }
        plain
    }
}

fn is_uuid(text: &str) -> bool {
    text.bytes().enumerate().all(|(i, byte)| match i {
        8 | 13 | 18 | 23 => byte == b'-',
        _ => byte.is_ascii_hexdigit(),
    })
}

/// Two services, with what is known of both.
struct Pair {
    services: [Service; 2],
    plain: [Plain; 2],
    requests: usize,
}

impl Pair {
    /// Sends the same request to both, whose answers must be the same. `ids`: index of a batch in the history, put in place of `{batch}`.
    async fn both(&mut self, method: Method, path: &str, body: Option<&Value>) -> Value {
        let mut plain = Vec::new();
        for (service, names) in self.services.iter().zip(&mut self.plain) {
            let found = answer(service, method.clone(), path, body).await;
            plain.push(names.value(&found));
        }
        self.requests += 1;
        assert_eq!(plain[0], plain[1], "{method} {path} {body:?}");
        plain.swap_remove(0)
    }

    /// Waits until both have assessed everything.
    async fn settle(&self) {
        for service in &self.services {
            within(Duration::from_mins(2), "all batches are assessed", async || {
                (pending(service).await == 0.0).then_some(())
            })
            .await;
        }
    }

    /// Compares all that can be read.
    async fn compare(&mut self) {
        self.settle().await;
        let mut plain = Vec::new();
        for (service, names) in self.services.iter().zip(&mut self.plain) {
            let found = answers(service, "three-dof").await;
            plain.push(found.iter().map(|(path, answer)| (names.text(path), names.value(answer))).collect::<Vec<_>>());
        }
        let (second, first) = (plain.pop().unwrap(), plain.pop().unwrap());
        assert_eq!(first.len(), second.len());
        for (first, second) in first.iter().zip(&second) {
            assert_eq!(first, second);
            self.requests += 1;
        }
    }
}

/// A batch: where it is in time, what it measures, and its key.
fn batch(dice: &mut Dice, position: usize, damaged: bool) -> Value {
    let spread = |dice: &mut Dice| 1.0 + 0.01 * (dice.below(100) as f64 / 50.0 - 1.0);
    let mut k = [4.0 * spread(dice), 5.0 * spread(dice), 6.0 * spread(dice)];
    if damaged {
        k[1] *= 0.8;
    }
    let mut rows = measurements(k, 2 + dice.below(11), position * 21_600);
    match dice.below(12) {
        // A mode was not identified.
        0 => rows[0]["frequencies_hz"][1] = Value::Null,
        // Two modes in the wrong order, in all rows: the batch is rejected.
        1 => rows.iter_mut().for_each(|row| row["frequencies_hz"].as_array_mut().unwrap().swap(0, 1)),
        _ => {}
    }
    let source = ["gateway", "logger-2"][dice.below(2)];
    let mut body = json!({ "measurements": rows, "source": source });
    if dice.below(3) == 0 {
        body["idempotency_key"] = json!(format!("key-{position}"));
    }
    body
}

/// One step of a history.
async fn step(pair: &mut Pair, dice: &mut Dice, posted: &mut Vec<Value>, damaged: bool) {
    let batches = format!("{STRUCTURE}/batches");
    match dice.below(20) {
        // The same again, with other content under the same key or times, and one between earlier ones.
        0 if !posted.is_empty() => {
            let body = posted[dice.below(posted.len())].clone();
            pair.both(Method::POST, &batches, Some(&body)).await;
        }
        1 if !posted.is_empty() => {
            let mut body = posted[dice.below(posted.len())].clone();
            body["measurements"][0]["frequencies_hz"][0] = json!(0.4321);
            pair.both(Method::POST, &batches, Some(&body)).await;
        }
        2 => {
            let from = dice.below(posted.len() + 1) * 43_200;
            let body = json!({ "from": time(from), "to": time(from + 40 * 3_600), "reason": "load test" });
            pair.both(Method::POST, &format!("{STRUCTURE}/maintenance"), Some(&body)).await;
        }
        3 => {
            let body = json!({ "at": time(dice.below(100) * 3_600), "text": "bearing greased\nand \"cleaned\"", "author": "Ann" });
            pair.both(Method::POST, &format!("{STRUCTURE}/notes"), Some(&body)).await;
        }
        4 if posted.len() > 4 => {
            let to = time((1 + dice.below(posted.len())) * 43_200);
            let body =
                json!({ "from": time(0), "to": to, "leave_out_doubtful": true, "reason": "after the inspection" });
            pair.both(Method::POST, &format!("{STRUCTURE}/reference"), Some(&body)).await;
            pair.settle().await;
        }
        5 => {
            for (method, path, body) in [
                (Method::POST, "comments", json!({ "text": "a crack?", "author": "Ben" })),
                (Method::PUT, "assignee", json!({ "assignee": "Ann", "author": "Ben" })),
                (Method::POST, "acknowledgement", json!({ "by": "Ben", "note": "seen" })),
                (Method::POST, "closing", json!({ "reason": "repaired", "text": "new bearing", "author": "Ann" })),
            ] {
                let path = format!("{STRUCTURE}/alarms/{}/{path}", 1 + dice.below(3));
                pair.both(method, &path, Some(&body)).await;
            }
        }
        6 => {
            pair.both(Method::GET, &format!("{STRUCTURE}/history?limit=3"), None).await;
            pair.both(Method::GET, "/v1/overview", None).await;
        }
        _ => {
            // Sometimes one comes late, between earlier ones.
            let late = dice.below(6) == 0;
            let position = if late { 2 * dice.below(posted.len() + 1) + 1 } else { 2 * posted.len() };
            let body = batch(dice, position, damaged);
            pair.both(Method::POST, &batches, Some(&body)).await;
            posted.push(body);
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_same_history_gives_the_same_answers_from_both() {
    if !Server::is_installed() {
        return;
    }
    for seed in 1..=2 {
        let (file, folder) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let url = format!("{}", url_of(folder.path()).await);
        let plain = || [Plain::new(), Plain::new()];
        let services = [Service::start(file.path()), Service::spawn(&mut serve(folder.path(), &url))];
        let mut pair = Pair { services, plain: plain(), requests: 0 };
        let hook = json!({ "url": "https://hooks.example/alarms", "events": ["alarm.opened"], "structures": ["three-dof"], "enabled": false });
        pair.both(Method::POST, "/v1/webhooks", Some(&hook)).await;
        let (mut dice, mut posted) = (Dice(seed), Vec::new());
        for number in 0..70 {
            step(&mut pair, &mut dice, &mut posted, number > 45).await;
        }
        pair.compare().await;
        let history = &answers(&pair.services[1], "three-dof").await[&format!("{STRUCTURE}/history?limit=1000")];
        let assessed = history["body"]["items"].as_array().unwrap().len();
        assert!(assessed > 20, "only {assessed} batches");

        // The old batches go, and both have started again.
        let Pair { services: [one, other], requests, .. } = pair;
        drop((one, other));
        let retention = ("MODALWATCH__RETENTION__MEASUREMENTS_DAYS", "300");
        let services = [
            Service::spawn(command(file.path()).env(retention.0, retention.1)),
            Service::spawn(serve(folder.path(), &url).env(retention.0, retention.1)),
        ];
        for service in &services {
            within(Duration::from_mins(1), "the retention", async || {
                let text = service.get("/metrics").send().await.unwrap().text().await.unwrap();
                text.lines()
                    .any(|line| line.starts_with("modalwatch_retention_deleted_batches_total") && !line.ends_with(" 0"))
                    .then_some(())
            })
            .await;
        }
        let mut pair = Pair { services, plain: plain(), requests };
        pair.compare().await;
        println!("seed {seed}: {} pairs of answers are the same", pair.requests);
    }
}
