//! Neighbouring modes that cross or veer between the runs.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::basis::Candidates;
use super::expansion::Expansion;
use super::select::Fit;
use crate::stats;

/// A pair is not examined if its smallest gap exceeds this many standard deviations of the gap over the runs.
const FAR: f64 = 1.0;

/// Neighbouring modes that come so close that they probably cross or veer sharply between the runs.
///
/// At a crossing, frequencies in ascending order are not differentiable, and the two mode shapes swap.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crossing {
    /// The lower of the two modes, from 0.
    pub lower_mode: usize,
    /// The run where the two come closest, from 0.
    pub run: usize,
    /// (f_upper − f_lower)/f_lower in that run.
    pub gap: f64,
}

/// The gap of two neighbouring modes that may cross.
#[derive(Debug)]
pub(super) struct Gap {
    /// The lower of the two modes, from 0.
    pub lower_mode: usize,
    /// The run with the smallest gap.
    closest: usize,
    /// ln f_upper − ln f_lower in that run.
    least: f64,
    /// D = (ln f_upper − ln f_lower)² of each run, `[n]`.
    pub squared: Vec<f64>,
}

/// Pairs of neighbouring modes whose smallest gap is small compared with the variation of the gap; `ln_frequencies`: `[m][n]`.
pub(super) fn near(ln_frequencies: &[Vec<f64>]) -> Vec<Gap> {
    let gap = |(lower_mode, pair): (usize, &[Vec<f64>])| {
        let gap: Vec<f64> = pair[1].iter().zip(&pair[0]).map(|(upper, lower)| upper - lower).collect();
        let closest = (0..gap.len()).min_by(|&a, &b| gap[a].total_cmp(&gap[b]))?;
        let varies = stats::sample_std(&gap)?;
        let squared = gap.iter().map(|gap| gap * gap).collect();
        (gap[closest] <= FAR * varies).then_some(Gap { lower_mode, closest, least: gap[closest], squared })
    };
    ln_frequencies.windows(2).enumerate().filter_map(gap).collect()
}

/// The pairs whose gap probably closes between the runs.
///
/// ```text
///  t = 2D/‖∇D‖
/// ```
///
/// D is the squared gap. It is smooth where the two modes cross, unlike the gap itself, so that the gradient of its expansion is
/// reliable. Where the gap changes linearly, t is the distance in the direction opposite to the gradient at which it closes.
/// Where two modes veer with a smallest gap g, t is nowhere below 2g divided by the rate at which the gap opens. A pair is
/// reported if, at any run, t is below the spacing of the runs and the point at that distance is inside their box. A gap that
/// closes outside the box, or that varies slowly enough for the runs to resolve it, is not reported.
///
/// `fits` holds the expansion of D of each pair; `x` holds the runs, `[n, d]`, scaled to [−1, 1].
pub(super) fn crossings<'a>(
    candidates: &Candidates,
    x: &DMatrix<f64>,
    gaps: &[Gap],
    fits: impl Iterator<Item = &'a Fit>,
) -> Vec<Crossing> {
    if gaps.is_empty() {
        return Vec::new();
    }
    let spacing = spacing(x);
    let closes = |(gap, fit): &(&Gap, &Fit)| {
        let expansion = Expansion::new(candidates, x.ncols(), std::iter::once(*fit));
        (0..x.nrows()).any(|run| {
            let (_, gradient) = expansion.values_and_gradients(|parameter| x[(run, parameter)]);
            let slope = gradient.norm();
            let distance = 2.0 * gap.squared[run] / slope;
            let inside = |parameter| (x[(run, parameter)] - distance * gradient[(0, parameter)] / slope).abs() <= 1.0;
            distance <= spacing && (0..x.ncols()).all(inside)
        })
    };
    let crossing =
        |(gap, _): (&Gap, _)| Crossing { lower_mode: gap.lower_mode, run: gap.closest, gap: gap.least.exp_m1() };
    gaps.iter().zip(fits).filter(closes).map(crossing).collect()
}

/// Distance between neighbouring runs along one direction: their median distance divided by √d.
fn spacing(x: &DMatrix<f64>) -> f64 {
    let (n, d) = x.shape();
    let points: Vec<Vec<f64>> = x.row_iter().map(|row| row.iter().copied().collect()).collect();
    let distance = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    // Duplicate runs have distance 0 and are ignored.
    let nearest = |run: &Vec<f64>| {
        points.iter().map(|other| distance(run, other)).filter(|d| *d > 0.0).fold(f64::INFINITY, f64::min)
    };
    let nearest: Vec<f64> = (0..n).into_par_iter().map(|run| nearest(&points[run])).collect();
    stats::quantile(&nearest, 0.5) / (d as f64).sqrt()
}
