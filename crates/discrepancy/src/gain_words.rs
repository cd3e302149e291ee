//! The gain from the causes in words.

use super::gain::{Gain, GainMethod};

/// Coverage of 90 % intervals below and above which a note says what it means.
const COVERAGE: [f64; 2] = [0.8, 0.97];

/// How the errors of the modes change.
pub(super) struct Modes {
    /// Modes whose error is clearly smaller: the 90 % interval of its change lies below 0.
    pub(super) better: usize,
    /// Modes whose error is clearly larger.
    pub(super) worse: usize,
    /// Modes whose error is not clearly different.
    pub(super) unclear: usize,
}

impl Modes {
    /// Counts the modes that were measured in the rows of the gain.
    pub(super) fn of(gain: &Gain) -> Self {
        let mut found = Self { better: 0, worse: 0, unclear: 0 };
        for mode in measured(gain) {
            let [low, high] = gain.rms_difference_interval90[mode];
            if high < 0.0 {
                found.better += 1;
            } else if low > 0.0 {
                found.worse += 1;
            } else {
                found.unclear += 1;
            }
        }
        found
    }

    /// The counts as a sentence without capital and full stop.
    pub(super) fn sentence(&self) -> String {
        let all = self.better + self.worse + self.unclear;
        let worse = match self.worse {
            0 => "none clearly worse".to_owned(),
            worse => format!("{worse} clearly worse"),
        };
        let unclear = match self.unclear {
            0 => String::new(),
            unclear => format!(", and of {unclear} the change is not clear"),
        };
        format!("{} of {all} modes are predicted clearly better, {worse}{unclear}", self.better)
    }
}

/// Indices of the modes that were measured in the rows of the gain.
fn measured(gain: &Gain) -> impl Iterator<Item = usize> + '_ {
    let rms = &gain.rms_error_percent;
    (0..rms.before.len()).filter(|mode| rms.before[*mode].is_finite() && rms.after[*mode].is_finite())
}

/// The rows on which the gain was measured, with the preposition.
pub(super) fn rows_in_words(gain: &Gain) -> String {
    match gain.method {
        GainMethod::HeldOut => format!("on the {} rows held out", gain.holdout_rows),
        GainMethod::CrossValidation => format!("in cross-validation over {} rows", gain.holdout_rows),
    }
}

/// The gain in sentences, each after a space: the error of every mode before and after, how many modes gain and lose, whether the whole is
/// better, and the batches beyond an alarm limit. `None` if no mode was measured in the rows.
pub(super) fn gain_in_words(gain: &Gain, with: &str) -> Option<String> {
    let rms = &gain.rms_error_percent;
    let each = |mode: usize| format!("mode {} from {:.2} to {:.2} %", mode + 1, rms.before[mode], rms.after[mode]);
    let modes: Vec<String> = measured(gain).map(each).collect();
    if modes.is_empty() {
        return None;
    }
    let density = &gain.log_density_per_row;
    let all_modes = format!(
        "the probability of a row under the prediction changes by a factor of {} (log density {:+.2} ± {:.2} per row)",
        factor(density.difference),
        density.difference,
        density.standard_error
    );
    let whole = if density.difference + 2.0 * density.standard_error < 0.0 {
        format!(" As a whole these rows are predicted worse: {all_modes}. What was found in the other rows does not hold there.")
    } else if density.difference - 2.0 * density.standard_error <= 0.0 {
        format!(" As a whole the prediction is not clearly better: {all_modes}.")
    } else {
        String::new()
    };
    let pronoun = if with == "With them" { "them" } else { "it" };
    let alarms = gain.false_alarms_per_1000.as_ref().map_or_else(String::new, |alarms| {
        format!(
            " Of 1000 batches of ten of these rows, {:.0} are beyond an alarm limit without {pronoun} and {:.0} with {pronoun}; {}.",
            alarms.before,
            alarms.after,
            gain.condition()
        )
    });
    Some(format!(
        " {with} in the simulation, the prediction errors change {}: {}; {}.{whole}{alarms}",
        rows_in_words(gain),
        modes.join(", "),
        Modes::of(gain).sentence()
    ))
}

/// A factor on a probability from its logarithm.
fn factor(log: f64) -> String {
    match log.exp() {
        f if f >= 1000.0 => "more than 1000".to_owned(),
        f if f >= 10.0 => format!("{f:.0}"),
        f if f >= 0.01 => format!("{f:.2}"),
        _ => "less than 0.01".to_owned(),
    }
}

/// Notes on a gain: prediction intervals that are too narrow or too wide, and modes that are predicted worse.
pub(super) fn notes(gain: &Gain) -> Vec<String> {
    let mut notes = Vec::new();
    let rows = rows_in_words(gain);
    let after = gain.coverage90.after;
    let share = format!("{:.0} of 100", 100.0 * after);
    if after < COVERAGE[0] {
        notes.push(format!(
            "{rows}, only {share} frequencies lie inside the intervals that should contain 90 of 100, even with what was found: the \
             prediction is surer than it should be, because something acts there that the simulation does not contain"
        ));
    } else if after > COVERAGE[1] {
        notes.push(format!(
            "{rows}, {share} frequencies lie inside the intervals that should contain 90 of 100: the prediction is less sure than it \
             could be"
        ));
    }
    let modes = Modes::of(gain);
    if modes.worse > 0 {
        notes.push(format!(
            "{rows}, {} of {} modes are predicted worse with what was found than without it",
            modes.worse,
            modes.better + modes.worse + modes.unclear
        ));
    }
    notes
}
