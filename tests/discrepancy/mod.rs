//! `modalwatch diagnose` on synthetic worlds with known hidden effects: target, size and gain must be right, nothing may be found
//! where nothing is hidden, and no false cause may be named where no law fits. The program is run on files, as a user runs it.

mod everywhere;
mod further;
mod lasting;
mod learned;
mod next;
mod places;
mod reliability;
mod sentences;
mod settings;
mod spectrum;
mod tables;
mod world;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Mutex;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use serde_json::Value;
use world::{Kind, Truth, World};

/// Difference in log evidence, nats, below which two causes cannot be distinguished.
const EQUIVALENT_NATS: f64 = 5.0;

/// Greatest number of causes that an ambiguous answer names.
const MOST_NAMED: usize = 8;

/// Share of the gain of the true model on the rows held out that a diagnosis should reach.
const GAIN: f64 = 0.8;

// ---- Running ----

/// Runs `modalwatch diagnose` on a structure and measurements.
fn diagnose(structure_toml: &str, csv: &str, options: &[&str]) -> Output {
    let folder = tempfile::tempdir().unwrap();
    let (structure, data) = (folder.path().join("world.toml"), folder.path().join("world.csv"));
    fs::write(&structure, structure_toml).unwrap();
    fs::write(&data, csv).unwrap();
    let file = |name: &str, path: &Path| [name.to_owned(), path.to_str().unwrap().to_owned()];
    Command::new(env!("CARGO_BIN_EXE_modalwatch"))
        .arg("diagnose")
        .args(file("--structure", &structure))
        .args(file("--data", &data))
        .args(options)
        .output()
        .unwrap()
}

/// The JSON answer of a run that must succeed.
fn answer(structure_toml: &str, csv: &str, options: &[&str]) -> Value {
    let output = diagnose(structure_toml, csv, &[&["--json"], options].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// The error message of a run that must fail.
fn refusal(structure_toml: &str, csv: &str, options: &[&str]) -> String {
    let output = diagnose(structure_toml, csv, options);
    assert!(!output.status.success(), "should have been refused: {}", String::from_utf8_lossy(&output.stdout));
    String::from_utf8(output.stderr).unwrap()
}

/// A world to draw: with one effect of a given family, or of a given kind.
#[derive(Clone, Copy)]
enum Order {
    Family(u64, &'static str, &'static str),
    Kind(u64, Kind),
}

impl Order {
    fn draw(self) -> (Kind, World) {
        match self {
            Self::Family(seed, target, law) => (Kind::Single, world::draw_single(seed, target, law)),
            Self::Kind(seed, kind) => (kind, world::draw(seed, kind)),
        }
    }
}

/// Results of a computation for each item, computed in parallel on all cores, in the order of the items.
fn in_parallel<T: Sync, R: Send>(items: &[T], compute: impl Fn(&T) -> R + Sync) -> Vec<R> {
    let next = AtomicUsize::new(0);
    let done = Mutex::new(BTreeMap::new());
    let work = || loop {
        let index = next.fetch_add(1, Ordering::Relaxed);
        let Some(item) = items.get(index) else { break };
        let result = compute(item);
        done.lock().unwrap().insert(index, result);
    };
    let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    std::thread::scope(|scope| (0..threads).for_each(|_| drop(scope.spawn(work))));
    done.into_inner().unwrap().into_values().collect()
}

/// Draws worlds, runs the program on each and judges the answers; the results are in the order given.
fn judged(orders: &[Order]) -> Vec<Judged> {
    in_parallel(orders, |order| {
        let (kind, world) = order.draw();
        let answer = answer(&world.structure_toml, &world.csv, &[]);
        Judged::new(kind, world, answer)
    })
}

// ---- Judging ----

/// Whether a target multiplies all frequencies by one factor; such targets are equivalent.
fn acts_on_all(kind: &str, name: &str) -> bool {
    matches!((kind, name), ("spring_group" | "mass_group", "all") | ("frequency_scale", ""))
}

/// Factor on all frequencies of an effect of such a kind; [`from_frequency`] is the inverse.
fn to_frequency(kind: &str, size: f64) -> f64 {
    match kind {
        "spring_group" => (1.0 + size).sqrt(),
        "mass_group" => 1.0 / (1.0 + size).sqrt(),
        _ => 1.0 + size,
    }
}

fn from_frequency(kind: &str, factor: f64) -> f64 {
    match kind {
        "spring_group" => factor * factor - 1.0,
        "mass_group" => 1.0 / (factor * factor) - 1.0,
        _ => factor - 1.0,
    }
}

fn list<'a>(value: &'a Value, name: &str) -> &'a [Value] {
    value[name].as_array().map_or(&[], Vec::as_slice)
}

