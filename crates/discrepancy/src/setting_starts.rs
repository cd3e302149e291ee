//! First guesses for corrections of settings, which have no score test: switches have no derivative, and the derivative by an
//! offset is 0 where a setting lies far outside the prior.

use super::data::{Data, TIME};
use super::grammar::Candidate;
use structures::physics::effect::Target;
use structures::simulator::law::LawKind;
use structures::simulator::Simulator;
use structures::stats;

/// Number of first guesses of an offset, and of the sum of both ends of a mirrored setting.
const POSITIONS: usize = 7;

/// Number of times of a step that are tried for an exchange or a unit.
const STEPS: usize = 10;

/// A first guess of the numbers of a candidate under a law.
pub(super) struct Guess {
    /// The law.
    pub(super) law: LawKind,
    /// Time of a step, days.
    pub(super) step_days: f64,
    /// The numbers of the effect.
    pub(super) psi: Vec<f64>,
}

/// The settings of a fit, as its effects correct them.
pub(super) struct PresentSettings<'a> {
    /// The simulation.
    pub(super) simulator: &'a Simulator,
    /// The measurements.
    pub(super) data: &'a Data,
    /// Rows of the fit.
    pub(super) rows: &'a [usize],
    /// Parameters after the corrections that the fit has already, `[rows][d]`.
    pub(super) corrected: Vec<Vec<f64>>,
    /// Whether any row lies outside.
    pub(super) any_outside: bool,
}

impl PresentSettings<'_> {
    /// First guesses for a candidate; empty for one that has a score test.
    pub(super) fn guesses(&self, candidate: &Candidate) -> Vec<Guess> {
        let target = &candidate.target;
        if target.settings().is_empty() {
            return Vec::new();
        }
        let guess = |law: LawKind, psi: Vec<f64>| Guess { law, step_days: 0.0, psi };
        let law = match (candidate.covariate.as_deref(), &candidate.level) {
            (None, _) => LawKind::Constant,
            (Some(TIME), _) if target.is_switch() => return self.steps(target),
            (Some(_), Some(_)) => LawKind::Category,
            _ => return Vec::new(),
        };
        self.numbers(target).into_iter().map(|psi| guess(law, psi)).collect()
    }

    /// A switch that acts from one of several times on.
    fn steps(&self, target: &Target) -> Vec<Guess> {
        let times: Vec<f64> = self.rows.iter().map(|row| self.data.times_days[*row]).collect();
        let mut found = Vec::new();
        for step in 1..STEPS {
            let step_days = stats::quantile(&times, step as f64 / STEPS as f64);
            found.extend(self.numbers(target).into_iter().map(|psi| Guess { law: LawKind::Step, step_days, psi }));
        }
        found
    }

    /// First guesses of the numbers of a target.
    fn numbers(&self, target: &Target) -> Vec<Vec<f64>> {
        if matches!(target, Target::SettingUnit { .. } | Target::SettingExchange(..)) {
            return vec![Vec::new()];
        }
        match target {
            Target::InMode(_, inner) if inner.is_switch() => self.numbers(inner),
            Target::SettingMirror(column) => {
                let (given, prior) = (self.range(*column), self.prior(*column));
                positions(prior.0 + given.1, prior.1 + given.0).map(|sum| vec![sum]).collect()
            }
            Target::SettingOffset(column) if self.any_outside => {
                let (given, prior) = (self.range(*column), self.prior(*column));
                positions(prior.0 - given.0, prior.1 - given.1).map(|offset| vec![offset]).collect()
            }
            Target::SettingScale(column) if self.any_outside => {
                let (given, prior) = (self.range(*column), self.prior(*column));
                let middle = f64::midpoint(prior.0, prior.1) / f64::midpoint(given.0, given.1);
                let widths = (prior.1 - prior.0) / (given.1 - given.0);
                let share = [middle, prior.0 / given.0, prior.1 / given.1, 0.7 * widths].into_iter();
                share.map(|factor| factor - 1.0).filter(|g| g.is_finite() && *g > -0.95).map(|g| vec![g]).collect()
            }
            _ => Vec::new(),
        }
    }

    /// Smallest and largest value of a setting under the present corrections.
    fn range(&self, column: usize) -> (f64, f64) {
        let set = self.rows.iter().zip(&self.corrected).filter(|(row, _)| self.data.settings[**row][column].is_some());
        set.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), (_, x)| (l.min(x[column]), h.max(x[column])))
    }

    fn prior(&self, column: usize) -> (f64, f64) {
        let p = &self.simulator.space().as_slice()[column];
        (p.lower, p.upper)
    }
}

/// Values from `first` to `last` at equal distances, both included.
fn positions(first: f64, last: f64) -> impl Iterator<Item = f64> {
    (0..POSITIONS).map(move |i| first + (last - first) * i as f64 / (POSITIONS - 1) as f64)
}
