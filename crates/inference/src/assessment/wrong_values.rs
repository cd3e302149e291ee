//! Single frequencies of a batch that do not belong to their measurement: another peak was taken, a harmonic, or a digit was mistyped.
//!
//! The frequencies of a measurement move together, as the parameters let them. A single wrong one breaks that pattern, long before it lies
//! far from the others of its mode. With the covariance C of the frequencies of a measurement about the mean of its batch,
//!
//! ```text
//!  C = J S Jᵀ + R,    r = y − f(m),    z_i = (C⁻¹ r)_i / √(C⁻¹)_ii
//! ```
//!
//! z_i is the distance of frequency i from what the others of the measurement, and the other measurements, let expect, in standard deviations
//! (the deletion residual). S is the scatter of the healthy structure. A loss of stiffness moves all measurements of a batch and is in m.
//!
//! One or two measurements have no mean of their own, and are compared with the healthy structure as it was at all times of the reference. A
//! frequency is set aside only if the others of the measurement fit a healthy structure and if the measurement before does not show the
//! same: one measurement alone does not tell a wrong frequency from a loss that shows in a single mode, and a second one does.
//!
//! Source: R. D. Cook, S. Weisberg (1982), Residuals and Influence in Regression, ch. 2.

use nalgebra::DVector;
use statrs::distribution::{ChiSquared, ContinuousCDF as _};

use super::batch_mean::{Healthy, Problem, Rows};
use crate::baseline::observation::Observation;
use crate::baseline::Baseline;
use crate::trust::{fit, Finding, FindingCode, FindingEffect};
use structures::quantity::Hertz;
use structures::stats;

/// Least z of a wrong frequency: six in 100,000 right ones reach it.
const FAR: f64 = 4.0;

/// Frequencies whose z is below this share of the largest one are judged again without that one, because a wrong frequency moves the mean.
const BESIDE_LARGEST: f64 = 0.7;

/// Fewest measurements that have a mean of their own.
const FEWEST: usize = 3;

/// Fewest frequencies whose z show that the batch scatters more than the healthy structure: its own scatter counts then.
const FEWEST_FOR_SCALE: usize = 24;

/// Largest share of the frequencies of a mode that are set aside: more of them are no slips, and the batch is judged as it is.
const MOST: f64 = 0.25;

/// Rounds in which frequencies are set aside.
const ROUNDS: usize = 8;

/// Probability with which the other frequencies of a healthy measurement lie further from a healthy structure.
const REST_FITS: f64 = 0.01;

/// A frequency that is set aside.
struct Wrong {
    row: usize,
    mode: usize,
    measured_hz: f64,
    expected_hz: f64,
    /// Standard deviation of what is expected, Hz.
    std_hz: f64,
}

/// What the measurements of a batch are compared with.
#[derive(Clone, Copy)]
pub(super) struct Compared<'a> {
    /// The healthy structure with the scatter of measurements within a batch.
    pub healthy: &'a Healthy,
    /// Standard deviations of all measurements of the reference, `[d]`; `None` for a batch that is to become part of one.
    pub all_times: Option<&'a [f64]>,
    /// Frequencies of the measurement before the batch, `[modes]`.
    pub previous: Option<&'a [Option<Hertz>]>,
    /// Misfit of the batches of the reference.
    pub usual_misfit: fit::Misfit,
}

/// Sets wrong frequencies aside. Measurements without any other are left out. `indices`: those of the measurements in their batch, which a
/// finding names.
pub(super) fn set_aside(
    baseline: &Baseline,
    indices: Vec<usize>,
    observations: Vec<Observation>,
    compared: Compared<'_>,
    findings: &mut Vec<Finding>,
) -> (Vec<usize>, Vec<Observation>) {
    let found = if observations.len() < FEWEST {
        of_few(baseline, &observations, compared)
    } else {
        of_many(baseline, &observations, compared.healthy)
    };
    let Some(wrong) = found.filter(|wrong| !wrong.is_empty()) else { return (indices, observations) };
    findings.push(finding(&wrong, &indices));
    let left = without(&observations, &wrong);
    let pairs = indices.into_iter().zip(left);
    pairs.filter(|(_, observation)| observation.modes_present() > 0).unzip()
}

