//! A world in the time domain: a chain of three masses under ambient noise, with one spring that softens with amplitude.
//! Its frequencies are identified from spectra of the simulated response, without eigenvalues. (Eigenvalues only set the time
//! step, the damping and the bands in which peaks are searched.)

use std::f64::consts::TAU;
use std::fmt::Write as _;

use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use super::world::{
    frequencies_hz, mean, mean_and_sd, number, quantiles, rfc3339, rounded, structure_toml, Truth, EPOCH_2024_S,
};

/// Number of records for the measurements, and of records at constant amplitude from which the noise is estimated.
const RECORDS: (usize, usize) = (100, 30);
/// Length of a record in periods of the lowest mode.
const PERIODS: f64 = 3000.0;
/// Steps in a period of the highest mode, and steps between samples.
const STEPS: (f64, usize) = (40.0, 8);
/// Samples of one segment of the averaged periodogram.
const SEGMENT: usize = 8192;
/// Greatest rms elongation of the softening spring.
const TOP_RMS_M: f64 = 2e-3;
/// Elongation beyond which the softening spring continues linearly with its tangent.
const LAST_CUBIC_M: f64 = 3.0 * TOP_RMS_M;

/// A structure file, measurements of the same structure with a softening spring, and the truth.
#[derive(Debug, Clone)]
pub struct SpectrumWorld {
    /// Seed it was drawn from.
    pub seed: u64,
    /// Structure file, at the linear stiffness.
    pub structure_toml: String,
    /// Measurements, one row each.
    pub csv: String,
    /// The softening spring; its size is the effect range by equivalent linearisation, k - 3 c rms².
    pub truth: Truth,
    /// Relative scatter of each frequency at constant amplitude.
    pub scatter: [f64; 3],
    /// The world in one line.
    pub description: String,
}

/// The chain ground - m1 - m2 - m3 - ground.
#[derive(Debug, Clone)]
struct Chain {
    masses_kg: [f64; 3],
    springs_n_per_m: [f64; 4],
    softening: usize,
    /// Cubic part of the softening spring: its force is k u - c u³.
    cubic_n_per_m3: f64,
    /// Damping c = mass_rate m + spring_time k.
    mass_rate_hz: f64,
    spring_time_s: f64,
}

/// Time step and length of a record.
struct Recording {
    step_s: f64,
    warm_up: usize,
    samples: usize,
    /// Linear frequencies, which define the bands of the peaks.
    linear_hz: [f64; 3],
    damping_ratio: f64,
}

