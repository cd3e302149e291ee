//! Effects against structures that have them built in, their derivatives against finite differences, and their mistakes in
//! a structure file.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::Matrix3;

use modalwatch::measurement::CovariateValue;
use modalwatch::physics::deviation::{Deviation, DeviationKind};
use modalwatch::physics::effect::{respond, Direction, Target};
use modalwatch::physics::shapes::shapes_at;
use modalwatch::physics::tangent::TangentSpace;
use modalwatch::physics::tracked::{respond_tracked, ReferenceMode};
use modalwatch::physics::{modes, natural_frequencies_hz, Form, Mass, Node, Spring, Structure};
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;

const SIZES: [f64; 4] = [0.07, -0.11, 0.03, 0.2];

/// Each target once, for a structure of at least three masses.
fn targets(structure: &Structure) -> Vec<(Target, Vec<f64>)> {
    let all = (0..structure.springs().len()).collect();
    vec![
        (Target::Springs(vec![1]), vec![SIZES[0]]),
        (Target::Springs(all), vec![SIZES[1]]),
        (Target::Masses(vec![0]), vec![SIZES[0]]),
        (Target::Masses(vec![0, 1, 2]), vec![SIZES[1]]),
        (Target::FrequencyScale(None), vec![SIZES[2]]),
        (Target::FrequencyScale(Some(1)), vec![SIZES[2]]),
        (Target::FrequencyOffset(None), vec![SIZES[2]]),
        (Target::FrequencyOffset(Some(0)), vec![-SIZES[2]]),
        (Target::AddedSpring(Node::Dof(0), Node::Dof(2)), vec![SIZES[3]]),
        (Target::AddedSpring(Node::Ground, Node::Dof(1)), vec![SIZES[3]]),
        (Target::Oscillator(1), vec![0.05, 0.2]),
        (Target::Everywhere(directions()), vec![SIZES[2], -SIZES[0], SIZES[1]]),
        (chain(structure, DeviationKind::Bending), vec![SIZES[3]]),
        (chain(structure, DeviationKind::BaseRotation), vec![SIZES[0]]),
        (chain(structure, DeviationKind::SpreadMass), vec![SIZES[3]]),
        (chain(structure, DeviationKind::StiffnessGradient), vec![-SIZES[3]]),
        (chain(structure, DeviationKind::MassGradient), vec![SIZES[1]]),
    ]
}

fn chain(structure: &Structure, kind: DeviationKind) -> Target {
    Target::Deviation(Arc::new(Deviation::new(structure, kind).unwrap()))
}

/// Change of ln f of each mode along the last of [`directions`], beside what springs and masses change.
const BY_MODE: [f64; 3] = [0.3, -0.1, 0.2];

/// Three directions in which all springs and masses of three change; the last one leaves the masses as they are and moves the modes.
fn directions() -> Vec<Direction> {
    let direction = |springs: &[f64], masses: &[f64], frequencies: &[f64]| Direction {
        springs: springs.to_vec(),
        masses: masses.to_vec(),
        frequencies: frequencies.to_vec(),
    };
    vec![
        direction(&[1.0, -0.5, 0.3], &[0.2, 0.0, -0.4], &[]),
        direction(&[0.1, 0.8, 0.6], &[-1.0, 0.5, 0.5], &[]),
        direction(&[0.7, 0.0, -1.2], &[], &BY_MODE),
    ]
}

fn structure() -> Structure {
    let mass = |i: usize, kg: f64| Mass::at(format!("m{i}"), i, kg);
    let spring = |i: usize, from, to, n_per_m| Spring::between(format!("k{i}"), from, to, n_per_m);
    let masses = vec![mass(0, 0.7), mass(1, 0.5), mass(2, 0.3)];
    let springs = vec![
        spring(0, Node::Ground, Node::Dof(0), 4.0),
        spring(1, Node::Dof(0), Node::Dof(1), 5.0),
        spring(2, Node::Dof(1), Node::Dof(2), 6.0),
    ];
    Structure::new(masses, springs).unwrap()
}

fn close(a: &[f64], b: &[f64]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a / b - 1.0).abs() < 1e-10)
}

