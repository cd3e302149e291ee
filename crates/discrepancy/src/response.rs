//! Frequencies and mode shapes, and their derivatives, for many rows that differ in a few numbers.
//!
//! Rows differ in the sizes of effects and in settings, and the frequencies and the coordinates of shapes are smooth functions of both. The eigenproblem is
//! therefore solved only at Chebyshev nodes of these numbers, between which the results are interpolated. Numbers with few
//! different values (categories, steps) are used exactly. Effects that multiply all frequencies by one factor, and effects of the
//! instrument, need no eigenproblem and are applied afterwards. If interpolation saves nothing, every different row is solved.

use std::collections::HashMap;

use nalgebra::DMatrix;

use structures::physics::effect::Target;
use structures::physics::tracked::ReferenceMode;
use structures::simulator::Simulator;

/// Numbers with at most this many different values are not interpolated.
const FEW: usize = 12;

/// Number of nodes for a range up to this fraction of the quantity that the number acts on.
const NODES: [(f64, usize); 3] = [(0.02, 5), (0.2, 7), (f64::INFINITY, MOST_NODES)];

/// Greatest number of nodes of one dimension.
const MOST_NODES: usize = 10;

/// Greatest number of dimensions of the interpolation.
const MOST_DIMENSIONS: usize = 3;

/// Responses of rows: the outputs, which are ln f of each mode and the coordinates of mode shapes, and their derivatives by the
/// parameters and by the sizes.
pub struct Responses {
    modes: usize,
    /// Number of outputs: modes, then coordinates of shapes.
    outputs: usize,
    parameters: usize,
    /// Values of an output: 1 + parameters + sizes.
    width: usize,
    /// Blocks of `[outputs][width]`.
    values: Vec<f64>,
    /// Index of the first value of each row's block, `[rows]`.
    places: Vec<usize>,
}

impl Responses {
    /// ln f of a mode in a row, f in Hz.
    fn log_frequency(&self, row: usize, mode: usize) -> f64 {
        self.value(row, mode)
    }

    /// An output in a row: ln f of a mode, f in Hz, or a coordinate of a shape, rad.
    pub fn value(&self, row: usize, output: usize) -> f64 {
        self.values[self.places[row] + output * self.width]
    }

    /// Derivatives of an output in a row by the parameters, `[parameters]`, per unit of each parameter.
    pub fn by_parameter(&self, row: usize, output: usize) -> &[f64] {
        let first = self.places[row] + output * self.width + 1;
        &self.values[first..first + self.parameters]
    }

    /// Derivatives of an output in a row by the sizes, `[sizes]`, per unit of each size.
    pub fn by_size(&self, row: usize, output: usize) -> &[f64] {
        let first = self.places[row] + output * self.width;
        &self.values[first + 1 + self.parameters..first + self.width]
    }

    /// Number of modes.
    pub fn modes(&self) -> usize {
        self.modes
    }

    /// Number of outputs: the modes, and the coordinates of shapes if they are simulated.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// The responses for parameters `theta`, `[d, rows]`, and sizes of all targets in turn, `[sizes, rows]`; `None` if the
    /// frequencies cannot be computed in some row. With `reference` modes, `[m]`, the modes are paired with them, and the outputs
    /// include the coordinates of the shapes.
    pub fn new(
        simulator: &Simulator,
        reference: Option<&[ReferenceMode]>,
        targets: &[Target],
        theta: &DMatrix<f64>,
        sizes: &DMatrix<f64>,
    ) -> Option<Self> {
        let after = Afterwards::new(simulator, targets);
        if after.steps.is_empty() {
            return Self::structural(simulator, reference, targets, theta, sizes);
        }
        let left: Vec<Target> = after.structural.iter().map(|(target, _)| targets[*target].clone()).collect();
        let own = |(target, first): &(usize, usize)| *first..first + targets[*target].sizes();
        let picked: Vec<usize> = after.structural.iter().flat_map(own).collect();
        let inner = Self::structural(simulator, reference, &left, theta, &sizes.select_rows(&picked))?;
        after.apply(&inner, targets, sizes)
    }

