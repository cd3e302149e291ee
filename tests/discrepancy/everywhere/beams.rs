//! Continuous beams on supports that do not give way in the file, by finite elements of a sixth of half a span.

use std::fmt::Write as _;

use nalgebra::DMatrix;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::measurements::{factor, head, Modes};
use super::{label, of_kinds, World};

/// Elements of half a span.
const ELEMENTS: usize = 6;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Wrong {
    /// The supports at both ends hold the rotation.
    Restraint,
    /// All supports give way.
    SoftSupports,
    /// A force along the beam.
    AxialForce,
    /// EI of every third of half a span is off by a factor of its own.
    ScatteredStiffness,
    /// The mass of every third of half a span is off by a factor of its own.
    ScatteredMass,
    StiffnessGradient,
    MassGradient,
    /// The cross-sections resist rotation.
    RotaryInertia,
    /// One half of a span is less or more stiff than its group.
    OneStiffness(usize),
    /// One half of a span is lighter or heavier.
    OneMass(usize),
}

impl Wrong {
    /// The kind of target that is true, of those that are in no single part.
    fn family(self) -> Option<&'static str> {
        match self {
            Self::Restraint => Some("end_restraint"),
            Self::AxialForce => Some("axial_force"),
            Self::StiffnessGradient => Some("stiffness_gradient"),
            Self::MassGradient => Some("mass_gradient"),
            Self::RotaryInertia => Some("rotary_inertia"),
            _ => None,
        }
    }
}

const KINDS: [Wrong; 10] = [
    Wrong::Restraint,
    Wrong::SoftSupports,
    Wrong::AxialForce,
    Wrong::ScatteredStiffness,
    Wrong::ScatteredMass,
    Wrong::StiffnessGradient,
    Wrong::MassGradient,
    Wrong::RotaryInertia,
    Wrong::OneStiffness(0),
    Wrong::OneMass(0),
];

/// Two or three spans, each of two halves, with one factor for the first span and one for the others.
struct Beam {
    spans_m: Vec<f64>,
    ei_n_m2: Vec<f64>,
    kg_per_m: Vec<f64>,
    modes: usize,
    noise: f64,
}

impl Beam {
    fn draw(stream: &mut ChaCha8Rng) -> Self {
        let spans = stream.random_range(2..=3);
        let mut each = |low: f64, high: f64| (0..spans).map(|_| stream.random_range(low..high).round()).collect();
        let (spans_m, ei_n_m2, kg_per_m) = (each(18.0, 36.0), each(1.5e10, 3.5e10), each(7e3, 1.1e4));
        let modes = stream.random_range(4..=6);
        Self { spans_m, ei_n_m2, kg_per_m, modes, noise: stream.random_range(0.0005..0.002) }
    }

    fn toml(&self) -> String {
        let mut text = head("beam", self.modes, self.noise, &[]) + "simulation = \"beam\"\n";
        let mut x_m = 0.0;
        text += "[[node]]\nname = \"s0\"\nx_m = 0.0\nsupport = \"pinned\"\n";
        for (span, length_m) in self.spans_m.iter().enumerate() {
            let _ = writeln!(text, "[[node]]\nname = \"middle{span}\"\nx_m = {:?}", x_m + 0.5 * length_m);
            x_m += length_m;
            let _ = writeln!(text, "[[node]]\nname = \"s{}\"\nx_m = {x_m:?}\nsupport = \"pinned\"", span + 1);
        }
        for (span, (ei, kg)) in self.ei_n_m2.iter().zip(&self.kg_per_m).enumerate() {
            let ends = [
                (2 * span, format!("s{span}"), format!("middle{span}")),
                (2 * span + 1, format!("middle{span}"), format!("s{}", span + 1)),
            ];
            for (half, from, to) in ends {
                let _ = writeln!(
                    text,
                    "[[beam]]\nname = \"b{half}\"\nfrom = \"{from}\"\nto = \"{to}\"\nbending_stiffness_n_m2 = {ei:?}\nmass_kg_per_m = {kg:?}\nelements = 6"
                );
            }
        }
        for (name, halves) in [("first", 0..2), ("others", 2..2 * self.spans_m.len())] {
            text += &factor(name, halves.map(|half| format!("{{ beam = \"b{half}\" }}")));
        }
        text
    }