#[test]
fn an_effect_is_the_structure_with_it_built_in() {
    let base = structure();
    let built = |change: &dyn Fn(&mut Vec<Mass>, &mut Vec<Spring>)| {
        let (mut masses, mut springs) = (base.masses().to_vec(), base.springs().to_vec());
        change(&mut masses, &mut springs);
        let count = 3;
        natural_frequencies_hz(&Structure::new(masses, springs).unwrap(), count).unwrap()
    };
    let under = |target: Target, sizes: &[f64]| respond(&base, 3, &[target], sizes).unwrap().frequencies_hz;
    assert!(close(&under(Target::Springs(vec![1]), &[0.1]), &built(&|_, s| s[1].n_per_m *= 1.1)));
    assert!(close(
        &under(Target::Masses(vec![0, 2]), &[-0.1]),
        &built(&|m, _| {
            m[0].kg *= 0.9;
            m[2].kg *= 0.9;
        })
    ));
    let tie = |from, to, n_per_m| Spring::between("new", from, to, n_per_m);
    assert!(close(
        &under(Target::AddedSpring(Node::Dof(0), Node::Dof(2)), &[1.5]),
        &built(&|_, s| s.push(tie(Node::Dof(0), Node::Dof(2), 1.5)))
    ));
    let (kg, hz) = (0.02, 0.4);
    assert!(close(
        &under(Target::Oscillator(1), &[kg, hz]),
        &built(&|m, s| {
            m.push(Mass::at("body", 3, kg));
            s.push(tie(Node::Dof(1), Node::Dof(3), (std::f64::consts::TAU * hz).powi(2) * kg));
        })
    ));
    let parts = built(&|m, s| {
        s.iter_mut().zip([0.1 - 0.14, -0.05, 0.03 + 0.24]).for_each(|(s, log)| s.n_per_m *= f64::exp(log));
        m.iter_mut().zip([0.02, 0.0, -0.04]).for_each(|(m, log)| m.kg *= f64::exp(log));
    });
    let moved: Vec<f64> = parts.iter().zip(BY_MODE).map(|(hz, by)| hz * f64::exp(-0.2 * by)).collect();
    assert!(close(&under(Target::Everywhere(directions()), &[0.1, 0.0, -0.2]), &moved));
    let plain = natural_frequencies_hz(&base, 3).unwrap();
    let scaled: Vec<f64> = plain.iter().map(|f| f * 1.01).collect();
    assert!(close(&under(Target::FrequencyScale(None), &[0.01]), &scaled));
    // Scaling all springs by 1 + g is equivalent to scaling all masses by 1/(1 + g).
    let all = Target::Springs(vec![0, 1, 2]);
    assert!(close(&under(all, &[0.2]), &under(Target::Masses(vec![0, 1, 2]), &[1.0 / 1.2 - 1.0])));
    // A mode that was not identified.
    let order = respond(&base, 2, &[Target::ModeOrder(vec![0, 2])], &[]).unwrap().frequencies_hz;
    assert!(close(&order, &[plain[0], plain[2]]));
}

/// Frequencies of three bodies from their flexibility and their mass matrix, Hz, ascending.
fn by_flexibility_hz(flexibility: Matrix3<f64>, mass: Matrix3<f64>) -> Vec<f64> {
    let root = mass.cholesky().unwrap().l();
    let periods = (root.transpose() * flexibility * root).symmetric_eigenvalues();
    let mut hz: Vec<f64> = periods.iter().map(|square| 1.0 / (std::f64::consts::TAU * square.sqrt())).collect();
    hz.sort_by(f64::total_cmp);
    hz
}