    /// Responses of consecutive rows from their values, `[rows][outputs][1 + parameters + sizes]`.
    pub(super) fn from_values(
        (modes, outputs): (usize, usize),
        parameters: usize,
        sizes: usize,
        values: Vec<f64>,
    ) -> Self {
        let width = 1 + parameters + sizes;
        let block = outputs * width;
        Self {
            modes,
            outputs,
            parameters,
            width,
            places: (0..values.len() / block).map(|row| row * block).collect(),
            values,
        }
    }

    /// As [`Self::new`], but solves the eigenproblem for all targets.
    fn structural(
        simulator: &Simulator,
        reference: Option<&[ReferenceMode]>,
        targets: &[Target],
        theta: &DMatrix<f64>,
        sizes: &DMatrix<f64>,
    ) -> Option<Self> {
        let (modes, parameters) = (simulator.modes(), simulator.space().len());
        let (count, rows) = sizes.shape();
        let width = 1 + parameters + count;
        let coordinates = reference.map_or(0, |reference| reference.len() * (simulator.shape_points() - 1));
        let outputs = modes + coordinates;
        let places = Vec::with_capacity(rows);
        let mut found = Self { modes, outputs, parameters, width, values: Vec::new(), places };
        let at = |row: usize, dimension: usize| {
            if dimension < parameters {
                theta[(dimension, row)]
            } else {
                sizes[(dimension - parameters, row)]
            }
        };
        let mut smooth: Vec<Dimension> = Vec::new();
        for index in 0..parameters + count {
            let values = (0..rows).map(|row| at(row, index));
            if let Some(dimension) = Dimension::new(index, values, parameters, targets) {
                smooth.push(dimension);
            }
        }
        let corners: usize = smooth.iter().map(|d| d.nodes.len()).product();
        let interpolated = !smooth.is_empty() && smooth.len() <= MOST_DIMENSIONS && 2 * corners < rows;
        let mut known = Known::default();
        let exact: Vec<usize> = (0..parameters + count).filter(|i| smooth.iter().all(|d| d.index != *i)).collect();
        // Rows with the same values of all numbers that are not interpolated share their nodes.
        let mut shared: HashMap<Vec<u64>, Vec<usize>> = HashMap::new();
        let (mut weights, mut further, mut key): (Vec<f64>, Vec<f64>, Vec<u64>) = Default::default();
        let mut point = Vec::with_capacity(parameters + count);
        for row in 0..rows {
            point.clear();
            point.extend(theta.column(row).iter().chain(sizes.column(row).iter()));
            if !interpolated {
                let place = found.solved(simulator, reference, targets, &mut known, &point)?;
                found.places.push(place);
                continue;
            }
            // The weight of a node is the product of its weights in each dimension.
            weights.clear();
            weights.push(1.0);
            for dimension in &smooth {
                further.clear();
                dimension.weights(point[dimension.index], &weights, &mut further);
                std::mem::swap(&mut weights, &mut further);
            }
            key.clear();
            key.extend(exact.iter().map(|i| point[*i].to_bits()));
            if !shared.contains_key(key.as_slice()) {
                let mut sources = Vec::with_capacity(corners);
                for corner in 0..corners {
                    let mut rest = corner;
                    for dimension in smooth.iter().rev() {
                        point[dimension.index] = dimension.nodes[rest % dimension.nodes.len()];
                        rest /= dimension.nodes.len();
                    }
                    sources.push(found.solved(simulator, reference, targets, &mut known, &point)?);
                }
                shared.insert(key.clone(), sources);
            }
            let first = found.values.len();
            found.values.resize(first + outputs * width, 0.0);
            let (before, own) = found.values.split_at_mut(first);
            for (weight, source) in weights.iter().zip(&shared[key.as_slice()]) {
                for (value, node) in own.iter_mut().zip(&before[*source..*source + outputs * width]) {
                    *value += weight * node;
                }
            }
            found.places.push(first);
        }
        Some(found)
    }