/// Simulates a chain with a softening spring, and measures it.
pub fn softening_world(seed: u64) -> SpectrumWorld {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (mut chain, recording) = std::iter::repeat_with(|| draw_chain(&mut rng)).flatten().next().expect("endless");
    let nominal_n_per_m = chain.springs_n_per_m;
    let mut others = (0..4).filter(|s| *s != chain.softening).collect::<Vec<_>>();
    others.shuffle(&mut rng);
    others.truncate(rng.random_range(1..=2));
    others.sort_unstable();
    let population = others
        .iter()
        .map(|&s| (s, nominal_n_per_m[s] * rng.random_range(0.95..1.05), rng.random_range(0.003..0.006)))
        .collect::<Vec<_>>();
    for &(spring, mean, _) in &population {
        chain.springs_n_per_m[spring] = mean;
    }

    // The response is linear without the cubic part: one record sets the strength of the force.
    let (_, unit_rms_m) = chain.record(&recording, 1.0, &mut rng);
    let top = TOP_RMS_M / unit_rms_m;
    let softening = rng.random_range(0.06..0.09);
    chain.cubic_n_per_m3 = softening * nominal_n_per_m[chain.softening] / (3.0 * TOP_RMS_M * TOP_RMS_M);

    let mut at_constant: [Vec<f64>; 3] = Default::default();
    for _ in 0..RECORDS.1 {
        let (hz, _) = chain.record(&recording, 0.55 * top, &mut rng);
        (0..3).for_each(|mode| at_constant[mode].push(hz[mode]));
    }
    let scatter = at_constant.map(|hz| {
        let (mean, sd) = mean_and_sd(&hz);
        sd / mean
    });
    let noise = rounded(mean(&scatter.map(|s| s * s)).sqrt(), 3);

    let mut csv = String::from("measured_at,f1_hz,f2_hz,f3_hz,amplitude_mm\n");
    let mut at_s = EPOCH_2024_S;
    let mut amplitudes_mm = Vec::new();
    for _ in 0..RECORDS.0 {
        at_s += rng.random_range(20_000..300_000);
        for &(spring, mean, spread) in &population {
            let z: f64 = rng.sample(StandardNormal);
            chain.springs_n_per_m[spring] = mean * (1.0 + spread * z);
        }
        let strength = top * rng.random_range(0.3_f64.ln()..0.0).exp();
        let (hz, rms_m) = chain.record(&recording, strength, &mut rng);
        let cells = hz.map(number).join(",");
        let _ = writeln!(csv, "{},{cells},{}", rfc3339(at_s), number(1e3 * rms_m));
        amplitudes_mm.push(1e3 * rms_m);
    }
    let (low_mm, high_mm) = quantiles(amplitudes_mm);
    let squares_m2 = 1e-6 * (high_mm * high_mm - low_mm * low_mm);
    let size = -3.0 * chain.cubic_n_per_m3 * squares_m2 / nominal_n_per_m[chain.softening];
    let name = |spring: usize| format!("k{}", spring + 1);
    let free = others.iter().map(|&s| name(s)).collect::<Vec<_>>();
    let description = format!(
        "chain of 3 masses, free {}, noise {:.3} %: spring {} softens with amplitude_mm {size:.4}",
        free.join(" "),
        100.0 * noise,
        name(chain.softening)
    );
    let truth = Truth {
        kind: "spring",
        name: name(chain.softening),
        between: None,
        law: "quadratic",
        covariate: Some("amplitude_mm".to_owned()),
        level: None,
        size,
    };
    SpectrumWorld {
        seed,
        structure_toml: chain_toml(chain.masses_kg, nominal_n_per_m, noise, &free),
        csv,
        truth,
        scatter,
        description,
    }
}

/// Ends of the springs of the chain; the last one goes back to the ground.
const ENDS: [(Option<usize>, usize); 4] = [(None, 0), (Some(0), 1), (Some(1), 2), (None, 2)];

fn chain_toml(masses_kg: [f64; 3], springs_n_per_m: [f64; 4], noise: f64, free: &[String]) -> String {
    let mass = |m: usize| format!("m{}", m + 1);
    let masses = (0..3).map(|m| (mass(m), masses_kg[m])).collect::<Vec<_>>();
    let spring = |s: usize| {
        let (from, to) = ENDS[s];
        (format!("k{}", s + 1), from.map_or("ground".to_owned(), mass), mass(to), springs_n_per_m[s])
    };
    structure_toml(3, noise, &masses, &(0..4).map(spring).collect::<Vec<_>>(), free)
}

/// A chain whose modes lie well apart, still linear.
fn draw_chain(rng: &mut ChaCha8Rng) -> Option<(Chain, Recording)> {
    let tie = rng.random_range(1500.0..6000.0);
    let masses_kg = [(); 3].map(|()| rounded(rng.random_range(0.6..1.4), 4));
    let springs_n_per_m = [(); 4].map(|()| rounded(tie * rng.random_range(0.7..1.4), 4));
    let springs = (0..4).map(|s| (ENDS[s].0, ENDS[s].1, springs_n_per_m[s])).collect::<Vec<_>>();
    let hz = frequencies_hz(&masses_kg, &springs)?;
    if hz[1] < 1.3 * hz[0] || hz[2] < 1.2 * hz[1] || hz[2] > 3.5 * hz[0] {
        return None;
    }
    let damping_ratio = rng.random_range(0.005..0.008);
    // Equal damping ratios of the lowest and the highest mode.
    let (low, high) = (TAU * hz[0], TAU * hz[2]);
    let chain = Chain {
        masses_kg,
        springs_n_per_m,
        softening: rng.random_range(0..4),
        cubic_n_per_m3: 0.0,
        mass_rate_hz: 2.0 * damping_ratio * low * high / (low + high),
        spring_time_s: 2.0 * damping_ratio / (low + high),
    };
    let step_s = 1.0 / (STEPS.0 * hz[2]);
    let recording = Recording {
        step_s,
        warm_up: (5.0 / (damping_ratio * low * step_s)) as usize,
        samples: (PERIODS / (hz[0] * step_s * STEPS.1 as f64)) as usize,
        linear_hz: [hz[0], hz[1], hz[2]],
        damping_ratio,
    };
    Some((chain, recording))
}

