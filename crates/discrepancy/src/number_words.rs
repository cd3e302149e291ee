//! The numbers of a cause in words.

use super::describe::{rounded, Cause, NamedNumber};
use structures::simulator::law::LawKind;
use structures::stats;

impl NamedNumber {
    /// Name, value and 90 % interval with their unit, as a reader understands them; fractions in per cent.
    pub fn in_words(&self, cause: &Cause) -> [String; 3] {
        let over = cause.covariate.as_deref().unwrap_or_default();
        let name = match self.name.as_str() {
            _ if cause.law == LawKind::Category => format!("where {over} is {}", self.name),
            "swing" => format!("effect range: change from the 5 % to the 95 % quantile of {over}"),
            "level" => format!("level at the middle of {over}"),
            "slope_per_unit" => "slope".to_owned(),
            "slope_below_per_unit" => "slope below the knee".to_owned(),
            "slope_above_per_unit" => "slope above the knee".to_owned(),
            "curvature_per_unit2" => "curvature".to_owned(),
            "rate_per_unit" => "rate".to_owned(),
            "lag_days" => "lag".to_owned(),
            "frequency_hz" => "tuning frequency".to_owned(),
            "time_days" => "time of the step".to_owned(),
            other => other.replace('_', " "),
        };
        let (factor, unit) = match self.unit.strip_prefix("share") {
            Some(rest) => (100.0, format!("%{rest}")),
            None => (1.0, self.unit.clone()),
        };
        // A column whose unit is not known has the unit of its numbers.
        let unit = unit.replace("per unit²", &format!("per squared unit of {over}"));
        let unit = if unit.ends_with("per unit") { format!("{unit} of {over}") } else { unit };
        let [low, high] = self.interval90.map(|edge| factor * edge);
        let std = (high - low) / (2.0 * stats::normal_quantile(0.95));
        let shown = |value: f64| rounded(value, std).0.replace('-', "−");
        let interval =
            if std > 0.0 { format!("{} to {} {unit}", shown(low), shown(high)) } else { "not estimated".to_owned() };
        [name, format!("{} {unit}", shown(factor * self.value)), interval]
    }
}
