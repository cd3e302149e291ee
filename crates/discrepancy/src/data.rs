//! Measurements in the form that a diagnosis uses: rows in order of time, logarithms of frequencies, covariates, settings.

use std::collections::{BTreeMap, BTreeSet};

use super::cycle::Cycle;
use super::declared::{declared, is_marked, Declared, Weighing, SECOND_INSTRUMENT};
use super::shapes::MeasuredShapes;
use structures::measurement::{CovariateValue, ModalMeasurement};
use structures::quantity::{Digest, Hertz, Timestamp};
use structures::simulator::law::{lagged, Input, Law, LawKind};
use structures::simulator::Simulator;
use structures::stats;

/// Name of the covariate time, counted from the first row in the unit [`Data::time_unit`].
pub const TIME: &str = "time";

/// Smallest relative standard deviation of a frequency: data have a finite precision even if no noise is stated.
const LEAST_NOISE: f64 = 1e-5;

/// Prefix of the name of a column that holds a setting, as in the header of a table.
pub(super) const SETTING: &str = "set_";

/// Greatest number of numeric columns whose products are considered.
const MOST_FACTORS: usize = 6;

/// Greatest number of categories of a covariate.
pub const MOST_LEVELS: usize = 12;

const MICROS_A_DAY: f64 = 86_400e6;

/// Times before this one count from an unknown start: 1980-01-01.
const EARLIEST_DATE_MICROS: i64 = 315_532_800_000_000;

/// Data that cover at most this many days are described by the minute.
const SHORT_DAYS: f64 = 20.0;

/// Values of a covariate.
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// One number for each row; NaN if missing.
    Numbers(Vec<f64>),
    /// Names of the categories, and for each row an index among them; `None` if missing.
    Categories(Vec<String>, Vec<Option<usize>>),
}

/// What a column holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// A covariate that was measured.
    Covariate,
    /// A parameter that the experimenter set.
    Setting,
    /// The product of two columns with these indices, each minus its mean.
    Product(usize, usize),
    /// Time.
    Time,
    /// Time of the day or of the year.
    Cycle(Cycle),
}

impl Origin {
    /// The cycle of the time that the column holds, if it does.
    pub(super) const fn cycle(self) -> Option<Cycle> {
        match self {
            Self::Cycle(cycle) => Some(cycle),
            _ => None,
        }
    }
}

/// A quantity that deviations may depend on, with its values.
#[derive(Debug, Clone, PartialEq)]
pub struct Column {
    /// Its name, which ends with its unit.
    pub name: String,
    /// What it holds.
    pub origin: Origin,
    /// Its values.
    pub values: Values,
}

/// n measurements of m modes and d parameters, in order of time.
#[derive(Debug, Clone)]
pub struct Data {
    /// Days since the first row, `[n]`; the index of the row if no times are known.
    pub times_days: Vec<f64>,
    /// `day`, or `row` if no times are known.
    pub time_unit: &'static str,
    /// Time of each row, `[n]`; empty if no times are known.
    pub measured_at: Vec<Timestamp>,
    /// Whether a row is part of the declared undamaged reference, `[n]`. Of all others it is not known whether the structure was
    /// undamaged.
    pub declared_undamaged: Vec<bool>,
    /// ln f, `[n][m]`, f in Hz; NaN if a mode is missing.
    pub log_frequencies: Vec<Vec<f64>>,
    /// Relative standard deviation of each frequency as stated by the row or by the structure, with the error of an emulator,
    /// `[n][m]`.
    pub noise: Vec<Vec<f64>>,
    /// Values of the parameters that the experimenter set, `[n][d]`, in their own units.
    pub settings: Vec<Vec<Option<f64>>>,
    /// Mode shapes; `None` if none was measured.
    pub shapes: Option<MeasuredShapes>,
    /// Covariates, settings that vary, their products by pairs, time, and the times of day and year, in this order.
    pub columns: Vec<Column>,
    /// Known masses that were hung: the degree of freedom, and kg in each row.
    pub hung: Vec<(usize, Column)>,
    /// Bodies that were weighed.
    pub weighings: Vec<Weighing>,
    /// Whether a row was measured with a second instrument, `[n]`.
    pub second_instrument: Vec<bool>,
    /// Whether a row was measured after an earlier diagnosis, to decide between its candidates, `[n]`.
    pub further: Vec<bool>,
    /// Digest of the measurements.
    pub digest: Digest,
}