fn target(cause: &Value) -> (&str, &str) {
    let part = |name: &str| cause["target"][name].as_str().unwrap();
    (part("kind"), part("name"))
}

/// Whether a cause has the target, covariate and category of the hidden effect; its law may differ.
fn names(cause: &Value, truth: &Truth) -> bool {
    let (kind, name) = target(cause);
    let between = || {
        let ends = list(&cause["target"], "between").iter().filter_map(Value::as_str).collect::<Vec<_>>();
        truth.between.as_ref().is_some_and(|(from, to)| ends == [from, to])
    };
    let place = match truth.kind {
        "added_spring" => kind == "added_spring" && between(),
        "mode_assignment" => kind == "mode_assignment",
        _ if acts_on_all(truth.kind, &truth.name) => acts_on_all(kind, name),
        _ => (kind, name) == (truth.kind, truth.name.as_str()),
    };
    // A cause in which each category has its own number has no level.
    let level = cause["target"]["level"].as_str();
    let same_level = truth.level.is_none() || level.is_none() || level == truth.level.as_deref();
    place && cause["covariate"].as_str() == truth.covariate.as_deref() && same_level
}

/// Whether the true size lies in the 90 % interval of a cause that names it; `None` if the sizes are not comparable.
fn size_inside(cause: &Value, truth: &Truth) -> Option<bool> {
    let first = list(cause, "parameters").first()?;
    let (kind, _) = target(cause);
    // The error of a setting can also be stated as a share of its value.
    let incomparable = kind == "setting" && first["unit"] == "share";
    if incomparable || truth.kind == "mode_assignment" {
        return None;
    }
    let size = if kind == truth.kind { truth.size } else { from_frequency(kind, to_frequency(truth.kind, truth.size)) };
    let edge = |side: usize| first["interval90"][side].as_f64().unwrap();
    Some((edge(0)..=edge(1)).contains(&size))
}

/// A world with the answer and its judgement.
struct Judged {
    kind: Kind,
    world: World,
    answer: Value,
    /// Whether the answer is right for a world of this kind.
    right: bool,
    /// For a single effect with the right target: whether the size is inside its interval.
    size_inside: Option<bool>,
    /// Gain of the answer on the rows held out, as a share of that of the true model.
    gain: f64,
}

impl Judged {
    fn new(kind: Kind, world: World, answer: Value) -> Self {
        assert!(kind == Kind::Nothing || world.nats >= 20.0, "the hidden effect is not detectable");
        let right = match kind {
            Kind::Nothing => answer["verdict"] == "nothing_found",
            Kind::Single => named(&answer, &world.truths[0]).is_some(),
            Kind::Two => both_named(&answer, &world.truths),
            Kind::Outside => confident_wrong_name(&answer, world.outside_target.as_ref().unwrap()).is_none(),
        };
        let size_inside = match &world.truths[..] {
            [truth] => named(&answer, truth).and_then(|cause| size_inside(cause, truth)),
            _ => None,
        };
        let (base, truth) = world.holdout_log_density;
        // Without a cause there is no gain.
        let gain = answer["gain"]["log_density_per_row"]["after"].as_f64().map_or(0.0, |a| (a - base) / (truth - base));
        Self { kind, world, answer, right, size_inside, gain }
    }

    fn verdict(&self) -> &str {
        self.answer["verdict"].as_str().unwrap()
    }

