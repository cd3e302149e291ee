//! Bodies on springs, as a structure file and by an eigenproblem of its own.

use std::f64::consts::TAU;
use std::fmt::Write as _;

use nalgebra::{DMatrix, SymmetricEigen};

/// The prior of each part, as a factor of its nominal stiffness.
const PRIOR: [f64; 2] = [0.6, 1.4];

/// A spring between two bodies, or the ground and a body.
#[derive(Debug, Clone, Copy)]
pub struct Spring {
    pub from: Option<usize>,
    pub to: usize,
    pub n_per_m: f64,
    /// Part of which it is a member.
    pub part: usize,
}

/// Bodies on springs.
#[derive(Debug, Clone)]
pub struct Frame {
    pub id: &'static str,
    pub kg: Vec<f64>,
    pub springs: Vec<Spring>,
    pub parts: usize,
    pub modes: usize,
    pub noise: f64,
}

impl Frame {
    /// Storeys one above the other. `storeys`: mass, stiffness and part of each.
    pub fn chain(id: &'static str, storeys: &[(f64, f64, usize)], modes: usize) -> Self {
        let spring = |(to, (_, n_per_m, part)): (usize, &(f64, f64, usize))| Spring {
            from: to.checked_sub(1),
            to,
            n_per_m: *n_per_m,
            part: *part,
        };
        let springs: Vec<Spring> = storeys.iter().enumerate().map(spring).collect();
        let parts = 1 + springs.iter().map(|own| own.part).max().unwrap();
        Self { id, kg: storeys.iter().map(|own| own.0).collect(), springs, parts, modes, noise: 0.002 }
    }

    /// A body for each mode, which stands on springs of some parts, of 1,000 N/m each.
    pub fn bodies(id: &'static str, bodies: &[(f64, &[usize])], noise: f64) -> Self {
        let mass = |(hz, parts): &(f64, &[usize])| 1_000.0 * parts.len() as f64 / (TAU * hz).powi(2);
        let own = |(to, (_, parts)): (usize, &(f64, &'_ [usize]))| {
            parts.iter().map(move |part| Spring { from: None, to, n_per_m: 1_000.0, part: *part }).collect::<Vec<_>>()
        };
        let springs: Vec<Spring> = bodies.iter().enumerate().flat_map(own).collect();
        let parts = 1 + springs.iter().map(|own| own.part).max().unwrap();
        Self { id, kg: bodies.iter().map(mass).collect(), springs, parts, modes: bodies.len(), noise }
    }

    /// With a further spring between two bodies.
    pub fn braced(mut self, from: usize, to: usize, n_per_m: f64) -> Self {
        self.springs.push(Spring { from: Some(from), to, n_per_m, part: self.parts });
        self.parts += 1;
        self
    }

    pub fn file(&self) -> String {
        let bodies: Vec<String> =
            self.kg.iter().enumerate().map(|(i, kg)| format!("{{ name = \"m{i}\", kg = {kg:?} }}")).collect();
        let (mut springs, mut sets) = (Vec::new(), vec![Vec::new(); self.parts]);
        for (number, own) in self.springs.iter().enumerate() {
            let from = own.from.map_or_else(|| "ground".to_owned(), |body| format!("m{body}"));
            springs.push(format!(
                "{{ name = \"s{number}\", from = \"{from}\", to = \"m{}\", n_per_m = {:?} }}",
                own.to, own.n_per_m
            ));
            sets[own.part].push(format!("{{ spring = \"s{number}\" }}"));
        }
        let [low, high] = PRIOR;
        let mut file = format!(
            "id = \"{}\"\nmodes = {}\nmeasurement_noise = {{ relative = {} }}\nmass = [{}]\nspring = [{}]\nparameter = [\n",
            self.id,
            self.modes,
            self.noise,
            bodies.join(", "),
            springs.join(", ")
        );
        for (part, sets) in sets.iter().enumerate() {
            let sets = sets.join(", ");
            let _ = writeln!(
                file,
                "{{ name = \"p{part}\", scale = true, prior = {{ uniform = [{low}, {high}] }}, sets = [{sets}] }},"
            );
        }
        file + "]\n"
    }

    /// The lowest natural frequencies, Hz, with a factor of the stiffness of each spring.
    pub fn frequencies_hz(&self, factors: &[f64]) -> Vec<f64> {
        let n = self.kg.len();
        let mut matrix = DMatrix::<f64>::zeros(n, n);
        for (own, factor) in self.springs.iter().zip(factors) {
            let k = own.n_per_m * factor;
            matrix[(own.to, own.to)] += k;
            if let Some(from) = own.from {
                matrix[(from, from)] += k;
                matrix[(from, own.to)] -= k;
                matrix[(own.to, from)] -= k;
            }
        }
        let scaled = DMatrix::from_fn(n, n, |i, j| matrix[(i, j)] / (self.kg[i] * self.kg[j]).sqrt());
        let mut hz: Vec<f64> =
            SymmetricEigen::new(scaled).eigenvalues.iter().map(|square| square.max(0.0).sqrt() / TAU).collect();
        hz.sort_by(f64::total_cmp);
        hz.truncate(self.modes);
        hz
    }
}

/// Storeys of 1 kg and 1,000 N/m, each of a part.
fn even(parts: &[usize]) -> Vec<(f64, f64, usize)> {
    parts.iter().map(|part| (1.0, 1_000.0, *part)).collect()
}

/// Five storeys in two parts, the lower two and the upper three.
pub fn five_storeys() -> Frame {
    Frame::chain("five-storeys", &even(&[0, 0, 1, 1, 1]), 5)
}

/// Ten structures of two to eight parts.
pub fn frames() -> Vec<Frame> {
    let tapered = |parts: &[usize]| -> Vec<(f64, f64, usize)> {
        (0..).zip(parts).map(|(i, part)| (1.0 - 0.06 * f64::from(i), 1_000.0 - 90.0 * f64::from(i), *part)).collect()
    };
    vec![
        Frame::chain("three-storeys", &even(&[0, 1, 2]), 3),
        five_storeys(),
        Frame::bodies("bridge-three-parts", &[(4.0, &[0, 1]), (5.2, &[1]), (10.15, &[0, 2]), (10.83, &[2])], 0.008),
        Frame::bodies(
            "bridge-two-parts",
            &[(4.0, &[0]), (6.3, &[0, 1]), (9.6, &[1]), (13.7, &[0, 0, 1]), (15.1, &[0, 1, 1])],
            0.004,
        ),
        Frame::chain("eight-storeys-three-parts", &even(&[0, 0, 1, 1, 1, 2, 2, 2]), 8),
        Frame::chain("ten-storeys-four-parts", &even(&[0, 0, 1, 1, 1, 2, 2, 3, 3, 3]), 6),
        Frame::chain("tower-of-six", &tapered(&[0, 1, 2, 3, 4, 5]), 6),
        Frame::chain("tower-of-ten", &tapered(&[0, 1, 2, 3, 4, 5, 6, 6, 7, 7]), 10),
        Frame::chain("braced", &tapered(&[0, 1, 2, 3]), 4).braced(0, 2, 400.0),
        Frame::chain("four-storeys", &even(&[0, 1, 2, 3]), 4),
    ]
}