#[test]
fn a_deviation_of_a_chain_is_that_of_its_flexibility_or_mass_in_closed_form() {
    let base = structure();
    let under = |kind, size| respond(&base, 3, &[chain(&base, kind)], &[size]).unwrap().frequencies_hz;
    let springs =
        |n_per_m: [f64; 3]| Matrix3::from_fn(|a, b| n_per_m.iter().take(a.min(b) + 1).map(|k| 1.0 / k).sum::<f64>());
    let (flexibility, kg) = (springs([4.0, 5.0, 6.0]), [0.7, 0.5, 0.3]);
    let mass = Matrix3::from_diagonal(&kg.into());
    let roof = 1.0 / 4.0 + 1.0 / 5.0 + 1.0 / 6.0;
    let heights = |place: usize| (place + 1) as f64 / 3.0;
    let rotated = Matrix3::from_fn(|a, b| 0.4 * roof * heights(a) * heights(b));
    assert!(close(&under(DeviationKind::BaseRotation, 0.4), &by_flexibility_hz(flexibility + rotated, mass)));
    // Deflection of a cantilever of length 1 at one height under a force at another, as a share of that of its end.
    let bent = Matrix3::from_fn(|a, b| {
        let (low, high) = (heights(a.min(b)), heights(a.max(b)));
        0.4 * roof * low * low * (3.0 * high - low) / 2.0
    });
    assert!(close(&under(DeviationKind::Bending, 0.4), &by_flexibility_hz(flexibility + bent, mass)));
    // Kinetic energy of a rod whose ends move with a and b: m (a² + a b + b²)/6.
    let mut spread = mass * 0.6;
    for (body, kg) in kg.iter().enumerate() {
        let rod = 0.4 * kg / 3.0;
        spread[(body, body)] += rod;
        if body > 0 {
            spread[(body - 1, body - 1)] += rod;
            spread[(body, body - 1)] += 0.5 * rod;
            spread[(body - 1, body)] += 0.5 * rod;
        }
    }
    assert!(close(&under(DeviationKind::SpreadMass, 0.4), &by_flexibility_hz(flexibility, spread)));
    let factors = [(-0.2_f64).exp(), 1.0, 0.2_f64.exp()];
    let softer = springs([4.0 * factors[0], 5.0, 6.0 * factors[2]]);
    assert!(close(&under(DeviationKind::StiffnessGradient, 0.4), &by_flexibility_hz(softer, mass)));
    let heavier = Matrix3::from_diagonal(&[0.7 * factors[0], 0.5, 0.3 * factors[2]].into());
    assert!(close(&under(DeviationKind::MassGradient, 0.4), &by_flexibility_hz(flexibility, heavier)));
    // With floors at 3, 7 and 9 m.
    let heights = [3.0 / 9.0, 7.0 / 9.0, 1.0];
    let placed = base.clone().with_positions(vec![3.0, 7.0, 9.0]);
    let placed = |kind| respond(&placed, 3, &[chain(&placed, kind)], &[0.4]).unwrap().frequencies_hz;
    let uneven = Matrix3::from_fn(|a, b| 0.4 * roof * heights[a] * heights[b]);
    assert!(close(&placed(DeviationKind::BaseRotation), &by_flexibility_hz(flexibility + uneven, mass)));
    let uneven = Matrix3::from_fn(|a, b| {
        let (low, high) = (heights[a.min(b)], heights[a.max(b)]);
        0.4 * roof * low * low * (3.0 * high - low) / 2.0
    });
    assert!(close(&placed(DeviationKind::Bending), &by_flexibility_hz(flexibility + uneven, mass)));
    // Flexibilities add in any order, and a negative one takes away what there is.
    let both = |first, second| {
        respond(&base, 3, &[chain(&base, first), chain(&base, second)], &[0.4, 0.4]).unwrap().frequencies_hz
    };
    let together = by_flexibility_hz(flexibility + rotated + bent, mass);
    assert!(close(&both(DeviationKind::Bending, DeviationKind::BaseRotation), &together));
    assert!(close(&both(DeviationKind::BaseRotation, DeviationKind::Bending), &together));
    let less = by_flexibility_hz(flexibility - rotated * 0.05, mass);
    assert!(close(&under(DeviationKind::BaseRotation, -0.02), &less));
    assert!(respond(&base, 3, &[chain(&base, DeviationKind::BaseRotation)], &[-2.0]).is_err());
}

