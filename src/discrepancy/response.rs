//! Frequencies and slopes of many rows that differ in a few numbers.
//!
//! Rows differ in the sizes of effects and in settings, and in each smoothly. So the eigenproblem is solved at Chebyshev
//! nodes of those numbers and interpolated between them; numbers with few different values (categories, steps) are met
//! exactly. Where that would save nothing, every different row is solved.

use std::collections::HashMap;

use crate::physics::effect::Target;
use crate::simulator::Simulator;

/// Numbers with at most this many different values are met exactly.
const FEW: usize = 12;

/// Ranges, as a share of what they act on, up to which so many nodes do; beyond the last, the last number.
const NODES: [(f64, usize); 3] = [(0.02, 5), (0.2, 7), (f64::INFINITY, 10)];

/// Most numbers to interpolate over.
const MOST_DIMENSIONS: usize = 3;

/// Of each row: ln f, ∂ln f/∂x, ∂ln f/∂size.
pub struct Responses {
    modes: usize,
    parameters: usize,
    width: usize,
    values: Vec<f64>,
    places: Vec<usize>,
}

impl Responses {
    /// ln f of a mode, f in Hz.
    pub fn log_frequency(&self, row: usize, mode: usize) -> f64 {
        self.values[self.places[row] + mode * self.width]
    }

    /// ∂ln f/∂x of a mode, one for each parameter.
    pub fn by_parameter(&self, row: usize, mode: usize) -> &[f64] {
        let first = self.places[row] + mode * self.width + 1;
        &self.values[first..first + self.parameters]
    }

    /// ∂ln f/∂size of a mode, one for each size.
    pub fn by_size(&self, row: usize, mode: usize) -> &[f64] {
        let first = self.places[row] + mode * self.width;
        &self.values[first + 1 + self.parameters..first + self.width]
    }

    /// Number of modes.
    pub fn modes(&self) -> usize {
        self.modes
    }

    /// The responses at each row of parameters and sizes; `None` where the structure has no frequencies.
    pub fn new(simulator: &Simulator, targets: &[Target], theta: &[Vec<f64>], sizes: &[Vec<f64>]) -> Option<Self> {
        let (modes, parameters) = (simulator.modes(), simulator.space().len());
        let count = sizes.first().map_or(0, Vec::len);
        let width = 1 + parameters + count;
        let mut found = Self { modes, parameters, width, values: Vec::new(), places: Vec::with_capacity(theta.len()) };
        let at = |row: usize, dimension: usize| {
            if dimension < parameters {
                theta[row][dimension]
            } else {
                sizes[row][dimension - parameters]
            }
        };
        let mut smooth: Vec<Dimension> = Vec::new();
        for index in 0..parameters + count {
            let values = (0..theta.len()).map(|row| at(row, index));
            if let Some(dimension) = Dimension::new(index, values, parameters, targets) {
                smooth.push(dimension);
            }
        }
        let corners: usize = smooth.iter().map(|d| d.nodes.len()).product();
        let interpolated = !smooth.is_empty() && smooth.len() <= MOST_DIMENSIONS && 2 * corners < theta.len();
        let mut known: HashMap<Vec<u64>, usize> = HashMap::new();
        let mut weights: Vec<f64> = Vec::new();
        for row in 0..theta.len() {
            let mut point: Vec<f64> = theta[row].iter().chain(&sizes[row]).copied().collect();
            if !interpolated {
                let place = found.solved(simulator, targets, &mut known, &point)?;
                found.places.push(place);
                continue;
            }
            // Weights of all corners: the product over the dimensions.
            weights.clear();
            weights.push(1.0);
            for dimension in &smooth {
                let along = dimension.weights(point[dimension.index]);
                weights = weights.iter().flat_map(|w| along.iter().map(move |a| w * a)).collect();
            }
            let mut sources = Vec::with_capacity(corners);
            for corner in 0..corners {
                let mut rest = corner;
                for dimension in smooth.iter().rev() {
                    point[dimension.index] = dimension.nodes[rest % dimension.nodes.len()];
                    rest /= dimension.nodes.len();
                }
                sources.push(found.solved(simulator, targets, &mut known, &point)?);
            }
            let first = found.values.len();
            found.values.resize(first + modes * width, 0.0);
            let (before, own) = found.values.split_at_mut(first);
            for (weight, source) in weights.iter().zip(&sources) {
                for (value, node) in own.iter_mut().zip(&before[*source..*source + modes * width]) {
                    *value += weight * node;
                }
            }
            found.places.push(first);
        }
        Some(found)
    }