    /// Index of the response at a point, which is solved if it is new.
    fn solved(
        &mut self,
        simulator: &Simulator,
        reference: Option<&[ReferenceMode]>,
        targets: &[Target],
        known: &mut Known,
        point: &[f64],
    ) -> Option<usize> {
        known.key.clear();
        known.key.extend(point.iter().map(|v| v.to_bits()));
        if let Some(place) = known.places.get(known.key.as_slice()) {
            return Some(*place);
        }
        let (theta, sizes) = point.split_at(self.parameters);
        let (response, shapes) = match reference {
            Some(reference) => simulator.respond_tracked(theta, reference, targets, sizes).ok()?,
            None => (simulator.respond(theta, self.modes, targets, sizes).ok()?, None),
        };
        let place = self.values.len();
        for (mode, f) in response.frequencies_hz.iter().enumerate() {
            if !(f.is_finite() && *f > 0.0) {
                return None;
            }
            self.values.push(f.ln());
            self.values.extend((0..self.parameters).map(|k| response.by_parameter[(mode, k)] / f));
            self.values.extend((0..sizes.len()).map(|s| response.by_size[(mode, s)] / f));
        }
        if let Some(shapes) = shapes {
            for (row, coordinate) in shapes.coordinates.iter().enumerate() {
                self.values.push(*coordinate);
                self.values.extend(shapes.by_parameter.row(row).iter());
                self.values.extend(shapes.by_size.row(row).iter());
            }
        }
        known.places.insert(known.key.clone(), place);
        Some(place)
    }
}

/// Points that have been solved.
#[derive(Default)]
struct Known {
    /// Index of the response by the bits of the point.
    places: HashMap<Vec<u64>, usize>,
    /// The bits of the point that is looked up, kept to avoid allocations.
    key: Vec<u64>,
}

/// Division of the targets into those that are applied after the eigenproblem is solved and those that are part of it.
struct Afterwards {
    /// Index of each such target, and index of its size.
    steps: Vec<(usize, usize)>,
    /// Index of each other target, and index of its first size.
    structural: Vec<(usize, usize)>,
}

impl Afterwards {
    /// Divides the targets of a simulation.
    fn new(simulator: &Simulator, targets: &[Target]) -> Self {
        let springs = simulator.structure().map_or(0, |s| s.springs().len());
        let masses = simulator.structure().map_or(0, |s| s.masses().len());
        // A factor on all springs or masses is a factor on all frequencies only if no spring, mass or flexibility is added.
        let added = |t: &Target| {
            matches!(t, Target::AddedSpring(..) | Target::AddedMass(_) | Target::Oscillator(_) | Target::Deviation(_))
        };
        let alone = !targets.iter().any(added) && !simulator.sets_deviation();
        let (mut steps, mut structural) = (Vec::new(), Vec::new());
        let mut first = 0;
        for (index, target) in targets.iter().enumerate() {
            let later = match target {
                Target::FrequencyScale(_) | Target::FrequencyOffset(_) => true,
                Target::Springs(all) => alone && all.len() == springs,
                Target::Masses(all) => alone && all.len() == masses,
                _ => false,
            };
            if later { &mut steps } else { &mut structural }.push((index, first));
            first += target.sizes();
        }
        Self { steps, structural }
    }