fn without(observations: &[Observation], wrong: &[Wrong]) -> Vec<Observation> {
    let mut left = observations.to_vec();
    for Wrong { row, mode, .. } in wrong {
        left[*row].frequencies_hz[*mode] = None;
        left[*row].noise_multiple[*mode] = 1.0;
    }
    left
}

fn finding(wrong: &[Wrong], indices: &[usize]) -> Finding {
    let one = |wrong: &Wrong| {
        format!(
            "measurement {} has mode {} at {:.6} Hz, where {:.6} Hz ± {:.2} % agrees with the rest",
            indices[wrong.row],
            wrong.mode + 1,
            wrong.measured_hz,
            wrong.expected_hz,
            100.0 * wrong.std_hz / wrong.expected_hz
        )
    };
    let examples: Vec<String> = wrong.iter().take(3).map(one).collect();
    let what = match wrong.len() {
        1 => "1 frequency seems to be wrong and is set aside".to_owned(),
        count => format!("{count} frequencies seem to be wrong and are set aside"),
    };
    let mut rows: Vec<usize> = wrong.iter().map(|wrong| indices[wrong.row]).collect();
    rows.sort_unstable();
    rows.dedup();
    let message = format!("{what}: {}", examples.join("; "));
    Finding::new(FindingCode::Outlier, FindingEffect::Note, message).of(rows)
}

/// Whether a batch has wrong frequencies.
pub(super) fn any(baseline: &Baseline, observations: &[Observation], healthy: &Healthy) -> bool {
    observations.len() >= FEWEST && of_many(baseline, observations, healthy).is_some_and(|wrong| !wrong.is_empty())
}

/// A frequency beside what the others let expect.
struct Distance {
    mode: usize,
    z: f64,
    /// Expected deviation from the simulated frequency, and its standard deviation, Hz.
    expected_off_hz: f64,
    std_hz: f64,
}

/// The distance of each frequency of each measurement; `None` where the covariance is not positive.
fn distances(rows: &Rows) -> Option<Vec<Vec<Distance>>> {
    let inverse = rows.covariance.clone().cholesky()?.inverse();
    let weighted = &inverse * &rows.residuals;
    let one = |n: usize, (i, mode): (usize, &usize)| {
        let precision = inverse[(i, i)];
        let (off, std_hz) = (weighted[(i, n)] / precision, precision.powf(-0.5));
        Distance { mode: *mode, z: off / std_hz, expected_off_hz: rows.residuals[(i, n)] - off, std_hz }
    };
    let of_measurement = |n: usize| rows.modes.iter().enumerate().map(|mode| one(n, mode)).collect();
    Some((0..rows.places.len()).map(of_measurement).collect())
}