impl Data {
    /// Sorts n measurements by time and converts them to rows. Frequencies become logarithms, and a noise that a measurement
    /// does not state is that of the structure. In rows with mode shapes, the modes are put in the order that their shapes show.
    pub fn new(simulator: &Simulator, measurements: &[ModalMeasurement]) -> Self {
        Self::joined(simulator, measurements, &[])
    }

    /// As [`Self::new`], for the measurements of an earlier diagnosis and those that were taken after it, which are never held
    /// out.
    pub fn joined(simulator: &Simulator, earlier: &[ModalMeasurement], further: &[ModalMeasurement]) -> Self {
        let mut flagged: Vec<(&ModalMeasurement, bool)> = earlier.iter().map(|m| (m, false)).collect();
        flagged.extend(further.iter().map(|m| (m, true)));
        flagged.sort_by_key(|(m, _)| m.measured_at);
        let (sorted, further): (Vec<&ModalMeasurement>, Vec<bool>) = flagged.into_iter().unzip();
        let measured_at: Vec<Timestamp> = sorted.iter().map(|m| m.measured_at).collect();
        let start = measured_at.first().map_or(0, |at| at.micros());
        let times_days: Vec<f64> = measured_at.iter().map(|at| (at.micros() - start) as f64 / MICROS_A_DAY).collect();
        let noise_of = |m: &ModalMeasurement, mode: usize, f: f64| {
            let stated = m.std_hz.as_ref().and_then(|stds| stds[mode]).unwrap_or_else(|| simulator.noise().std_hz(f));
            (simulator.with_emulator_error(mode, f, stated) / f).max(LEAST_NOISE)
        };
        let row = |m: &&ModalMeasurement| -> (Vec<f64>, Vec<f64>) {
            let cell = |(mode, f): (usize, &Option<Hertz>)| {
                f.map_or((f64::NAN, LEAST_NOISE), |f| (f.get().ln(), noise_of(m, mode, f.get())))
            };
            m.frequencies_hz.iter().enumerate().map(cell).unzip()
        };
        // A discrepancy that was learned before is known: what is left is diagnosed.
        let known: Vec<_> = sorted.iter().map(|m| simulator.corrected(m)).collect();
        let (mut log_frequencies, mut noise): (Vec<Vec<f64>>, Vec<Vec<f64>>) = known.iter().map(|m| row(&&**m)).unzip();
        let shapes = MeasuredShapes::new(simulator, &sorted).map(|(shapes, orders)| {
            for ((log_frequencies, noise), order) in log_frequencies.iter_mut().zip(&mut noise).zip(&orders) {
                *log_frequencies = order.iter().map(|listed| log_frequencies[*listed]).collect();
                *noise = order.iter().map(|listed| noise[*listed]).collect();
            }
            shapes
        });
        let setting = |m: &&ModalMeasurement| {
            simulator.space().iter().map(|p| m.settings.get(&p.name).copied()).collect::<Vec<_>>()
        };
        let (mut columns, mut hung, mut weighings): (Vec<Column>, _, _) = (Vec::new(), Vec::new(), Vec::new());
        let kg_in = |m: &&ModalMeasurement, name: &str| match m.covariates.get(name) {
            Some(CovariateValue::Number(kg)) => *kg,
            _ => 0.0,
        };
        for (name, category) in covariates(&sorted) {
            let kg = || sorted.iter().map(|m| kg_in(m, name));
            match declared(simulator, name) {
                None => columns.push(column(simulator, name, category, &sorted)),
                Some(Declared::SecondInstrument) => {}
                Some(Declared::Hung(dof)) => {
                    let values = Values::Numbers(kg().collect());
                    hung.push((dof, Column { name: name.to_owned(), origin: Origin::Covariate, values }));
                }
                Some(Declared::Weighed(mass)) => {
                    weighings.extend(kg().enumerate().filter_map(|(row, kg)| Weighing::new(simulator, row, mass, kg)));
                }
            }
        }
        let settings: Vec<Vec<Option<f64>>> = sorted.iter().map(setting).collect();
        let names = simulator.space().iter().map(|p| p.name.as_str());
        columns.extend(names.enumerate().filter_map(|(k, name)| setting_column(name, k, &settings)));
        columns.extend(products(&columns));
        let values = Values::Numbers(times_days.clone());
        columns.push(Column { name: TIME.to_owned(), origin: Origin::Time, values });
        columns.extend(Cycle::shown(&measured_at).into_iter().map(Column::of_cycle));
        Self {
            settings,
            second_instrument: sorted
                .iter()
                .map(|m| m.covariates.get(SECOND_INSTRUMENT).is_some_and(is_marked))
                .collect(),
            hung,
            weighings,
            further,
            digest: digest_of(&sorted),
            measured_at,
            declared_undamaged: vec![false; sorted.len()],
            times_days,
            time_unit: "day",
            log_frequencies,
            noise,
            shapes,
            columns,
        }
    }

