//! Simulations that are wrong everywhere: buildings and beams whose physics no single spring or mass can represent. No place may be
//! named for it with confidence; and a single place that is wrong must still be found.
//!
//! Structures, physics and measurements are computed here with matrices of their own, independently of the program.

use std::fmt::Write as _;
use std::fs;
use std::ops::Range;
use std::path::Path;
use std::process::{Command, Output};

use nalgebra::{DMatrix, DVector};
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::world::{rfc3339, EPOCH_2024_S};
use super::{answer, in_parallel, list, target};
use serde_json::Value;

/// Probability above which a cause is named with confidence.
const SURE: f64 = 0.9;

const ROWS: i64 = 200;

/// What is wrong with the simulation.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Wrong {
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
    fn in_one_place(self) -> bool {
        matches!(self, Self::OneSpring(_) | Self::OneMass(_))
    }

    /// The families of causes that are true.
    fn families(self) -> &'static [&'static str] {
        match self {
            Self::Bending => &["bending"],
            Self::Rotation => &["base_rotation"],
            Self::SpreadMass | Self::Tributary => &["spread_mass"],
            // The weight of a storey grows towards the ground.
            Self::Gradient | Self::Gravity => &["stiffness_gradient"],
            Self::BendingAndRotation => &["bending", "base_rotation"],
            _ => &[],
        }
    }
}

