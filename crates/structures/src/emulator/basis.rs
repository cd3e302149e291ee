//! Products of orthonormal Legendre polynomials, and the sets of them that are candidates for an expansion.

use std::collections::BTreeMap;

use nalgebra::DMatrix;

/// Largest number of candidates in one set: there are 1,771 terms up to degree 3 in 20 parameters.
const CANDIDATES: usize = 2_000;

/// Largest number of candidates per run: with more, a search selects terms by chance.
const CANDIDATES_PER_RUN: usize = 10;

/// Exponents q of the hyperbolic truncation: 1 keeps all interactions, 0.5 keeps little more than main effects.
const TRUNCATIONS: [f64; 3] = [1.0, 0.75, 0.5];

/// Highest degree for fewer than `MANY` runs, and for more.
const DEGREE_OF_FEW: usize = 14;
const DEGREE: usize = 20;
const MANY: usize = 500;

/// A set larger than `LARGE` is tried only if it is this many times as large as the one before it.
const GROWTH: f64 = 1.25;
const LARGE: usize = 500;

/// A product of Legendre polynomials: its factors of degree 1 or more, as (parameter, degree), parameters ascending.
pub(super) type Term = Vec<(usize, usize)>;

/// The candidate terms, and the nested sets of them that are tried.
#[derive(Debug)]
pub(super) struct Candidates {
    /// The terms of all sets.
    pub terms: Vec<Term>,
    /// For each truncation, sets of ascending degree as indices of `terms`. Each set begins with the constant.
    pub ladders: Vec<Vec<Vec<usize>>>,
}

impl Candidates {
    /// The terms α of degree p under hyperbolic truncation, up to the largest p that `runs` runs allow.
    ///
    /// ```text
    ///  ‖α‖_q = (Σ α_j^q)^(1/q) ≤ p
    /// ```
    ///
    /// Source: Blatman & Sudret (2011), §3.2.
    pub fn new(parameters: usize, runs: usize) -> Self {
        let limit = CANDIDATES.min(CANDIDATES_PER_RUN * runs);
        let highest = if runs < MANY { DEGREE_OF_FEW } else { DEGREE };
        let mut index = BTreeMap::new();
        let mut terms: Vec<Term> = Vec::new();
        let mut ladders: Vec<Vec<Vec<usize>>> = Vec::new();
        for q in TRUNCATIONS {
            let mut ladder: Vec<Vec<usize>> = Vec::new();
            for degree in 1..=highest {
                // The margin includes terms that are exactly on the limit, such as (1, 1) of degree 4 for q = 0.5.
                let mut set = Vec::new();
                let budget = (degree as f64).powf(q) + 1e-9;
                if !enumerate(parameters, q, budget, 0, &mut Vec::new(), &mut set, limit) {
                    break;
                }
                let before = ladder.last().map_or(0.0, |set| set.len() as f64);
                if set.len() > LARGE && (set.len() as f64) < GROWTH * before {
                    continue;
                }
                let set = set.into_iter().map(|term| {
                    *index.entry(term).or_insert_with_key(|term| {
                        terms.push(term.clone());
                        terms.len() - 1
                    })
                });
                ladder.push(set.collect());
            }
            // With a single parameter all truncations are equal.
            if !ladders.contains(&ladder) {
                ladders.push(ladder);
            }
        }
        Self { terms, ladders }
    }

    /// Values of all terms at the runs `x` (`[n, d]`, scaled to [−1, 1]), `[n, terms]`.
    pub fn design(&self, x: &DMatrix<f64>) -> DMatrix<f64> {
        let runs = x.nrows();
        let mut design = DMatrix::from_element(runs, self.terms.len(), 1.0);
        let mut values = [0.0; DEGREE + 1];
        let mut tables = vec![0.0; x.ncols() * (DEGREE + 1)];
        for run in 0..runs {
            for parameter in 0..x.ncols() {
                legendre(x[(run, parameter)], &mut values);
                tables[parameter * (DEGREE + 1)..][..=DEGREE].copy_from_slice(&values);
            }
            for (column, term) in self.terms.iter().enumerate() {
                let product: f64 = term.iter().map(|(parameter, k)| tables[parameter * (DEGREE + 1) + k]).product();
                design[(run, column)] = norm(term) * product;
            }
        }
        design
    }
}

/// Factor √Π(2α_j + 1), by which products of Legendre polynomials are orthonormal for independent uniform parameters.
pub(super) fn norm(term: &[(usize, usize)]) -> f64 {
    term.iter().map(|(_, degree)| (2 * degree + 1) as f64).product::<f64>().sqrt()
}

/// Legendre polynomials P_0(x), P_1(x), …, as many as `values` has entries.
///
/// ```text
///  (k + 1) P_(k+1) = (2k + 1) x P_k − k P_(k−1)
/// ```
pub(super) fn legendre(x: f64, values: &mut [f64]) {
    let (mut before, mut current) = (0.0, 1.0);
    for (k, value) in values.iter_mut().enumerate() {
        *value = current;
        let k = k as f64;
        (before, current) = (current, ((2.0 * k + 1.0) * x * current - k * before) / (k + 1.0));
    }
}

/// Derivatives P'_0(x), P'_1(x), … of the Legendre polynomials, from the values of the polynomials.
///
/// ```text
///  P'_(k+1) = P'_(k−1) + (2k + 1) P_k
/// ```
pub(super) fn legendre_slopes(values: &[f64], slopes: &mut [f64]) {
    let (mut before, mut current) = (0.0, 0.0);
    for (k, (slope, value)) in slopes.iter_mut().zip(values).enumerate() {
        *slope = current;
        (before, current) = (current, before + (2 * k + 1) as f64 * value);
    }
}

/// Appends to `set` all terms that begin with `term` and continue with parameters from `first` on; false if there are more than
/// `limit`.
fn enumerate(
    parameters: usize,
    q: f64,
    budget: f64,
    first: usize,
    term: &mut Term,
    set: &mut Vec<Term>,
    limit: usize,
) -> bool {
    set.push(term.clone());
    if set.len() > limit {
        return false;
    }
    for parameter in first..parameters {
        for degree in 1..=DEGREE {
            let cost = (degree as f64).powf(q);
            if cost > budget {
                break;
            }
            term.push((parameter, degree));
            let fits = enumerate(parameters, q, budget - cost, parameter + 1, term, set, limit);
            term.pop();
            if !fits {
                return false;
            }
        }
    }
    true
}
