//! Two rows of bodies on the ground that are joined at each floor, such as two frames of a hall: no chain.

use std::fmt::Write as _;

use nalgebra::{DMatrix, DVector};
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::measurements::{factor, head, Modes};
use super::{label, of_kinds, World};

#[derive(Debug, Clone, Copy, PartialEq)]
enum Wrong {
    ScatteredStiffness,
    ScatteredMass,
    /// Braces from each floor of one row to the floor above of the other, which the file leaves out.
    Braces,
    /// The stiffness of both rows falls or rises with the height.
    Gradient,
    /// All joints between the rows are off by one factor.
    Joints,
    /// The foundation of both rows gives way.
    SoftGround,
    OneSpring(usize),
    OneMass(usize),
}

const KINDS: [Wrong; 8] = [
    Wrong::ScatteredStiffness,
    Wrong::ScatteredMass,
    Wrong::Braces,
    Wrong::Gradient,
    Wrong::Joints,
    Wrong::SoftGround,
    Wrong::OneSpring(0),
    Wrong::OneMass(0),
];

/// Bodies floor by floor, the left one first; springs likewise, then the joints. One factor for each row.
struct Frame {
    floors: usize,
    kg: Vec<f64>,
    n_per_m: Vec<f64>,
    modes: usize,
    noise: f64,
}

impl Frame {
    fn draw(stream: &mut ChaCha8Rng) -> Self {
        let floors = stream.random_range(3..=4);
        let kg = (0..2 * floors).map(|_| stream.random_range(0.8e5..1.4e5_f64).round()).collect();
        let mut n_per_m: Vec<f64> = (0..2 * floors).map(|_| stream.random_range(0.9e8..1.6e8_f64).round()).collect();
        n_per_m.extend((0..floors).map(|_| stream.random_range(0.2e8..0.5e8_f64).round()));
        Self { floors, kg, n_per_m, modes: stream.random_range(4..=6), noise: stream.random_range(0.0005..0.002) }
    }

    /// Ends of a spring; `None` is the ground.
    fn ends(&self, spring: usize) -> (Option<usize>, usize) {
        if spring < 2 * self.floors {
            (spring.checked_sub(2), spring)
        } else {
            let floor = spring - 2 * self.floors;
            (Some(2 * floor), 2 * floor + 1)
        }
    }

    fn toml(&self) -> String {
        let mut text = head("frame", self.modes, self.noise, &[]);
        for (body, kg) in self.kg.iter().enumerate() {
            let _ = writeln!(text, "[[mass]]\nname = \"m{body}\"\nkg = {kg:?}");
        }
        for (spring, n_per_m) in self.n_per_m.iter().enumerate() {
            let (from, to) = self.ends(spring);
            let from = from.map_or("ground".to_owned(), |body| format!("m{body}"));
            let _ = writeln!(
                text,
                "[[spring]]\nname = \"k{spring}\"\nfrom = \"{from}\"\nto = \"m{to}\"\nn_per_m = {n_per_m:?}"
            );
        }
        for (row, name) in ["left", "right"].into_iter().enumerate() {
            text += &factor(name, (0..self.floors).map(|floor| format!("{{ spring = \"k{}\" }}", 2 * floor + row)));
        }
        text
    }