    /// The world and the answer as text.
    fn text(&self) -> String {
        let World { seed, description, holdout_rms_percent: (base, truth), .. } = &self.world;
        let mut text = format!("seed {seed}: {description}; held out {base:.3} % -> {truth:.3} %");
        let inside = self.size_inside.map_or("", |inside| if inside { ", size inside" } else { ", size OUTSIDE" });
        let _ = write!(text, "\n    {}, gain {:.2}{inside}", self.verdict(), self.gain);
        let one = |cause: &Value| {
            let (kind, name) = target(cause);
            let between = list(&cause["target"], "between").iter().filter_map(Value::as_str).collect::<Vec<_>>();
            let word = |value: &Value| value.as_str().unwrap_or("-").to_owned();
            let (law, covariate, level) =
                (word(&cause["law"]), word(&cause["covariate"]), word(&cause["target"]["level"]));
            format!("{kind} {name}{} {law} {covariate} {level}", between.join("-"))
        };
        for cause in list(&self.answer, "causes") {
            let _ = write!(text, "\n    cause: {} {:.3}", one(cause), cause["probability"].as_f64().unwrap());
            if let Some(first) = list(cause, "parameters").first() {
                let edge = |side: usize| first["interval90"][side].as_f64().unwrap();
                let _ = write!(text, " in {:.4} … {:.4}", edge(0), edge(1));
            }
        }
        for other in list(&self.answer, "alternatives").iter().take(6) {
            let nats = other["log_evidence_difference"].as_f64().unwrap();
            let _ = write!(text, "\n    instead of {}: {} {nats:+.1} nats", other["instead_of"], one(other));
        }
        if let Some(function) = self.answer["remainder"]["function"].as_str() {
            let p = self.answer["remainder"]["p_value"].as_f64().unwrap();
            let _ = write!(text, "\n    left: {function}, p = {p:.1e}");
        }
        text
    }
}

/// Whether an alternative is the effect, and nearly as probable as the cause that it would replace.
fn as_good(other: &Value, truth: &Truth) -> bool {
    names(other, truth) && other["log_evidence_difference"].as_f64().unwrap() > -EQUIVALENT_NATS
}

/// The cause that names the one hidden effect: the first, or one of the first three of an ambiguous answer.
fn named<'a>(answer: &'a Value, truth: &Truth) -> Option<&'a Value> {
    let causes = list(answer, "causes");
    match answer["verdict"].as_str()? {
        "cause" => causes.first().filter(|cause| names(cause, truth)),
        "ambiguous" => {
            assert!(causes.len() <= MOST_NAMED, "{} causes are too many for an answer", causes.len());
            let first = names(&causes[0], truth);
            let equivalent = first || list(answer, "alternatives").iter().any(|other| as_good(other, truth));
            causes.iter().take(3).find(|cause| names(cause, truth)).filter(|_| equivalent)
        }
        _ => None,
    }
}

/// Whether two hidden effects are named by two of several causes, or by alternatives that cannot be distinguished from them.
fn both_named(answer: &Value, truths: &[Truth]) -> bool {
    let places = |truth: &Truth| {
        let causes = list(answer, "causes").iter().enumerate();
        let chosen = causes.filter(|(_, cause)| names(cause, truth)).map(|(index, _)| index as u64 + 1);
        let others = list(answer, "alternatives").iter().filter(|other| as_good(other, truth));
        chosen.chain(others.map(|other| other["instead_of"].as_u64().unwrap())).collect::<BTreeSet<_>>()
    };
    let (first, second) = (places(&truths[0]), places(&truths[1]));
    answer["verdict"] == "several" && first.iter().any(|a| second.iter().any(|b| a != b))
}

/// A cause with a high probability whose target or covariate differs from that of the hidden effect, in an answer that does not
/// report a remainder.
fn confident_wrong_name<'a>(answer: &'a Value, hidden: &Truth) -> Option<&'a Value> {
    let columns = hidden.covariate.as_deref().unwrap().split(world::AND).collect::<Vec<_>>();
    let wrong = |cause: &&Value| {
        let mut covariates = cause["covariate"].as_str().unwrap_or_default().split(PRODUCT);
        target(cause) != (hidden.kind, hidden.name.as_str()) || !covariates.all(|c| columns.contains(&c))
    };
    let sure = |cause: &&Value| cause["probability"].as_f64().unwrap() > 0.9;
    list(answer, "causes").iter().filter(sure).find(wrong).filter(|_| answer["verdict"] != "none_of_these")
}

