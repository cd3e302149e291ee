//! How a table is to be read, as its sender says it in a query or on the command line.

use super::clock::DateOrder;
use super::split::Split;
use super::unit::FrequencyUnit;
use super::zone::Zone;
use crate::measurement::check::Problem;
use crate::measurement::times::TimeUnit;
use crate::quantity::shown;

/// The texts of the options; `None` for one that is not given.
#[derive(Debug, Clone, Copy, Default)]
pub struct OptionTexts<'a> {
    /// `f1=Erste Biegung,time=#3`: what a column is, by its name or number.
    pub columns: Option<&'a str>,
    /// Columns that are not read, separated by commas.
    pub ignore: Option<&'a str>,
    /// Zone of times without one.
    pub zone: Option<&'a str>,
    /// `dmy` or `mdy`.
    pub date_order: Option<&'a str>,
    /// `point` or `comma`.
    pub decimal: Option<&'a str>,
    /// Unit of frequencies whose header states none.
    pub unit: Option<&'a str>,
    /// Unit of times that are numbers.
    pub time_unit: Option<&'a str>,
    /// Rule by which the rows become batches.
    pub split: Option<&'a str>,
}

/// How a table is to be read; what is not said is taken from the table, or asked for.
#[derive(Debug, Clone, Default)]
pub struct TableOptions {
    /// What columns are.
    pub columns: Vec<Assigned>,
    /// Columns that are not read.
    pub ignore: Vec<Named>,
    /// Zone of times without one.
    pub zone: Option<Zone>,
    /// Order of day and month.
    pub date_order: Option<DateOrder>,
    /// Whether numbers have a decimal comma.
    pub decimal_comma: Option<bool>,
    /// Unit of frequencies whose header states none.
    pub unit: Option<FrequencyUnit>,
    /// Unit of times that are numbers.
    pub time_unit: Option<TimeUnit>,
    /// Rule by which the rows become batches.
    pub split: Option<Split>,
}

/// A column as its sender names it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Named {
    /// By the text in the header, of which the case of letters does not matter.
    Name(String),
    /// By its number, from 1, written `#3`.
    Number(usize),
}

/// What a column is said to be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Assigned {
    /// `f1`, `std_f1`, `time`, `date`, `time_of_day`, the name of a covariate, `set_<parameter>` or `phi<mode>_<point>`.
    pub target: String,
    /// The column.
    pub column: Named,
}

impl Named {
    fn parse(text: &str) -> Self {
        let text = text.trim();
        let number = text.strip_prefix('#').and_then(|number| number.parse().ok());
        number.map_or_else(|| Self::Name(text.to_owned()), Self::Number)
    }

    /// Whether this names a column with a header and a number, from 1.
    pub fn is(&self, header: &str, number: usize) -> bool {
        match self {
            Self::Name(name) => name.to_lowercase() == header.trim().to_lowercase(),
            Self::Number(named) => *named == number,
        }
    }

    /// The column as it was named.
    pub fn text(&self) -> String {
        match self {
            Self::Name(name) => name.clone(),
            Self::Number(number) => format!("#{number}"),
        }
    }
}

impl TableOptions {
    /// Reads the options.
    ///
    /// # Errors
    /// A problem for each option that cannot be read, at `query/<option>`.
    pub fn parse(texts: &OptionTexts<'_>) -> Result<Self, Vec<Problem>> {
        let mut problems = Vec::new();
        let mut options = Self {
            ignore: list(texts.ignore).map(Named::parse).collect(),
            zone: read(texts.zone, "zone", Zone::parse, &mut problems),
            date_order: read(texts.date_order, "date_order", DateOrder::parse, &mut problems),
            decimal_comma: read(texts.decimal, "decimal", decimal_comma, &mut problems),
            unit: read(texts.unit, "unit", FrequencyUnit::parse, &mut problems),
            time_unit: read(texts.time_unit, "time_unit", str::parse, &mut problems),
            split: read(texts.split, "split", Split::parse, &mut problems),
            columns: Vec::new(),
        };
        if options.time_unit == Some(TimeUnit::Days) {
            let message = "days do not say when they begin: use seconds, milliseconds, serial-days or decimal-year";
            problems.push(Problem::new("query/time_unit", message));
        }
        for text in list(texts.columns) {
            match text.split_once('=') {
                Some((target, column)) if !target.trim().is_empty() && !column.trim().is_empty() => {
                    let column = Named::parse(column);
                    options.columns.push(Assigned { target: target.trim().to_owned(), column });
                }
                _ => {
                    let message = format!(
                        "{} must read TARGET=COLUMN, such as f1=Erste Biegung or f1=#3 for the third column",
                        shown(text)
                    );
                    problems.push(Problem::new("query/columns", message));
                }
            }
        }
        if problems.is_empty() {
            Ok(options)
        } else {
            Err(problems)
        }
    }
}

fn list(text: Option<&str>) -> impl Iterator<Item = &str> {
    text.unwrap_or_default().split(',').filter(|part| !part.trim().is_empty())
}

fn decimal_comma(text: &str) -> Result<bool, String> {
    match text {
        "point" => Ok(false),
        "comma" => Ok(true),
        _ => Err(format!("{} is not a decimal sign: write point or comma", shown(text))),
    }
}

fn read<T>(
    text: Option<&str>,
    name: &str,
    parse: impl FnOnce(&str) -> Result<T, String>,
    problems: &mut Vec<Problem>,
) -> Option<T> {
    match text.map(parse)? {
        Ok(value) => Some(value),
        Err(message) => {
            problems.push(Problem::new(format!("query/{name}"), message));
            None
        }
    }
}
