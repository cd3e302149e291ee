//! The progress of a training in words and numbers, and an estimate of the time left.

use std::time::Instant;

use super::queue::Report;
use crate::baseline::rounds::Progress;

/// Share of a round that its epochs take; the rest is for its calibration.
const SHARE_OF_EPOCHS: f64 = 0.9;

/// Epochs or cells before the time left is estimated.
const FEWEST_TO_ESTIMATE: usize = 2;

/// Follows a training. The time left is that of the present round: whether a further round follows is known only from the calibration
/// at its end.
///
/// ```text
///  epochs       t̄ · (epochs left) + (duration of the last calibration, if there was one)
///  calibration  t̄ · (cells left)
/// ```
///
/// with the mean duration t̄ of the epochs or cells of this round so far.
pub(super) struct Watch {
    round: usize,
    /// When the epochs or the cells of this round began.
    begun: Instant,
    calibrated: Option<f64>,
}

impl Watch {
    pub(super) fn new() -> Self {
        Self { round: 1, begun: Instant::now(), calibrated: None }
    }

    /// What to report, `None` for a step without a report.
    pub(super) fn report(&mut self, progress: &Progress, now: Instant) -> Option<Report> {
        let round = self.round;
        let elapsed = now.duration_since(self.begun).as_secs_f64();
        match progress {
            Progress::Start(_) => {
                *self = Self { round: 1, begun: now, calibrated: None };
                None
            }
            Progress::Epoch { report, epochs } => {
                let (done, epochs) = (report.epoch, *epochs);
                let left = left(elapsed, done, epochs).map(|left| left + self.calibrated.unwrap_or(0.0));
                Some(Report {
                    what: format!("round {round}: epoch {done} of {epochs}"),
                    share: Some(SHARE_OF_EPOCHS * done as f64 / epochs as f64),
                    time_left_s: left,
                })
            }
            Progress::Calibration { .. } => {
                self.begun = now;
                Some(Report {
                    what: format!("round {round}: measuring the calibration"),
                    share: Some(SHARE_OF_EPOCHS),
                    time_left_s: self.calibrated,
                })
            }
            Progress::Cell { done, cells } => {
                if *done == 0 {
                    // Also where the calibration is measured again after a repair.
                    self.begun = now;
                } else {
                    self.calibrated = Some(elapsed);
                }
                Some(Report {
                    what: format!("round {round}: calibration, {done} of {cells} situations measured"),
                    share: Some(SHARE_OF_EPOCHS + (1.0 - SHARE_OF_EPOCHS) * *done as f64 / (*cells).max(1) as f64),
                    time_left_s: if done < cells { left(elapsed, *done, *cells) } else { None },
                })
            }
            Progress::Round(why) => {
                (self.round, self.begun) = (round + 1, now);
                Some(Report { what: why.clone(), share: None, time_left_s: None })
            }
        }
    }
}

/// Time left from the mean of the steps done.
fn left(elapsed_s: f64, done: usize, all: usize) -> Option<f64> {
    (done >= FEWEST_TO_ESTIMATE).then(|| elapsed_s / done as f64 * all.saturating_sub(done) as f64)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::flow::train::EpochReport;

    fn epoch(epoch: usize) -> Progress {
        Progress::Epoch { report: EpochReport { epoch, loss: 0.0, validation_loss: 0.0 }, epochs: 10 }
    }

    #[test]
    fn the_time_left_follows_from_what_is_done_and_there_is_none_before() {
        let mut watch = Watch::new();
        let begun = watch.begun;
        let at = |seconds: u64| begun + Duration::from_secs(seconds);
        assert_eq!(watch.report(&epoch(1), at(3)).unwrap().time_left_s, None);
        let fourth = watch.report(&epoch(4), at(12)).unwrap();
        assert_eq!((fourth.time_left_s, fourth.share), (Some(18.0), Some(0.36)));
        assert_eq!(fourth.what, "round 1: epoch 4 of 10");
        watch.report(&Progress::Calibration { round: 1 }, at(30));
        let cell = |done| Progress::Cell { done, cells: 4 };
        assert_eq!(watch.report(&cell(0), at(30)).unwrap().time_left_s, None);
        assert_eq!(watch.report(&cell(3), at(36)).unwrap().time_left_s, Some(2.0));
        assert_eq!(watch.report(&cell(4), at(38)).unwrap().share, Some(1.0));
        // A further round counts the calibration, which has been measured once.
        watch.report(&Progress::Round("it goes on".to_owned()), at(40));
        let second = watch.report(&epoch(5), at(50)).unwrap();
        assert_eq!((second.time_left_s, second.what.as_str()), (Some(10.0 + 8.0), "round 2: epoch 5 of 10"));
    }
}