type State = [f64; 6];

impl Chain {
    /// Difference between the linear force and that of the softening spring: c u³, continued along its tangent where the cubic
    /// would otherwise make the stiffness negative.
    fn softened_n(&self, elongation_m: f64) -> f64 {
        let cubic_m = elongation_m.clamp(-LAST_CUBIC_M, LAST_CUBIC_M);
        self.cubic_n_per_m3 * cubic_m * cubic_m * (cubic_m + 3.0 * (elongation_m - cubic_m))
    }

    /// Velocities and accelerations.
    fn rate(&self, state: &State, force_n: &[f64; 3]) -> State {
        let [x1, x2, x3, v1, v2, v3] = *state;
        let elongation = [x1, x2 - x1, x3 - x2, -x3];
        let speed = [v1, v2 - v1, v3 - v2, -v3];
        let mut pull = [0.0; 4];
        for s in 0..4 {
            pull[s] = self.springs_n_per_m[s] * (elongation[s] + self.spring_time_s * speed[s]);
        }
        pull[self.softening] -= self.softened_n(elongation[self.softening]);
        let mut rate = [v1, v2, v3, 0.0, 0.0, 0.0];
        for m in 0..3 {
            let net = force_n[m] + pull[m + 1] - pull[m];
            rate[3 + m] = net / self.masses_kg[m] - self.mass_rate_hz * state[3 + m];
        }
        rate
    }

    /// One Runge-Kutta step under a constant force.
    fn step(&self, state: &State, force_n: &[f64; 3], step_s: f64) -> State {
        let ahead = |rate: &State, by: f64| std::array::from_fn::<_, 6, _>(|i| state[i] + by * rate[i]);
        let a = self.rate(state, force_n);
        let b = self.rate(&ahead(&a, 0.5 * step_s), force_n);
        let c = self.rate(&ahead(&b, 0.5 * step_s), force_n);
        let d = self.rate(&ahead(&c, step_s), force_n);
        std::array::from_fn(|i| state[i] + step_s / 6.0 * (a[i] + 2.0 * (b[i] + c[i]) + d[i]))
    }

    /// Frequencies read from a record, and the rms elongation of the softening spring.
    fn record(&self, recording: &Recording, strength: f64, rng: &mut ChaCha8Rng) -> ([f64; 3], f64) {
        // A force of this size, constant within a step, has a spectral density that does not depend on the step.
        let size_n = strength / recording.step_s.sqrt();
        let mut state = State::default();
        let mut next = |steps: usize| {
            for _ in 0..steps {
                let force_n = [(); 3].map(|()| size_n * rng.sample::<f64, _>(StandardNormal));
                state = self.step(&state, &force_n, recording.step_s);
            }
            state
        };
        next(recording.warm_up);
        let mut channels: [Vec<f64>; 3] = Default::default();
        let mut squares_m2 = 0.0;
        for _ in 0..recording.samples {
            let state = next(STEPS.1);
            let elongation = [state[0], state[1] - state[0], state[2] - state[1], -state[2]];
            squares_m2 += elongation[self.softening].powi(2);
            (0..3).for_each(|m| channels[m].push(state[m]));
        }
        assert!(squares_m2.is_finite(), "the softening spring gave way");
        (recording.peaks_hz(&channels), (squares_m2 / recording.samples as f64).sqrt())
    }
}

