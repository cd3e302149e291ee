//! Measurements written as a CSV table.

use super::csv_text::{add_row, guarded};
use super::{CovariateValue, ModalMeasurement};
use crate::quantity::Hertz;

/// Writes measurements as a table from which [`super::csv::read`] restores them. Mode shapes are left out, because the measurements do not
/// contain the names of their points.
pub fn write(measurements: &[ModalMeasurement]) -> String {
    let modes = measurements.iter().map(|m| m.frequencies_hz.len()).max().unwrap_or_default();
    let with_std = measurements.iter().any(|m| m.std_hz.is_some());
    let names = |pick: fn(&ModalMeasurement) -> Vec<String>| {
        measurements.iter().flat_map(pick).collect::<std::collections::BTreeSet<_>>()
    };
    let covariates = names(|m| m.covariates.keys().cloned().collect());
    let settings = names(|m| m.settings.keys().cloned().collect());

    let mut table = String::new();
    let mut header = vec!["measured_at".to_owned()];
    header.extend((1..=modes).map(|mode| format!("f{mode}_hz")));
    header.extend((1..=if with_std { modes } else { 0 }).map(|mode| format!("std_f{mode}_hz")));
    header.extend(covariates.iter().cloned());
    header.extend(settings.iter().map(|name| format!("set_{name}")));
    add_row(&mut table, header);
    let cell = |value: Option<f64>| value.map_or_else(String::new, |v| v.to_string());
    for m in measurements {
        let mut row = vec![m.measured_at.to_string()];
        row.extend(m.frequencies_hz.iter().map(|f| cell(f.map(Hertz::get))));
        if with_std {
            row.extend((0..modes).map(|mode| cell(m.std_hz.as_ref().and_then(|stds| stds[mode]))));
        }
        row.extend(covariates.iter().map(|name| match m.covariates.get(name) {
            Some(CovariateValue::Number(number)) => number.to_string(),
            Some(CovariateValue::Category(text)) => guarded(text.clone()),
            None => String::new(),
        }));
        row.extend(settings.iter().map(|name| cell(m.settings.get(name).copied())));
        add_row(&mut table, row);
    }
    table
}