    /// Applies the targets to the responses of the others; `None` if a frequency or a factor is not positive.
    ///
    /// ```text
    ///  f' = f·Π s + Σ o;   s = 1 + g, √(1 + g) for all springs, 1/√(1 + g) for all masses
    ///  ∂ln f'/∂· = (f·Π s/f') ∂ln f/∂·,   ∂ln f'/∂g = (f·Π s/f') ∂ln s/∂g,   ∂ln f'/∂o = 1/f'
    /// ```
    fn apply(&self, inner: &Responses, targets: &[Target], sizes: &DMatrix<f64>) -> Option<Responses> {
        let (modes, outputs, parameters) = (inner.modes, inner.outputs, inner.parameters);
        let (count, rows) = sizes.shape();
        let width = 1 + parameters + count;
        let mut values = vec![0.0; rows * outputs * width];
        for (row, sizes) in sizes.column_iter().enumerate() {
            for mode in 0..modes {
                let line = &mut values[(row * outputs + mode) * width..(row * outputs + mode + 1) * width];
                let mut scaled_hz = inner.log_frequency(row, mode).exp();
                let mut offset_hz = 0.0;
                for (target, column) in &self.steps {
                    let size = sizes[*column];
                    let here = |m: &Option<usize>| m.is_none_or(|m| m == mode);
                    let factor = 1.0 + size;
                    let (scale, slope) = match &targets[*target] {
                        Target::Springs(_) => (factor.sqrt(), 0.5 / factor),
                        Target::Masses(_) => (1.0 / factor.sqrt(), -0.5 / factor),
                        Target::FrequencyScale(m) if here(m) => (factor, 1.0 / factor),
                        Target::FrequencyOffset(m) if here(m) => {
                            offset_hz += size;
                            (1.0, 0.0)
                        }
                        _ => (1.0, 0.0),
                    };
                    if !(factor > 0.0 || matches!(targets[*target], Target::FrequencyOffset(_))) {
                        return None;
                    }
                    scaled_hz *= scale;
                    line[1 + parameters + column] = slope;
                }
                let f = scaled_hz + offset_hz;
                if !(f.is_finite() && f > 0.0) {
                    return None;
                }
                let share = scaled_hz / f;
                line[0] = f.ln();
                for (own, by) in line[1..].iter_mut().zip(inner.by_parameter(row, mode)) {
                    *own = share * by;
                }
                for (target, column) in &self.steps {
                    let own = &mut line[1 + parameters + column];
                    *own = match &targets[*target] {
                        Target::FrequencyOffset(m) => f64::from(u8::from(m.is_none_or(|m| m == mode))) / f,
                        _ => share * *own,
                    };
                }
                let mut place = 0;
                for (target, first) in &self.structural {
                    for which in 0..targets[*target].sizes() {
                        line[1 + parameters + first + which] = share * inner.by_size(row, mode)[place];
                        place += 1;
                    }
                }
            }
            for output in modes..outputs {
                let line = &mut values[(row * outputs + output) * width..(row * outputs + output + 1) * width];
                self.copy_shape(inner, targets, (row, output), line);
            }
        }
        let places = (0..rows).map(|row| row * outputs * width).collect();
        Some(Responses { modes, outputs, parameters, width, values, places })
    }
}

impl Afterwards {
    /// Copies a coordinate of a shape in a row with its derivatives to `line`: a factor on all frequencies, or an error of the
    /// instrument, does not change shapes.
    fn copy_shape(&self, inner: &Responses, targets: &[Target], (row, output): (usize, usize), line: &mut [f64]) {
        let parameters = inner.parameters;
        line[0] = inner.value(row, output);
        line[1..=parameters].copy_from_slice(inner.by_parameter(row, output));
        let mut by_size = inner.by_size(row, output).iter();
        for (target, first) in &self.structural {
            let own = 1 + parameters + first;
            for (slope, by) in line[own..own + targets[*target].sizes()].iter_mut().zip(&mut by_size) {
                *slope = *by;
            }
        }
    }
}

/// One dimension of the interpolation.
struct Dimension {
    index: usize,
    nodes: Vec<f64>,
    /// Barycentric weights of the nodes.
    barycentric: Vec<f64>,
}

