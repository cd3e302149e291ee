//! Worlds with a known secret: a random structure, and measurements of it that hide an effect the structure file does
//! not know. Everything is this file's own (assembly, eigenvalues, effects, likelihood), so that a mistake of the
//! program cannot hide behind the same mistake here.

use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};
use std::fmt::Write as _;

use rand::seq::{IndexedRandom, SliceRandom};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

/// What a world hides.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// The structure file is right.
    Nothing,
    /// One effect of [`SINGLE_FAMILIES`].
    Single,
    /// Two effects of different targets.
    Two,
    /// An effect that no single law of the program describes.
    Outside,
}

/// One hidden effect.
#[derive(Debug, Clone)]
pub struct Truth {
    /// What it acts on: `spring`, `spring_group`, `mass`, `mass_group`, `frequency_scale`, `frequency_offset`,
    /// `setting`, `added_spring`, `oscillator` or `mode_assignment`.
    pub kind: &'static str,
    /// Name of the target: `k2`, `all` for groups, `mode 2`, empty for all modes; the host mass of an oscillator.
    pub name: String,
    /// Ends of an added spring, ground first, then in the order of the masses.
    pub between: Option<(String, String)>,
    /// `constant`, `linear`, `bilinear`, `quadratic`, `exponential`, `category`, `step` or `lagged`.
    pub law: &'static str,
    /// The column it follows, `time` for a step, none for a constant.
    pub covariate: Option<String>,
    /// The level that differs, for a category.
    pub level: Option<String>,
    /// Numeric covariates: the effect at the 95 % quantile of the column less that at the 5 % quantile (lagged: slope
    /// times the difference of the quantiles). Otherwise the effect itself. Relative for springs, masses and scales;
    /// in the parameter's unit for settings, Hz for offsets, N/m for added springs, kg for oscillators.
    pub size: f64,
}

/// A structure file, measurements, and what they hide.
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
    /// The effect in words where no law of the program describes it.
    pub outside: Option<&'static str>,
    /// What that effect acts on: kind, name and the swing; its columns, joined by [`AND`], as the covariate.
    pub outside_target: Option<Truth>,
    /// Log-likelihood of the true model less that of the best model without effect, on the first 75 % of the rows.
    pub nats: f64,
    /// Mean over the modes of the rms relative error of prediction on the last 25 % of the rows: without the effect,
    /// and with the truth.
    pub holdout_rms_percent: (f64, f64),
    /// Mean log predictive density of a row's log frequencies on the same rows: without the effect, and with the truth.
    pub holdout_log_density: (f64, f64),
    /// One line for a table.
    pub description: String,
}

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

/// Effects outside the laws above.
const OUTSIDE: [&str; 3] = [
    "product of temperature and humidity on one mass",
    "hysteresis of one spring with temperature",
    "product of temperature and amplitude on one spring",
];

/// Targets that all shift every frequency by the same share.
const GLOBAL: [&str; 3] = ["spring_group", "mass_group", "frequency_scale"];

/// Between the columns of an effect that follows two at once.
pub const AND: &str = " and ";

/// Least gain of the true model for one effect, and for an effect outside the laws.
const LEAST_NATS: (f64, f64) = (20.0, 30.0);
/// Share of the rows, in time order, that models are fitted to.
const TRAINING_SHARE: f64 = 0.75;
/// Prior of a parameter, in shares of its nominal value.
const PRIOR: (f64, f64) = (0.5, 1.6);

type Family = (&'static str, &'static str);

/// Draws a world; draws again until the effect can be seen.
pub fn draw(seed: u64, kind: Kind) -> World {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let single = |rng: &mut ChaCha8Rng| *SINGLE_FAMILIES.choose(rng).expect("there are families");
    match kind {
        Kind::Nothing => search(seed, &mut rng, &[], None).expect("most structures will do"),
        Kind::Single => {
            let family = single(&mut rng);
            search(seed, &mut rng, &[family], None).expect("every family can be seen in some structure")
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
            search(seed, &mut rng, &[], Some(name)).expect("every one can be seen in some structure")
        }
    }
}

/// Draws a world with one effect of a given family of [`SINGLE_FAMILIES`].
pub fn draw_single(seed: u64, target: &str, law: &str) -> World {
    let index = SINGLE_FAMILIES.iter().position(|f| *f == (target, law)).expect("a family of the list");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(1 + index as u64);
    search(seed, &mut rng, &[SINGLE_FAMILIES[index]], None).expect("every family can be seen in some structure")
}

/// Whether two effects can be told apart: different targets, and neither does the work of the other.
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

