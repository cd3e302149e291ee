//! Whether the process of a reference that was stored, or comes from an archive, can be used.

use super::direction::ChangeDirection;
use super::filter::Known;
use super::misfit::MisfitBasis;
use super::reference::ReferenceProcess;

impl ReferenceProcess {
    /// What is wrong with a process that somebody has changed: a list of the wrong length, with which the filter could not compute, or a
    /// negative variance; `None` if it can be used.
    pub fn defect(&self) -> Option<&'static str> {
        let process = &self.process;
        let sizes = process.sizes();
        let (d, m) = (sizes.quantities, sizes.covariates);
        // Each factor has an unknown. Without this check, their number could exceed what can be computed.
        if process.factors > process.unknowns.len() {
            return Some("it has more common factors than unknowns");
        }
        let unknowns = sizes.unknowns();
        let lists = [
            (process.units.len(), d),
            (process.scales.len(), d),
            (self.directions.len(), d),
            (process.covariate_scales.len(), m),
            (process.unknowns.len(), unknowns),
            (process.usual_errors.len(), d * d),
        ];
        let seen = process.coverage.as_ref().map_or(m, |coverage| coverage.covariates.len());
        if d == 0 || lists.iter().any(|(found, expected)| found != expected) || seen != m {
            return Some("a list in it does not have the length that its quantities and covariates need");
        }
        if self.one_factor.iter().any(|point| point.changes.len() != d) {
            return Some("a factor of all frequencies does not have the changes of all quantities");
        }
        let misfit = self.misfit.as_ref().map_or(0, MisfitBasis::count);
        if misfit != self.directions.iter().filter(|own| **own == ChangeDirection::Either).count() {
            return Some("its misfit does not have the coordinates that its quantities need");
        }
        if process.draws.iter().any(|draw| draw.len() != unknowns) {
            return Some("a draw does not have the length of the unknowns");
        }
        // The lists above are those that this computes with.
        let states = process.in_operation().variance.len();
        // Earlier versions of the program had no states of covariates.
        let fits = |known: Known| [states, states + m].contains(&known.mean.len());
        if !Known::from_numbers(&self.end).is_some_and(fits) {
            return Some("its last states do not have the length that its factors and quantities need");
        }
        let mut units = process.scales.iter().chain(&process.covariate_scales).map(|scale| scale.unit);
        if !units.all(|unit| unit > 0.0) || process.step_s.is_nan() || process.step_s <= 0.0 {
            return Some("a unit or the time between batches is not positive");
        }
        if (0..d).any(|k| process.usual_errors[k * d + k] < 0.0) {
            return Some("a variance is negative");
        }
        let limits = [self.limits.quantity, self.limits.joint]
            .into_iter()
            .chain(self.limits.misfit)
            .flat_map(|limit| [limit.fast, limit.slow]);
        if limits.chain([self.mean_run_batches]).any(|value| value < 0.0) {
            return Some("a limit is negative");
        }
        if self.usual_misfit.iter().any(|misfit| *misfit < 0.0) {
            return Some("a misfit is negative");
        }
        process
            .coverage
            .iter()
            .flat_map(|coverage| &coverage.months)
            .any(|month| !(1..=12).contains(month))
            .then_some("a month is not from 1 to 12")
    }
}
