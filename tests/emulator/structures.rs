//! Spring chains whose parameters lie in the unit cube.

use nalgebra::DMatrix;

/// Natural frequencies of a chain of masses, Hz. The spring `ground[i]` (N/m) connects mass i to the ground, and `coupling[i]`
/// connects it to mass i + 1.
fn chain(kg: &[f64], ground: &[f64], coupling: &[f64]) -> Vec<f64> {
    let n = kg.len();
    let mut scaled = DMatrix::<f64>::zeros(n, n);
    for i in 0..n {
        scaled[(i, i)] += ground[i] / kg[i];
    }
    for (i, k) in coupling.iter().enumerate() {
        scaled[(i, i)] += k / kg[i];
        scaled[(i + 1, i + 1)] += k / kg[i + 1];
        let mixed = k / (kg[i] * kg[i + 1]).sqrt();
        scaled[(i, i + 1)] -= mixed;
        scaled[(i + 1, i)] -= mixed;
    }
    let mut eigenvalues: Vec<f64> = scaled.symmetric_eigenvalues().iter().copied().collect();
    eigenvalues.sort_by(f64::total_cmp);
    eigenvalues.iter().map(|lambda| lambda.sqrt() / std::f64::consts::TAU).collect()
}

/// The laboratory rig: three masses whose couplings are set by the positions p12, p23 = 0.12 m · u.
pub fn rig(u: &[f64]) -> Vec<f64> {
    let k12 = 221.75 * (31.64 * 0.12 * u[0]).exp() + 855.75;
    let k23 = 300.45 * (28.89 * 0.12 * u[1]).exp() + 725.37;
    chain(&[1.52, 2.30, 1.08], &[4954.0; 3], &[k12, k23])
}

/// The lowest ten modes of 20 equal masses on 20 springs of 1 kN/m ± 30 %, the first of which is connected to the ground.
pub fn long_chain(u: &[f64]) -> Vec<f64> {
    let springs: Vec<f64> = u.iter().map(|u| 1000.0 * (0.7 + 0.6 * u)).collect();
    let mut ground = vec![0.0; springs.len()];
    ground[0] = springs[0];
    let mut frequencies = chain(&vec![1.0; springs.len()], &ground, &springs[1..]);
    frequencies.truncate(10);
    frequencies
}