    /// Modes of the beam with an error of this size; `each`: further numbers of the error.
    fn modes(&self, (wrong, size, each): (Wrong, f64, &[f64]), factors: [f64; 2]) -> Modes {
        let total_m: f64 = self.spans_m.iter().sum();
        let nodes = 2 * ELEMENTS * self.spans_m.len() + 1;
        let mut k = DMatrix::zeros(2 * nodes, 2 * nodes);
        let mut m = DMatrix::zeros(2 * nodes, 2 * nodes);
        let (mut left_m, mut supports) = (0.0, vec![0]);
        let reference_ei = self.ei_n_m2[0];
        let force_n = if wrong == Wrong::AxialForce {
            size * std::f64::consts::PI.powi(2) * reference_ei / self.spans_m[0].powi(2)
        } else {
            0.0
        };
        for element in 0..nodes - 1 {
            let half = element / ELEMENTS;
            let span = half / 2;
            let l = self.spans_m[span] / (2 * ELEMENTS) as f64;
            let place = (left_m + 0.5 * l) / total_m - 0.5;
            let third = each[element / (ELEMENTS / 3) % each.len()];
            let ei = self.ei_n_m2[span]
                * factors[usize::from(span > 0)]
                * match wrong {
                    Wrong::ScatteredStiffness => (size * third).exp(),
                    Wrong::StiffnessGradient => (size * place).exp(),
                    Wrong::OneStiffness(at) if at == half => 1.0 + size,
                    _ => 1.0,
                };
            let kg_per_m = self.kg_per_m[span]
                * match wrong {
                    Wrong::ScatteredMass => (size * third).exp(),
                    Wrong::MassGradient => (size * place).exp(),
                    Wrong::OneMass(at) if at == half => 1.0 + size,
                    _ => 1.0,
                };
            // Square of the radius of gyration of the cross-section, m².
            let gyration = if wrong == Wrong::RotaryInertia { (size * self.spans_m[0]).powi(2) } else { 0.0 };
            // Integrals over the element of products of the shape functions, by Gauss's four points.
            for (at, weight) in [
                (-0.861_136_311_594_053, 0.347_854_845_137_454),
                (-0.339_981_043_584_856, 0.652_145_154_862_546),
                (0.339_981_043_584_856, 0.652_145_154_862_546),
                (0.861_136_311_594_053, 0.347_854_845_137_454),
            ] {
                let s = 0.5 * (1.0 + at);
                let w = [
                    1.0 - 3.0 * s * s + 2.0 * s * s * s,
                    l * (s - 2.0 * s * s + s * s * s),
                    3.0 * s * s - 2.0 * s * s * s,
                    l * (s * s * s - s * s),
                ];
                let slope =
                    [6.0 * (s * s - s) / l, 1.0 - 4.0 * s + 3.0 * s * s, 6.0 * (s - s * s) / l, 3.0 * s * s - 2.0 * s];
                let bend =
                    [(12.0 * s - 6.0) / (l * l), (6.0 * s - 4.0) / l, (6.0 - 12.0 * s) / (l * l), (6.0 * s - 2.0) / l];
                for i in 0..4 {
                    for j in 0..4 {
                        let entry = (2 * element + i, 2 * element + j);
                        let volume = 0.5 * weight * l;
                        k[entry] += volume * (ei * bend[i] * bend[j] + force_n * slope[i] * slope[j]);
                        m[entry] += volume * kg_per_m * (w[i] * w[j] + gyration * slope[i] * slope[j]);
                    }
                }
            }
            left_m += l;
            if (element + 1) % (2 * ELEMENTS) == 0 {
                supports.push(element + 1);
            }
        }
        if wrong == Wrong::Restraint {
            for (place, node) in [0, nodes - 1].into_iter().enumerate() {
                let span = if place == 0 { 0 } else { self.spans_m.len() - 1 };
                k[(2 * node + 1, 2 * node + 1)] += size * self.ei_n_m2[span] / self.spans_m[span];
            }
        }
        let mut kept: Vec<usize> = (0..2 * nodes).collect();
        if wrong == Wrong::SoftSupports {
            for node in &supports {
                k[(2 * node, 2 * node)] += reference_ei / self.spans_m[0].powi(3) / size;
            }
        } else {
            kept.retain(|dof| dof % 2 == 1 || !supports.contains(&(dof / 2)));
        }
        let inner = |matrix: &DMatrix<f64>| matrix.select_rows(&kept).select_columns(&kept);
        let mut modes = Modes::new(&inner(&k), &inner(&m), self.modes);
        modes.shapes = DMatrix::zeros(0, self.modes);
        modes
    }
}