    /// The same data with the index of each row as its time, for tables without times.
    #[must_use]
    pub fn by_order(mut self) -> Self {
        self.measured_at.clear();
        self.times_days = (0..self.rows()).map(|row| row as f64).collect();
        self.time_unit = "row";
        self.columns.retain(|column| column.origin.cycle().is_none());
        if let Some(time) = self.columns.iter_mut().find(|c| c.name == TIME) {
            time.values = Values::Numbers(self.times_days.clone());
        }
        self
    }

    /// The same data, in which the rows at these times are part of the declared undamaged reference.
    #[must_use]
    pub fn with_undamaged(mut self, times: &BTreeSet<Timestamp>) -> Self {
        self.declared_undamaged = self.measured_at.iter().map(|at| times.contains(at)).collect();
        self
    }

    /// Time of a row in words, as the object of "since", "until" or "between": a date, or the day of the data if their dates are
    /// not known. Within a few days the time of the day is stated as well.
    pub fn time_in_words(&self, row: usize) -> String {
        let dated = self.measured_at.first().is_some_and(|first| first.micros() > EARLIEST_DATE_MICROS);
        let span = self.times_days.last().copied().unwrap_or(0.0);
        match self.measured_at.get(row) {
            Some(at) if dated && span > SHORT_DAYS => at.day_in_words(),
            Some(at) if dated => at.minute_in_words(),
            _ => format!("{} {} of the data", self.time_unit, shown_time(self.times_days[row])),
        }
    }

    /// Number of rows n.
    pub fn rows(&self) -> usize {
        self.times_days.len()
    }

    /// The covariate with this name.
    pub fn column(&self, name: &str) -> Option<&Column> {
        self.columns.iter().find(|c| c.name == name)
    }

    /// The two factors of a product at each row, each minus its mean.
    fn pairs(&self, column: &Column) -> Vec<Input> {
        let numbers = |index: usize| match &self.columns[index].values {
            Values::Numbers(values) => centred(values),
            Values::Categories(..) => vec![f64::NAN; self.rows()],
        };
        let Origin::Product(first, second) = column.origin else { return vec![Input::Missing; self.rows()] };
        let pair = |(a, b): (f64, f64)| if (a * b).is_finite() { Input::Pair(a, b) } else { Input::Missing };
        numbers(first).into_iter().zip(numbers(second)).map(pair).collect()
    }

    /// The input of a law at each row, `[n]`; `lag_days` is used by a law with a lag.
    ///
    /// The result is for all rows because a lagged covariate depends on all earlier ones.
    pub fn inputs(&self, law: &Law, lag_days: Option<f64>) -> Vec<Input> {
        let hung = |name: &str| self.hung.iter().map(|(_, column)| column).find(|c| c.name == name);
        let Some(column) = law.covariate.as_deref().and_then(|name| self.column(name).or_else(|| hung(name))) else {
            return vec![if law.covariate.is_none() { Input::Number(0.0) } else { Input::Missing }; self.rows()];
        };
        if let (Values::Numbers(times), Some(cycle)) = (&column.values, column.origin.cycle()) {
            return times.iter().map(|time| cycle.input(*time)).collect();
        }
        match &column.values {
            Values::Numbers(_) if law.kind == LawKind::Product => self.pairs(column),
            Values::Numbers(values) if law.kind == LawKind::Lagged => {
                let lag = lag_days.unwrap_or(1.0).max(1e-3);
                lagged(&self.times_days, values, lag).into_iter().map(|(v, slope)| Input::Lagged(v, slope)).collect()
            }
            Values::Numbers(values) => {
                let input = |v: &f64| if v.is_finite() { Input::Number(*v) } else { Input::Missing };
                values.iter().map(input).collect()
            }
            Values::Categories(names, indices) => {
                let place = |index: usize| law.levels.iter().position(|level| *level == names[index]);
                indices.iter().map(|i| i.map_or(Input::Missing, |i| Input::Level(place(i)))).collect()
            }
        }
    }
}