/// Joins the names of two covariates in an answer.
const PRODUCT: &str = " × ";

/// Number of worlds that hide a product of two covariates, and of those in which it was named on the right target.
fn products_named(judged: &[Judged]) -> (usize, usize) {
    let worlds = judged.iter().filter(|j| j.world.outside.is_some_and(|o| o.starts_with("product")));
    let named = |j: &&Judged| {
        let hidden = j.world.outside_target.as_ref().unwrap();
        let columns = hidden.covariate.as_deref().unwrap().split(world::AND).collect::<BTreeSet<_>>();
        let product = |cause: &Value| {
            let covariates = cause["covariate"].as_str().unwrap_or_default().split(PRODUCT).collect::<BTreeSet<_>>();
            cause["law"] == "product" && covariates == columns && target(cause) == (hidden.kind, hidden.name.as_str())
        };
        list(&j.answer, "causes").iter().any(product)
    };
    (worlds.clone().count(), worlds.filter(named).count())
}

// ---- Counting ----

/// The worlds of one kind.
struct Tally<'a> {
    all: Vec<&'a Judged>,
}

impl<'a> Tally<'a> {
    fn new(judged: &'a [Judged], kind: Kind) -> Self {
        Self { all: judged.iter().filter(|j| j.kind == kind).collect() }
    }

    fn worlds(&self) -> usize {
        self.all.len()
    }

    fn count(&self, good: impl Fn(&Judged) -> bool) -> usize {
        self.all.iter().filter(|j| good(j)).count()
    }

    fn share(&self, good: impl Fn(&Judged) -> bool) -> f64 {
        self.count(good) as f64 / self.worlds() as f64
    }

    fn right(&self) -> usize {
        self.count(|j| j.right)
    }

    /// Number of worlds whose size is comparable, and of those whose size is inside its interval.
    fn sizes(&self) -> (usize, usize) {
        (self.count(|j| j.size_inside.is_some()), self.count(|j| j.size_inside == Some(true)))
    }

    fn median_gain(&self) -> f64 {
        let mut gains = self.all.iter().map(|j| j.gain).collect::<Vec<_>>();
        gains.sort_by(f64::total_cmp);
        gains[gains.len() / 2]
    }
}

/// Prints a table of the hidden target against the target of the first cause, the counts, and every miss.
fn report(judged: &[Judged]) {
    let mut table = BTreeMap::<String, BTreeMap<String, usize>>::new();
    for j in judged.iter().filter(|j| j.kind != Kind::Two) {
        let hidden = match j.kind {
            Kind::Single => j.world.truths[0].kind,
            Kind::Nothing => "(nothing)",
            Kind::Two | Kind::Outside => "(outside)",
        };
        let named = match j.verdict() {
            "nothing_found" | "none_of_these" => format!("({})", j.verdict()),
            _ => target(&j.answer["causes"][0]).0.to_owned(),
        };
        *table.entry(hidden.to_owned()).or_default().entry(named).or_default() += 1;
    }
    let columns = table.values().flat_map(BTreeMap::keys).collect::<BTreeSet<_>>();
    println!("hidden \\ named first");
    let header = columns.iter().fold(String::new(), |text, column| format!("{text} {column:>17}"));
    println!("{:17}{header}", "");
    for (hidden, counts) in &table {
        let cell = |column: &&String| counts.get(*column).map_or("·".to_owned(), ToString::to_string);
        let cells = columns.iter().map(cell).fold(String::new(), |text, cell| format!("{text} {cell:>17}"));
        println!("{hidden:17}{cells}");
    }
    for j in judged.iter().filter(|j| !j.right) {
        println!("MISS {}", j.text());
    }
    for j in
        judged.iter().filter(|j| j.right && (j.size_inside == Some(false) || (j.kind == Kind::Single && j.gain < GAIN)))
    {
        println!("FAR {}", j.text());
    }
    let single = Tally::new(judged, Kind::Single);
    let (compared, inside) = single.sizes();
    let gained = single.count(|j| j.gain >= GAIN);
    println!(
        "single: {} of {} right, size inside {inside} of {compared}, gain >= {GAIN} in {gained}, median gain {:.3}",
        single.right(),
        single.worlds(),
        single.median_gain()
    );
    for (name, kind) in [("nothing", Kind::Nothing), ("two", Kind::Two), ("outside", Kind::Outside)] {
        let tally = Tally::new(judged, kind);
        println!("{name}: {} of {} right", tally.right(), tally.worlds());
    }
    let honest = Tally::new(judged, Kind::Outside).count(|j| j.verdict() == "none_of_these");
    let extra = Tally::new(judged, Kind::Two).count(|j| list(&j.answer, "causes").len() > 2);
    println!("outside: {honest} called none of these; two: {extra} with a third cause");
}