/// A bridge for worlds of its own.
pub(super) struct Bridge(Beam);

impl Bridge {
    pub(super) fn draw(stream: &mut ChaCha8Rng) -> Self {
        Self(Beam::draw(stream))
    }

    pub(super) fn noise(&self) -> f64 {
        self.0.noise
    }

    pub(super) fn toml(&self) -> String {
        self.0.toml()
    }

    /// Its modes with end bearings that hold the rotation by this share of EI/L of their spans.
    pub(super) fn held(&self, share: f64, factors: [f64; 2]) -> Modes {
        self.0.modes((Wrong::Restraint, share, &[0.0]), factors)
    }
}

fn world(seed: u64, kind: Wrong) -> World {
    let mut stream = ChaCha8Rng::seed_from_u64(seed);
    let beam = Beam::draw(&mut stream);
    let half = stream.random_range(0..2 * beam.spans_m.len());
    let wrong = match kind {
        Wrong::OneStiffness(_) => Wrong::OneStiffness(half),
        Wrong::OneMass(_) => Wrong::OneMass(half),
        other => other,
    };
    let sign = if stream.random_bool(0.5) { 1.0 } else { -1.0 };
    let size = match wrong {
        // As a share of EI/L.
        Wrong::Restraint => stream.random_range(0.2..1.5),
        // EI/L³, as a share of the stiffness of a support.
        Wrong::SoftSupports => stream.random_range(0.0004..0.003),
        Wrong::AxialForce => sign * stream.random_range(0.02..0.1),
        Wrong::ScatteredStiffness | Wrong::ScatteredMass => stream.random_range(0.05..0.15),
        Wrong::StiffnessGradient | Wrong::MassGradient => sign * stream.random_range(0.15..0.4),
        // Radius of gyration, as a share of the first span.
        Wrong::RotaryInertia => stream.random_range(0.02..0.04),
        Wrong::OneStiffness(_) => sign * stream.random_range(0.1..0.3),
        Wrong::OneMass(_) => sign * stream.random_range(0.08..0.2),
    };
    let each: Vec<f64> = (0..18).map(|_| stream.sample::<f64, _>(rand_distr::StandardNormal)).collect();
    let modes = |factors: [f64; 2]| beam.modes((wrong, size, &each), factors);
    let right = |factors: [f64; 2]| beam.modes((Wrong::ScatteredStiffness, 0.0, &each), factors);
    let text = format!("beam of {} spans, {wrong:?} {size:.4}, {} modes", beam.spans_m.len(), beam.modes);
    let about = (label(&wrong) + " of a beam", text, beam.toml());
    let world = World::complete((seed, &mut stream), about, beam.noise, &modes, &right);
    let (one_place, right) = match wrong {
        Wrong::OneStiffness(half) => (true, vec![("beam", Some(format!("b{half}")))]),
        Wrong::OneMass(half) => (true, vec![("mass", Some(format!("b{half}")))]),
        other => (false, other.family().map(|family| (family, None)).into_iter().collect()),
    };
    World { one_place, right, ..world }
}

/// `each` beams of each kind.
pub(super) fn worlds(first_seed: u64, each: u64) -> Vec<World> {
    of_kinds(&KINDS, first_seed, each, world)
}
