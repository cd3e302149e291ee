//! Structure files made to cost time and answers: work in proportion to the file, an answer of bounded size, and limits that are named.

use std::fmt::Write as _;

use reqwest::Method;
use serde_json::{json, Value};

use crate::helpers::{spawn, Service};

/// Largest answer to a file of mistakes, bytes.
const LARGEST_ANSWER: usize = 64 * 1024;

/// Processor time of the service so far, s.
fn processor_s(service: &Service) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{}/stat", service.pid())).unwrap();
    let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    // Fields 14 and 15 of proc(5), in hundredths of a second.
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
}

/// The answer to a definition that must be refused, and the processor time that it cost, s.
async fn refused(service: &Service, kind: &str, body: String) -> (Value, f64) {
    let before = processor_s(service);
    let put = service.request(Method::PUT, "/v1/structures/bad").header("content-type", kind);
    let answer = put.body(body).send().await.unwrap();
    assert_eq!(answer.status(), 422);
    let text = answer.text().await.unwrap();
    assert!(text.len() <= LARGEST_ANSWER, "an answer of {} bytes: {}…", text.len(), &text[..300]);
    (serde_json::from_str(&text).unwrap(), processor_s(service) - before)
}

/// A file in which every spring has several mistakes.
pub fn mistakes(springs: usize) -> String {
    let mut text = "id = \"bad\"\nmodes = 1\n[[mass]]\nname = \"m\"\nkg = 1\n".to_owned();
    for _ in 0..springs {
        text += "[[spring]]\nname=\"s\"\nfrom=\"x\"\nto=\"y\"\nn_per_m=-1\n";
    }
    text
}

fn mistakes_json(springs: usize) -> String {
    let spring = json!({ "name": "s", "from": "x", "to": "y", "n_per_m": -1 });
    let mass = json!([{ "name": "m", "kg": 1 }]);
    json!({ "id": "bad", "modes": 1, "mass": mass, "spring": vec![spring; springs] }).to_string()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_structure_of_mistakes_costs_time_in_proportion_and_its_answer_is_bounded() {
    let (service, _folder) = spawn();
    for (kind, make) in [
        ("application/toml", mistakes as fn(usize) -> String),
        ("application/json", mistakes_json as fn(usize) -> String),
    ] {
        let mut best = [f64::INFINITY; 2];
        // The least of three: whatever else the process did meanwhile is in the others.
        for _ in 0..3 {
            for (best, springs) in best.iter_mut().zip([5_000, 20_000]) {
                let (answer, took_s) = refused(&service, kind, make(springs)).await;
                *best = best.min(took_s);
                let problems = answer["errors"].as_array().unwrap();
                assert_eq!(problems.len(), 101, "a hundred, and the number of the others");
                let further: usize =
                    problems[100]["message"].as_str().unwrap().split(' ').next().unwrap().parse().unwrap();
                assert!(further + 100 >= 4 * springs - 1, "{}", problems[100]);
            }
        }
        println!("{kind}: {best:?} s for 5,000 and 20,000 springs");
        // Four times the file. In proportion to its square it would be 16 times; 0.1 s are ten steps of the clock.
        assert!(best[1] <= 8.0 * best[0] + 0.1, "{kind}: {best:?} s");
        assert!(best[1] < 3.0, "{kind}: {best:?} s");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_structure_beyond_its_limits_is_refused_before_anything_is_computed() {
    let (service, _folder) = spawn();
    // All of them are valid but for their number.
    let tower = |masses: usize, springs: usize, parameters: usize| {
        let mut text = "id = \"bad\"\nmodes = 1\n".to_owned();
        for i in 0..masses {
            writeln!(text, "[[mass]]\nname=\"m{i}\"\nkg=1").unwrap();
        }
        for i in 0..springs {
            let (from, to) = (i % masses, (i + 1) % masses);
            let from = if i < masses { "ground".to_owned() } else { format!("m{from}") };
            writeln!(text, "[[spring]]\nname=\"s{i}\"\nfrom=\"{from}\"\nto=\"m{to}\"\nn_per_m=1").unwrap();
        }
        for i in 0..parameters {
            writeln!(text, "[[parameter]]\nname=\"p{i}\"\nprior={{uniform=[0.5,1.5]}}\nsets={{spring=\"s{i}\"}}")
                .unwrap();
        }
        text
    };
    for (text, what) in [
        (tower(2_001, 2_001, 1), "2001 [[mass]]: a structure has at most 2000"),
        (tower(100, 20_001, 1), "20001 [[spring]]: a structure has at most 20000"),
        (tower(200, 200, 101), "101 [[parameter]]: a structure has at most 100"),
    ] {
        let (answer, took_s) = refused(&service, "application/toml", text).await;
        assert!(answer["errors"].to_string().contains(what), "{what}: {answer}");
        println!("{what}: {took_s} s");
        assert!(took_s < 2.0, "{what}: {took_s} s");
    }
    let structures = service.read("/v1/structures").await.to_string();
    assert!(!structures.contains("\"bad\""), "{structures}");
}