impl Dimension {
    /// The nodes for these values; `None` for a number with few different values.
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
        let count = NODES.iter().find(|(limit, _)| range <= *limit).map_or(MOST_NODES, |n| n.1);
        // Chebyshev nodes of the first kind, which have closed-form barycentric weights.
        let angle = |i: usize| std::f64::consts::PI * (2 * i + 1) as f64 / (2 * count) as f64;
        let nodes = (0..count).map(|i| f64::midpoint(low, high) - 0.5 * (high - low) * angle(i).cos()).collect();
        let sign = |i: usize| if i.is_multiple_of(2) { 1.0 } else { -1.0 };
        let barycentric = (0..count).map(|i| sign(i) * angle(i).sin()).collect();
        Some(Self { index, nodes, barycentric })
    }

    /// Appends the products of each of `before` with the weight of each node at a value.
    fn weights(&self, value: f64, before: &[f64], products: &mut Vec<f64>) {
        let mut own = [0.0; MOST_NODES];
        let own = &mut own[..self.nodes.len()];
        for (weight, (node, barycentric)) in own.iter_mut().zip(self.nodes.iter().zip(&self.barycentric)) {
            *weight = barycentric / (value - node);
        }
        // A value at a node takes its result from that node alone.
        if let Some(at) = own.iter().position(|weight| weight.is_infinite()) {
            own.fill(0.0);
            own[at] = 1.0;
        }
        let scale = own.iter().sum::<f64>().recip();
        for weight in own.iter_mut() {
            *weight *= scale;
        }
        for earlier in before {
            products.extend(own.iter().map(|weight| earlier * weight));
        }
    }
}

/// The size at which an effect changes its target by 100 %: 1 for relative targets. For other targets it is unknown; the tiny
/// number returned for them makes their relative range large, so that the greatest number of nodes is used.
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

#[cfg(test)]
mod tests {
    use super::*;
    use structures::physics::Node;
    use structures::simulator::definition::StructureDefinition;

    /// Compares the responses with the solution of one eigenproblem for each row.
    #[test]
    fn interpolated_responses_equal_those_of_single_rows() {
        let text = include_str!("../../../models/three-dof/structure.toml");
        let simulator = Simulator::new(StructureDefinition::parse_toml(text).unwrap()).unwrap();
        let all: Vec<usize> = (0..6).collect();
        let sets: [Vec<Target>; 3] = [
            vec![Target::Springs(vec![3]), Target::Springs(all), Target::FrequencyOffset(Some(1))],
            vec![Target::Masses(vec![1]), Target::FrequencyScale(None), Target::FrequencyScale(Some(2))],
            vec![
                Target::AddedSpring(Node::Dof(0), Node::Dof(2)),
                Target::Masses(vec![0, 1, 2]),
                Target::FrequencyOffset(None),
            ],
        ];
        for targets in sets {
            let row = |i: usize| {
                let (a, b, c) = ((0.37 * i as f64).sin(), (0.91 * i as f64).cos(), (1.7 * i as f64).sin());
                vec![0.15 * a, 0.1 * b, 0.004 * c]
            };
            let rows: Vec<Vec<f64>> = (0..400).map(row).collect();
            let theta = DMatrix::from_fn(3, rows.len(), |k, _| 4.0 + k as f64);
            let sizes = DMatrix::from_fn(3, rows.len(), |k, row| rows[row][k]);
            let many = Responses::new(&simulator, None, &targets, &theta, &sizes).unwrap();
            for (place, sizes) in rows.iter().enumerate().step_by(7) {
                let one = simulator.respond(&[4.0, 5.0, 6.0], 3, &targets, sizes).unwrap();
                for (mode, f) in one.frequencies_hz.iter().enumerate() {
                    // The smallest noise is 1e-5, so that an error of 1e-6 in ln f is negligible.
                    assert!((many.log_frequency(place, mode) - f.ln()).abs() < 1e-6, "{targets:?}");
                    for k in 0..3 {
                        let exact = one.by_parameter[(mode, k)] / f;
                        assert!((many.by_parameter(place, mode)[k] - exact).abs() < 1e-5, "{targets:?}, parameter {k}");
                        let exact = one.by_size[(mode, k)] / f;
                        assert!((many.by_size(place, mode)[k] - exact).abs() < 1e-4, "{targets:?}, size {k}");
                    }
                }
            }
        }
    }
}
