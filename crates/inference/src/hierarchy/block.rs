//! Assignment of measurements to SIMD lanes: sixteen measurements with one lane each, and the remaining ones with several
//! lanes each, so that few lanes are unused.

use std::iter::StepBy;
use std::ops::Range;

use super::kernel::{count_before, Lanes, Weighed, LANES};

/// Up to sixteen measurements that are processed in one vector.
#[derive(Debug, Clone)]
pub(super) struct Block {
    pub measurements: Range<usize>,
    /// Range of places that their samples occupy. A place is one entry of all lanes.
    pub places: Range<usize>,
    /// Distance between the lanes of a measurement; sixteen where it has only one.
    pub width: usize,
}

impl Block {
    /// The blocks for `measurements` measurements with `draws` samples each.
    pub fn all(measurements: usize, draws: usize) -> Vec<Self> {
        let mut places = 0;
        let one = |first: usize| {
            let own = first..(first + LANES).min(measurements);
            // As many lanes per measurement as fit into the vector and divide its samples evenly.
            let mut parts = 1;
            while 2 * parts * own.len() <= LANES && draws.is_multiple_of(2 * parts) {
                parts *= 2;
            }
            let here = places..places + draws / parts;
            places = here.end;
            Self { measurements: own, places: here, width: LANES / parts }
        };
        (0..measurements).step_by(LANES).map(one).collect()
    }

    /// Each measurement with its lanes.
    pub fn lanes(&self) -> impl Iterator<Item = (usize, StepBy<Range<usize>>)> {
        let width = self.width;
        let lanes = move |(first, measurement): (usize, usize)| (measurement, (first..LANES).step_by(width));
        self.measurements.clone().enumerate().map(lanes)
    }

    /// Place and lane of a sample.
    pub fn place(&self, measurement: usize, draw: usize) -> (usize, usize) {
        let each = self.places.len();
        (self.places.start + draw % each, measurement - self.measurements.start + draw / each * self.width)
    }

    /// Selects one sample of each measurement with probability proportional to its weight (`values`, `[place]`), by
    /// inversion of the cumulative weight at `share()`, a number in [0, 1). Appends place and lane of each.
    pub fn choose(
        &self,
        values: &[Lanes],
        weighed: &Weighed,
        mut share: impl FnMut() -> f32,
        chosen: &mut Vec<(usize, usize)>,
    ) {
        let mut targets = Lanes::ZERO;
        for (_, lanes) in self.lanes() {
            let mut left = share() * weighed.sum.of(lanes.clone()) as f32;
            for lane in lanes {
                targets.0[lane] = left;
                left -= weighed.sum.0[lane];
            }
        }
        let counts = count_before(&values[self.places.clone()], &targets);
        let draws = self.places.len() * LANES / self.width;
        for (measurement, lanes) in self.lanes() {
            let before: usize = lanes.map(|lane| counts[lane] as usize).sum();
            // With rounding errors the target can exceed the sum of all weights.
            chosen.push(self.place(measurement, before.min(draws - 1)));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::f64::consts::LOG2_E;

    use super::super::kernel::{weigh, Terms};
    use super::*;

    const SIZES: [(usize, usize); 8] = [(1, 64), (3, 10), (4, 64), (5, 7), (9, 64), (16, 64), (20, 64), (50, 16)];

    #[test]
    fn every_sample_has_its_own_place() {
        for (measurements, draws) in SIZES {
            let mut seen = BTreeSet::new();
            let blocks = Block::all(measurements, draws);
            for block in &blocks {
                for (measurement, lanes) in block.lanes() {
                    let lanes: Vec<usize> = lanes.collect();
                    for draw in 0..draws {
                        let (place, lane) = block.place(measurement, draw);
                        assert!(block.places.contains(&place) && lanes.contains(&lane), "{measurement}, {draw}");
                        assert!(seen.insert((place, lane)), "{measurements} measurements: {place}, {lane} twice");
                    }
                }
            }
            assert_eq!(seen.len(), measurements * draws);
            assert_eq!(blocks.last().unwrap().measurements.end, measurements);
        }
        // Four of twenty remain for the second block, which takes a quarter of the steps.
        assert_eq!(Block::all(20, 64).last().unwrap().places, 64..80);
    }

    #[test]
    fn samples_are_selected_by_their_weight_for_any_number_of_lanes() {
        for (measurements, draws) in SIZES {
            let exponent = |measurement: usize, draw: usize| (draw as f64 * 1.3 - measurement as f64).cos() * 2.0;
            for block in Block::all(measurements, draws) {
                let mut offsets = vec![Lanes::ZERO; block.places.end];
                for measurement in block.measurements.clone() {
                    for draw in 0..draws {
                        let (place, lane) = block.place(measurement, draw);
                        offsets[place].0[lane] = (exponent(measurement, draw) * LOG2_E) as f32;
                    }
                }
                // All samples are at their centre, so that only their own weights matter.
                let (centred, mut values) = ([vec![Lanes::ZERO; block.places.end]], offsets.clone());
                let (places, linears) = (block.places.clone(), [Lanes::ZERO]);
                let (own, offsets) = (&mut values[places.clone()], &offsets[places.clone()]);
                let terms = Terms {
                    to: offsets,
                    deviations: &centred,
                    places,
                    squares: &[0.0],
                    linears: &linears,
                    crosses: &[],
                };
                let mut logarithms = own.to_vec();
                let weighed = weigh(own, &mut logarithms, &terms, block.width, &Lanes([-1e4; LANES]));
                let mut counts = vec![[0.0; LANES]; block.places.end];
                let shares = 10_000_u32;
                for i in 0..shares {
                    let mut chosen = Vec::new();
                    block.choose(&values, &weighed, || ((f64::from(i) + 0.5) / f64::from(shares)) as f32, &mut chosen);
                    assert_eq!(chosen.len(), block.measurements.len());
                    for (place, lane) in chosen {
                        counts[place][lane] += 1.0;
                    }
                }
                for (measurement, lanes) in block.lanes() {
                    let all: f64 = (0..draws).map(|draw| exponent(measurement, draw).exp()).sum();
                    let largest = (0..draws).map(|draw| exponent(measurement, draw)).fold(f64::NEG_INFINITY, f64::max);
                    // Single precision: 6e-8 times several operations, and a sum of up to 64.
                    let (found, expected) = (weighed.sum.of(lanes), all / largest.exp());
                    assert!((found / expected - 1.0).abs() < 1e-5, "{measurements}: {found}, expected {expected}");
                    for draw in 0..draws {
                        let (place, lane) = block.place(measurement, draw);
                        let expected = exponent(measurement, draw).exp() / all * f64::from(shares);
                        // Over all shares each sample is selected in proportion to its weight, to within one at both ends.
                        assert!((counts[place][lane] - expected).abs() < 2.5, "{measurement}, {draw}: {expected}");
                    }
                }
            }
        }
    }
}
