//! Whether the stated probabilities hold: of the causes named with a probability of 0.8, four out of five must be right.

use serde_json::Value;

use crate::discrepancy::world::Kind;
use crate::discrepancy::{acts_on_all, confident_wrong_name, judged, list, names, orders, target, Judged};

/// Edges of the classes of stated probability.
const EDGES: [f64; 7] = [0.0, 0.4, 0.6, 0.8, 0.9, 0.99, 1.0];

/// Probability that an answer states for its first cause, together with those that act on all frequencies alike, because data
/// cannot distinguish them.
fn stated(answer: &Value) -> Option<f64> {
    let first = list(answer, "causes").first()?;
    let place = |cause: &Value| {
        let (kind, name) = target(cause);
        acts_on_all(kind, name).then(|| (cause["covariate"].clone(), cause["target"]["level"].clone()))
    };
    let own = first["probability"].as_f64().unwrap();
    let others = list(answer, "alternatives").iter().filter(|other| other["instead_of"] == 1);
    let equivalent = others.filter(|other| place(first).is_some() && place(other) == place(first));
    Some(own + equivalent.map(|other| other["probability"].as_f64().unwrap()).sum::<f64>())
}

/// Whether an answer names one cause with confidence and is wrong about its place.
fn confident_and_wrong(j: &Judged) -> bool {
    let first = || list(&j.answer, "causes").first();
    let right = |cause: &Value| j.world.truths.iter().any(|truth| names(cause, truth));
    j.answer["verdict"] == "cause"
        && match j.kind {
            Kind::Outside => confident_wrong_name(&j.answer, j.world.outside_target.as_ref().unwrap()).is_some(),
            _ => first().is_some_and(|cause| !right(cause)),
        }
}

/// Prints how often causes that were stated with a probability are right, by classes, and returns the expected calibration error.
pub(super) fn calibration_error(named: &[(f64, bool)]) -> f64 {
    println!("stated probability   causes   mean stated   right");
    let mut error = 0.0;
    for edges in EDGES.windows(2) {
        let inside = |p: f64| p > edges[0] && p <= edges[1];
        let class: Vec<&(f64, bool)> = named.iter().filter(|(p, _)| inside(p.min(1.0))).collect();
        if class.is_empty() {
            continue;
        }
        let n = class.len() as f64;
        let mean = class.iter().map(|(p, _)| p.min(1.0)).sum::<f64>() / n;
        let right = class.iter().filter(|(_, right)| *right).count() as f64 / n;
        println!(
            "{:8.2} to {:4.2} {n:13} {mean:13.3} {right:7.3} ± {:.3}",
            edges[0],
            edges[1],
            (right * (1.0 - right) / n).sqrt()
        );
        error += n / named.len() as f64 * (mean - right).abs();
    }
    error
}

#[test]
#[ignore = "20 minutes"]
fn stated_probabilities_hold_in_a_thousand_worlds() {
    let single = orders(100_000, 700, Kind::Single);
    let others = orders(110_000, 100, Kind::Nothing).chain(orders(120_000, 100, Kind::Two)).chain(orders(
        130_000,
        100,
        Kind::Outside,
    ));
    let judged = judged(&single.chain(others).collect::<Vec<_>>());
    let one = |j: &&Judged| j.kind == Kind::Single && ["cause", "ambiguous"].contains(&j.verdict());
    let named: Vec<(f64, bool)> = judged
        .iter()
        .filter(one)
        .filter_map(|j| {
            let first = list(&j.answer, "causes").first()?;
            Some((stated(&j.answer)?, names(first, &j.world.truths[0])))
        })
        .collect();
    let error = calibration_error(&named);
    let wrong: Vec<&Judged> = judged.iter().filter(|j| confident_and_wrong(j)).collect();
    for j in &wrong {
        println!("CONFIDENT AND WRONG {}", j.text());
    }
    println!(
        "expected calibration error {error:.3} over {} causes; confident and wrong {} of {}",
        named.len(),
        wrong.len(),
        judged.len()
    );
    assert!(error <= 0.05, "expected calibration error {error}");
    assert!(100 * wrong.len() <= judged.len(), "{} confident and wrong", wrong.len());
}