/// Number of worlds with hysteresis, and of those in which it was diagnosed as a lag of the right spring.
fn hysteresis_taken_for_a_lag(judged: &[Judged]) -> (usize, usize) {
    let worlds = judged.iter().filter(|j| j.world.outside.is_some_and(|o| o.starts_with("hysteresis")));
    let lagged = |j: &&Judged| {
        let hidden = j.world.outside_target.as_ref().unwrap();
        list(&j.answer, "causes").iter().any(|cause| cause["law"] == "lagged" && names(cause, hidden))
    };
    (worlds.clone().count(), worlds.filter(lagged).count())
}

/// Worlds of a kind from consecutive seeds.
fn orders(first_seed: u64, count: u64, kind: Kind) -> impl Iterator<Item = Order> {
    (first_seed..first_seed + count).map(move |seed| Order::Kind(seed, kind))
}

// ---- Worlds ----

#[test]
fn hidden_effects_are_found_in_a_fixed_set_of_worlds() {
    let families = world::SINGLE_FAMILIES.iter().zip(5000..);
    let singles = families.map(|((target, law), seed)| Order::Family(seed, target, law));
    let others = orders(5100, 6, Kind::Nothing).chain(orders(5200, 5, Kind::Two)).chain(orders(5300, 4, Kind::Outside));
    let judged = judged(&singles.chain(others).collect::<Vec<_>>());
    report(&judged);

    // Of two hundred worlds 95.5 % are right and 94.5 % gain enough: of 29, 27.7 ± 1.1 and 27.4 ± 1.2; the bounds are 0.6 and 1.9
    // standard errors below.
    let single = Tally::new(&judged, Kind::Single);
    assert!(single.right() + 2 >= single.worlds(), "{} wrong places", single.worlds() - single.right());
    // 90 % of 27: 24.3 ± 1.6, and the bound is 1.5 standard errors below. All 27 inside happen by chance in 6 % of such sets, so
    // that there is no bound above; the test of two hundred worlds has one.
    let (compared, inside) = single.sizes();
    assert!(compared >= 25 && inside >= 22, "{inside} of {compared} sizes inside");
    assert!(single.count(|j| j.gain >= GAIN) >= 25, "gains");
    // Of sixty worlds each 60, 57 and 59 are right. Of 6, 5 and 4 that makes 6, 4.75 ± 0.5 and 3.93 ± 0.26: three standard errors
    // below are 4.9 (were one of sixty wrong), 3.3 and 3.2.
    assert!(Tally::new(&judged, Kind::Nothing).right() >= 5, "something in nothing");
    assert!(Tally::new(&judged, Kind::Two).right() >= 4, "two effects");
    assert_eq!(Tally::new(&judged, Kind::Outside).right(), 4, "confident wrong names");
}