#[test]
fn only_a_row_of_bodies_that_stands_on_the_ground_is_a_chain() {
    let base = structure();
    let (masses, springs) = (base.masses().to_vec(), base.springs().to_vec());
    let with = |spring: Spring| {
        let springs = springs.iter().cloned().chain([spring]).collect();
        Structure::new(masses.clone(), springs).unwrap()
    };
    let is_chain = |structure: &Structure| Deviation::new(structure, DeviationKind::Bending).is_some();
    assert!(is_chain(&base));
    assert!(is_chain(&with(Spring::between("beside", Node::Dof(1), Node::Dof(0), 1.0))));
    assert!(!is_chain(&with(Spring::between("held", Node::Dof(2), Node::Ground, 1.0))));
    assert!(!is_chain(&base.clone().with_positions(vec![3.0, 2.0, 9.0])));
    assert!(!is_chain(&with(Spring::between("over", Node::Dof(2), Node::Dof(0), 1.0))));
    // The order of bodies in the file does not matter.
    let swapped = |dof: usize| [2, 0, 1][dof];
    let body = |(dof, mass): (usize, &Mass)| Mass::at(mass.name.clone(), swapped(dof), mass.kg);
    let mut moved: Vec<(usize, Mass)> = masses.iter().enumerate().map(|one| (swapped(one.0), body(one))).collect();
    moved.sort_by_key(|(dof, _)| *dof);
    let node = |node: &Node| match node {
        Node::Ground => Node::Ground,
        Node::Dof(dof) => Node::Dof(swapped(*dof)),
    };
    let spring = |s: &Spring| match &s.form {
        Form::Spring(a, b) => Spring::between(s.name.clone(), node(b), node(a), s.n_per_m),
        _ => unreachable!("all are springs"),
    };
    let other = Structure::new(moved.into_iter().map(|(_, mass)| mass).collect(), springs.iter().map(spring).collect())
        .unwrap();
    for kind in DeviationKind::OF_A_STRUCTURE.into_iter().filter(|kind| Deviation::new(&base, *kind).is_some()) {
        let hz =
            |structure: &Structure| respond(structure, 3, &[chain(structure, kind)], &[0.3]).unwrap().frequencies_hz;
        assert!(close(&hz(&base), &hz(&other)), "{kind:?}");
    }
}

#[test]
fn slopes_of_effects_are_central_differences_alone_and_together() {
    let base = structure();
    let each = targets(&base);
    let mut sets: Vec<Vec<(Target, Vec<f64>)>> = each.iter().cloned().map(|one| vec![one]).collect();
    sets.push(each);
    for set in sets {
        let targets: Vec<Target> = set.iter().map(|t| t.0.clone()).collect();
        let sizes: Vec<f64> = set.iter().flat_map(|t| t.1.clone()).collect();
        let at = |sizes: &[f64]| respond(&base, 3, &targets, sizes).unwrap();
        let here = at(&sizes);
        for column in 0..sizes.len() {
            let moved = |h: f64| {
                let mut sizes = sizes.clone();
                sizes[column] += h;
                at(&sizes).frequencies_hz
            };
            let (up, down) = (moved(1e-6), moved(-1e-6));
            for mode in 0..3 {
                let difference = (up[mode] - down[mode]) / 2e-6;
                let slope = here.by_size[(mode, column)];
                assert!((slope - difference).abs() < 1e-8 * (1.0 + slope.abs()), "{targets:?}: {slope} {difference}");
            }
        }
        for spring in 0..3 {
            let moved = |h: f64| {
                let stiffer = base.with_stiffness(&[(spring, base.springs()[spring].n_per_m + h)]).unwrap();
                respond(&stiffer, 3, &targets, &sizes).unwrap().frequencies_hz
            };
            let (up, down) = (moved(1e-6), moved(-1e-6));
            for mode in 0..3 {
                let difference = (up[mode] - down[mode]) / 2e-6;
                assert!((here.by_spring[(mode, spring)] - difference).abs() < 1e-8, "{targets:?}, spring {spring}");
            }
        }
    }
}

const FILE: &str = r#"
id = "small"
modes = 2
mass = [{ name = "m1", kg = 1.0 }, { name = "m2", kg = 2.0 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 10.0 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 20.0 },
]
parameter = [{ name = "k1", prior = { uniform = [5.0, 15.0] }, sets = { spring = "k1" } }]
covariate = [{ name = "temperature_c" }, { name = "operator", kind = "category" }]

[[effect]]
name = "warm"
target = { springs = ["k2"] }
law = "linear"
covariate = "temperature_c"
reference = 10.0
numbers = { slope_per_unit = -0.01 }
covariance = [[1e-8]]
seen = [-10.0, 10.0, 30.0]
"#;

fn covariates(celsius: f64) -> BTreeMap<String, CovariateValue> {
    BTreeMap::from([("temperature_c".to_owned(), CovariateValue::Number(celsius))])
}

