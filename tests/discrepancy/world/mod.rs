//! Synthetic worlds: a random structure, and measurements with a hidden effect that the structure file does not contain.
//!
//! Assembly, eigenvalues, effects and likelihood are implemented here independently of the program, so that a mistake of the
//! program is not repeated here and so hidden.

mod effect;
mod likelihood;
mod measure;
mod numbers;
mod rows;
mod structure;

use std::fmt::Write as _;

use rand::seq::IndexedRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

pub use effect::{Truth, AND};
pub use numbers::{mean, mean_and_sd, number, quantiles, rfc3339, rounded, EPOCH_2024_S};
pub use structure::{frequencies_hz, structure_toml};

use effect::{draw_effect, draw_outside, Effect, OUTSIDE};
use likelihood::{Data, Fit};
use measure::{csv, measure, Shapes};
use rows::{draw_rows, training_rows, Row, Weather};
use structure::Structure;

/// What a world hides.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// No effect: the structure file is right.
    Nothing,
    /// One effect of [`SINGLE_FAMILIES`].
    Single,
    /// Two effects of different targets.
    Two,
    /// An effect that no single law of the program describes.
    Outside,
}

/// A structure file, measurements, and the effects hidden in them.
#[derive(Debug, Clone)]
pub struct World {
    /// Seed it was drawn from.
    pub seed: u64,
    /// Structure file, without the hidden effect.
    pub structure_toml: String,
    /// Measurements, one row each.
    pub csv: String,
    /// The hidden effects.
    pub truths: Vec<Truth>,
    /// The effect in words, if no law of the program describes it.
    pub outside: Option<&'static str>,
    /// Target and effect range of that effect; its columns, joined by [`AND`], are the covariate.
    pub outside_target: Option<Truth>,
    /// Log-likelihood of the true model minus that of the best model without effects, on the first 75 % of the rows.
    pub nats: f64,
    /// Mean over the modes of the rms relative prediction error on the last 25 % of the rows: without effects, and with the
    /// true ones.
    pub holdout_rms_percent: (f64, f64),
    /// Mean log predictive density of the log frequencies of a row, on the same rows: without effects, and with the true ones.
    pub holdout_log_density: (f64, f64),
    /// The world in one line.
    pub description: String,
    structure: Structure,
    effects: Vec<Effect>,
    rows: Vec<Row>,
}

impl World {
    /// Structure file and measurements with mode shapes at half of the masses; the frequencies are the same.
    pub fn with_shapes(&self) -> (String, String) {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(SHAPES);
        let shapes = Shapes::measure(&mut rng, &self.structure, &self.effects, &self.rows);
        let names = shapes.points.iter().map(|p| format!("\"{}\"", structure::mass_name(*p))).collect::<Vec<_>>();
        let declared = format!("mode_shapes = {{ points = [{}], noise = {:?} }}\n", names.join(", "), shapes.noise);
        let toml = self.structure_toml.replacen("measurement_noise", &format!("{declared}measurement_noise"), 1);
        (toml, csv(&self.structure, &self.rows, Some(&shapes)))
    }
}

/// Random stream of the mode shapes, which no other part of a world uses.
const SHAPES: u64 = 1 << 32;

/// Targets and laws of single effects.
pub const SINGLE_FAMILIES: &[(&str, &str)] = &[
    ("spring", "constant"),
    ("spring", "linear"),
    ("spring", "bilinear"),
    ("spring", "quadratic"),
    ("spring", "exponential"),
    ("spring", "category"),
    ("spring", "step"),
    ("spring", "lagged"),
    ("spring_group", "linear"),
    ("spring_group", "bilinear"),
    ("spring_group", "category"),
    ("mass", "constant"),
    ("mass", "linear"),
    ("mass", "category"),
    ("mass", "step"),
    ("mass_group", "linear"),
    ("frequency_scale", "constant"),
    ("frequency_scale", "linear"),
    ("frequency_scale", "category"),
    ("frequency_scale", "step"),
    ("frequency_offset", "constant"),
    ("frequency_offset", "category"),
    ("setting", "constant"),
    ("setting", "category"),
    ("added_spring", "constant"),
    ("added_spring", "linear"),
    ("added_spring", "category"),
    ("oscillator", "constant"),
    ("mode_assignment", "constant"),
];

/// Targets that multiply all frequencies by the same factor.
const GLOBAL: [&str; 3] = ["spring_group", "mass_group", "frequency_scale"];

/// Smallest gain in log-likelihood of the true model, for one effect and for an effect outside the laws, nats.
const LEAST_NATS: (f64, f64) = (20.0, 30.0);

type Family = (&'static str, &'static str);

/// Draws worlds until the effect is detectable in one of them.
pub fn draw(seed: u64, kind: Kind) -> World {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let single = |rng: &mut ChaCha8Rng| *SINGLE_FAMILIES.choose(rng).expect("there are families");
    match kind {
        Kind::Nothing => search(seed, &mut rng, &[], None).expect("most structures are suitable"),
        Kind::Single => {
            let family = single(&mut rng);
            search(seed, &mut rng, &[family], None).expect("every family is detectable in some structure")
        }
        Kind::Two => loop {
            let pair = [single(&mut rng), single(&mut rng)];
            if compatible(pair) {
                if let Some(world) = search(seed, &mut rng, &pair, None) {
                    break world;
                }
            }
        },
        Kind::Outside => {
            let name = OUTSIDE.choose(&mut rng).expect("there are some");
            search(seed, &mut rng, &[], Some(name)).expect("every one is detectable in some structure")
        }
    }
}

