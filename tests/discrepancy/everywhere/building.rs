//! Shear buildings in two groups of storeys, and what can be wrong with their files.

use std::fmt::Write as _;

use nalgebra::{DMatrix, DVector};
use rand::seq::SliceRandom as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::measurements::{self, factor_with, head, Modes};

/// What is wrong with the simulation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Wrong {
    /// The building also bends: F = F_shear + α B(h).
    Bending,
    /// The foundation rotates: F = F_shear + h hᵀ/k_θ.
    Rotation,
    /// The mass is spread over the storeys.
    SpreadMass,
    /// The stiffness of every storey is off by a factor of its own.
    Scattered,
    /// The stiffness falls along the structure, within both groups.
    Gradient,
    /// The instrument has a curved calibration.
    Calibration,
    /// Every second floor carries partition walls that the file leaves out: springs between all floors and the one after next.
    Walls,
    /// The masses of the floors are off by factors of their own.
    ScatteredMass,
    /// The storeys in the middle are less or more stiff than those at both ends.
    Bulge,
    /// The building bends, and its foundation rotates.
    BendingAndRotation,
    /// The weight of the floors above takes from the stiffness of each storey.
    Gravity,
    /// The mass is spread over the storeys, and the file has half of that above and half of that below at each floor.
    Tributary,
    /// One storey is 10 to 30 % less or more stiff than its group.
    OneSpring(usize),
    /// One floor is 8 to 20 % heavier or lighter.
    OneMass(usize),
}

impl Wrong {
    pub(super) fn in_one_place(self) -> bool {
        matches!(self, Self::OneSpring(_) | Self::OneMass(_))
    }

    /// The families of causes that are true.
    pub(super) fn families(self) -> &'static [&'static str] {
        match self {
            Self::Bending => &["bending"],
            Self::Rotation => &["base_rotation"],
            Self::SpreadMass | Self::Tributary => &["spread_mass"],
            // The weight of a storey grows towards the ground.
            Self::Gradient | Self::Gravity => &["stiffness_gradient"],
            Self::BendingAndRotation => &["bending", "base_rotation"],
            Self::Calibration => &["calibration"],
            _ => &[],
        }
    }

    /// The kinds of targets that are true, each with the name of its part if only one part is.
    pub(super) fn right(self) -> Vec<(&'static str, Option<String>)> {
        match self {
            Self::OneSpring(storey) => vec![("spring", Some(format!("k{}", storey + 1)))],
            Self::OneMass(floor) => vec![("mass", Some(format!("m{}", floor + 1)))],
            _ => self.families().iter().map(|family| (*family, None)).collect(),
        }
    }
}

pub(super) const EVERYWHERE: [Wrong; 12] = [
    Wrong::Bending,
    Wrong::Rotation,
    Wrong::SpreadMass,
    Wrong::Scattered,
    Wrong::Gradient,
    Wrong::Calibration,
    Wrong::Walls,
    Wrong::ScatteredMass,
    Wrong::Bulge,
    Wrong::BendingAndRotation,
    Wrong::Gravity,
    Wrong::Tributary,
];

/// How a file describes a building. Each of them can represent the same frequencies.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Description {
    Plain,
    /// Bodies and storeys are listed from the top, and springs lead downwards.
    FromTheTop,
    WidePriors,
    NormalPriors,
    /// All stiffnesses are four fifths of what they are, and the factors so much larger.
    SofterNominal,
    /// The first storey is a group of its own.
    ThreeGroups,
}

impl Description {
    pub(super) const ALL: [Self; 6] =
        [Self::Plain, Self::FromTheTop, Self::WidePriors, Self::NormalPriors, Self::SofterNominal, Self::ThreeGroups];
}

/// A shear building in two groups of storeys, as its file states it.
pub(super) struct Building {
    kg: Vec<f64>,
    n_per_m: Vec<f64>,
    pub(super) modes: usize,
    /// First storey of the upper group.
    upper: usize,
    pub(super) noise: f64,
}

impl Building {
    pub(super) fn draw(stream: &mut ChaCha8Rng) -> Self {
        let storeys = stream.random_range(5..=8);
        let kg = (0..storeys).map(|_| stream.random_range(0.8e5..1.4e5_f64).round()).collect();
        let n_per_m = (0..storeys).map(|_| stream.random_range(0.9e8..1.6e8_f64).round()).collect();
        let modes = stream.random_range(4..=storeys.min(6));
        Self { kg, n_per_m, modes, upper: storeys / 2, noise: stream.random_range(0.0005..0.002) }
    }

    pub(super) fn storeys(&self) -> usize {
        self.kg.len()
    }

    /// The structure file that states `noise`, and shapes at these floors.
    pub(super) fn toml(&self, noise: f64, instrumented: &[usize]) -> String {
        self.described(noise, instrumented, Description::Plain)
    }

