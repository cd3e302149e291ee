//! Metrics of the structures in the text format of Prometheus: state, newest values and charts.
//!
//! They are written at each request and not kept in the recorder, so that a structure or state that is gone leaves no old value behind.

use std::fmt::Write as _;

use super::verdict::Condition;
use crate::monitor::stored::{LatestPoint, LatestQuantity};
use crate::quantity::{StructureId, Timestamp};

/// What the metrics say about a structure as a whole.
pub(super) struct StructureState {
    pub structure: StructureId,
    pub condition: Condition,
    pub batches: u64,
    pub waiting_batches: u64,
    pub open_alarms: u64,
    pub last_measured_at: Option<Timestamp>,
}

/// A metric: labels in braces, and the value.
type Samples = Vec<(String, f64)>;

/// The metrics of the structures.
pub(super) fn text(states: &[StructureState], quantities: &[LatestQuantity], points: &[LatestPoint]) -> String {
    let mut text = String::new();
    let of_state = |value: &dyn Fn(&StructureState) -> Option<f64>| -> Samples {
        let sample = |s: &StructureState| Some((labels(&[("structure", s.structure.as_str())]), value(s)?));
        states.iter().filter_map(sample).collect()
    };
    let condition =
        |s: &StructureState| (labels(&[("structure", s.structure.as_str()), ("state", s.condition.as_str())]), 1.0);
    write(
        &mut text,
        "structure_state",
        "State of the structure in the label; always 1.",
        &states.iter().map(condition).collect(),
    );
    write(&mut text, "structure_batches", "Stored batches.", &of_state(&|s| Some(s.batches as f64)));
    write(
        &mut text,
        "structure_waiting_batches",
        "Batches that wait for their assessment.",
        &of_state(&|s| Some(s.waiting_batches as f64)),
    );
    write(&mut text, "structure_open_alarms", "Open alarms.", &of_state(&|s| Some(s.open_alarms as f64)));
    write(
        &mut text,
        "structure_last_measured_timestamp_seconds",
        "Time of the latest measurement.",
        &of_state(&|s| s.last_measured_at.map(|at| at.micros() as f64 / 1e6)),
    );
    let of_quantity = |value: &dyn Fn(&LatestQuantity) -> Option<f64>| -> Samples {
        let sample = |q: &LatestQuantity| {
            let labels = labels(&[("structure", &q.structure_id), ("parameter", &q.quantity), ("unit", &q.unit)]);
            Some((labels, value(q)?))
        };
        quantities.iter().filter_map(sample).collect()
    };
    for (name, meaning, samples) in [
        ("parameter_mean", "Mean of the parameter in the latest assessed batch.", of_quantity(&|q| Some(q.mean))),
        ("parameter_std", "Standard deviation of the parameter in that batch.", of_quantity(&|q| q.std)),
        ("parameter_probability_of_damage", "Probability of damage.", of_quantity(&|q| q.probability_of_damage)),
        (
            "parameter_relative_change",
            "Relative difference from the mean in the undamaged reference.",
            of_quantity(&|q| q.relative_change),
        ),
    ] {
        write(&mut text, name, meaning, &samples);
    }
    let of_point = |value: &dyn Fn(&LatestPoint) -> Option<f64>| -> Samples {
        let sample =
            |p: &LatestPoint| Some((labels(&[("structure", &p.structure_id), ("chart", &p.series)]), value(p)?));
        points.iter().filter_map(sample).collect()
    };
    for (name, meaning, samples) in [
        (
            "chart_shift",
            "Shift towards damage of the latest batch, or evidence of the fast chart.",
            of_point(&|p| Some(p.shift)),
        ),
        ("chart_shift_limit", "Limit of the shift.", of_point(&|p| Some(p.shift_limit))),
        ("chart_average", "Moving average of the shifts, or evidence of the slow chart.", of_point(&|p| Some(p.ewma))),
        ("chart_average_limit", "Limit of the moving average.", of_point(&|p| p.ewma_limit)),
    ] {
        write(&mut text, name, meaning, &samples);
    }
    text
}

/// A metric with its description, if it has samples. Values that are not finite are left out.
fn write(text: &mut String, name: &str, meaning: &str, samples: &Samples) {
    let finite: Vec<&(String, f64)> = samples.iter().filter(|(_, value)| value.is_finite()).collect();
    if finite.is_empty() {
        return;
    }
    let _ = writeln!(text, "# HELP modalwatch_{name} {meaning}\n# TYPE modalwatch_{name} gauge");
    for (labels, value) in finite {
        let _ = writeln!(text, "modalwatch_{name}{labels} {value}");
    }
    text.push('\n');
}

/// Labels with their values in the syntax of the format.
fn labels(pairs: &[(&str, &str)]) -> String {
    let escaped = |value: &str| value.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n");
    let parts: Vec<String> = pairs.iter().map(|(name, value)| format!("{name}=\"{}\"", escaped(value))).collect();
    format!("{{{}}}", parts.join(","))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_is_a_sample_with_its_labels_and_what_is_missing_is_left_out() {
        let state = StructureState {
            structure: StructureId::parse("bridge").unwrap(),
            condition: Condition::NotJudged,
            batches: 7,
            waiting_batches: 2,
            open_alarms: 1,
            last_measured_at: None,
        };
        let quantity = LatestQuantity {
            structure_id: "bridge".to_owned(),
            quantity: "a \"b\"\\".to_owned(),
            unit: "N/m".to_owned(),
            mean: 4.5e6,
            std: None,
            probability_of_damage: Some(f64::NAN),
            relative_change: Some(-0.08),
        };
        let text = text(&[state], &[quantity], &[]);
        assert!(text.contains("modalwatch_structure_state{structure=\"bridge\",state=\"not_judged\"} 1\n"), "{text}");
        assert!(text.contains("modalwatch_structure_batches{structure=\"bridge\"} 7\n"), "{text}");
        let labels = "{structure=\"bridge\",parameter=\"a \\\"b\\\"\\\\\",unit=\"N/m\"}";
        assert!(text.contains(&format!("modalwatch_parameter_mean{labels} 4500000\n")), "{text}");
        assert!(text.contains(&format!("modalwatch_parameter_relative_change{labels} -0.08\n")), "{text}");
        for absent in ["last_measured", "parameter_std", "probability_of_damage", "chart_"] {
            assert!(!text.contains(absent), "{absent}: {text}");
        }
        let described = text.lines().filter(|line| line.starts_with("# TYPE")).count();
        assert_eq!(described, 6, "{text}");
    }
}