impl Recording {
    /// Frequency of the peak of each mode in the sum of the spectra of all channels.
    fn peaks_hz(&self, channels: &[Vec<f64>; 3]) -> [f64; 3] {
        let mut spectrum = vec![0.0; SEGMENT / 2];
        for samples in channels {
            add_periodograms(samples, &mut spectrum);
        }
        let bin_hz = 1.0 / (self.step_s * STEPS.1 as f64 * SEGMENT as f64);
        let [f1, f2, f3] = self.linear_hz;
        let between = [0.5 * f1, (f1 * f2).sqrt(), (f2 * f3).sqrt(), 1.3 * f3];
        std::array::from_fn(|mode| {
            let band = (between[mode] / bin_hz) as usize..(between[mode + 1] / bin_hz) as usize;
            let top = band.max_by(|a, b| spectrum[*a].total_cmp(&spectrum[*b])).expect("a band has bins");
            let half_bins = (2.0 * self.damping_ratio * self.linear_hz[mode] / bin_hz).ceil() + 1.0;
            // Twice, so that the second window is centred on the peak.
            let first = peak_bin(&spectrum, top as f64, half_bins);
            bin_hz * peak_bin(&spectrum, first, half_bins)
        })
    }
}

/// Position of a resonance near a bin: the reciprocal spectrum is a parabola in the square of the frequency, which is fitted
/// with equal weights for relative errors.
fn peak_bin(spectrum: &[f64], centre: f64, half_bins: f64) -> f64 {
    let scale = spectrum[centre.round() as usize];
    let mut normal = [[0.0; 4]; 3];
    let (first, last) = ((centre - half_bins).round() as usize, (centre + half_bins).round() as usize);
    for (bin, power) in spectrum.iter().enumerate().take(last + 1).skip(first) {
        let power = power / scale;
        let t = ((bin as f64).powi(2) - centre * centre) / (2.0 * centre * half_bins);
        let row = [power, power * t, power * t * t, 1.0];
        for i in 0..3 {
            for j in 0..4 {
                normal[i][j] += row[i] * row[j];
            }
        }
    }
    let [_, slope, bend] = solve_3(normal);
    let t = (-slope / (2.0 * bend)).clamp(-1.0, 1.0);
    (centre * centre + 2.0 * centre * half_bins * t).sqrt()
}

/// Solves three normal equations by elimination.
fn solve_3(rows: [[f64; 4]; 3]) -> [f64; 3] {
    let mut rows = rows;
    for pivot in 0..3 {
        for below in pivot + 1..3 {
            let factor = rows[below][pivot] / rows[pivot][pivot];
            let upper = rows[pivot];
            rows[below].iter_mut().zip(upper).for_each(|(entry, above)| *entry -= factor * above);
        }
    }
    let z = rows[2][3] / rows[2][2];
    let y = (rows[1][3] - rows[1][2] * z) / rows[1][1];
    let x = (rows[0][3] - rows[0][1] * y - rows[0][2] * z) / rows[0][0];
    [x, y, z]
}

/// Adds the periodograms of half-overlapping segments with a Hann window.
fn add_periodograms(samples: &[f64], spectrum: &mut [f64]) {
    let window = (0..SEGMENT).map(|i| 0.5 - 0.5 * (TAU * i as f64 / SEGMENT as f64).cos()).collect::<Vec<_>>();
    for start in (0..samples.len().saturating_sub(SEGMENT - 1)).step_by(SEGMENT / 2) {
        let mut segment = window.iter().zip(&samples[start..]).map(|(w, s)| (w * s, 0.0)).collect::<Vec<_>>();
        fourier(&mut segment);
        spectrum.iter_mut().zip(&segment).for_each(|(power, (re, im))| *power += re * re + im * im);
    }
}

/// Discrete Fourier transform of a power of two of complex numbers, in place (radix 2, decimation in time).
pub fn fourier(values: &mut [(f64, f64)]) {
    let n = values.len();
    let bits = n.trailing_zeros();
    for i in 0..n {
        let j = i.reverse_bits() >> (usize::BITS - bits);
        if i < j {
            values.swap(i, j);
        }
    }
    let mut half = 1;
    while half < n {
        let turns = (0..half).map(|k| (-TAU * k as f64 / (2 * half) as f64).sin_cos()).collect::<Vec<_>>();
        for block in values.chunks_mut(2 * half) {
            let (low, high) = block.split_at_mut(half);
            for ((a, b), (sin, cos)) in low.iter_mut().zip(high).zip(&turns) {
                let turned = (b.0 * cos - b.1 * sin, b.0 * sin + b.1 * cos);
                (*a, *b) = ((a.0 + turned.0, a.1 + turned.1), (a.0 - turned.0, a.1 - turned.1));
            }
        }
        half *= 2;
    }
}