    /// As [`Self::toml`], in another description of the same building.
    pub(super) fn described(&self, noise: f64, instrumented: &[usize], description: Description) -> String {
        let mut text = head("building", self.modes, noise, instrumented);
        let stated = if description == Description::SofterNominal { 0.8 } else { 1.0 };
        let mass = |floor: usize| format!("[[mass]]\nname = \"m{}\"\nkg = {:?}\n", floor + 1, self.kg[floor]);
        let spring = |storey: usize| {
            let from = if storey == 0 { "ground".to_owned() } else { format!("m{storey}") };
            let ends = [from, format!("m{}", storey + 1)];
            let [from, to] =
                if description == Description::FromTheTop { [&ends[1], &ends[0]] } else { [&ends[0], &ends[1]] };
            let n_per_m = stated * self.n_per_m[storey];
            format!("[[spring]]\nname = \"k{}\"\nfrom = \"{from}\"\nto = \"{to}\"\nn_per_m = {n_per_m:?}\n", storey + 1)
        };
        let mut order: Vec<usize> = (0..self.storeys()).collect();
        if description == Description::FromTheTop {
            order.reverse();
        }
        text.extend(order.iter().map(|floor| mass(*floor)));
        text.extend(order.iter().map(|storey| spring(*storey)));
        let mut ends = vec![0, self.upper, self.storeys()];
        if description == Description::ThreeGroups {
            ends.insert(1, 1);
        }
        let prior = match description {
            Description::WidePriors => "{ uniform = [0.3, 2.5] }",
            Description::NormalPriors => "{ normal = { mean = 1.0, std = 0.2 } }",
            Description::SofterNominal => "{ uniform = [0.625, 2.0] }",
            _ => "{ uniform = [0.5, 1.6] }",
        };
        for (group, storeys) in ends.windows(2).map(|pair| pair[0]..pair[1]).enumerate() {
            let sets = storeys.map(|s| format!("{{ spring = \"k{}\" }}", s + 1));
            text += &factor_with(&format!("group{}", group + 1), prior, sets);
        }
        text
    }

    /// The structure file with a table of 80 runs of the simulation.
    pub(super) fn table(&self, seed: u64) -> String {
        let mut stream = ChaCha8Rng::seed_from_u64(seed);
        let exact = Truth { wrong: Wrong::Scattered, size: 0.0, each: vec![0.0; self.storeys()] };
        let runs = 80;
        let mut order: Vec<usize> = (0..runs).collect();
        order.shuffle(&mut stream);
        let mut text = head("building", self.modes, self.noise, &[]) + "simulation = \"table\"\n";
        for name in ["lower", "upper"] {
            let _ = writeln!(text, "[[parameter]]\nname = \"{name}\"\nprior = {{ uniform = [0.5, 1.6] }}");
        }
        let columns: Vec<String> = (1..=self.modes).map(|m| format!("f{m}_hz")).collect();
        let _ = writeln!(text, "[table]\ncsv = '''\nlower,upper,{}", columns.join(","));
        for (run, partner) in order.into_iter().enumerate() {
            let factors =
                [run, partner].map(|stratum| 0.5 + 1.1 * (stratum as f64 + stream.random::<f64>()) / runs as f64);
            let hz: Vec<String> = exact.modes(self, factors).hz.iter().map(|f| format!("{f:.9}")).collect();
            let _ = writeln!(text, "{:.9},{:.9},{}", factors[0], factors[1], hz.join(","));
        }
        text + "'''\n"
    }
}

/// What the structure really is.
pub(super) struct Truth {
    wrong: Wrong,
    /// Size of the error in units of its kind.
    pub(super) size: f64,
    /// Further numbers of the error, one for each storey.
    each: Vec<f64>,
}

impl Truth {
    pub(super) fn draw(wrong: Wrong, building: &Building, stream: &mut ChaCha8Rng) -> Self {
        let n = building.storeys();
        let sign = if stream.random_bool(0.5) { 1.0 } else { -1.0 };
        let size = match wrong {
            // Share of the flexibility of the roof.
            Wrong::Bending | Wrong::Rotation | Wrong::BendingAndRotation => stream.random_range(0.1..0.6),
            Wrong::SpreadMass | Wrong::Tributary => stream.random_range(0.3..0.8),
            // Share of the stiffness of the first storey.
            Wrong::Gravity => stream.random_range(0.05..0.2),
            Wrong::Scattered | Wrong::ScatteredMass => stream.random_range(0.04..0.1),
            Wrong::Gradient => sign * stream.random_range(0.15..0.4),
            Wrong::Calibration => sign * stream.random_range(0.005..0.02),
            Wrong::Walls => stream.random_range(0.02..0.08),
            Wrong::OneSpring(_) | Wrong::Bulge => sign * stream.random_range(0.1..0.3),
            Wrong::OneMass(_) => sign * stream.random_range(0.08..0.2),
        };
        let each = (0..n).map(|_| stream.sample::<f64, _>(rand_distr::StandardNormal)).collect();
        Self { wrong, size, each }
    }