/// Rows that models are fitted to: all but the last share, as the program rounds it.
fn training_rows(rows: usize) -> usize {
    rows - ((1.0 - TRAINING_SHARE) * rows as f64).round() as usize
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
    if structure.on_edge(&base) || (!effects.is_empty() && nats < least) {
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
        csv: csv(&structure, &rows),
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

// ---- Structure ----

/// One end of a spring: a mass, or none for the ground.
type Node = Option<usize>;

#[derive(Debug, Clone)]
struct Spring {
    name: String,
    from: Node,
    to: usize,
    n_per_m: f64,
}

/// The structure as its file states it.
#[derive(Debug, Clone)]
struct Structure {
    masses_kg: Vec<f64>,
    springs: Vec<Spring>,
    modes: usize,
    /// Springs whose stiffness is a free parameter.
    free: Vec<usize>,
    /// The spring that the experimenter sets.
    setting: Option<usize>,
    /// Relative standard deviation of a measured frequency.
    noise: f64,
    nominal_hz: Vec<f64>,
}

impl Structure {
    fn draw(rng: &mut ChaCha8Rng, families: &[Family]) -> Option<Self> {
        let has = |target: &str| families.iter().any(|f| f.0 == target);
        let n = rng.random_range(if has("mode_assignment") { 4..=6 } else { 3..=6 });
        let masses_kg = (0..n).map(|_| rounded(log_uniform(rng, 0.2, 3.0), 4)).collect::<Vec<_>>();
        let springs = draw_springs(rng, &masses_kg);
        let most = if has("mode_assignment") { n - 1 } else { n };
        let modes = match rng.random_range(0..4) {
            0 | 1 => most,
            2 => (n - 1).max(3),
            _ => rng.random_range(3..=most),
        };
        let constant = families.iter().any(|f| f.1 == "constant");
        let settings = usize::from(has("setting"));
        let parameters = if constant || rng.random_bool(0.85) {
            rng.random_range(1 + settings..=4.min(modes - 1))
        } else {
            4.min(modes)
        };
        let mut chosen = (0..springs.len()).collect::<Vec<_>>();
        chosen.shuffle(rng);
        chosen.truncate(parameters);
        let setting = has("setting").then(|| chosen.remove(0));
        chosen.sort_unstable();
        let noise = rounded(rng.random_range(0.001..0.005), 3);
        let ends = springs.iter().map(|s| (s.from, s.to, s.n_per_m)).collect::<Vec<_>>();
        let nominal_hz = frequencies_hz(&masses_kg, &ends)?;
        let separate = nominal_hz.windows(2).all(|f| f[1] >= 1.06 * f[0]);
        let audible = nominal_hz[0] >= 0.5 && nominal_hz[n - 1] <= 50.0;
        (separate && audible).then_some(Self { masses_kg, springs, modes, free: chosen, setting, noise, nominal_hz })
    }

    fn node_name(node: Node) -> String {
        node.map_or("ground".to_owned(), mass_name)
    }

    fn mean_n_per_m(&self) -> f64 {
        mean(&self.springs.iter().map(|s| s.n_per_m).collect::<Vec<_>>())
    }

    /// Whether a fitted mean lies on the edge of its prior.
    fn on_edge(&self, fit: &Fit) -> bool {
        self.free.iter().zip(&fit.theta).any(|(&s, &mean)| {
            let share = mean / self.springs[s].n_per_m;
            share < PRIOR.0 + 0.005 || share > PRIOR.1 - 0.005
        })
    }

    /// Log frequencies of a structure with effects: `None` where it is not stable.
    fn log_frequencies(&self, set: f64, free: &[f64], gains: &[(&Target, f64)]) -> Option<Vec<f64>> {
        let mut masses_kg = self.masses_kg.clone();
        let mut springs = self.springs.iter().map(|s| (s.from, s.to, s.n_per_m)).collect::<Vec<_>>();
        for (&spring, &n_per_m) in self.free.iter().zip(free) {
            springs[spring].2 = n_per_m;
        }
        if let Some(spring) = self.setting {
            springs[spring].2 = set;
        }
        let mut kept = (0..self.modes).collect::<Vec<_>>();
        for (target, gain) in gains {
            match **target {
                Target::Spring(spring) => springs[spring].2 *= 1.0 + gain,
                Target::Springs => springs.iter_mut().for_each(|s| s.2 *= 1.0 + gain),
                Target::Mass(mass) => masses_kg[mass] *= 1.0 + gain,
                Target::Masses => masses_kg.iter_mut().for_each(|m| *m *= 1.0 + gain),
                Target::Setting => springs[self.setting?].2 += gain,
                Target::AddedSpring(from, to) => springs.push((from, to, *gain)),
                Target::Oscillator { host, hz } => {
                    let kg = gain * self.masses_kg[host];
                    springs.push((Some(host), masses_kg.len(), kg * (TAU * hz).powi(2)));
                    masses_kg.push(kg);
                }
                Target::SkippedMode(skipped) => kept = (0..=self.modes).filter(|&m| m != skipped).collect(),
                Target::Scale(_) | Target::Offset => {}
            }
        }
        if masses_kg.iter().any(|m| *m <= 0.0) {
            return None;
        }
        let all_hz = frequencies_hz(&masses_kg, &springs)?;
        let mut hz = kept.iter().map(|&m| all_hz[m]).collect::<Vec<_>>();
        for (target, gain) in gains {
            match target {
                Target::Scale(None) => hz.iter_mut().for_each(|f| *f *= 1.0 + gain),
                Target::Scale(Some(mode)) => hz[*mode] *= 1.0 + gain,
                Target::Offset => hz.iter_mut().for_each(|f| *f += gain),
                _ => {}
            }
        }
        hz.iter().all(|f| *f > 0.0).then(|| hz.iter().map(|f| f.ln()).collect())
    }

    fn toml(&self) -> String {
        let masses = self.masses_kg.iter().enumerate().map(|(m, &kg)| (mass_name(m), kg)).collect::<Vec<_>>();
        let springs = self
            .springs
            .iter()
            .map(|s| (s.name.clone(), Self::node_name(s.from), mass_name(s.to), s.n_per_m))
            .collect::<Vec<_>>();
        let parameters = self.setting.iter().chain(&self.free).map(|&s| self.springs[s].name.clone());
        structure_toml(self.modes, self.noise, &masses, &springs, &parameters.collect::<Vec<_>>())
    }
}

/// A chain from the ground in random order of the masses, and some more springs.
fn draw_springs(rng: &mut ChaCha8Rng, masses_kg: &[f64]) -> Vec<Spring> {
    let n = masses_kg.len();
    let mut order = (0..n).collect::<Vec<_>>();
    order.shuffle(rng);
    let mut ends = vec![(None, order[0])];
    ends.extend(order.windows(2).map(|p| (Some(p[0].min(p[1])), p[0].max(p[1]))));
    let pairs = (0..n).flat_map(|to| (0..to).map(Some).chain([None]).map(move |from| (from, to)));
    let extra = pairs.filter(|pair| !ends.contains(pair)).collect::<Vec<_>>();
    ends.extend(extra.into_iter().filter(|_| rng.random_bool(0.25)));
    let tie = mean(masses_kg) * (TAU * log_uniform(rng, 1.5, 20.0)).powi(2);
    let mut named = |(index, (from, to)): (usize, (Node, usize))| {
        let n_per_m = rounded(tie * log_uniform(rng, 0.4, 2.5), 4);
        Spring { name: format!("k{}", index + 1), from, to, n_per_m }
    };
    ends.into_iter().enumerate().map(&mut named).collect()
}

/// A structure file: masses as name and kg, springs as name, from, to and N/m, parameters as names of springs.
pub fn structure_toml(
    modes: usize,
    noise: f64,
    masses: &[(String, f64)],
    springs: &[(String, String, String, f64)],
    parameters: &[String],
) -> String {
    let mut text = format!("id = \"world\"\nmodes = {modes}\nmeasurement_noise = {{ relative = {noise:?} }}\n");
    for (name, kg) in masses {
        let _ = write!(text, "\n[[mass]]\nname = \"{name}\"\nkg = {kg:?}\n");
    }
    for (name, from, to, n_per_m) in springs {
        let ends = format!("from = \"{from}\"\nto = \"{to}\"");
        let _ = write!(text, "\n[[spring]]\nname = \"{name}\"\n{ends}\nn_per_m = {n_per_m:?}\n");
    }
    for name in parameters {
        let nominal = springs.iter().find(|s| s.0 == *name).map_or(f64::NAN, |s| s.3);
        let (low, high) = (rounded(PRIOR.0 * nominal, 8), rounded(PRIOR.1 * nominal, 8));
        let prior = format!("prior = {{ uniform = [{low:?}, {high:?}] }}\nsets = {{ spring = \"{name}\" }}");
        let _ = write!(text, "\n[[parameter]]\nname = \"{name}\"\n{prior}\n");
    }
    text
}

fn mass_name(index: usize) -> String {
    format!("m{}", index + 1)
}

/// Natural frequencies, ascending, from the eigenvalues of M^-1/2 K M^-1/2; `None` if one is not positive.
pub fn frequencies_hz(masses_kg: &[f64], springs: &[(Node, usize, f64)]) -> Option<Vec<f64>> {
    let n = masses_kg.len();
    let mut a = vec![0.0; n * n];
    for &(from, to, n_per_m) in springs {
        a[to * n + to] += n_per_m / masses_kg[to];
        if let Some(from) = from {
            a[from * n + from] += n_per_m / masses_kg[from];
            let coupling = n_per_m / (masses_kg[from] * masses_kg[to]).sqrt();
            a[from * n + to] -= coupling;
            a[to * n + from] -= coupling;
        }
    }
    let mut squares = symmetric_eigenvalues(&mut a, n);
    squares.sort_by(f64::total_cmp);
    (squares[0] > 1e-6).then(|| squares.iter().map(|s| s.sqrt() / TAU).collect())
}

/// Eigenvalues of a symmetric matrix by cyclic Jacobi rotations.
fn symmetric_eigenvalues(a: &mut [f64], n: usize) -> Vec<f64> {
    for _ in 0..50 {
        let diagonal: f64 = (0..n).map(|i| a[i * n + i].powi(2)).sum();
        let off: f64 = (0..n).flat_map(|i| (0..i).map(move |j| (i, j))).map(|(i, j)| a[i * n + j].powi(2)).sum();
        if off <= 1e-26 * diagonal {
            break;
        }
        for p in 0..n {
            for q in p + 1..n {
                rotate(a, n, p, q);
            }
        }
    }
    (0..n).map(|i| a[i * n + i]).collect()
}

/// The rotation that makes the entry (p, q) zero.
fn rotate(a: &mut [f64], n: usize, p: usize, q: usize) {
    let entry = a[p * n + q];
    if entry == 0.0 {
        return;
    }
    let half_cot = (a[q * n + q] - a[p * n + p]) / (2.0 * entry);
    let t = half_cot.signum() / (half_cot.abs() + half_cot.hypot(1.0));
    let c = 1.0 / t.hypot(1.0);
    let s = t * c;
    for i in 0..n {
        let (x, y) = (a[i * n + p], a[i * n + q]);
        a[i * n + p] = c * x - s * y;
        a[i * n + q] = s * x + c * y;
    }
    for i in 0..n {
        let (x, y) = (a[p * n + i], a[q * n + i]);
        a[p * n + i] = c * x - s * y;
        a[q * n + i] = s * x + c * y;
    }
}

// ---- Rows ----

/// Temperature of every hour, from some weeks before the first measurement on.
struct Weather {
    start_s: i64,
    days: f64,
    hourly_c: Vec<f64>,
}

/// Days of weather before the first measurement, so that a slow part has forgotten its start.
const WARM_UP_DAYS: f64 = 120.0;

impl Weather {
    /// A year's wave, coldest in mid-January, a day's wave, and a slow random part.
    fn draw(rng: &mut ChaCha8Rng) -> Self {
        let start_day = rng.random_range(0.0..365.0_f64);
        let days = rng.random_range(200.0..500.0);
        let (year_c, day_c) = (rng.random_range(8.0..11.0), rng.random_range(2.0..4.0));
        let (mean_c, slow_c) = (rng.random_range(9.0..12.0), rng.random_range(1.5..2.5));
        let keep = (-1.0 / (24.0 * rng.random_range(2.0..5.0_f64))).exp();
        let mut slow = slow_c * normal(rng);
        let hourly_c = (0..=((WARM_UP_DAYS + days) * 24.0) as usize + 1)
            .map(|hour| {
                let day = start_day - WARM_UP_DAYS + hour as f64 / 24.0;
                slow = keep * slow + slow_c * (1.0 - keep * keep).sqrt() * normal(rng);
                let year = -(TAU * (day - 15.0) / 365.25).cos();
                let daily = -(TAU * (day - 3.0 / 24.0)).cos();
                mean_c + year_c * year + day_c * daily + slow
            })
            .collect();
        Self { start_s: EPOCH_2024_S + (start_day * 86_400.0) as i64, days, hourly_c }
    }

    /// Value of an hourly series on a day after the first measurement.
    fn at(series: &[f64], day: f64) -> f64 {
        let hour = (WARM_UP_DAYS + day) * 24.0;
        let index = (hour as usize).min(series.len() - 2);
        let share = hour - index as f64;
        series[index] * (1.0 - share) + series[index + 1] * share
    }

    /// The hourly temperature behind a first-order lag.
    fn lagged_c(&self, tau_days: f64) -> Vec<f64> {
        let gain = 1.0 - (-1.0 / (24.0 * tau_days)).exp();
        let mut state = mean(&self.hourly_c[..(24.0 * tau_days) as usize]);
        self.hourly_c
            .iter()
            .map(|c| {
                state += gain * (c - state);
                state
            })
            .collect()
    }
}

#[derive(Debug, Clone)]
struct Row {
    index: usize,
    day: f64,
    at_s: i64,
    temperature_c: f64,
    humidity_percent: f64,
    amplitude_um: f64,
    operator: &'static str,
    /// What the experimenter sets, 0 without a setting.
    set: f64,
    /// Natural logs of the measured frequencies; missing cells are none.
    log_f: Vec<Option<f64>>,
    outlier: bool,
}

impl Row {
    fn column(&self, name: &str) -> f64 {
        match name {
            "temperature_c" => self.temperature_c,
            "humidity_percent" => self.humidity_percent,
            _ => self.amplitude_um,
        }
    }
}

fn draw_rows(rng: &mut ChaCha8Rng, structure: &Structure, weather: &Weather) -> Vec<Row> {
    let n = rng.random_range(150..=600);
    let mut days = (0..n).map(|_| rng.random_range(0.0..weather.days)).collect::<Vec<_>>();
    days.sort_by(f64::total_cmp);
    let raw = [(); 3].map(|()| rng.random_range(0.05..1.0_f64));
    let shares = raw.map(|r| 0.18 + 0.46 * r / raw.iter().sum::<f64>());
    let correlation: f64 = rng.random_range(0.4..0.7);
    let log_sd = rng.random_range(0.25..0.5);
    let (mean_c, sd_c) = mean_and_sd(&weather.hourly_c);
    let mut last_s = 0;
    days.into_iter()
        .enumerate()
        .map(|(index, day)| {
            let at_s = (weather.start_s + (day * 86_400.0).round() as i64).max(last_s + 1);
            last_s = at_s;
            let temperature_c = Weather::at(&weather.hourly_c, day);
            let own = (1.0 - correlation * correlation).sqrt() * normal(rng);
            let z = own - correlation * (temperature_c - mean_c) / sd_c;
            let pick = rng.random_range(0.0..1.0);
            let operator = match pick {
                p if p < shares[0] => "A",
                p if p < shares[0] + shares[1] => "B",
                _ => "C",
            };
            let set = structure.setting.map_or(0.0, |s| {
                let share = rng.random_range(0.2..0.8);
                rounded((PRIOR.0 + share * (PRIOR.1 - PRIOR.0)) * structure.springs[s].n_per_m, 8)
            });
            Row {
                index,
                day,
                at_s,
                temperature_c,
                humidity_percent: (65.0 + 14.0 * z).clamp(5.0, 100.0),
                amplitude_um: (log_sd * normal(rng) - 0.5 * log_sd * log_sd).exp(),
                operator,
                set,
                log_f: Vec::new(),
                outlier: false,
            }
        })
        .collect()
}

/// Fills in the measured frequencies; `None` if a row is not stable or its modes change places.
fn measure(
    rng: &mut ChaCha8Rng,
    structure: &Structure,
    population: &[(f64, f64)],
    effects: &[Effect],
    rows: &mut [Row],
) -> Option<()> {
    let missing = rng.random_range(0.0..0.03);
    let gross = if rng.random_bool(0.25) { 0.01 } else { 0.0 };
    let training = training_rows(rows.len());
    for (index, row) in rows.iter_mut().enumerate() {
        let free = population.iter().map(|(mean, sd)| mean + sd * normal(rng)).collect::<Vec<_>>();
        let gains = effects.iter().map(|e| (&e.target, e.signal[index])).collect::<Vec<_>>();
        let clean = structure.log_frequencies(row.set, &free, &gains)?;
        let noisy = clean.iter().map(|f| f + (structure.noise * normal(rng)).ln_1p()).collect::<Vec<_>>();
        if noisy.windows(2).any(|f| f[1] <= f[0]) {
            return None;
        }
        for log_f in noisy {
            let mut log_f = log_f;
            // None on the rows held out: there they would drown what the figures are compared for.
            if rng.random_bool(gross) && index < training {
                let error: f64 = rng.random_range(0.05..0.15);
                log_f += (if rng.random_bool(0.5) { error } else { -error }).ln_1p();
                row.outlier = true;
            }
            // An outlier that goes missing leaves its row marked: that only costs the likelihood a good row.
            row.log_f.push((!rng.random_bool(missing)).then_some(log_f));
        }
        if row.log_f.iter().all(Option::is_none) {
            return None;
        }
    }
    Some(())
}

fn csv(structure: &Structure, rows: &[Row]) -> String {
    let mut text = String::from("measured_at");
    for mode in 1..=structure.modes {
        let _ = write!(text, ",f{mode}_hz");
    }
    text += ",temperature_c,humidity_percent,amplitude_um,operator";
    if let Some(spring) = structure.setting {
        let _ = write!(text, ",set_{}", structure.springs[spring].name);
    }
    text.push('\n');
    for row in rows {
        text += &rfc3339(row.at_s);
        for log_f in &row.log_f {
            let cell = log_f.map_or(String::new(), |l| number(l.exp()));
            let _ = write!(text, ",{cell}");
        }
        let columns = [row.temperature_c, row.humidity_percent, row.amplitude_um];
        for column in columns {
            let _ = write!(text, ",{}", number(column));
        }
        let _ = write!(text, ",{}", row.operator);
        if structure.setting.is_some() {
            let _ = write!(text, ",{}", number(row.set));
        }
        text.push('\n');
    }
    text
}

// ---- Effects ----

/// What an effect acts on.
#[derive(Debug, Clone)]
enum Target {
    Spring(usize),
    Springs,
    Mass(usize),
    Masses,
    Scale(Option<usize>),
    Offset,
    Setting,
    AddedSpring(Node, usize),
    Oscillator { host: usize, hz: f64 },
    SkippedMode(usize),
}

/// An effect: its target and its value in each row.
#[derive(Debug, Clone)]
struct Effect {
    target: Target,
    signal: Vec<f64>,
    truth: Truth,
}

/// A law: what it follows, its value in each row, and its swing (or its value) as [`Truth::size`] defines it.
struct Shape {
    covariate: Option<&'static str>,
    level: Option<&'static str>,
    values: Vec<f64>,
    size: f64,
}

/// Draws target, law and size; `None` where the structure or the weather does not offer them.
fn draw_effect(
    rng: &mut ChaCha8Rng,
    structure: &Structure,
    weather: &Weather,
    rows: &[Row],
    (kind, law): Family,
) -> Option<Effect> {
    let n = structure.masses_kg.len();
    let any_mass = rng.random_range(0..n);
    let (target, name) = match kind {
        "spring" => {
            let taken = |s: &usize| structure.setting == Some(*s) || (law == "constant" && structure.free.contains(s));
            let springs = (0..structure.springs.len()).filter(|s| !taken(s)).collect::<Vec<_>>();
            let spring = *springs.choose(rng)?;
            (Target::Spring(spring), structure.springs[spring].name.clone())
        }
        "spring_group" => (Target::Springs, "all".to_owned()),
        "mass" => (Target::Mass(any_mass), mass_name(any_mass)),
        "mass_group" => (Target::Masses, "all".to_owned()),
        "frequency_scale" if law == "category" && rng.random_bool(0.5) => {
            let mode = rng.random_range(0..structure.modes);
            (Target::Scale(Some(mode)), format!("mode {}", mode + 1))
        }
        "frequency_scale" => (Target::Scale(None), String::new()),
        "frequency_offset" => (Target::Offset, String::new()),
        "setting" => (Target::Setting, structure.springs[structure.setting?].name.clone()),
        "added_spring" => {
            let (from, to) = draw_gap(rng, structure)?;
            (Target::AddedSpring(from, to), String::new())
        }
        "oscillator" => {
            let modes_hz = &structure.nominal_hz;
            let hz = rng.random_range(0.5 * modes_hz[0]..1.3 * modes_hz[structure.modes - 1]);
            if modes_hz.iter().any(|f| (hz / f - 1.0).abs() < 0.04) {
                return None;
            }
            (Target::Oscillator { host: any_mass, hz }, mass_name(any_mass))
        }
        _ if structure.modes < n => (Target::SkippedMode(rng.random_range(0..structure.modes)), String::new()),
        _ => return None,
    };
    let sign = if matches!(kind, "oscillator" | "added_spring") && law != "linear" || rng.random_bool(0.5) {
        1.0
    } else {
        -1.0
    };
    let shape = draw_shape(rng, weather, rows, law, sign)?;
    let scale = draw_scale(rng, structure, kind);
    let signal = shape.values.iter().map(|v| scale * v).collect::<Vec<_>>();
    let relative = !matches!(kind, "frequency_offset" | "setting" | "added_spring");
    if relative && signal.iter().any(|g| *g < -0.6 || *g > 2.0) {
        return None;
    }
    let size = match target {
        Target::SkippedMode(_) => 0.0,
        Target::Oscillator { host, .. } => scale * shape.size * structure.masses_kg[host],
        _ => scale * shape.size,
    };
    let between = match target {
        Target::AddedSpring(from, to) => Some((Structure::node_name(from), mass_name(to))),
        _ => None,
    };
    let (covariate, level) = (shape.covariate.map(str::to_owned), shape.level.map(str::to_owned));
    Some(Effect { target, signal, truth: Truth { kind, name, between, law, covariate, level, size } })
}

/// Two nodes that no spring joins.
fn draw_gap(rng: &mut ChaCha8Rng, structure: &Structure) -> Option<(Node, usize)> {
    let n = structure.masses_kg.len();
    let pairs = (0..n).flat_map(|to| (0..to).map(Some).chain([None]).map(move |from| (from, to)));
    let joined = |pair: &(Node, usize)| structure.springs.iter().any(|s| (s.from, s.to) == *pair);
    pairs.filter(|p| !joined(p)).collect::<Vec<_>>().choose(rng).copied()
}

/// Size of an effect on a kind of target, in the unit of the effect.
fn draw_scale(rng: &mut ChaCha8Rng, structure: &Structure, kind: &str) -> f64 {
    let (low, high, unit) = match kind {
        "spring" | "spring_group" => (0.02, 0.15, 1.0),
        "mass" | "mass_group" => (0.02, 0.10, 1.0),
        "frequency_scale" => (0.003, 0.02, 1.0),
        "frequency_offset" => (0.003, 0.02, structure.nominal_hz[0]),
        "setting" => {
            let nominal = structure.setting.map_or(0.0, |s| structure.springs[s].n_per_m);
            (0.03, 0.15, (PRIOR.1 - PRIOR.0) * nominal)
        }
        "added_spring" => (0.03, 0.30, structure.mean_n_per_m()),
        _ => (0.01, 0.10, 1.0),
    };
    rng.random_range(low..high) * unit
}

/// A law of size ±1: the sign is given, but for `bilinear`, which is always stiffer in the cold.
fn draw_shape(rng: &mut ChaCha8Rng, weather: &Weather, rows: &[Row], law: &str, sign: f64) -> Option<Shape> {
    let plain = |covariate, level, values| Some(Shape { covariate, level, values, size: sign });
    let training = training_rows(rows.len());
    match law {
        "constant" => plain(None, None, vec![sign; rows.len()]),
        "category" => {
            let level = *["A", "B", "C"].choose(rng)?;
            let values = rows.iter().map(|r| if r.operator == level { sign } else { 0.0 }).collect();
            plain(Some("operator"), Some(level), values)
        }
        "step" => {
            let (first, last) = (rows[0].day, rows[training - 1].day);
            let from = first + rng.random_range(0.25..0.75) * (last - first);
            plain(Some("time"), None, rows.iter().map(|r| if r.day > from { sign } else { 0.0 }).collect())
        }
        "lagged" => {
            let lagged_c = weather.lagged_c(rng.random_range(5.0..30.0));
            let (low, high) = quantiles(rows.iter().map(|r| r.temperature_c).collect());
            let slope = sign / (high - low);
            let values = rows.iter().map(|r| slope * (Weather::at(&lagged_c, r.day) - 20.0)).collect();
            plain(Some("temperature_c"), None, values)
        }
        _ => draw_curve(rng, rows, training, law, sign),
    }
}

/// A law of a number in the row: linear, bilinear, quadratic or exponential.
fn draw_curve(rng: &mut ChaCha8Rng, rows: &[Row], training: usize, law: &str, sign: f64) -> Option<Shape> {
    let covariate = match rng.random_range(0..10) {
        0 if law == "linear" || law == "quadratic" => "amplitude_um",
        1 | 2 if law == "linear" || law == "quadratic" => "humidity_percent",
        _ => "temperature_c",
    };
    let reference = match covariate {
        "temperature_c" => 20.0,
        "humidity_percent" => 50.0,
        _ => 1.0,
    };
    let column = rows.iter().map(|r| r.column(covariate)).collect::<Vec<_>>();
    let (low, high) = quantiles(column.clone());
    let width = high - low;
    let curve: Box<dyn Fn(f64) -> f64> = match law {
        "linear" => Box::new(move |c| c - reference),
        "bilinear" => {
            let (knee_c, ratio) = (rng.random_range(-2.0..5.0), rng.random_range(3.0..10.0));
            let cold = column[..training].iter().filter(|c| **c < knee_c).count();
            if cold * 10 < training {
                return None;
            }
            Box::new(move |c: f64| ratio * (c - knee_c).min(0.0) + (c - knee_c).max(0.0))
        }
        "quadratic" => {
            let bend = rng.random_range(0.4..1.5) * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            Box::new(move |c| {
                let z = (c - reference) / width;
                z + bend * z * z
            })
        }
        _ => {
            let range =
                column.iter().copied().fold(f64::MIN, f64::max) - column.iter().copied().fold(f64::MAX, f64::min);
            let rate = rng.random_range(1.0..3.0) / range * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            Box::new(move |c| (rate * (c - reference)).exp() - 1.0)
        }
    };
    let swing = curve(high) - curve(low);
    let inner = column.iter().filter(|c| (low..=high).contains(*c)).map(|c| curve(*c)).collect::<Vec<_>>();
    let spread = inner.iter().copied().fold(f64::MIN, f64::max) - inner.iter().copied().fold(f64::MAX, f64::min);
    // A curve that comes back to where it began has no swing to speak of.
    if swing.abs() < 0.5 * spread {
        return None;
    }
    let size = if law == "bilinear" { -1.0 } else { sign };
    let values = column.iter().map(|c| size * curve(*c) / swing).collect();
    Some(Shape { covariate: Some(covariate), level: None, values, size })
}

/// An effect that no law of the families describes.
fn draw_outside(rng: &mut ChaCha8Rng, structure: &Structure, weather: &Weather, rows: &[Row], name: &str) -> Effect {
    let spring = rng.random_range(0..structure.springs.len());
    let (target, columns, raw) = if name == OUTSIDE[0] {
        let values = rows.iter().map(|r| (r.temperature_c - 15.0) * (r.humidity_percent - 50.0)).collect::<Vec<_>>();
        let mass = rng.random_range(0..structure.masses_kg.len());
        (Target::Mass(mass), vec!["temperature_c", "humidity_percent"], values)
    } else if name == OUTSIDE[1] {
        let half_width_c = rng.random_range(3.0..6.0);
        let mut centre_c = weather.hourly_c[0];
        let play = |c: &f64| {
            centre_c = centre_c.clamp(c - half_width_c, c + half_width_c);
            centre_c
        };
        let behind_c = weather.hourly_c.iter().map(play).collect::<Vec<_>>();
        let values = rows.iter().map(|r| Weather::at(&behind_c, r.day) - 15.0).collect();
        (Target::Spring(spring), vec!["temperature_c"], values)
    } else {
        let values = rows.iter().map(|r| (r.temperature_c - 15.0) * (r.amplitude_um - 1.0)).collect();
        (Target::Spring(spring), vec!["temperature_c", "amplitude_um"], values)
    };
    let (low, high) = quantiles(raw.clone());
    let swing = rng.random_range(0.05..0.15) * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let signal = raw.iter().map(|v| (swing * v / (high - low)).clamp(-0.6, 2.0)).collect();
    let (kind, name) = match target {
        Target::Mass(mass) => ("mass", mass_name(mass)),
        _ => ("spring", structure.springs[spring].name.clone()),
    };
    let truth = Truth {
        kind,
        name,
        between: None,
        law: "outside",
        covariate: Some(columns.join(AND)),
        level: None,
        size: swing,
    };
    Effect { target, signal, truth }
}

// ---- Likelihood ----

/// Population means and factors of the effects, spreads of the population, and noise.
struct Fit {
    theta: Vec<f64>,
    spreads: Vec<f64>,
    noise: f64,
    log_likelihood: f64,
}

/// Rows that share their effects, their setting and their missing cells.
struct Cell {
    point: usize,
    present: Vec<usize>,
    rows: f64,
    /// Mean of the log frequencies.
    mean: Vec<f64>,
    /// Sum of the products of deviations from the mean.
    scatter: Vec<f64>,
}

/// Log frequencies at a point and their derivatives, one vector per parameter.
struct Expansion {
    value: Vec<f64>,
    slopes: Vec<Vec<f64>>,
}

/// The rows as the likelihood needs them: outliers left out, equal ones together.
struct Data<'a> {
    structure: &'a Structure,
    effects: &'a [&'a Effect],
    /// Setting, then the value of each effect.
    points: Vec<Vec<f64>>,
    cells: Vec<Cell>,
}