#[test]
fn a_dependence_with_a_large_constant_part_is_found() {
    // The parameters adapt to the constant part, so that a score test promises nothing for the dependence. Both worlds were missed once: a spring
    // that depends on the temperature where the file has none, and a mass that depends on the humidity beside another effect.
    let judged = judged(&[Order::Kind(10_169, Kind::Single), Order::Kind(30_033, Kind::Two)]);
    report(&judged);
    assert!(judged.iter().all(|j| j.right));
}

#[test]
#[ignore = "10 minutes"]
fn hidden_effects_are_found_in_two_hundred_worlds() {
    let singles = orders(10_000, 200, Kind::Single);
    let others =
        orders(20_000, 60, Kind::Nothing).chain(orders(30_000, 60, Kind::Two)).chain(orders(40_000, 60, Kind::Outside));
    let judged = judged(&singles.chain(others).collect::<Vec<_>>());
    report(&judged);
    let (worlds, lagged) = hysteresis_taken_for_a_lag(&judged);
    println!("hysteresis: taken for a lag of the right spring in {lagged} of {worlds}");
    let (products, named) = products_named(&judged);
    println!("products: named on the right target in {named} of {products}");

    let single = Tally::new(&judged, Kind::Single);
    assert!(single.share(|j| j.right) >= 0.95, "{} single effects in the right place", single.right());
    let (compared, inside) = single.sizes();
    // A share of 182 scatters by 0.022 about 0.9: 3.5 times that below and 3.2 times above. The program reaches 0.874.
    let coverage = inside as f64 / compared as f64;
    assert!((0.822..=0.97).contains(&coverage), "{inside} of {compared} sizes inside");
    assert!(single.median_gain() >= GAIN, "median gain {}", single.median_gain());
    // Shares of sixty: the program reaches 1, 0.95 ± 0.028 and 0.983 ± 0.017; three standard errors below, for nothing hidden
    // three worlds.
    for (kind, least) in [(Kind::Nothing, 0.95), (Kind::Two, 0.866), (Kind::Outside, 0.93)] {
        let tally = Tally::new(&judged, kind);
        assert!(tally.share(|j| j.right) >= least, "{kind:?}: {} of {} right", tally.right(), tally.worlds());
    }
}

#[test]
fn a_softening_spring_is_found_in_simulated_time_histories() {
    let world = spectrum::softening_world(1);
    let answer = answer(&world.structure_toml, &world.csv, &[]);
    let scatter = world.scatter.map(|s| format!("{:.3} %", 100.0 * s)).join(", ");
    println!("seed {}: {}; scatter {scatter}: {}", world.seed, world.description, answer["summary"]);
    let cause = named(&answer, &world.truth).expect("the softening spring, with amplitude");
    let range = cause["parameters"][0]["value"].as_f64().unwrap();
    let size = world.truth.size;
    assert!((range / size - 1.0).abs() < 0.25, "effect range {range}, by equivalent linearisation {size}");
}

// ---- Tables ----

/// Masses, springs and noise of a chain of three masses; its first spring is the only free parameter.
const CHAIN_KG: [f64; 3] = [1.0, 1.2, 0.8];
const CHAIN_N_PER_M: [f64; 3] = [4000.0, 3000.0, 2000.0];
const CHAIN_NOISE: f64 = 0.002;

fn chain_toml() -> String {
    let name = |kind: &str, index: usize| format!("{kind}{}", index + 1);
    let masses = (0..3).map(|i| (name("m", i), CHAIN_KG[i])).collect::<Vec<_>>();
    let from = |i: usize| if i == 0 { "ground".to_owned() } else { name("m", i - 1) };
    let springs = (0..3).map(|i| (name("k", i), from(i), name("m", i), CHAIN_N_PER_M[i])).collect::<Vec<_>>();
    world::structure_toml(3, CHAIN_NOISE, &masses, &springs, &[name("k", 0)])
}