/// Draws a world with one effect of a given family of [`SINGLE_FAMILIES`].
pub fn draw_single(seed: u64, target: &str, law: &str) -> World {
    let index = SINGLE_FAMILIES.iter().position(|f| *f == (target, law)).expect("a family of the list");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(1 + index as u64);
    search(seed, &mut rng, &[SINGLE_FAMILIES[index]], None).expect("every family is detectable in some structure")
}

/// Whether two effects can be distinguished: their targets differ, and neither can replace the other.
fn compatible(pair: [Family; 2]) -> bool {
    let both = |list: &[&str]| pair.iter().all(|f| list.contains(&f.0));
    pair[0].0 != pair[1].0
        && !both(&GLOBAL)
        && !both(&["oscillator", "mode_assignment"])
        && !pair.iter().all(|f| f.1 == "constant")
}

fn search(seed: u64, rng: &mut ChaCha8Rng, families: &[Family], outside: Option<&'static str>) -> Option<World> {
    let most = if families.len() > 1 { 300 } else { 20_000 };
    (1..=most).find_map(|attempt| {
        let mut world = attempt_world(rng, families, outside)?;
        world.seed = seed;
        let _ = write!(world.description, ", draw {attempt}");
        Some(world)
    })
}

fn attempt_world(rng: &mut ChaCha8Rng, families: &[Family], outside: Option<&'static str>) -> Option<World> {
    let structure = Structure::draw(rng, families)?;
    let population = structure
        .free
        .iter()
        .map(|&s| {
            let mean = structure.springs[s].n_per_m * rng.random_range(0.92..1.08);
            (mean, mean * rng.random_range(0.003..0.015))
        })
        .collect::<Vec<_>>();
    let weather = Weather::draw(rng);
    let mut rows = draw_rows(rng, &structure, &weather);
    let mut effects = Vec::new();
    for family in families {
        effects.push(draw_effect(rng, &structure, &weather, &rows, *family)?);
    }
    if let Some(name) = outside {
        effects.push(draw_outside(rng, &structure, &weather, &rows, name));
    }
    measure(rng, &structure, &population, &effects, &mut rows)?;

    let (seen, unseen) = rows.split_at(training_rows(rows.len()));
    let all = effects.iter().collect::<Vec<_>>();
    let truth = Fit {
        theta: population.iter().map(|p| p.0).chain(effects.iter().map(|_| 1.0)).collect(),
        spreads: population.iter().map(|p| p.1).collect(),
        noise: structure.noise,
        log_likelihood: 0.0,
    };
    let log_likelihood =
        |effects: &[&Effect], fit: &Fit, rows: &[Row]| Data::new(&structure, effects, rows).log_likelihood_of(fit);
    let true_log_likelihood = log_likelihood(&all, &truth, seen)?;
    let base = Data::new(&structure, &[], seen).fit(&truth.theta)?;
    let nats = true_log_likelihood - base.log_likelihood;
    let least = if outside.is_some() { LEAST_NATS.1 } else { LEAST_NATS.0 };
    if structure.on_edge(&base.theta) || (!effects.is_empty() && nats < least) {
        return None;
    }
    if let [first, second] = &all[..] {
        for other in [first, second] {
            let reduced = Data::new(&structure, &[other], seen).fit(&truth.theta)?;
            if true_log_likelihood - reduced.log_likelihood < LEAST_NATS.0 {
                return None;
            }
        }
    }
    let scored = unseen.iter().filter(|r| !r.outlier).count() as f64;
    let hidden = effects.iter().map(|e| e.truth.clone()).collect::<Vec<_>>();
    let (truths, outside_target) =
        if outside.is_some() { (Vec::new(), hidden.first().cloned()) } else { (hidden, None) };
    Some(World {
        seed: 0,
        structure_toml: structure.toml(),
        csv: csv(&structure, &rows, None),
        description: describe(&structure, rows.len(), &truths, outside, nats),
        truths,
        outside,
        outside_target,
        nats,
        holdout_rms_percent: (
            Data::rms_percent(&structure, &[], unseen, &base)?,
            Data::rms_percent(&structure, &all, unseen, &truth)?,
        ),
        holdout_log_density: (
            log_likelihood(&[], &base, unseen)? / scored,
            log_likelihood(&all, &truth, unseen)? / scored,
        ),
        structure,
        effects,
        rows,
    })
}

fn describe(structure: &Structure, rows: usize, truths: &[Truth], outside: Option<&'static str>, nats: f64) -> String {
    let free = structure.free.iter().map(|&s| structure.springs[s].name.as_str()).collect::<Vec<_>>().join(" ");
    let mut text = format!(
        "{} masses, {} springs, {} modes, free {free}, {rows} rows, noise {:.2} %:",
        structure.masses_kg.len(),
        structure.springs.len(),
        structure.modes,
        100.0 * structure.noise
    );
    for truth in truths {
        let ends = truth.between.as_ref().map_or(String::new(), |(a, b)| format!(" {a}-{b}"));
        let covariate = truth.covariate.as_ref().map_or(String::new(), |c| format!(" {c}"));
        let level = truth.level.as_ref().map_or(String::new(), |l| format!("={l}"));
        let (kind, name, law, size) = (truth.kind, &truth.name, truth.law, truth.size);
        let _ = write!(text, " {kind} {name}{ends} {law}{covariate}{level} {size:.4};");
    }
    let _ = write!(text, " {}{nats:.0} nats", outside.map_or(String::new(), |o| format!("{o}; ")));
    text
}