#[test]
fn an_effect_of_a_file_acts_by_the_measurements_covariate() {
    let simulator = Simulator::new(StructureDefinition::parse_toml(FILE).unwrap()).unwrap();
    let sizes = |celsius: f64| simulator.effect_sizes(&covariates(celsius));
    assert!((sizes(20.0).values[0] + 0.1).abs() < 1e-12);
    let softer = simulator.structure().unwrap().with_stiffness(&[(1, 18.0)]).unwrap();
    let warm = simulator.under(&sizes(20.0).values).frequencies_hz(&[10.0]).unwrap();
    assert!(close(&warm, &natural_frequencies_hz(&softer, 2).unwrap()));
    // The value 9999 of a faulty sensor is clamped to a tenth beyond the range of the effect, and reported.
    let broken = sizes(9999.0);
    assert_eq!(broken.beyond, ["temperature_c"]);
    assert!((broken.values[0] + 0.24).abs() < 1e-12);
    // Without the covariate: the mean size, and the sizes at all values that the effect was learnt from.
    let blind = simulator.effect_sizes(&BTreeMap::new());
    assert_eq!(blind.missing, ["temperature_c"]);
    assert!(blind.values[0].abs() < 1e-12);
    assert_eq!(simulator.marginalised_sizes(&BTreeMap::new()).len(), 3);
    // The definition survives the round trip through JSON.
    let again = StructureDefinition::parse_json(&simulator.definition().canonical_json()).unwrap();
    assert_eq!(again.digest(), *simulator.digest());
}

#[test]
fn each_mistake_of_an_effect_is_named_with_its_place() {
    let cases = [
        ("springs = [\"k2\"]", "springs = [\"k9\"]", "/effect/0/target", "no spring \"k9\""),
        ("springs = [\"k2\"]", "masses = []", "/effect/0/target", "at least one"),
        ("springs = [\"k2\"]", "frequency_scale = 3", "/effect/0/target", "2 modes"),
        ("springs = [\"k2\"]", "added_spring = [\"m1\", \"m1\"]", "/effect/0/target", "to itself"),
        ("name = \"m2\", kg", "name = \"m2\", at_m = 3.0, kg", "/mass/0/at_m", "for all masses or for none"),
        ("springs = [\"k2\"]", "mode_order = [1, 1]", "/effect/0/target", "2 different modes"),
        ("covariate = \"temperature_c\"\n", "covariate = \"wind\"\n", "/effect/0/covariate", "no [[covariate]]"),
        ("covariate = \"temperature_c\"\n", "covariate = \"operator\"\n", "/effect/0/covariate", "of kind number"),
        ("covariate = \"temperature_c\"\n", "", "/effect/0/covariate", "needs a covariate"),
        ("law = \"linear\"", "law = \"lagged\"", "/effect/0/law", "history"),
        ("law = \"linear\"", "law = \"constant\"", "/effect/0/covariate", "no covariate"),
        ("{ slope_per_unit = -0.01 }", "{ slope = -0.01 }", "/effect/0/numbers", "slope_per_unit"),
        ("{ slope_per_unit = -0.01 }", "{ slope_per_unit = nan }", "/effect/0/numbers", "finite"),
        ("[[1e-8]]", "[[-1e-8]]", "/effect/0/covariance", "positive"),
        ("[[1e-8]]", "[[1e-8, 0.0]]", "/effect/0/covariance", "1 rows of 1"),
        ("seen = [-10.0, 10.0, 30.0]", "seen = [10.0]", "/effect/0/seen", "at least two"),
        ("seen = [-10.0, 10.0, 30.0]", "", "/effect/0/seen", "at least two"),
    ];
    for (right, wrong, pointer, message) in cases {
        let error = StructureDefinition::parse_toml(&FILE.replace(right, wrong)).unwrap_err();
        let problem = &error.problems[0];
        assert!(problem.pointer == pointer && problem.message.contains(message), "{wrong}: {error}");
    }
}

/// The modes of a structure as the modes that others are paired with, with their shapes at some points.
fn reference(structure: &Structure, points: &[usize]) -> Vec<ReferenceMode> {
    let all = modes(structure, structure.dofs()).unwrap();
    let shapes = shapes_at(&all, points);
    let mode = |(shape, frequency_hz): (_, &f64)| {
        let shape: nalgebra::DVectorView<'_, f64> = shape;
        ReferenceMode { frequency_hz: *frequency_hz, shape: TangentSpace::new(shape.as_slice()) }
    };
    shapes.column_iter().zip(&all.frequencies_hz).map(mode).collect()
}