/// Names of all covariates, and whether any of their values is a category.
fn covariates<'a>(measurements: &[&'a ModalMeasurement]) -> BTreeMap<&'a str, bool> {
    let mut names: BTreeMap<&str, bool> = BTreeMap::new();
    for (name, value) in measurements.iter().flat_map(|m| &m.covariates) {
        *names.entry(name).or_default() |= matches!(value, CovariateValue::Category(_));
    }
    names
}

/// Digest of measurements in order of time.
fn digest_of(sorted: &[&ModalMeasurement]) -> Digest {
    Digest::of(&[&serde_json::to_vec(sorted).expect("measurements can be written as JSON")])
}

/// A number of days or rows: one decimal, none if it is whole.
fn shown_time(value: f64) -> String {
    if value.fract().abs() < 0.05 {
        format!("{value:.0}")
    } else {
        format!("{value:.1}")
    }
}

/// The column of a setting; `None` if it has the same value wherever it is set.
fn setting_column(name: &str, k: usize, settings: &[Vec<Option<f64>>]) -> Option<Column> {
    let values: Vec<f64> = settings.iter().map(|row| row[k].unwrap_or(f64::NAN)).collect();
    let known = || values.iter().copied().filter(|v| v.is_finite());
    let (low, high) = known().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    let name = format!("{SETTING}{name}");
    (low < high).then_some(Column { name, origin: Origin::Setting, values: Values::Numbers(values) })
}

/// The products of the numeric columns by pairs, each factor minus its mean; none for more than [`MOST_FACTORS`] columns.
fn products(columns: &[Column]) -> Vec<Column> {
    let numeric = |(index, column): (usize, &Column)| {
        let Values::Numbers(values) = &column.values else { return None };
        Some((index, centred(values)))
    };
    let factors: Vec<(usize, Vec<f64>)> = columns.iter().enumerate().filter_map(numeric).collect();
    if factors.len() > MOST_FACTORS {
        return Vec::new();
    }
    let mut found = Vec::new();
    for (place, (first, a)) in factors.iter().enumerate() {
        for (second, b) in &factors[place + 1..] {
            found.push(Column {
                name: format!("{} × {}", columns[*first].name, columns[*second].name),
                origin: Origin::Product(*first, *second),
                values: Values::Numbers(a.iter().zip(b).map(|(a, b)| a * b).collect()),
            });
        }
    }
    found
}

/// The values minus their mean; NaN stays NaN.
fn centred(values: &[f64]) -> Vec<f64> {
    let known: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    let mean = if known.is_empty() { 0.0 } else { stats::mean(&known) };
    values.iter().map(|v| v - mean).collect()
}

impl Column {
    /// The times in a cycle.
    fn of_cycle((cycle, times): (Cycle, Vec<f64>)) -> Self {
        Self { name: cycle.name().to_owned(), origin: Origin::Cycle(cycle), values: Values::Numbers(times) }
    }

    /// Its finite numbers in the rows with the indices `rows`, in that order and in the unit of the covariate, `[≤ rows]`;
    /// empty for categories.
    pub fn numbers(&self, rows: &[usize]) -> Vec<f64> {
        match &self.values {
            Values::Numbers(values) => rows.iter().map(|r| values[*r]).filter(|v| v.is_finite()).collect(),
            Values::Categories(..) => Vec::new(),
        }
    }
}

/// The values of one covariate in all rows; of categories if `category` is true, otherwise of numbers, without impossible ones.
fn column(simulator: &Simulator, name: &str, category: bool, sorted: &[&ModalMeasurement]) -> Column {
    let values = || sorted.iter().map(|m| m.covariates.get(name));
    if !category {
        let declared = simulator.covariates().iter().find(|c| c.name == name);
        let is_possible = |number: f64| declared.is_none_or(|covariate| covariate.impossible(number).is_none());
        let number = |value: Option<&CovariateValue>| match value {
            Some(CovariateValue::Number(number)) if is_possible(*number) => *number,
            _ => f64::NAN,
        };
        let values = Values::Numbers(values().map(number).collect());
        return Column { name: name.to_owned(), origin: Origin::Covariate, values };
    }
    let text = |value: &CovariateValue| match value {
        CovariateValue::Category(text) => text.clone(),
        CovariateValue::Number(number) => number.to_string(),
    };
    let mut levels: Vec<String> = values().flatten().map(text).collect();
    levels.sort();
    levels.dedup();
    let index = |value: Option<&CovariateValue>| value.and_then(|v| levels.binary_search(&text(v)).ok());
    let indices = values().map(index).collect();
    Column { name: name.to_owned(), origin: Origin::Covariate, values: Values::Categories(levels, indices) }
}
