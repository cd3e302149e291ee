//! What a simulation lacks in the same way in all batches of a reference.

use super::misfit::MOST_LN;
use super::samples::BatchSamples;
use crate::baseline::nearest::Nearest;
use crate::baseline::observation::Observation;
use crate::process::fit::FEWEST_BATCHES;
use structures::stats;

/// A usual misfit below this share of the noise is left where it is, and so is one that is not clear by so many standard errors.
const LEAST_SHARE: f64 = 0.25;
const CLEAR: f64 = 4.0;

/// Usual difference of measured and simulated ln f of each mode, `[modes]`: the median over some batches of the mean of their complete
/// measurements, each beside the point of the prior that fits it best. Empty if it is small or not clear in all modes, if it is too large for
/// the simulation of this structure, and where too few batches show it.
pub(super) fn usual(batches: &[&BatchSamples]) -> Vec<f64> {
    let means: Vec<Vec<[f64; 2]>> = batches.iter().filter_map(|batch| mean_residuals(batch)).collect();
    if means.len() < FEWEST_BATCHES.max(batches.len().div_ceil(2)) {
        return Vec::new();
    }
    let of_mode = |mode: usize| {
        let ln: Vec<f64> = means.iter().map(|own| own[mode][0]).collect();
        let median = stats::quantile(&ln, 0.5);
        let off: Vec<f64> = ln.iter().map(|own| (own - median).abs()).collect();
        let error = 1.4826 * stats::quantile(&off, 0.5) / (ln.len() as f64).sqrt();
        let noise = stats::mean(&means.iter().map(|own| own[mode][1]).collect::<Vec<_>>());
        (median, median.abs() > (CLEAR * error).max(LEAST_SHARE * noise))
    };
    let found: Vec<(f64, bool)> = (0..means[0].len()).map(of_mode).collect();
    let matters = found.iter().any(|(_, matters)| *matters) && found.iter().all(|(ln, _)| ln.abs() < MOST_LN);
    found.into_iter().map(|(ln, _)| ln).filter(|_| matters).collect()
}

/// Mean over the complete measurements of a batch of ln f beside the nearest point of the prior, and standard deviation of the noise of ln f, of
/// each mode; `None` if it has no complete measurement whose residuals can be tested.
fn mean_residuals(batch: &BatchSamples) -> Option<Vec<[f64; 2]>> {
    let points = batch.fit.nearest.iter().enumerate();
    let all_used = batch.fit.nearest.len() == batch.observations.len();
    let used = points.filter(|(row, _)| all_used || !batch.fit.gross.contains(row)).map(|(_, point)| point);
    let complete = |(point, own): &(_, &Observation)| {
        let point: &&Nearest = point;
        point.degrees_of_freedom > 0 && own.frequencies_hz.iter().all(Option::is_some) && !own.has_shapes()
    };
    let rows: Vec<_> = used.zip(&batch.observations).filter(complete).collect();
    let modes = rows.first()?.1.frequencies_hz.len();
    let of_mode = |mode: usize| {
        let residual = |(point, own): &(&Nearest, &Observation)| {
            own.frequencies_hz[mode].map_or(0.0, |hz| (hz / point.frequencies_hz[mode]).ln())
        };
        let residuals: Vec<f64> = rows.iter().map(residual).collect();
        let standardised: Vec<f64> = rows.iter().map(|(point, _)| point.standardised_residuals[mode]).collect();
        let size = |all: &[f64]| all.iter().map(|own| own.abs()).sum::<f64>();
        let noise = size(&residuals) / size(&standardised).max(f64::MIN_POSITIVE);
        [stats::mean(&residuals), noise]
    };
    Some((0..modes).map(of_mode).collect())
}

/// The usual misfit of a reference, as a sentence.
pub(super) fn in_words(usual_ln: &[f64]) -> String {
    let percent = |ln: &f64| format!("{:+.2} %", 100.0 * ln.exp_m1()).replace('-', "−");
    let modes: Vec<String> =
        usual_ln.iter().zip(1..).map(|(ln, mode)| format!("mode {mode} {}", percent(ln))).collect();
    format!(
        "its frequencies differ from all that the simulation gives, in the same way in all batches ({}): this is taken out as usual for this \
         structure; a diagnosis may find the cause",
        modes.join(", ")
    )
}