impl<'a> Data<'a> {
    fn new(structure: &'a Structure, effects: &'a [&'a Effect], rows: &[Row]) -> Self {
        let mut data = Self { structure, effects, points: Vec::new(), cells: Vec::new() };
        let mut point_of = BTreeMap::new();
        let mut rows_of = BTreeMap::<_, Vec<&Row>>::new();
        for row in rows.iter().filter(|r| !r.outlier) {
            let point = data.point(row);
            let bits = point.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            let point = *point_of.entry(bits).or_insert_with(|| {
                data.points.push(point);
                data.points.len() - 1
            });
            let present = (0..structure.modes).filter(|&m| row.log_f[m].is_some()).collect::<Vec<_>>();
            rows_of.entry((point, present)).or_default().push(row);
        }
        data.cells = rows_of.into_iter().map(|((point, present), rows)| Cell::new(point, present, &rows)).collect();
        data
    }

    /// Setting, then the value of each effect, in a row.
    fn point(&self, row: &Row) -> Vec<f64> {
        [row.set].into_iter().chain(self.effects.iter().map(|e| e.signal[row.index])).collect()
    }

    fn value(&self, point: &[f64], theta: &[f64]) -> Option<Vec<f64>> {
        let (free, factors) = theta.split_at(self.structure.free.len());
        let gains = self.effects.iter().zip(&point[1..]).zip(factors).map(|((e, g), factor)| (&e.target, g * factor));
        self.structure.log_frequencies(point[0], free, &gains.collect::<Vec<_>>())
    }

    fn expand(&self, theta: &[f64]) -> Option<Vec<Expansion>> {
        let slope = |point: &Vec<f64>, index: usize| {
            let step = 1e-4 * theta[index];
            let shifted = |by: f64| {
                let mut theta = theta.to_vec();
                theta[index] += by;
                self.value(point, &theta)
            };
            let (up, down) = (shifted(step)?, shifted(-step)?);
            Some(up.iter().zip(&down).map(|(u, d)| (u - d) / (2.0 * step)).collect())
        };
        let expansion = |point| {
            let slopes = (0..theta.len()).map(|index| slope(point, index)).collect::<Option<_>>()?;
            Some(Expansion { value: self.value(point, theta)?, slopes })
        };
        self.points.iter().map(expansion).collect()
    }

    /// Log density of the log frequencies, up to nothing: normal, with the spread of the population and the noise.
    fn log_likelihood(&self, expansions: &[Expansion], spreads: &[f64], noise: f64) -> f64 {
        let of_cell = |cell: &Cell| {
            let expansion = &expansions[cell.point];
            let m = cell.present.len();
            let Some((inverse, log_det)) = inverse(&cell.covariance(expansion, spreads, noise), m) else {
                return f64::NEG_INFINITY;
            };
            let off = cell.deviation(expansion);
            let square =
                |i: usize, j: usize| inverse[i * m + j] * (cell.rows * off[i] * off[j] + cell.scatter[i * m + j]);
            let squares: f64 = (0..m).flat_map(|i| (0..m).map(move |j| (i, j))).map(|(i, j)| square(i, j)).sum();
            -0.5 * (cell.rows * (m as f64 * (2.0 * PI).ln() + log_det) + squares)
        };
        self.cells.iter().map(of_cell).sum()
    }

    fn log_likelihood_of(&self, fit: &Fit) -> Option<f64> {
        Some(self.log_likelihood(&self.expand(&fit.theta)?, &fit.spreads, fit.noise))
    }

    /// Most likely means, factors, spreads and noise: the best end of several starts.
    fn fit(&self, true_theta: &[f64]) -> Option<Fit> {
        let free = &self.structure.free;
        let start = |share: &dyn Fn(usize) -> f64| {
            let means = free.iter().enumerate().map(|(i, &s)| share(i) * self.structure.springs[s].n_per_m);
            means.chain(self.effects.iter().map(|_| 1.0)).collect::<Vec<_>>()
        };
        let mut truth = start(&|_| 1.0);
        truth[..free.len()].copy_from_slice(&true_theta[..free.len()]);
        let mut starts = vec![truth];
        // A fit without rows of its own kind is cheap: a wrong model may have its best means far from the true ones.
        if self.points.len() < 10 {
            starts.push(start(&|_| 0.75));
            starts.push(start(&|_| 1.3));
            starts.push(start(&|i| if i % 2 == 0 { 0.75 } else { 1.3 }));
            starts.push(start(&|i| if i % 2 == 0 { 1.3 } else { 0.75 }));
        }
        let fits = starts.into_iter().filter_map(|theta| self.climb(theta));
        fits.max_by(|a, b| a.log_likelihood.total_cmp(&b.log_likelihood))
    }

    /// Gauss-Newton steps of the means and factors, in turn with a search over log spreads and log noise.
    fn climb(&self, theta: Vec<f64>) -> Option<Fit> {
        let free = self.structure.free.len();
        let mut log_sds =
            theta[..free].iter().map(|mean| (0.01 * mean).ln()).chain([0.01_f64.ln()]).collect::<Vec<_>>();
        let mut theta = theta;
        let mut expansions = self.expand(&theta)?;
        let mut best = f64::NEG_INFINITY;
        for _ in 0..40 {
            let before = best;
            best = self.search_sds(&expansions, &mut log_sds);
            let (spreads, noise) = split_sds(&log_sds);
            let step = self.newton_step(&expansions, &spreads, noise)?;
            for share in [1.0, 0.5, 0.25, 0.1, 0.02] {
                let next = self.within_prior(&theta, &step, share);
                let Some(trial) = self.expand(&next) else { continue };
                let log_likelihood = self.log_likelihood(&trial, &spreads, noise);
                if log_likelihood > best {
                    (best, theta, expansions) = (log_likelihood, next, trial);
                    break;
                }
            }
            if best - before < 1e-3 {
                break;
            }
        }
        let (spreads, noise) = split_sds(&log_sds);
        Some(Fit { theta, spreads, noise, log_likelihood: best })
    }

    /// Compass search: a step along each axis, halved when none helps.
    fn search_sds(&self, expansions: &[Expansion], log_sds: &mut [f64]) -> f64 {
        let value = |log_sds: &[f64]| {
            let (spreads, noise) = split_sds(log_sds);
            self.log_likelihood(expansions, &spreads, noise)
        };
        let mut best = value(log_sds);
        let mut step = 0.4;
        while step > 0.01 {
            let mut better = false;
            for axis in 0..log_sds.len() {
                for by in [step, -step] {
                    let kept = log_sds[axis];
                    log_sds[axis] = (kept + by).max(-12.0);
                    let trial = value(log_sds);
                    if trial > best + 1e-6 {
                        (best, better) = (trial, true);
                        break;
                    }
                    log_sds[axis] = kept;
                }
            }
            if !better {
                step *= 0.5;
            }
        }
        best
    }

    fn newton_step(&self, expansions: &[Expansion], spreads: &[f64], noise: f64) -> Option<Vec<f64>> {
        let n = expansions.first()?.slopes.len();
        let (mut curvature, mut slope) = (vec![0.0; n * n], vec![0.0; n]);
        for cell in &self.cells {
            let expansion = &expansions[cell.point];
            let m = cell.present.len();
            let (inverse, _) = inverse(&cell.covariance(expansion, spreads, noise), m)?;
            let off = cell.deviation(expansion);
            let column = |p: usize, i: usize| expansion.slopes[p][cell.present[i]];
            for p in 0..n {
                let weighted = (0..m).map(|j| (0..m).map(|i| column(p, i) * inverse[i * m + j]).sum::<f64>());
                let weighted = weighted.collect::<Vec<_>>();
                slope[p] += cell.rows * weighted.iter().zip(&off).map(|(w, o)| w * o).sum::<f64>();
                for q in 0..n {
                    curvature[p * n + q] += cell.rows * (0..m).map(|j| weighted[j] * column(q, j)).sum::<f64>();
                }
            }
        }
        // Scaled to a unit diagonal, with a little more on it: two parameters may do the same.
        let scale = (0..n).map(|p| curvature[p * n + p].max(1e-300).sqrt()).collect::<Vec<_>>();
        for p in 0..n {
            for q in 0..n {
                curvature[p * n + q] /= scale[p] * scale[q];
            }
            curvature[p * n + p] += 1e-8;
        }
        let (covariance, _) = inverse(&curvature, n)?;
        let step = |p: usize| (0..n).map(|q| covariance[p * n + q] * slope[q] / scale[q]).sum::<f64>() / scale[p];
        Some((0..n).map(step).collect())
    }

    /// A share of a step, held inside the prior and, for factors, between 0.05 and 5.
    fn within_prior(&self, theta: &[f64], step: &[f64], share: f64) -> Vec<f64> {
        let next = |index: usize| {
            let bounds = self.structure.free.get(index).map_or((0.05, 5.0), |&s| {
                let nominal = self.structure.springs[s].n_per_m;
                (PRIOR.0 * nominal, PRIOR.1 * nominal)
            });
            (theta[index] + share * step[index]).clamp(bounds.0, bounds.1)
        };
        (0..theta.len()).map(next).collect()
    }

    /// Mean over the modes of the rms relative error of prediction.
    fn rms_percent(structure: &Structure, effects: &[&Effect], rows: &[Row], fit: &Fit) -> Option<f64> {
        let data = Data { structure, effects, points: Vec::new(), cells: Vec::new() };
        let (mut squares, mut counts) = (vec![0.0; structure.modes], vec![0.0; structure.modes]);
        for row in rows.iter().filter(|r| !r.outlier) {
            let predicted = data.value(&data.point(row), &fit.theta)?;
            for (mode, log_f) in row.log_f.iter().enumerate() {
                if let Some(log_f) = log_f {
                    squares[mode] += (predicted[mode] - log_f).exp_m1().powi(2);
                    counts[mode] += 1.0;
                }
            }
        }
        Some(100.0 * mean(&squares.iter().zip(&counts).map(|(s, c)| (s / c).sqrt()).collect::<Vec<_>>()))
    }
}

impl Cell {
    fn new(point: usize, present: Vec<usize>, rows: &[&Row]) -> Self {
        let m = present.len();
        let of_mode = |mode: usize| rows.iter().filter_map(move |r| r.log_f[mode]).collect::<Vec<_>>();
        let columns = present.iter().map(|&mode| of_mode(mode)).collect::<Vec<_>>();
        let mean = columns.iter().map(|c| mean(c)).collect::<Vec<_>>();
        let product = |i: usize, j: usize| {
            let pairs = columns[i].iter().zip(&columns[j]);
            pairs.map(|(a, b)| (a - mean[i]) * (b - mean[j])).sum::<f64>()
        };
        let scatter = (0..m * m).map(|k| product(k / m, k % m)).collect();
        Self { point, present, rows: rows.len() as f64, mean, scatter }
    }