    /// Modes with the factors of the two groups; the shapes are those at the floors.
    pub(super) fn modes(&self, building: &Building, factors: [f64; 2]) -> Modes {
        let n = building.storeys();
        let place = |storey: usize| (storey as f64 + 0.5) / n as f64 - 0.5;
        let stiffness = |storey: usize, factors: [f64; 2]| {
            let own = building.n_per_m[storey] * factors[usize::from(storey >= building.upper)];
            own * match self.wrong {
                Wrong::Scattered => (self.size * self.each[storey]).exp(),
                Wrong::Gradient => (self.size * place(storey)).exp(),
                Wrong::Bulge => (self.size * (1.0 - 8.0 * place(storey).powi(2))).exp(),
                Wrong::Gravity => {
                    let above = building.kg[storey..].iter().sum::<f64>() / building.kg.iter().sum::<f64>();
                    1.0 - self.size * above * building.n_per_m[0] / own
                }
                Wrong::OneSpring(at) if at == storey => 1.0 + self.size,
                _ => 1.0,
            }
        };
        // Flexibility of a shear building: the sum over the storeys below both floors.
        let mut flexibility =
            DMatrix::from_fn(n, n, |a, b| (0..=a.min(b)).map(|s| 1.0 / stiffness(s, factors)).sum::<f64>());
        // Foundation and walls do not change with the storeys.
        let roof: f64 = (0..n).map(|s| 1.0 / stiffness(s, [1.0; 2])).sum();
        let height = |floor: usize| (floor + 1) as f64 / n as f64;
        let further = |of: &dyn Fn(f64, f64) -> f64| {
            let unit = DMatrix::from_fn(n, n, |a, b| of(height(a), height(b)));
            let scale = self.size * roof / unit[(n - 1, n - 1)];
            unit * scale
        };
        let bends = |a: f64, b: f64| {
            let (low, high) = (a.min(b), a.max(b));
            low * low * (3.0 * high - low) / 6.0
        };
        match self.wrong {
            Wrong::Bending => flexibility += further(&bends),
            Wrong::Rotation => flexibility += further(&|a, b| a * b),
            Wrong::BendingAndRotation => flexibility += further(&bends) + further(&|a, b| a * b),
            _ => {}
        }
        let mut k = flexibility.try_inverse().unwrap();
        if self.wrong == Wrong::Walls {
            let walls = self.size * building.n_per_m[0];
            for floor in 0..n.saturating_sub(2) {
                let other = floor + 2;
                for (a, b, sign) in
                    [(floor, floor, 1.0), (other, other, 1.0), (floor, other, -1.0), (other, floor, -1.0)]
                {
                    k[(a, b)] += sign * walls * (1.0 + 0.3 * self.each[floor].abs());
                }
            }
        }
        let kg = |floor: usize| match self.wrong {
            Wrong::OneMass(at) if at == floor => building.kg[floor] * (1.0 + self.size),
            Wrong::ScatteredMass => building.kg[floor] * (self.size * self.each[floor]).exp(),
            _ => building.kg[floor],
        };
        let mut m = DMatrix::from_diagonal(&DVector::from_fn(n, |floor, _| kg(floor)));
        if self.wrong == Wrong::SpreadMass {
            // A share of each mass belongs to the columns below its floor: that of a rod whose ends are two floors.
            for floor in 0..n {
                let column = self.size * kg(floor);
                m[(floor, floor)] -= column;
                m[(floor, floor)] += column / 3.0;
                if floor > 0 {
                    m[(floor - 1, floor - 1)] += column / 3.0;
                    m[(floor - 1, floor)] += column / 6.0;
                    m[(floor, floor - 1)] += column / 6.0;
                }
            }
        }
        if self.wrong == Wrong::Tributary {
            // Of each storey, the rod has m/3 and m/6, where the file has m/2 and 0.
            for floor in 0..n {
                let sixth = self.size * kg(floor) / 6.0;
                m[(floor, floor)] -= sixth;
                if floor > 0 {
                    m[(floor - 1, floor - 1)] -= sixth;
                    m[(floor - 1, floor)] += sixth;
                    m[(floor, floor - 1)] += sixth;
                }
            }
        }
        let mut modes = Modes::new(&k, &m, building.modes);
        let middle = modes.hz[building.modes / 2];
        if self.wrong == Wrong::Calibration {
            for f in &mut modes.hz {
                *f *= 1.0 + self.size * ((*f / middle).powi(2) - 1.0) * 0.5;
            }
        }
        modes
    }
}

/// Largest deviation over the modes that is left by the best factors of the two groups, per cent.
pub(super) fn off_percent(building: &Building, truth: &Truth) -> f64 {
    let right = Truth { wrong: Wrong::Scattered, size: 0.0, each: truth.each.clone() };
    measurements::off_percent(&truth.modes(building, [1.0; 2]).hz, |factors| right.modes(building, factors).hz)
}