/// Measurements of chains that agree with the structure file, with further columns.
fn chain_csv(rows: usize, columns: &str, cells: impl Fn(usize, &mut ChaCha8Rng) -> String) -> String {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut text = format!("measured_at,f1_hz,f2_hz,f3_hz,{columns}\n");
    for row in 0..rows {
        let normals = [(); 4].map(|()| rng.sample::<f64, _>(StandardNormal));
        let first_n_per_m = CHAIN_N_PER_M[0] * (1.0 + 0.01 * normals[3]);
        let springs = [(None, 0, first_n_per_m), (Some(0), 1, CHAIN_N_PER_M[1]), (Some(1), 2, CHAIN_N_PER_M[2])];
        let hz = world::frequencies_hz(&CHAIN_KG, &springs).unwrap();
        text += &world::rfc3339(world::EPOCH_2024_S + 40_000 * row as i64);
        for (f, normal) in hz.iter().zip(normals) {
            let _ = write!(text, ",{}", world::number(f * (1.0 + CHAIN_NOISE * normal)));
        }
        let _ = writeln!(text, ",{}", cells(row, &mut rng));
    }
    text
}

/// The table with all values of one column removed.
fn emptied(csv: &str, column: &str) -> String {
    let place = csv.lines().next().unwrap().split(',').position(|name| name == column).unwrap();
    let without = |(line, text): (usize, &str)| {
        let keep = |(cell, value)| if line > 0 && cell == place { "" } else { value };
        text.split(',').enumerate().map(keep).collect::<Vec<_>>().join(",") + "\n"
    };
    csv.lines().enumerate().map(without).collect()
}

fn celsius(rng: &mut ChaCha8Rng) -> String {
    world::number(rng.random_range(-5.0..25.0))
}

/// Asserts that nothing is found in a table and that a note contains all `words`.
fn noted(csv: &str, words: &[&str]) {
    let answer = answer(&chain_toml(), csv, &[]);
    assert_eq!(answer["verdict"], "nothing_found", "{}", answer["summary"]);
    let notes = list(&answer, "notes").iter().map(|note| note.as_str().unwrap()).collect::<Vec<_>>();
    assert!(notes.iter().any(|note| words.iter().all(|word| note.contains(word))), "{words:?} in {notes:?}");
}

/// Asserts that a table is refused with a message that contains all `words`.
fn refused(csv: &str, options: &[&str], words: &[&str]) {
    let text = refusal(&chain_toml(), csv, options);
    assert!(words.iter().all(|word| text.contains(word)), "{words:?} in {text:?}");
}

#[test]
fn bad_data_get_clear_answers() {
    let weather = |rows| chain_csv(rows, "temperature_c", |_, rng| celsius(rng));
    let operators = chain_csv(120, "operator", |row, _| ["A", "B", "C"][row % 3].to_owned());

    refused(&weather(7), &[], &["7 measurements", "at least 8"]);
    // A quarter is held out if 30 rows remain.
    noted(&weather(36), &["36 rows are few"]);
    noted(&weather(40), &["30 rows are few"]);

    noted(&chain_csv(120, "temperature_c", |_, _| "21.5".to_owned()), &["temperature_c", "21.5 in every row"]);
    noted(&chain_csv(120, "operator", |_, _| "A".to_owned()), &["operator", "A in every row"]);
    noted(&emptied(&weather(120), "f3_hz"), &["mode 3 was never measured"]);
    let together = |_, rng: &mut ChaCha8Rng| {
        let c = rng.random_range(-5.0..25.0);
        format!("{c:.3},{:.3}", 70.0 - 1.5 * c + rng.random_range(-0.1..0.1))
    };
    let collinear = chain_csv(120, "temperature_c,humidity_percent", together);
    noted(&collinear, &["temperature_c", "humidity_percent", "cannot tell which"]);

    refused(&weather(120).replace("f1_hz", "first_hz"), &[], &["f1_hz", "3 modes"]);
    refused(&operators, &["--holdout", "where:lab=B"], &["lab", "there are operator, time"]);
    refused(&operators, &["--holdout", "where:operator=D"], &["operator = D", "A, B, C"]);
    refused(&weather(120), &["--holdout", "where:temperature_c=3"], &["temperature_c", "numbers"]);
    refused(&weather(120), &["--holdout", "first:0.2"], &["last:0.25"]);

    let answer = answer(&chain_toml(), &operators, &["--holdout", "where:operator=B"]);
    assert_eq!((&answer["training_rows"], &answer["holdout_rows"]), (&80.into(), &40.into()));
}