const EVERYWHERE: [Wrong; 12] = [
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

/// A shear building in two groups of storeys, as its file states it.
struct Building {
    kg: Vec<f64>,
    n_per_m: Vec<f64>,
    modes: usize,
    /// First storey of the upper group.
    upper: usize,
    noise: f64,
}

impl Building {
    fn draw(stream: &mut ChaCha8Rng) -> Self {
        let storeys = stream.random_range(5..=8);
        let kg = (0..storeys).map(|_| stream.random_range(0.8e5..1.4e5_f64).round()).collect();
        let n_per_m = (0..storeys).map(|_| stream.random_range(0.9e8..1.6e8_f64).round()).collect();
        let modes = stream.random_range(4..=storeys.min(6));
        Self { kg, n_per_m, modes, upper: storeys / 2, noise: stream.random_range(0.0005..0.002) }
    }

    fn storeys(&self) -> usize {
        self.kg.len()
    }

    fn toml(&self) -> String {
        let mut text = format!(
            "id = \"building\"\nmodes = {}\nmeasurement_noise = {{ relative = {:.5} }}\n",
            self.modes, self.noise
        );
        text += "covariate = [{ name = \"temperature_c\" }, { name = \"wind_m_per_s\" }, { name = \"humidity_percent\" }]\n";
        for (floor, kg) in self.kg.iter().enumerate() {
            let _ = writeln!(text, "[[mass]]\nname = \"m{}\"\nkg = {kg:?}", floor + 1);
        }
        for (storey, n_per_m) in self.n_per_m.iter().enumerate() {
            let from = if storey == 0 { "ground".to_owned() } else { format!("m{storey}") };
            let (name, to) = (format!("k{}", storey + 1), format!("m{}", storey + 1));
            let _ = writeln!(
                text,
                "[[spring]]\nname = \"{name}\"\nfrom = \"{from}\"\nto = \"{to}\"\nn_per_m = {n_per_m:?}"
            );
        }
        for (name, storeys) in [("lower", 0..self.upper), ("upper", self.upper..self.storeys())] {
            let set: Vec<String> = storeys.map(|s| format!("{{ spring = \"k{}\" }}", s + 1)).collect();
            let _ = writeln!(
                text,
                "[[parameter]]\nname = \"{name}\"\nscale = true\nprior = {{ uniform = [0.5, 1.6] }}\nsets = [{}]",
                set.join(", ")
            );
        }
        text
    }
}

/// What the structure really is.
struct Truth {
    wrong: Wrong,
    /// Size of the error in units of its kind.
    size: f64,
    /// Further numbers of the error, one for each storey.
    each: Vec<f64>,
}

impl Truth {
    fn draw(wrong: Wrong, building: &Building, stream: &mut ChaCha8Rng) -> Self {
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

    /// Frequencies with the factors of the two groups, Hz, `[modes]`.
    fn frequencies_hz(&self, building: &Building, factors: [f64; 2]) -> Vec<f64> {
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
        let inverse = m.cholesky().unwrap().l().try_inverse().unwrap();
        let symmetric = &inverse * k * inverse.transpose();
        let mut squares: Vec<f64> = symmetric.symmetric_eigenvalues().iter().copied().collect();
        squares.sort_by(f64::total_cmp);
        let hz: Vec<f64> = squares.iter().take(building.modes).map(|s| s.sqrt() / std::f64::consts::TAU).collect();
        let middle = hz[building.modes / 2];
        let curved = |f: f64| match self.wrong {
            Wrong::Calibration => f * (1.0 + self.size * ((f / middle).powi(2) - 1.0) * 0.5),
            _ => f,
        };
        hz.into_iter().map(curved).collect()
    }
}

/// Measurements with the mean `factors` of the two groups, which scatter by 1 % from row to row, as CSV: the rows with these numbers,
/// six a day.
fn measured(
    building: &Building,
    truth: &Truth,
    factors: [f64; 2],
    rows: Range<i64>,
    stream: &mut ChaCha8Rng,
) -> String {
    let mut normal = move || stream.sample::<f64, _>(rand_distr::StandardNormal);
    let modes: Vec<String> = (1..=building.modes).map(|m| format!("f{m}_hz")).collect();
    let mut csv = format!("measured_at,{},temperature_c,wind_m_per_s,humidity_percent\n", modes.join(","));
    for row in rows {
        let factors = factors.map(|factor| factor * (1.0 + 0.01 * normal()));
        let hz = truth.frequencies_hz(building, factors);
        let hz: Vec<String> = hz.iter().map(|f| format!("{:.6}", f * (1.0 + building.noise * normal()))).collect();
        let time = rfc3339(EPOCH_2024_S + 14_400 * row);
        let weather = [10.0 + 8.0 * normal(), 3.0 * normal().abs(), 60.0 + 10.0 * normal()];
        let _ = writeln!(csv, "{time},{},{:.2},{:.2},{:.1}", hz.join(","), weather[0], weather[1], weather[2]);
    }
    csv
}

/// A building, what is wrong with its file, and its measurements.
struct World {
    seed: u64,
    wrong: Wrong,
    size: f64,
    modes: usize,
    storeys: usize,
    toml: String,
    csv: String,
    /// Largest deviation of a frequency from the best simulation with other factors, per cent: how far off the simulation is.
    off_percent: f64,
}

impl World {
    fn draw(seed: u64, wrong: impl Fn(&mut ChaCha8Rng, usize) -> Wrong) -> Self {
        let mut stream = ChaCha8Rng::seed_from_u64(seed);
        let building = Building::draw(&mut stream);
        let wrong = wrong(&mut stream, building.storeys());
        let truth = Truth::draw(wrong, &building, &mut stream);
        let csv = measured(&building, &truth, [1.0; 2], 0..ROWS, &mut stream);
        let off_percent = off_percent(&building, &truth);
        Self {
            seed,
            wrong,
            size: truth.size,
            modes: building.modes,
            storeys: building.storeys(),
            toml: building.toml(),
            csv,
            off_percent,
        }
    }
}

/// Largest deviation over the modes that is left by the best factors of the two groups, by Gauss–Newton, per cent.
fn off_percent(building: &Building, truth: &Truth) -> f64 {
    let right = Truth { wrong: Wrong::Scattered, size: 0.0, each: truth.each.clone() };
    let logs = |hz: Vec<f64>| DVector::from_iterator(hz.len(), hz.into_iter().map(f64::ln));
    let wanted = logs(truth.frequencies_hz(building, [1.0; 2]));
    let mut factors = [1.0; 2];
    let mut left = wanted.clone();
    for _ in 0..20 {
        let here = logs(right.frequencies_hz(building, factors));
        left = &wanted - &here;
        let column = |which: usize| {
            let mut moved = factors;
            moved[which] *= 1.0 + 1e-6;
            (logs(right.frequencies_hz(building, moved)) - &here) / 1e-6
        };
        let slopes = DMatrix::from_columns(&[column(0), column(1)]);
        let step = (slopes.transpose() * &slopes).try_inverse().unwrap() * slopes.transpose() * &left;
        factors = [factors[0] * step[0].clamp(-0.2, 0.2).exp(), factors[1] * step[1].clamp(-0.2, 0.2).exp()];
    }
    100.0 * left.amax()
}

/// The causes that an answer names with confidence, apart from a deviation of all parts.
fn confident(answer: &Value) -> Vec<&Value> {
    let sure = |cause: &&Value| cause["probability"].as_f64().unwrap() > SURE && target(cause).0 != "everywhere";
    list(answer, "causes").iter().filter(sure).collect()
}

/// Whether a cause is the place, or of the family, that is wrong.
fn is_right(cause: &Value, wrong: Wrong) -> bool {
    let (kind, name) = target(cause);
    match wrong {
        Wrong::OneSpring(storey) => kind == "spring" && name == format!("k{}", storey + 1),
        Wrong::OneMass(floor) => kind == "mass" && name == format!("m{}", floor + 1),
        _ => wrong.families().contains(&kind),
    }
}

/// A world with its answer.
struct Judged {
    world: World,
    answer: Value,
}

impl Judged {
    fn untrue(&self) -> usize {
        confident(&self.answer).into_iter().filter(|cause| !is_right(cause, self.world.wrong)).count()
    }

    /// Number of the cause that is the one place that is wrong.
    fn place(&self) -> Option<usize> {
        list(&self.answer, "causes").iter().position(|cause| is_right(cause, self.world.wrong))
    }

    fn first_is(&self, kind: &str) -> bool {
        list(&self.answer, "causes").first().is_some_and(|cause| target(cause).0 == kind)
    }

    /// Whether the first cause is of a family that is true.
    fn family_is_first(&self) -> bool {
        list(&self.answer, "causes").first().is_some_and(|cause| is_right(cause, self.world.wrong))
    }

    fn text(&self) -> String {
        let World { seed, wrong, size, modes, storeys, off_percent, .. } = &self.world;
        let mut text = format!(
            "seed {seed}: {wrong:?} {size:.3}, {storeys} storeys, {modes} modes, off by {off_percent:.2} %: {}",
            self.answer["verdict"].as_str().unwrap()
        );
        for cause in list(&self.answer, "causes").iter().take(4) {
            let (kind, name) = target(cause);
            let _ = write!(text, "\n    {:.3} {kind} {name}", cause["probability"].as_f64().unwrap());
            let _ = write!(text, " {}", cause["covariate"].as_str().unwrap_or(""));
        }
        text
    }
}

fn judged(worlds: Vec<World>) -> Vec<Judged> {
    let answers = in_parallel(&worlds, |world| answer(&world.toml, &world.csv, &[]));
    worlds.into_iter().zip(answers).map(|(world, answer)| Judged { world, answer }).collect()
}

/// `each` worlds of each kind.
fn wrong_everywhere(first_seed: u64, each: u64) -> Vec<World> {
    let of_kind = |kind: usize| {
        (0..each).map(move |i| World::draw(first_seed + 1_000 * kind as u64 + i, |_, _| EVERYWHERE[kind]))
    };
    (0..EVERYWHERE.len()).flat_map(of_kind).collect()
}

fn wrong_in_one_place(first_seed: u64, count: u64) -> Vec<World> {
    let one = |stream: &mut ChaCha8Rng, storeys: usize| {
        let place = stream.random_range(0..storeys);
        if stream.random_bool(0.5) {
            Wrong::OneSpring(place)
        } else {
            Wrong::OneMass(place)
        }
    };
    (0..count).map(|i| World::draw(first_seed + i, one)).collect()
}

/// Prints what was named, and returns the number of worlds in which an untrue cause was named with confidence.
fn report(judged: &[Judged]) -> usize {
    for kind in EVERYWHERE {
        let own: Vec<&Judged> = judged.iter().filter(|j| j.world.wrong == kind).collect();
        if own.is_empty() {
            continue;
        }
        let count = |good: &dyn Fn(&&Judged) -> bool| own.iter().filter(|j| good(j)).count();
        println!(
            "{kind:?}: {} worlds, untrue cause above {SURE} in {}; the family first in {}, everywhere first in {}, nothing found in {}, none of these in {}",
            own.len(),
            count(&|j| j.untrue() > 0),
            count(&|j| j.family_is_first()),
            count(&|j| j.first_is("everywhere")),
            count(&|j| j.answer["verdict"] == "nothing_found"),
            count(&|j| j.answer["verdict"] == "none_of_these")
        );
    }
    let one: Vec<&Judged> = judged.iter().filter(|j| j.world.wrong.in_one_place()).collect();
    if !one.is_empty() {
        println!(
            "one place: {} worlds, untrue cause above {SURE} in {}; the place first in {}, alone in {}, among the named in {}",
            one.len(),
            one.iter().filter(|j| j.untrue() > 0).count(),
            one.iter().filter(|j| j.place() == Some(0)).count(),
            one.iter().filter(|j| j.place() == Some(0) && j.answer["verdict"] == "cause").count(),
            one.iter().filter(|j| j.place().is_some()).count()
        );
    }
    for j in judged {
        println!("{}{}", if j.untrue() > 0 { "UNTRUE " } else { "" }, j.text());
    }
    judged.iter().filter(|j| j.untrue() > 0).count()
}

#[test]
fn no_place_is_blamed_for_a_simulation_that_is_wrong_everywhere() {
    let mut worlds = wrong_everywhere(10_000, 2);
    worlds.extend(wrong_in_one_place(18_000, 10));
    let judged = judged(worlds);
    let untrue = report(&judged);
    // About one world in fifty of the first kind fails, and none of a hundred of the second.
    assert!(untrue <= 1, "an untrue cause in {untrue} of {} worlds", judged.len());
    let (one, everywhere): (Vec<&Judged>, Vec<&Judged>) = judged.iter().partition(|j| j.world.wrong.in_one_place());
    let found = one.iter().filter(|j| j.place().is_some()).count();
    assert!(found >= 7, "the one place that is wrong is named in {found} of {}", one.len());
    for j in one.iter().filter(|j| j.answer["verdict"] == "cause" && j.place() == Some(0)) {
        assert!(j.answer["left_out_modes"]["contradicted"] == false, "{}: {}", j.text(), j.answer["left_out_modes"]);
    }
    let first = everywhere.iter().filter(|j| j.family_is_first() || j.first_is("everywhere")).count();
    assert!(first >= 22, "the family or everywhere comes first in {first} of {}", everywhere.len());
    for j in everywhere.iter().filter(|j| matches!(j.world.wrong, Wrong::Bending | Wrong::Rotation | Wrong::SpreadMass))
    {
        assert!(j.family_is_first(), "{}", j.text());
        // A mode that is left out of the fit is predicted by the others to a few standard errors, of a hundredth of a per cent.
        let left = &j.answer["left_out_modes"];
        let rms = |which: &str| left["rms_error_percent"][which].as_f64().unwrap();
        assert!(left["contradicted"] == false && rms("after") < 0.1 * rms("before"), "{}: {left}", j.text());
    }
}

/// Runs a command of the program on a structure and measurements.
fn run(command: &[&str], structure: &Path, csv: &str, folder: &Path) -> Output {
    let data = folder.join("rows.csv");
    fs::write(&data, csv).unwrap();
    let (structure, data) = (structure.to_str().unwrap(), data.to_str().unwrap());
    let files = ["--structure", structure, "--data", data];
    Command::new(env!("CARGO_BIN_EXE_modalwatch")).args(command).args(files).output().unwrap()
}

/// Means of the parameters, % of nominal, and root mean square of what is left of ln f, %, by least squares for each measurement.
fn updated(structure: &Path, csv: &str, folder: &Path) -> (Vec<f64>, f64) {
    let output = run(&["update", "--method", "sensitivity", "--json"], structure, csv, folder);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    let left: Vec<f64> = list(&answer, "updates").iter().map(|u| u["residual_percent"].as_f64().unwrap()).collect();
    let square = left.iter().map(|r| r * r).sum::<f64>() / left.len() as f64;
    (list(&answer, "parameters").iter().map(|p| p["mean"].as_f64().unwrap()).collect(), square.sqrt())
}

/// A deviation that the structure file was extended by, as what it is or as a constant of each mode, and measurements after it.
struct Accepted {
    wrong: Wrong,
    /// Whether the file was extended by the family of the error; otherwise by a constant of each mode.
    as_family: bool,
    /// What is left of ln f in later measurements, without and with it, as a multiple of what noise leaves.
    left: [f64; 2],
    /// Change of the two groups where the lower one has lost 10 %, without and with it, %.
    change: [Vec<f64>; 2],
}

impl Accepted {
    /// `None` if the simulation is told neither what it lacks nor to be off everywhere, or if a constant of each mode is refused.
    fn new(seed: u64, wrong: Wrong) -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let (given, extended) = (folder.path().join("given.toml"), folder.path().join("extended/structure.json"));
        let mut stream = ChaCha8Rng::seed_from_u64(seed);
        let building = Building::draw(&mut stream);
        let truth = Truth::draw(wrong, &building, &mut stream);
        let mut rows = |factors, numbers| measured(&building, &truth, factors, numbers, &mut stream);
        let (reference, later, lossy) =
            (rows([1.0; 2], 0..ROWS), rows([1.0; 2], ROWS..ROWS + 40), rows([0.9, 1.0], 400..440));
        fs::write(&given, building.toml()).unwrap();
        let out = extended.parent().unwrap().to_str().unwrap();
        let extend = ["extend", "--no-training", "--holdout", "last:0", "--out", out];
        let by_cause = run(&extend, &given, &reference, folder.path());
        let as_family = by_cause.status.success();
        if as_family {
            let structure: Value = serde_json::from_str(&fs::read_to_string(&extended).unwrap()).unwrap();
            let family = structure["effect"][0]["target"]["chain"].as_str().unwrap_or_default();
            let wanted = wrong.families().contains(&family);
            if !wanted {
                println!("UNTRUE {seed} {wrong:?}: {}", String::from_utf8_lossy(&by_cause.stdout));
                return None;
            }
        } else {
            if !String::from_utf8_lossy(&by_cause.stderr).contains("constant discrepancy of each mode (`--learned`") {
                return None;
            }
            let accepted = run(&[&extend[..], &["--learned"]].concat(), &given, &reference, folder.path());
            let said = String::from_utf8_lossy(&accepted.stdout).into_owned();
            // Several causes may be as probable, so that a constant of each mode predicts no better.
            if !accepted.status.success() {
                println!("REFUSED {seed} {wrong:?}: {}", String::from_utf8_lossy(&accepted.stderr));
                return None;
            }
            assert!(said.contains("added: a constant discrepancy of each mode"), "{said}");
        }

        // What is left of M modes by two parameters is √((M − 2)/M) of the noise.
        let noise = 100.0 * building.noise * (1.0 - 2.0 / building.modes as f64).sqrt();
        let [before, after] = [&given, &extended].map(|structure| {
            let (healthy, left) = updated(structure, &later, folder.path());
            let (lost, _) = updated(structure, &lossy, folder.path());
            let change = healthy.iter().zip(&lost).map(|(from, to)| 100.0 * (to / from - 1.0));
            (left / noise, change.collect::<Vec<f64>>())
        });
        Some(Self { wrong, as_family, left: [before.0, after.0], change: [before.1, after.1] })
    }

    fn text(&self) -> String {
        let ([before, after], [change_before, change_after]) = (&self.left, &self.change);
        format!(
            "{:?} ({}): left {before:.2} and {after:.2} times the noise; change {change_before:.1?} and {change_after:.1?} %",
            self.wrong,
            if self.as_family { "by its family" } else { "by a constant of each mode" }
        )
    }
}

/// A deviation in no single place becomes part of the structure file, as what it is or as a constant of each mode. Later measurements then
/// fit within their noise, and a loss of 10 % of the lower group is a change of that group.
#[test]
fn a_deviation_everywhere_can_be_accepted_and_a_later_loss_is_seen() {
    let worlds = [
        (60_004, Wrong::Gradient),
        (60_005, Wrong::SpreadMass),
        (60_006, Wrong::Walls),
        (60_007, Wrong::Bending),
        (60_008, Wrong::Rotation),
    ];
    let all = in_parallel(&worlds, |(seed, wrong)| Accepted::new(*seed, *wrong));
    for (accepted, (_, wrong)) in all.into_iter().zip(worlds) {
        let accepted = accepted.expect("a simulation that is off everywhere");
        println!("{}", accepted.text());
        assert!(accepted.left[0] > 2.0 && accepted.left[1] < 1.5);
        assert_eq!(accepted.as_family, !wrong.families().is_empty());
        // Beside constants of the modes, how the modes follow the stiffnesses stays wrong: the loss of 10 % is told to a quarter of it.
        let off = if accepted.as_family { 0.6 } else { 2.5 };
        let change = &accepted.change[1];
        assert!((change[0] + 10.0).abs() < off && change[1].abs() < off, "{change:?}");
    }
}

#[test]
#[ignore = "a study of 8 minutes"]
fn deviations_everywhere_are_accepted_in_many_worlds() {
    let worlds: Vec<(u64, Wrong)> = (0..240).map(|i| (70_000 + i, EVERYWHERE[i as usize % 12])).collect();
    let accepted = in_parallel(&worlds, |(seed, wrong)| Accepted::new(*seed, *wrong));
    let mut fit = 0;
    for kind in EVERYWHERE {
        let own: Vec<&Accepted> = accepted.iter().flatten().filter(|a| a.wrong == kind).collect();
        for a in &own {
            println!("{}", a.text());
        }
        let within = |which: usize, limit: f64| own.iter().filter(|a| a.left[which] < limit).count();
        let mean =
            |which: usize, group: usize| own.iter().map(|a| a.change[which][group]).sum::<f64>() / own.len() as f64;
        println!(
            "{kind:?}: {} accepted, {} of them by the family; left below 1.5 times the noise in {} without it and {} with it; mean change of the groups {:.1} and \
             {:.1} % without it, {:.1} and {:.1} % with it",
            own.len(),
            own.iter().filter(|a| a.as_family).count(),
            within(0, 1.5),
            within(1, 1.5),
            mean(0, 0),
            mean(0, 1),
            mean(1, 0),
            mean(1, 1)
        );
        fit += within(1, 1.5);
    }
    let all = accepted.iter().flatten().count();
    assert!(10 * fit >= 9 * all, "later measurements fit in {fit} of {all}");
}

#[test]
#[ignore = "a study of 9 minutes"]
fn no_place_is_blamed_for_a_simulation_that_is_wrong_everywhere_in_many_worlds() {
    let mut worlds = wrong_everywhere(40_000, 60);
    worlds.extend(wrong_in_one_place(50_000, 180));
    let judged = judged(worlds);
    let untrue = report(&judged);
    assert!(50 * untrue <= judged.len(), "an untrue cause in {untrue} of {} worlds", judged.len());
}