    /// Place of the response at a point, solved if it is new.
    fn solved(
        &mut self,
        simulator: &Simulator,
        targets: &[Target],
        known: &mut HashMap<Vec<u64>, usize>,
        point: &[f64],
    ) -> Option<usize> {
        let key: Vec<u64> = point.iter().map(|v| v.to_bits()).collect();
        if let Some(place) = known.get(&key) {
            return Some(*place);
        }
        let (theta, sizes) = point.split_at(self.parameters);
        let response = simulator.respond(theta, self.modes, targets, sizes).ok()?;
        let place = self.values.len();
        for (mode, f) in response.frequencies_hz.iter().enumerate() {
            if !(f.is_finite() && *f > 0.0) {
                return None;
            }
            self.values.push(f.ln());
            self.values.extend((0..self.parameters).map(|k| response.by_parameter[(mode, k)] / f));
            self.values.extend((0..sizes.len()).map(|s| response.by_size[(mode, s)] / f));
        }
        known.insert(key, place);
        Some(place)
    }
}

/// A number that is interpolated over.
struct Dimension {
    index: usize,
    nodes: Vec<f64>,
    /// Barycentric weights of the nodes.
    barycentric: Vec<f64>,
}

impl Dimension {
    /// `None` for a number with few different values.
    fn new(
        index: usize,
        values: impl Iterator<Item = f64> + Clone,
        parameters: usize,
        targets: &[Target],
    ) -> Option<Self> {
        let mut different: Vec<u64> = Vec::with_capacity(FEW + 1);
        for value in values.clone() {
            let bits = value.to_bits();
            if different.len() <= FEW && !different.contains(&bits) {
                different.push(bits);
            }
            if different.len() > FEW {
                break;
            }
        }
        if different.len() <= FEW {
            return None;
        }
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        let range = (high - low)
            / if index < parameters {
                f64::midpoint(low, high).abs().max(f64::MIN_POSITIVE)
            } else {
                scale(index - parameters, targets)
            };
        let count = NODES.iter().find(|(limit, _)| range <= *limit).map_or(10, |n| n.1);
        // Chebyshev nodes of the first kind, whose barycentric weights are known.
        let angle = |i: usize| std::f64::consts::PI * (2 * i + 1) as f64 / (2 * count) as f64;
        let nodes = (0..count).map(|i| f64::midpoint(low, high) - 0.5 * (high - low) * angle(i).cos()).collect();
        let sign = |i: usize| if i % 2 == 0 { 1.0 } else { -1.0 };
        let barycentric = (0..count).map(|i| sign(i) * angle(i).sin()).collect();
        Some(Self { index, nodes, barycentric })
    }

    /// Weight of each node at a value.
    fn weights(&self, value: f64) -> Vec<f64> {
        let mut weights = Vec::with_capacity(self.nodes.len());
        let mut sum = 0.0;
        for (place, (node, own)) in self.nodes.iter().zip(&self.barycentric).enumerate() {
            let distance = value - node;
            if distance == 0.0 {
                return (0..self.nodes.len()).map(|i| f64::from(u8::from(i == place))).collect();
            }
            let weight = own / distance;
            sum += weight;
            weights.push(weight);
        }
        weights.iter_mut().for_each(|w| *w /= sum);
        weights
    }
}

/// What a size of 1 means as a share: 1 for relative targets; of others the most nodes are taken.
fn scale(size: usize, targets: &[Target]) -> f64 {
    let mut first = 0;
    for target in targets {
        if size < first + target.sizes() {
            return match target {
                Target::Springs(_) | Target::Masses(_) | Target::FrequencyScale(_) => 1.0,
                _ => f64::MIN_POSITIVE,
            };
        }
        first += target.sizes();
    }
    1.0
}