#[test]
fn the_same_question_gets_the_same_answer_and_the_seed_moves_only_bootstrap_intervals() {
    let world = world::draw_single(1, "spring", "linear");
    let json = |options: &[&str]| {
        let output = diagnose(&world.structure_toml, &world.csv, &[&["--json"], options].concat());
        assert!(output.status.success());
        output.stdout
    };
    let first = json(&[]);
    assert!(first == json(&[]), "two runs differ");

    let [mut one, mut other] = [first, json(&["--seed", "1001"])].map(|j| serde_json::from_slice::<Value>(&j).unwrap());
    assert_ne!(one, other);
    for answer in [&mut one, &mut other] {
        answer["seed"] = Value::Null;
        answer["gain"]["rms_difference_interval90"] = Value::Null;
    }
    assert_eq!(one, other);
}

#[test]
fn two_laboratories_differ_by_something_common_and_not_by_three_storeys() {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR"));
    let data = repository.join("../shared/data/ruler-frame-4dof/ruler_frame_frequencies.csv");
    if !data.exists() {
        crate::needs::missing("the data ../shared/data/ruler-frame-4dof, which are not part of the repository");
        return;
    }
    let output = Command::new(env!("CARGO_BIN_EXE_modalwatch"))
        .args(["diagnose", "--structure", "ruler-frame-4dof", "--holdout", "last:0", "--json"])
        .args(["--ignore", "zeta1,zeta2,zeta3,zeta4,measurement", "--data"])
        .arg(&data)
        .output()
        .unwrap();
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    println!("{}", answer["summary"].as_str().unwrap());
    let first = &answer["causes"][0];
    assert_eq!(first["covariate"], "lab");
    let common = [("mass_group", "all"), ("spring_group", "all"), ("frequency_scale", "")];
    let target = (first["target"]["kind"].as_str().unwrap(), first["target"]["name"].as_str().unwrap());
    assert!(common.contains(&target), "{first}");
    // Three equivalent targets: none of them may have a high probability.
    assert!(first["probability"].as_f64().unwrap() < 0.9);
}

#[test]
fn an_extended_structure_explains_its_data_and_half_an_effect_is_not_enough() {
    let world = world::draw_single(5_008, "spring_group", "linear");
    let folder = tempfile::tempdir().unwrap();
    let (structure, data) = (folder.path().join("world.toml"), folder.path().join("world.csv"));
    fs::write(&structure, &world.structure_toml).unwrap();
    fs::write(&data, &world.csv).unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_modalwatch"))
        .args(["extend", "--no-training", "--structure"])
        .arg(&structure)
        .arg("--data")
        .arg(&data)
        .arg("--out")
        .arg(folder.path().join("extended"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let written = folder.path().join("extended/structure.json");
    let verdict = |structure: &Path| -> Value {
        let output = Command::new(env!("CARGO_BIN_EXE_modalwatch"))
            .args(["diagnose", "--json", "--structure"])
            .arg(structure)
            .arg("--data")
            .arg(&data)
            .output()
            .unwrap();
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let answer = verdict(&written);
    assert_eq!(answer["verdict"], "nothing_found", "{}", answer["summary"]);
    // The effect with half the slope in the structure must not prevent that the other half is found.
    let mut half: Value = serde_json::from_str(&fs::read_to_string(&written).unwrap()).unwrap();
    let slope = half["effect"][0]["numbers"]["slope_per_unit"].as_f64().unwrap();
    half["effect"][0]["numbers"]["slope_per_unit"] = (0.5 * slope).into();
    let halved = folder.path().join("half.json");
    fs::write(&halved, half.to_string()).unwrap();
    let answer = verdict(&halved);
    let first = &answer["causes"][0];
    let common = ["spring_group", "mass_group", "frequency_scale"];
    assert!(common.contains(&first["target"]["kind"].as_str().unwrap()), "{}", answer["summary"]);
    assert_eq!(first["covariate"], "temperature_c");
}
