//! Random structures and their natural frequencies.

use std::f64::consts::TAU;
use std::fmt::Write as _;

use rand::seq::SliceRandom;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::numbers::{log_uniform, mean, rounded};

/// Prior of a parameter, as a share of its nominal value.
pub const PRIOR: (f64, f64) = (0.5, 1.6);

/// One end of a spring: a mass, or none for the ground.
pub type Node = Option<usize>;

#[derive(Debug, Clone)]
pub struct Spring {
    pub name: String,
    pub from: Node,
    pub to: usize,
    pub n_per_m: f64,
}

/// The structure as its file states it.
#[derive(Debug, Clone)]
pub struct Structure {
    pub masses_kg: Vec<f64>,
    pub springs: Vec<Spring>,
    pub modes: usize,
    /// Springs whose stiffness is a free parameter.
    pub free: Vec<usize>,
    /// The spring whose stiffness the experimenter sets.
    pub setting: Option<usize>,
    /// Relative standard deviation of a measured frequency.
    pub noise: f64,
    pub nominal_hz: Vec<f64>,
}

/// What an effect acts on.
#[derive(Debug, Clone)]
pub enum Target {
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

impl Structure {
    pub fn draw(rng: &mut ChaCha8Rng, families: &[(&str, &str)]) -> Option<Self> {
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

    pub fn node_name(node: Node) -> String {
        node.map_or("ground".to_owned(), mass_name)
    }

    pub fn mean_n_per_m(&self) -> f64 {
        mean(&self.springs.iter().map(|s| s.n_per_m).collect::<Vec<_>>())
    }

    /// Whether a fitted mean of `theta` lies at a bound of its prior.
    pub fn on_edge(&self, theta: &[f64]) -> bool {
        self.free.iter().zip(theta).any(|(&s, &mean)| {
            let share = mean / self.springs[s].n_per_m;
            share < PRIOR.0 + 0.005 || share > PRIOR.1 - 0.005
        })
    }

    /// Log frequencies with effects; `None` if the structure is not stable.
    pub fn log_frequencies(&self, set: f64, free: &[f64], gains: &[(&Target, f64)]) -> Option<Vec<f64>> {
        let Changed { masses_kg, springs, kept } = self.changed(set, free, gains)?;
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

    /// Shapes of unit norm at some masses with effects, one for each measured mode.
    pub fn shapes(&self, set: f64, free: &[f64], gains: &[(&Target, f64)], points: &[usize]) -> Option<Vec<Vec<f64>>> {
        let Changed { masses_kg, springs, kept } = self.changed(set, free, gains)?;
        let all = shapes(&masses_kg, &springs);
        let at_points = |&mode: &usize| {
            let shape = points.iter().map(|&p| all[mode][p]).collect::<Vec<_>>();
            let norm = shape.iter().map(|x| x * x).sum::<f64>().sqrt();
            shape.iter().map(|x| x / norm).collect()
        };
        Some(kept.iter().map(at_points).collect())
    }

    /// Masses and springs with effects, and the modes that are measured.
    fn changed(&self, set: f64, free: &[f64], gains: &[(&Target, f64)]) -> Option<Changed> {
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
        masses_kg.iter().all(|m| *m > 0.0).then_some(Changed { masses_kg, springs, kept })
    }

    pub fn toml(&self) -> String {
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

/// A structure with effects.
struct Changed {
    masses_kg: Vec<f64>,
    springs: Vec<(Node, usize, f64)>,
    kept: Vec<usize>,
}

/// Draws a chain of springs from the ground through the masses in random order, and some further springs.
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

pub fn mass_name(index: usize) -> String {
    format!("m{}", index + 1)
}

/// Natural frequencies, ascending, from the eigenvalues of M^-1/2 K M^-1/2; `None` if one is not positive.
pub fn frequencies_hz(masses_kg: &[f64], springs: &[(Node, usize, f64)]) -> Option<Vec<f64>> {
    let n = masses_kg.len();
    let mut a = scaled_stiffness(masses_kg, springs);
    diagonalise(&mut a, n, |_, _, _, _| {});
    let mut squares = (0..n).map(|i| a[i * n + i]).collect::<Vec<_>>();
    squares.sort_by(f64::total_cmp);
    (squares[0] > 1e-6).then(|| squares.iter().map(|s| s.sqrt() / TAU).collect())
}

/// Mode shapes at all masses, in the order of the natural frequencies: M^-1/2 times the eigenvectors of M^-1/2 K M^-1/2.
pub fn shapes(masses_kg: &[f64], springs: &[(Node, usize, f64)]) -> Vec<Vec<f64>> {
    let n = masses_kg.len();
    let mut a = scaled_stiffness(masses_kg, springs);
    let mut vectors = (0..n).map(|i| (0..n).map(|j| f64::from(u8::from(i == j))).collect()).collect::<Vec<Vec<f64>>>();
    diagonalise(&mut a, n, |p, q, c, s| {
        for row in &mut vectors {
            let (x, y) = (row[p], row[q]);
            row[p] = c * x - s * y;
            row[q] = s * x + c * y;
        }
    });
    let mut order = (0..n).collect::<Vec<_>>();
    order.sort_by(|i, j| a[i * n + i].total_cmp(&a[j * n + j]));
    let shape = |&mode: &usize| (0..n).map(|i| vectors[i][mode] / masses_kg[i].sqrt()).collect();
    order.iter().map(shape).collect()
}

/// M^-1/2 K M^-1/2, `[n * n]`.
fn scaled_stiffness(masses_kg: &[f64], springs: &[(Node, usize, f64)]) -> Vec<f64> {
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
    a
}

/// Makes a symmetric matrix diagonal by cyclic Jacobi rotations; each is passed on as (p, q, cosine, sine).
fn diagonalise(a: &mut [f64], n: usize, mut rotated: impl FnMut(usize, usize, f64, f64)) {
    for _ in 0..50 {
        let diagonal: f64 = (0..n).map(|i| a[i * n + i].powi(2)).sum();
        let off: f64 = (0..n).flat_map(|i| (0..i).map(move |j| (i, j))).map(|(i, j)| a[i * n + j].powi(2)).sum();
        if off <= 1e-26 * diagonal {
            break;
        }
        for p in 0..n {
            for q in p + 1..n {
                if let Some((c, s)) = rotate(a, n, p, q) {
                    rotated(p, q, c, s);
                }
            }
        }
    }
}

/// Makes the entry (p, q) zero by a rotation; its cosine and sine, or `None` if the entry is zero already.
fn rotate(a: &mut [f64], n: usize, p: usize, q: usize) -> Option<(f64, f64)> {
    let entry = a[p * n + q];
    if entry == 0.0 {
        return None;
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
    Some((c, s))
}
