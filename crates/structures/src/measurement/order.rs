//! The order of the modes of a measurement: frequencies that are equal or that decrease.
//!
//! Two modes with the same frequency are one peak of the spectrum that was taken for two: the measurement says nothing about one of
//! them, and nobody knows which. Frequencies that decrease were assigned to the wrong modes: now and then by mistake, or in many
//! measurements by another convention, which is then a property of the data.

use std::fmt;

use super::ModalMeasurement;
use crate::quantity::Hertz;

/// Measurements with two equal frequencies are left out unless they are more than this share of all.
const MOST_EQUAL: f64 = 0.5;

/// Measurements with decreasing frequencies are left out unless they are more than this share of all, and more than one.
const MOST_DECREASING: f64 = 0.1;

/// Two neighbouring modes that are present and not in ascending order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Disorder {
    /// Indices of the two modes, from 0.
    modes: [usize; 2],
    /// Their frequencies, Hz.
    frequencies_hz: [f64; 2],
}

impl Disorder {
    /// The first two modes with equal frequencies; or, if there are none, the first two that decrease.
    pub fn of(frequencies_hz: &[Option<Hertz>]) -> Option<Self> {
        let present: Vec<(usize, f64)> =
            frequencies_hz.iter().enumerate().filter_map(|(mode, f)| Some((mode, (*f)?.get()))).collect();
        let pairs = present
            .windows(2)
            .map(|pair| Self { modes: [pair[0].0, pair[1].0], frequencies_hz: [pair[0].1, pair[1].1] });
        let disordered: Vec<Self> = pairs.filter(|d| d.frequencies_hz[1] <= d.frequencies_hz[0]).collect();
        disordered.iter().find(|d| d.is_equal()).or(disordered.first()).copied()
    }

    /// Whether the two frequencies are equal.
    #[expect(clippy::float_cmp, reason = "the same number was written twice")]
    pub fn is_equal(&self) -> bool {
        self.frequencies_hz[0] == self.frequencies_hz[1]
    }
}

impl fmt::Display for Disorder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ([low, high], [low_hz, high_hz]) = (self.modes.map(|mode| mode + 1), self.frequencies_hz);
        if self.is_equal() {
            write!(f, "modes {low} and {high} have the same frequency, {low_hz} Hz: one peak was taken for two modes")
        } else {
            write!(f, "mode {low} at {low_hz} Hz is not below mode {high} at {high_hz} Hz")
        }
    }
}

/// Measurements of which those with modes in disorder were left out.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Ordered {
    /// Indices of the measurements that can be used.
    pub kept: Vec<usize>,
    /// Indices of those left out, with the reason.
    pub left_out: Vec<(usize, Disorder)>,
    /// What was found in measurements that were kept because they are so many.
    pub notes: Vec<String>,
}

impl Ordered {
    /// Leaves out the measurements in which modes are equal (unless they are more than half of all) or decrease (unless they are more
    /// than a tenth of all, and more than one: the order is then a property of the data, which a diagnosis has to explain).
    pub fn of(measurements: &[ModalMeasurement]) -> Self {
        let found: Vec<(usize, Disorder)> =
            measurements.iter().enumerate().filter_map(|(i, m)| Some((i, Disorder::of(&m.frequencies_hz)?))).collect();
        let (equal, decreasing): (Vec<_>, Vec<_>) = found.into_iter().partition(|(_, disorder)| disorder.is_equal());
        let all = measurements.len();
        let mut ordered = Self::default();
        for (some, most, what) in [
            (equal, MOST_EQUAL * all as f64, "have two modes with the same frequency"),
            (decreasing, (MOST_DECREASING * all as f64).max(1.0), "have modes that are not in ascending order"),
        ] {
            if some.len() as f64 <= most {
                ordered.left_out.extend(some);
            } else if let Some((_, example)) = some.first() {
                ordered.notes.push(format!(
                    "{} of {all} measurements {what} (in the first, {example}): these are too many to be left out and are used as they are",
                    some.len()
                ));
            }
        }
        ordered.left_out.sort_by_key(|(index, _)| *index);
        ordered.kept =
            (0..all).filter(|i| ordered.left_out.binary_search_by_key(i, |(index, _)| *index).is_err()).collect();
        ordered
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::quantity::Timestamp;

    fn measurements(rows: &[[f64; 3]]) -> Vec<ModalMeasurement> {
        let one = |(index, row): (usize, &[f64; 3])| ModalMeasurement {
            measured_at: Timestamp::from_micros(index as i64).unwrap(),
            frequencies_hz: row.iter().map(|f| Hertz::new(*f).ok()).collect(),
            std_hz: None,
            mode_shapes: None,
            covariates: BTreeMap::new(),
            settings: BTreeMap::new(),
        };
        rows.iter().enumerate().map(one).collect()
    }

    #[test]
    fn equal_and_decreasing_neighbours_are_found_across_missing_modes() {
        let of = |row: [f64; 3]| Disorder::of(&measurements(&[row])[0].frequencies_hz).map(|d| d.to_string());
        assert_eq!(of([1.0, 2.0, 3.0]), None);
        // A frequency of 0 stands for a missing mode here.
        assert_eq!(of([0.0, 2.0, 3.0]), None);
        assert_eq!(of([2.5, 0.0, 2.0]).unwrap(), "mode 1 at 2.5 Hz is not below mode 3 at 2 Hz");
        assert!(of([3.0, 2.0, 2.0]).unwrap().starts_with("modes 2 and 3 have the same frequency, 2 Hz"));
    }

    #[test]
    fn few_are_left_out_and_many_are_kept() {
        let (good, equal, decreasing) = ([1.0, 2.0, 3.0], [1.0, 2.0, 2.0], [2.0, 1.0, 3.0]);
        let rows = |equals: usize, decreasings: usize| {
            let all = (0..20).map(|i| match i {
                i if i < equals => equal,
                i if i < equals + decreasings => decreasing,
                _ => good,
            });
            Ordered::of(&measurements(&all.collect::<Vec<_>>()))
        };
        let Ordered { kept, left_out, notes } = rows(1, 2);
        assert_eq!((kept, left_out.len(), notes.len()), ((3..20).collect(), 3, 0));
        let Ordered { kept, left_out, notes } = rows(10, 3);
        assert_eq!((kept.len(), left_out.len()), (10, 10));
        assert!(notes.len() == 1 && notes[0].starts_with("3 of 20 measurements have modes"), "{notes:?}");
        let Ordered { kept, left_out, notes } = rows(11, 0);
        assert_eq!((kept.len(), left_out.len(), notes.len()), (20, 0, 1));
    }
}