    fn modes(&self, (wrong, size, each): (Wrong, f64, &[f64]), factors: [f64; 2]) -> Modes {
        let n = 2 * self.floors;
        let mut k = DMatrix::zeros(n, n);
        let mut add = |from: Option<usize>, to: usize, n_per_m: f64| {
            k[(to, to)] += n_per_m;
            if let Some(from) = from {
                k[(from, from)] += n_per_m;
                k[(from, to)] -= n_per_m;
                k[(to, from)] -= n_per_m;
            }
        };
        for (spring, n_per_m) in self.n_per_m.iter().enumerate() {
            let (from, to) = self.ends(spring);
            let joint = spring >= n;
            let place = (spring / 2) as f64 / (self.floors - 1) as f64 - 0.5;
            let own = n_per_m * if joint { 1.0 } else { factors[spring % 2] };
            let right = match wrong {
                Wrong::ScatteredStiffness => own * (size * each[spring]).exp(),
                Wrong::Gradient if !joint => own * (size * place).exp(),
                Wrong::Joints if joint => own * size.exp(),
                // In series with the springs of the lowest floor.
                Wrong::SoftGround if from.is_none() => 1.0 / (1.0 / own + size / n_per_m),
                Wrong::OneSpring(at) if at == spring => own * (1.0 + size),
                _ => own,
            };
            add(from, to, right);
        }
        if wrong == Wrong::Braces {
            for floor in 0..self.floors - 1 {
                add(Some(2 * floor), 2 * floor + 3, size * self.n_per_m[0]);
                add(Some(2 * floor + 1), 2 * floor + 2, size * self.n_per_m[0]);
            }
        }
        let kg = |body: usize| match wrong {
            Wrong::ScatteredMass => self.kg[body] * (size * each[body]).exp(),
            Wrong::OneMass(at) if at == body => self.kg[body] * (1.0 + size),
            _ => self.kg[body],
        };
        let m = DMatrix::from_diagonal(&DVector::from_fn(n, |body, _| kg(body)));
        Modes::new(&k, &m, self.modes)
    }
}

fn world(seed: u64, kind: Wrong) -> World {
    let mut stream = ChaCha8Rng::seed_from_u64(seed);
    let frame = Frame::draw(&mut stream);
    let wrong = match kind {
        Wrong::OneSpring(_) => Wrong::OneSpring(stream.random_range(0..frame.n_per_m.len())),
        Wrong::OneMass(_) => Wrong::OneMass(stream.random_range(0..frame.kg.len())),
        other => other,
    };
    let sign = if stream.random_bool(0.5) { 1.0 } else { -1.0 };
    let size = match wrong {
        Wrong::ScatteredStiffness | Wrong::ScatteredMass => stream.random_range(0.04..0.1),
        // Share of the stiffness of the first spring.
        Wrong::Braces => stream.random_range(0.02..0.08),
        Wrong::Gradient => sign * stream.random_range(0.15..0.4),
        Wrong::Joints => sign * stream.random_range(0.2..0.6),
        // Share of the flexibility of the lowest floor.
        Wrong::SoftGround => stream.random_range(0.1..0.5),
        Wrong::OneSpring(_) => sign * stream.random_range(0.1..0.3),
        Wrong::OneMass(_) => sign * stream.random_range(0.08..0.2),
    };
    let each: Vec<f64> =
        (0..frame.n_per_m.len()).map(|_| stream.sample::<f64, _>(rand_distr::StandardNormal)).collect();
    let modes = |factors: [f64; 2]| frame.modes((wrong, size, &each), factors);
    let right = |factors: [f64; 2]| frame.modes((Wrong::ScatteredStiffness, 0.0, &each), factors);
    let text = format!("frame of {} floors, {wrong:?} {size:.3}, {} modes", frame.floors, frame.modes);
    let about = (label(&wrong) + " of a frame", text, frame.toml());
    let world = World::complete((seed, &mut stream), about, frame.noise, &modes, &right);
    let (one_place, right) = match wrong {
        Wrong::OneSpring(spring) => (true, vec![("spring", Some(format!("k{spring}")))]),
        Wrong::OneMass(body) => (true, vec![("mass", Some(format!("m{body}")))]),
        Wrong::Joints => (false, vec![("spring_group", Some("without parameter".to_owned()))]),
        _ => (false, Vec::new()),
    };
    World { one_place, right, ..world }
}

/// `each` frames of each kind.
pub(super) fn worlds(first_seed: u64, each: u64) -> Vec<World> {
    of_kinds(&KINDS, first_seed, each, world)
}
