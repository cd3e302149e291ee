//! Two stiffnesses that the modes cannot distinguish: damage is reported for both together, and for neither alone.

use modalwatch::assessment::{self, Context};
use modalwatch::baseline::observation::DEFAULT_NOISE_RANGE;
use modalwatch::baseline::train::train;
use modalwatch::damage::QuantityKind;
use modalwatch::flow::train::TrainSettings;
use modalwatch::flow::FlowSettings;
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use modalwatch::trust::FindingCode;

use super::population::{batch, undamaged, DRAWS};
use super::shipped;

/// Two equal masses between walls: the frequencies do not change when the left and the right spring are exchanged.
const SYMMETRIC: &str = r#"
id = "symmetric"
modes = 2
measurement_noise = { relative = 0.002 }
mass = [{ name = "m1", kg = 1.0 }, { name = "m2", kg = 1.0 }]
spring = [
    { name = "left", from = "ground", to = "m1", n_per_m = 100.0 },
    { name = "middle", from = "m1", to = "m2", n_per_m = 50.0 },
    { name = "right", from = "m2", to = "ground", n_per_m = 100.0 },
]
parameter = [
    { name = "left", prior = { uniform = [60.0, 140.0] }, sets = { spring = "left" } },
    { name = "right", prior = { uniform = [60.0, 140.0] }, sets = { spring = "right" } },
]
"#;

#[test]
fn damage_of_one_of_two_is_reported_for_the_group_and_for_neither_alone() {
    let simulator = Simulator::new(StructureDefinition::parse_toml(SYMMETRIC).unwrap()).unwrap();
    let settings = TrainSettings { epochs: 12, ..TrainSettings::default() };
    let trained = train(&simulator, 8_000, DEFAULT_NOISE_RANGE, &FlowSettings::default(), &settings, |_| {}).unwrap();
    let baseline = &trained.baseline;
    let record = &baseline.manifest().identifiability;
    println!("{record:#?}");
    assert_eq!(record.groups, [["left".to_owned(), "right".to_owned()]]);
    for p in &record.parameters {
        // The local information describes one of two separate points, the posterior covers both.
        assert!(p.posterior_std > 1.5 * p.fisher_std, "{p:?}");
    }
    let state = undamaged(baseline, &batch(baseline, &[(100.0, 1.5), (100.0, 1.5)], 40, 1.0, 1));
    let damaged = batch(baseline, &[(85.0, 1.5), (100.0, 1.5)], 20, 1.0, 2);
    let context = Context { undamaged: Some(&state), earlier: None };
    let assessment = assessment::assess(baseline, &damaged, context, DRAWS, damaged[0].measured_at).unwrap();
    assert!(assessment.trust.findings.iter().any(|f| f.code == FindingCode::NotIdentifiable), "{:?}", assessment.trust);
    for q in &assessment.quantities {
        match q.kind {
            QuantityKind::Group => {
                let damage = q.damage.as_ref().unwrap();
                println!(
                    "{}: PoD {:.2}, change {:.1} %",
                    q.name,
                    damage.probability_of_damage,
                    100.0 * damage.relative_change
                );
                assert!(damage.probability_of_damage > 0.5, "{q:?}");
                // Half of 15 % of one of two.
                assert!((damage.relative_change + 0.075).abs() < 0.03, "{q:?}");
            }
            _ => assert!(q.damage.is_none() && q.group.as_deref() == Some("group:left+right"), "{q:?}"),
        }
    }
}

#[test]
fn the_parameters_of_the_shipped_structures_can_be_distinguished() {
    for id in ["three-dof", "rig"] {
        let baseline = shipped(id);
        assert_eq!(baseline.groups(), []);
        for p in &baseline.manifest().identifiability.parameters {
            assert!(p.variance_left < 0.05, "{id}: {p:?}");
        }
    }
}
