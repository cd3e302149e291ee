//! Several expansions that share their terms, evaluated together with their gradients.

use std::collections::BTreeMap;

use nalgebra::DMatrix;

use super::basis::{legendre, legendre_slopes, norm, Candidates};
use super::select::Fit;

/// A Legendre polynomial of one parameter.
#[derive(Debug, Clone, Copy)]
struct Factor {
    parameter: u32,
    /// Index in the table of polynomial values.
    entry: u32,
}

/// A term of one expansion with its coefficient.
#[derive(Debug, Clone, Copy)]
struct Weight {
    term: u32,
    coefficient: f64,
}

/// Expansions in products of Legendre polynomials: `[m]` functions of x in [−1, 1]^d.
#[derive(Debug, Clone)]
pub(super) struct Expansion {
    parameters: usize,
    /// Number of polynomials per parameter in the table: the highest degree plus 1.
    orders: usize,
    factors: Vec<Factor>,
    /// Term t has the factors `ends[t]..ends[t + 1]`.
    ends: Vec<u32>,
    weights: Vec<Vec<Weight>>,
}

impl Expansion {
    /// The expansions of several fits over `parameters` parameters. Only terms that a fit uses are kept, and a term that several
    /// fits use is evaluated once.
    pub fn new<'a>(candidates: &Candidates, parameters: usize, fits: impl Iterator<Item = &'a Fit> + Clone) -> Self {
        let used: BTreeMap<usize, u32> = {
            let mut used: Vec<usize> = fits.clone().flat_map(|fit| fit.terms.iter().copied()).collect();
            used.sort_unstable();
            used.dedup();
            used.into_iter().zip(0..).collect()
        };
        let degrees = used.keys().flat_map(|&term| candidates.terms[term].iter().map(|(_, degree)| *degree));
        let orders = degrees.max().unwrap_or(0) + 1;
        let mut factors = Vec::new();
        let mut ends = vec![0];
        for &term in used.keys() {
            factors.extend(candidates.terms[term].iter().map(|&(parameter, degree)| Factor {
                parameter: parameter as u32,
                entry: (parameter * orders + degree) as u32,
            }));
            ends.push(factors.len() as u32);
        }
        let weights = |fit: &Fit| {
            // The table contains Legendre polynomials that are not normalised: the coefficients include the norms.
            let weight = |(term, coefficient): (&usize, &f64)| Weight {
                term: used[term],
                coefficient: coefficient * norm(&candidates.terms[*term]),
            };
            fit.terms.iter().zip(&fit.coefficients).map(weight).collect()
        };
        Self { parameters, orders, factors, ends, weights: fits.map(weights).collect() }
    }

    /// Values of all expansions, `[m]`; `x(j)` is parameter j, scaled to [−1, 1].
    pub fn values(&self, x: impl Fn(usize) -> f64) -> Vec<f64> {
        let terms = self.ends.len() - 1;
        let entries = self.parameters * self.orders;
        let mut scratch = vec![0.0; entries + terms];
        let (table, products) = scratch.split_at_mut(entries);
        for (parameter, values) in table.chunks_exact_mut(self.orders).enumerate() {
            legendre(x(parameter), values);
        }
        for (product, range) in products.iter_mut().zip(self.ends.windows(2)) {
            let factors = &self.factors[range[0] as usize..range[1] as usize];
            *product = factors.iter().map(|factor| table[factor.entry as usize]).product();
        }
        let value = |weights: &Vec<Weight>| weights.iter().map(|w| w.coefficient * products[w.term as usize]).sum();
        self.weights.iter().map(value).collect()
    }

    /// Values of all expansions, `[m]`, and their derivatives with respect to the scaled parameters, `[m, d]`.
    pub fn values_and_gradients(&self, x: impl Fn(usize) -> f64) -> (Vec<f64>, DMatrix<f64>) {
        let terms = self.ends.len() - 1;
        let entries = self.parameters * self.orders;
        let mut scratch = vec![0.0; 2 * entries + terms + self.factors.len()];
        let (table, rest) = scratch.split_at_mut(entries);
        let (slope_table, rest) = rest.split_at_mut(entries);
        let (products, slopes) = rest.split_at_mut(terms);
        let orders = self.orders;
        for (parameter, (values, slopes)) in
            table.chunks_exact_mut(orders).zip(slope_table.chunks_exact_mut(orders)).enumerate()
        {
            legendre(x(parameter), values);
            legendre_slopes(values, slopes);
        }
        for (product, range) in products.iter_mut().zip(self.ends.windows(2)) {
            let range = range[0] as usize..range[1] as usize;
            let (factors, slopes) = (&self.factors[range.clone()], &mut slopes[range]);
            // The product of the factors before each factor, then that of the factors after it, avoids dividing by a zero factor.
            let mut before = 1.0;
            for (slope, factor) in slopes.iter_mut().zip(factors) {
                *slope = before * slope_table[factor.entry as usize];
                before *= table[factor.entry as usize];
            }
            *product = before;
            let mut after = 1.0;
            for (slope, factor) in slopes.iter_mut().zip(factors).rev() {
                *slope *= after;
                after *= table[factor.entry as usize];
            }
        }
        let mut values = vec![0.0; self.weights.len()];
        let mut gradients = DMatrix::zeros(self.weights.len(), self.parameters);
        for (mode, weights) in self.weights.iter().enumerate() {
            let mut value = 0.0;
            for weight in weights {
                let term = weight.term as usize;
                value += weight.coefficient * products[term];
                for index in self.ends[term] as usize..self.ends[term + 1] as usize {
                    gradients[(mode, self.factors[index].parameter as usize)] += weight.coefficient * slopes[index];
                }
            }
            values[mode] = value;
        }
        (values, gradients)
    }

    /// Number of terms of an expansion.
    pub fn terms(&self, mode: usize) -> usize {
        self.weights[mode].len()
    }
}