#[test]
fn shapes_under_effects_are_those_of_the_structure_with_them_built_in() {
    let (base, points) = (structure(), [0, 2]);
    let known = reference(&base, &points);
    let (mut masses, mut springs) = (base.masses().to_vec(), base.springs().to_vec());
    masses[1].kg *= 1.3;
    springs.push(Spring::between("new", Node::Dof(0), Node::Dof(2), 0.4));
    let built = Structure::new(masses, springs).unwrap();
    let targets = [Target::Masses(vec![1]), Target::AddedSpring(Node::Dof(0), Node::Dof(2))];
    let (response, shapes) = respond_tracked(&base, &targets, &[0.3, 0.4], &points, &known).unwrap();
    let expected = modes(&built, 3).unwrap();
    assert!(close(&response.frequencies_hz, &expected.frequencies_hz));
    for (mode, shape) in shapes_at(&expected, &points).column_iter().enumerate() {
        let own = known[mode].shape.as_ref().unwrap().coordinates(&[shape[0], shape[1]]).unwrap();
        // With two points the coordinate is the angle between the shapes, and it is not 0.
        assert!(own[0].abs() > 1e-3 && (own[0] - shapes.coordinates[mode]).abs() < 1e-12, "mode {mode}");
    }
}

#[test]
fn derivatives_of_shapes_equal_finite_differences() {
    let base = structure();
    for points in [vec![0, 2], vec![0, 1, 2]] {
        let known = reference(&base, &points);
        for (target, sizes) in targets(&base) {
            let targets = [Target::Springs(vec![2]), target.clone()];
            let sizes: Vec<f64> = [0.1].into_iter().chain(sizes).collect();
            let at = |structure: &Structure, sizes: &[f64]| {
                let shapes = respond_tracked(structure, &targets, sizes, &points, &known).unwrap().1;
                nalgebra::DVector::from_vec(shapes.coordinates)
            };
            let shapes = respond_tracked(&base, &targets, &sizes, &points, &known).unwrap().1;
            let step = 1e-6;
            for which in 0..sizes.len() {
                let moved = |by: f64| {
                    let mut sizes = sizes.clone();
                    sizes[which] += by;
                    at(&base, &sizes)
                };
                let difference = (moved(step) - moved(-step)) / (2.0 * step);
                assert!((difference - shapes.by_size.column(which)).amax() < 1e-7, "{target:?}, size {which}");
            }
            for spring in 0..base.springs().len() {
                let moved = |by: f64| {
                    let mut springs = base.springs().to_vec();
                    springs[spring].n_per_m += by;
                    at(&Structure::new(base.masses().to_vec(), springs).unwrap(), &sizes)
                };
                let difference = (moved(step) - moved(-step)) / (2.0 * step);
                assert!((difference - shapes.by_spring.column(spring)).amax() < 1e-7, "{target:?}, spring {spring}");
            }
        }
    }
}

/// Two bodies, each on a spring, with a weak link: their frequencies change places where the springs become equal.
#[test]
fn a_mode_keeps_its_place_where_two_modes_cross() {
    let masses = vec![Mass::at("m0", 0, 1.0), Mass::at("m1", 1, 1.0)];
    let springs = vec![
        Spring::between("k0", Node::Ground, Node::Dof(0), 4.0),
        Spring::between("k1", Node::Ground, Node::Dof(1), 5.0),
        Spring::between("link", Node::Dof(0), Node::Dof(1), 1e-4),
    ];
    let base = Structure::new(masses, springs).unwrap();
    let known = reference(&base, &[0, 1]);
    let own_hz = natural_frequencies_hz(&base, 2).unwrap();
    let softer = respond_tracked(&base, &[Target::Springs(vec![1])], &[-0.3], &[0, 1], &known).unwrap().0;
    assert!((softer.frequencies_hz[0] / own_hz[0] - 1.0).abs() < 1e-4, "the first body is not touched");
    assert!((softer.frequencies_hz[1] / own_hz[1] - 0.7_f64.sqrt()).abs() < 1e-4);
    assert!(softer.frequencies_hz[1] < softer.frequencies_hz[0], "the order has changed");
    // The second mode alone depends on the second spring.
    assert!(softer.by_spring[(0, 1)].abs() < 1e-6 && softer.by_spring[(1, 1)] > 1e-3);
}
