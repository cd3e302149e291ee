//! An undamaged reference that grows with batches accepted as healthy, and does not take a slow loss for healthy.

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use serde_json::{json, Value};

use crate::helpers::{created, measurements, problem, spawn, time, Service};

const REFERENCE: &str = "/v1/structures/three-dof/reference";
const EXTEND: &str = "/v1/structures/three-dof/reference/extend";
const DAY_S: usize = 86_400;

/// Days of the first reference, and the day on which the loss begins.
const FIRST: usize = 40;
const ONSET: usize = 60;

/// Loss of the second stiffness in a day.
const LOSS_A_DAY: f64 = 0.001_5;

fn share_lost(day: usize) -> f64 {
    LOSS_A_DAY * day.saturating_sub(ONSET) as f64
}

/// A structure under weather that nobody measures, 3 % of each stiffness with a correlation of 0.8 from day to day.
struct World {
    stream: ChaCha8Rng,
    weather: f64,
    day: usize,
}

impl World {
    /// The batch of the next day.
    async fn post_day(&mut self, service: &Service) -> String {
        let mut normal = || self.stream.sample::<f64, _>(StandardNormal);
        self.weather = 0.8 * self.weather + 0.6 * normal();
        let own = [0; 3].map(|_| 1.0 + 0.003 * normal());
        let usual = 1.0 + 0.03 * self.weather;
        let k = [4.0 * own[0] * usual, 5.0 * own[1] * usual * (1.0 - share_lost(self.day)), 6.0 * own[2] * usual];
        let answer = service.post_batch("three-dof", &measurements(k, 12, self.day * DAY_S)).await;
        self.day += 1;
        answer["batch"].as_str().unwrap().to_owned()
    }
}

/// All batches from one day on, before another.
fn period(from: usize, to: usize) -> Value {
    json!({ "from": time(from * DAY_S), "to": time(to * DAY_S) })
}

#[tokio::test]
async fn a_reference_grows_with_healthy_batches_and_not_with_a_slow_loss() {
    let (service, _folder) = spawn();
    let mut world = World { stream: ChaCha8Rng::seed_from_u64(5), weather: 0.0, day: 0 };
    let nothing = problem(service.post(EXTEND, &period(0, 5)).await, 422, "unusable_baseline").await;
    assert!(nothing["detail"].as_str().unwrap().contains("declare one first"), "{nothing}");

    let mut ids = Vec::new();
    for _ in 0..FIRST {
        ids.push(world.post_day(&service).await);
    }
    let body = json!({ "from": time(0), "to": time(FIRST * DAY_S), "reason": "first weeks after the opening" });
    let first = created(service.post(REFERENCE, &body).await).await;
    assert_eq!((&first["version"], &first["extends"]), (&json!(1), &Value::Null), "{first}");
    assert_eq!(first["process"]["coverage"]["months"], json!([1, 2]), "{first}");
    let known = problem(service.post(EXTEND, &json!({ "batches": [ids[3]] })).await, 422, "unusable_baseline").await;
    assert!(known["detail"].as_str().unwrap().contains("already part of it"), "{known}");

    // Healthy weeks are added.
    for _ in FIRST..ONSET {
        world.post_day(&service).await;
    }
    let second = created(service.post(EXTEND, &period(FIRST, ONSET)).await).await;
    assert_eq!((&second["version"], &second["extends"]), (&json!(2), &json!(1)), "{second}");
    assert_eq!(second["process"]["coverage"]["months"], json!([1, 2, 3]));
    assert_eq!(second["batches"].as_array().unwrap().len(), ONSET, "{second}");

    // A loss of 4.5 % a month is not: it is refused before it has reached 6 %.
    let refusal = loop {
        let begin = world.day;
        assert!(share_lost(begin) < 0.06, "a loss of {} became part of the reference", share_lost(begin));
        for _ in 0..10 {
            world.post_day(&service).await;
        }
        let answer = service.post(EXTEND, &period(begin, world.day)).await;
        if answer.status() != 201 {
            break answer;
        }
    };
    println!("refused after a loss of {:.1} %", 100.0 * share_lost(world.day));
    let versions = service.read("/v1/structures/three-dof/references").await;
    let status = refusal.status();
    let refusal: Value = refusal.json().await.unwrap();
    let detail = refusal["detail"].as_str().unwrap();
    println!("{status}: {detail}");
    assert!(detail.contains("k2") || detail.contains("alarm"), "{refusal}");
    assert_eq!(versions["items"].as_array().unwrap().last().unwrap()["reason"], "first weeks after the opening");

    // A person who inspected the structure decides, and says why.
    let mut despite = period(ONSET, world.day);
    despite["despite_alarms"] = json!(true);
    let without = problem(service.post(EXTEND, &despite).await, 422, "invalid").await;
    assert!(without.to_string().contains("/reason"), "{without}");
    despite["reason"] = json!("inspection of 12 April: the bearing was cleaned, no damage");
    let accepted = created(service.post(EXTEND, &despite).await).await;
    assert_eq!(accepted["reason"], despite["reason"], "{accepted}");
    let versions = service.read("/v1/structures/three-dof/references").await;
    assert_eq!(versions["items"][0]["version"], accepted["version"], "{versions}");
    assert_eq!(versions["items"][0]["batch_count"], world.day, "{versions}");
}