/// The wrong frequencies of a batch that has a mean of its own; `None` where that is not computed.
fn of_many(baseline: &Baseline, observations: &[Observation], healthy: &Healthy) -> Option<Vec<Wrong>> {
    let mut wrong: Vec<Wrong> = Vec::new();
    for _ in 0..ROUNDS {
        let left = without(observations, &wrong);
        let problem = Problem::new(baseline, &left, healthy)?;
        let about = problem.solved()?.at;
        let mut all: Vec<(usize, Distance, f64)> = Vec::new();
        for rows in problem.rows(&about)? {
            for (place, found) in rows.places.iter().zip(distances(&rows)?) {
                for distance in found {
                    let simulated_hz = rows.simulated_hz[distance.mode];
                    all.push((*place, distance, simulated_hz));
                }
            }
        }
        let sizes: Vec<f64> = all.iter().map(|(_, d, _)| d.z.abs()).collect();
        // The median of the absolute values of a standard normal variable is 0.6745.
        let scale = if sizes.len() < FEWEST_FOR_SCALE { 1.0 } else { (stats::quantile(&sizes, 0.5) / 0.6745).max(1.0) };
        let largest = sizes.iter().copied().fold(0.0, f64::max);
        let least = (FAR * scale).max(BESIDE_LARGEST * largest);
        let before = wrong.len();
        let mut rows: Vec<usize> = Vec::new();
        all.sort_by(|a, b| b.1.z.abs().total_cmp(&a.1.z.abs()));
        for (row, distance, simulated_hz) in all.into_iter().take_while(|(_, d, _)| d.z.abs() >= least) {
            // The others of the same measurement are judged again without it.
            if rows.contains(&row) {
                continue;
            }
            rows.push(row);
            wrong.push(Wrong {
                row,
                mode: distance.mode,
                measured_hz: observations[row].frequencies_hz[distance.mode].unwrap_or_default(),
                expected_hz: simulated_hz + distance.expected_off_hz,
                std_hz: distance.std_hz,
            });
        }
        if wrong.len() == before {
            break;
        }
    }
    let crowded = (0..baseline.simulator().modes()).any(|mode| {
        let present = observations.iter().filter(|o| o.frequencies_hz[mode].is_some()).count();
        wrong.iter().filter(|wrong| wrong.mode == mode).count() as f64 > (MOST * present as f64).max(1.0)
    });
    Some(if crowded { Vec::new() } else { wrong })
}

/// The wrong frequencies of one or two measurements; `None` where they cannot be compared.
fn of_few(baseline: &Baseline, observations: &[Observation], compared: Compared<'_>) -> Option<Vec<Wrong>> {
    let mut scatter = compared.healthy.scatter.clone();
    for (k, std) in compared.all_times?.iter().enumerate() {
        scatter[(k, k)] = scatter[(k, k)].max(std * std);
    }
    let healthy = Healthy { centre: compared.healthy.centre.clone(), scatter };
    let problem = Problem::new(baseline, observations, &healthy)?;
    let about = DVector::from_column_slice(problem.centre.as_slice());
    let mut wrong = Vec::new();
    for rows in problem.rows(&about)? {
        for (n, (place, all)) in rows.places.iter().copied().zip(distances(&rows)?).enumerate() {
            let Some(furthest) = all.iter().max_by(|a, b| a.z.abs().total_cmp(&b.z.abs())) else { continue };
            if furthest.z.abs() < FAR || rows.modes.len() < 2 {
                continue;
            }
            let measured_hz = observations[place].frequencies_hz[furthest.mode].unwrap_or_default();
            let expected_hz = rows.simulated_hz[furthest.mode] + furthest.expected_off_hz;
            let others = (0..observations.len()).filter(|other| *other != place);
            let others = others.filter_map(|other| observations[other].frequencies_hz[furthest.mode]);
            let before = compared.previous.and_then(|previous| previous[furthest.mode]).map(Hertz::get);
            // Nearer to the doubted frequency than to the expected one.
            let shows_the_same = |other: f64| (other - measured_hz).abs() < (other - expected_hz).abs();
            if rest_fits(&rows, n, furthest.mode) && !others.chain(before).any(shows_the_same) {
                wrong.push(Wrong {
                    row: place,
                    mode: furthest.mode,
                    measured_hz,
                    expected_hz,
                    std_hz: furthest.std_hz,
                });
            }
        }
    }
    Some(wrong)
}

/// Whether the frequencies of a measurement fit a healthy structure without one of them.
fn rest_fits(rows: &Rows, n: usize, without: usize) -> bool {
    let rest: Vec<usize> = (0..rows.modes.len()).filter(|i| rows.modes[*i] != without).collect();
    let residuals = rows.residuals.column(n).select_rows(&rest);
    let covariance = rows.covariance.select_rows(&rest).select_columns(&rest);
    let Some(factor) = covariance.cholesky() else { return false };
    let squared = residuals.dot(&factor.solve(&residuals));
    ChiSquared::new(rest.len() as f64).is_ok_and(|chi| chi.sf(squared) > REST_FITS)
}