    fn deviation(&self, expansion: &Expansion) -> Vec<f64> {
        self.present.iter().zip(&self.mean).map(|(&mode, mean)| mean - expansion.value[mode]).collect()
    }

    /// J diag(spreads²) Jᵀ + noise² I of the modes that are there.
    fn covariance(&self, expansion: &Expansion, spreads: &[f64], noise: f64) -> Vec<f64> {
        let m = self.present.len();
        let mut covariance = vec![0.0; m * m];
        for i in 0..m {
            covariance[i * m + i] = noise * noise;
            for j in 0..m {
                let parts = expansion.slopes.iter().zip(spreads);
                covariance[i * m + j] +=
                    parts.map(|(slope, sd)| slope[self.present[i]] * slope[self.present[j]] * sd * sd).sum::<f64>();
            }
        }
        covariance
    }
}

fn split_sds(log_sds: &[f64]) -> (Vec<f64>, f64) {
    let (log_noise, log_spreads) = log_sds.split_last().expect("the noise is always there");
    (log_spreads.iter().map(|l| l.exp()).collect(), log_noise.exp())
}

/// Inverse and log determinant of a symmetric positive definite matrix, by its Cholesky factor.
fn inverse(a: &[f64], n: usize) -> Option<(Vec<f64>, f64)> {
    let mut l = vec![0.0; n * n];
    for i in 0..n {
        for j in 0..=i {
            let rest = a[i * n + j] - (0..j).map(|k| l[i * n + k] * l[j * n + k]).sum::<f64>();
            if i == j && !(rest > 0.0 && rest.is_finite()) {
                return None;
            }
            l[i * n + j] = if i == j { rest.sqrt() } else { rest / l[j * n + j] };
        }
    }
    let mut lower = vec![0.0; n * n];
    for j in 0..n {
        lower[j * n + j] = 1.0 / l[j * n + j];
        for i in j + 1..n {
            lower[i * n + j] = -(j..i).map(|k| l[i * n + k] * lower[k * n + j]).sum::<f64>() / l[i * n + i];
        }
    }
    let product = |i: usize, j: usize| (i.max(j)..n).map(|k| lower[k * n + i] * lower[k * n + j]).sum();
    let log_det = 2.0 * (0..n).map(|i| l[i * n + i].ln()).sum::<f64>();
    Some(((0..n * n).map(|k| product(k / n, k % n)).collect(), log_det))
}

// ---- Numbers ----

fn normal(rng: &mut ChaCha8Rng) -> f64 {
    rng.sample(StandardNormal)
}

fn log_uniform(rng: &mut ChaCha8Rng, low: f64, high: f64) -> f64 {
    rng.random_range(low.ln()..high.ln()).exp()
}

/// Mean of some numbers.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Mean and standard deviation.
pub fn mean_and_sd(values: &[f64]) -> (f64, f64) {
    let mean = mean(values);
    let squares = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
    (mean, (squares / (values.len() as f64 - 1.0)).sqrt())
}

/// The 5 % and the 95 % quantile, linear between the order statistics.
pub fn quantiles(values: Vec<f64>) -> (f64, f64) {
    let mut values = values;
    values.sort_by(f64::total_cmp);
    let at = |share: f64| {
        let place = share * (values.len() - 1) as f64;
        let below = (place as usize).min(values.len() - 2);
        values[below] + (place - below as f64) * (values[below + 1] - values[below])
    };
    (at(0.05), at(0.95))
}

/// A number rounded to some significant digits.
pub fn rounded(value: f64, digits: usize) -> f64 {
    format!("{value:.*e}", digits - 1).parse().expect("a printed number can be read")
}

/// A number in nine significant digits, without exponent.
pub fn number(value: f64) -> String {
    format!("{:?}", rounded(value, 9))
}

// ---- Times ----

/// 2024-01-01T00:00:00Z in seconds since 1970.
pub const EPOCH_2024_S: i64 = 1_704_067_200;

/// A time in UTC: the civil date of a day count (Hinnant, "chrono-compatible low-level date algorithms").
pub fn rfc3339(seconds: i64) -> String {
    let (days, second) = (seconds.div_euclid(86_400), seconds.rem_euclid(86_400));
    let shifted = days + 719_468;
    let (era, of_era) = (shifted.div_euclid(146_097), shifted.rem_euclid(146_097));
    let year_of_era = (of_era - of_era / 1_460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_from_march = (5 * of_year + 2) / 153;
    let day = of_year - (153 * month_from_march + 2) / 5 + 1;
    let month = if month_from_march < 10 { month_from_march + 3 } else { month_from_march - 9 };
    let year = year_of_era + era * 400 + i64::from(month <= 2);
    let (hour, minute, second) = (second / 3_600, second / 60 % 60, second % 60);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
}
