//! Reads structure definitions from TOML or JSON and locates every mistake.

use std::ops::Range;

use serde::de::DeserializeOwned;
use toml::de::{DeTable, DeValue};
use toml::Spanned;

use super::check;
use super::definition::{DefinitionError, DefinitionProblem, StructureDefinition};
use super::simulate::Simulator;
use crate::quantity::{json_pointer, shown};

/// Mistakes of a structure file that are listed; the others are counted.
const MOST_PROBLEMS: usize = 100;

impl StructureDefinition {
    /// Reads and checks a TOML text.
    ///
    /// # Errors
    /// [`DefinitionError`] with the line and the JSON pointer of each mistake.
    pub fn parse_toml(text: &str) -> Result<Self, DefinitionError> {
        Self::from_toml(text)?.checked(Some(text)).map(|(definition, _)| definition)
    }

    fn from_toml(text: &str) -> Result<Self, DefinitionError> {
        let syntax = |error: &toml::de::Error, pointer: String| {
            let line = error.span().map(|span| line_at(text, span.start));
            DefinitionError {
                problems: vec![DefinitionProblem {
                    message: with_hint(&pointer, &one_line(error.message())),
                    pointer,
                    line,
                }],
            }
        };
        let document = toml::Deserializer::parse(text).map_err(|e| syntax(&e, String::new()))?;
        serde_path_to_error::deserialize(document).map_err(|e| syntax(e.inner(), json_pointer(e.path())))
    }

    /// Reads and checks a TOML text. If its table of runs is in a separate file, `read` returns the text of that file by its name.
    ///
    /// # Errors
    /// [`DefinitionError`], as [`Self::parse_toml`].
    pub fn parse_toml_beside(
        text: &str,
        read: impl Fn(&str) -> std::io::Result<String>,
    ) -> Result<Self, DefinitionError> {
        let mut definition = Self::from_toml(text)?;
        definition.read_table(read)?;
        definition.checked(Some(text)).map(|(definition, _)| definition)
    }

    /// Reads and checks a JSON text.
    ///
    /// # Errors
    /// [`DefinitionError`] with the JSON pointer of each mistake.
    pub fn parse_json(text: &str) -> Result<Self, DefinitionError> {
        from_json::<Self>(text)?.checked(None).map(|(definition, _)| definition)
    }

    /// Reads and checks a JSON text. If its table of runs is in a separate file, `read` returns the text of that file by its name.
    ///
    /// # Errors
    /// [`DefinitionError`], as [`Self::parse_json`].
    pub fn parse_json_beside(
        text: &str,
        read: impl Fn(&str) -> std::io::Result<String>,
    ) -> Result<Self, DefinitionError> {
        let mut definition: Self = from_json(text)?;
        definition.read_table(read)?;
        definition.checked(None).map(|(definition, _)| definition)
    }

    /// Replaces the name of the file with the runs by the text of that file.
    fn read_table(&mut self, read: impl Fn(&str) -> std::io::Result<String>) -> Result<(), DefinitionError> {
        let Some(table) = &mut self.table else { return Ok(()) };
        if let Some(file) = table.file.take_if(|_| table.csv.is_none()) {
            let failed = |error: std::io::Error| DefinitionError {
                problems: vec![DefinitionProblem::new(
                    "/table/file",
                    format!("{} cannot be read: {error}", shown(&file)),
                )],
            };
            table.csv = Some(read(&file).map_err(failed)?);
        }
        Ok(())
    }

    /// Checks the contents; adds the line of each mistake in the text `toml`, if it is given.
    fn checked(self, toml: Option<&str>) -> Result<(Self, check::Checked), DefinitionError> {
        match check::check(&self) {
            Ok(checked) => Ok((self, checked)),
            Err(mut problems) => {
                let more = problems.len().saturating_sub(MOST_PROBLEMS);
                problems.truncate(MOST_PROBLEMS);
                let document = toml.and_then(|text| Some((text, DeTable::parse(text).ok()?)));
                for problem in &mut problems {
                    problem.line =
                        document.as_ref().map(|(text, document)| toml_line(text, document, &problem.pointer));
                }
                if more > 0 {
                    let message = format!("{more} further mistakes are not listed: mend these first");
                    problems.push(DefinitionProblem::new("", message));
                }
                Err(DefinitionError { problems })
            }
        }
    }
}

/// Reading a definition for use. The check solves an eigenproblem, which takes seconds for a large structure: here it is done once,
/// while [`StructureDefinition::parse_json`] and then [`Simulator::new`] do it twice.
impl Simulator {
    /// Reads a TOML text, checks it and builds its simulator; `read` returns the text of a file of runs by its name.
    ///
    /// # Errors
    /// As [`StructureDefinition::parse_toml_beside`].
    pub fn parse_toml_beside(
        text: &str,
        read: impl Fn(&str) -> std::io::Result<String>,
    ) -> Result<Self, DefinitionError> {
        let mut definition = StructureDefinition::from_toml(text)?;
        definition.read_table(read)?;
        definition.checked(Some(text)).map(|(definition, checked)| Self::of_checked(definition, checked))
    }

    /// Reads a JSON text, checks it and builds its simulator; `read` returns the text of a file of runs by its name.
    ///
    /// # Errors
    /// As [`StructureDefinition::parse_json_beside`].
    pub fn parse_json_beside(
        text: &str,
        read: impl Fn(&str) -> std::io::Result<String>,
    ) -> Result<Self, DefinitionError> {
        let mut definition: StructureDefinition = from_json(text)?;
        definition.read_table(read)?;
        definition.checked(None).map(|(definition, checked)| Self::of_checked(definition, checked))
    }

    /// Reads a TOML text, checks it and builds its simulator.
    ///
    /// # Errors
    /// As [`StructureDefinition::parse_toml`].
    pub fn parse_toml(text: &str) -> Result<Self, DefinitionError> {
        let checked = StructureDefinition::from_toml(text)?.checked(Some(text));
        checked.map(|(definition, checked)| Self::of_checked(definition, checked))
    }

    /// Reads a JSON text, checks it and builds its simulator.
    ///
    /// # Errors
    /// As [`StructureDefinition::parse_json`].
    pub fn parse_json(text: &str) -> Result<Self, DefinitionError> {
        let checked = from_json::<StructureDefinition>(text)?.checked(None);
        checked.map(|(definition, checked)| Self::of_checked(definition, checked))
    }
}

fn from_json<T: DeserializeOwned>(text: &str) -> Result<T, DefinitionError> {
    let mut deserializer = serde_json::Deserializer::from_str(text);
    let failed = |pointer: String, error: &serde_json::Error| DefinitionError {
        problems: vec![DefinitionProblem {
            message: with_hint(&pointer, &error.to_string()),
            pointer,
            line: Some(error.line()),
        }],
    };
    let value =
        serde_path_to_error::deserialize(&mut deserializer).map_err(|e| failed(json_pointer(e.path()), e.inner()))?;
    deserializer.end().map_err(|e| failed(String::new(), &e))?;
    Ok(value)
}

/// Adds to the message of a parser where the key belongs that was looked for at the pointer.
fn with_hint(pointer: &str, message: &str) -> String {
    let hint = hint(pointer, message);
    hint.map_or_else(|| message.to_owned(), |hint| format!("{message}; {hint}"))
}

/// Where `law`, `scale`, `unit` and `covariate` belong, which are looked for in several tables.
fn hint(pointer: &str, message: &str) -> Option<&'static str> {
    const LAW: &str = "the law of a stiffness belongs into sets of its [[parameter]]: sets = { spring = \"k1\", law = { exponential = { a = \
                       1e3, b = 0.5, c = 2e4 } } }";
    const INFLUENCE: &str = "the influence of a covariate is an [[effect]] with target, law, covariate and numbers: target = { springs = \
                             [\"k1\"] }, law = \"linear\", covariate = \"temperature_c\", numbers = { slope_per_unit = -0.001 }";
    let section = pointer.split('/').nth(1).unwrap_or_default();
    let unknown = |key: &str| message.contains(&format!("unknown field `{key}`"));
    match section {
        "covariate" if unknown("law") || unknown("effect") => Some(INFLUENCE),
        _ if pointer.contains("/sets") && pointer.ends_with("/law") && !unknown("law") => {
            Some("a stiffness has the law exponential, k = a·exp(b·p) + c; the laws linear, bilinear and others are those of an [[effect]]")
        }
        _ if unknown("law") || unknown("laws") => Some(LAW),
        "parameter" if unknown("covariate") => Some(INFLUENCE),
        _ if unknown("scale") => {
            Some("scale = true belongs to the [[parameter]], which then is a factor of the nominal stiffness of all that it sets")
        }
        "parameter" if message.contains("unknown variant") && pointer.contains("/prior") => Some(
            "a prior is one of { uniform = [low, high] }, { normal = { mean = 1.0, std = 0.1 } } and { log_normal = { median = 1.0, \
             relative_std = 0.2 } }",
        ),
        "spring" | "beam" if unknown("prior") || unknown("uniform") => {
            Some("a prior belongs to a [[parameter]] that sets the stiffness: sets = { spring = \"k1\" } or { beam = \"span\" }")
        }
        _ => None,
    }
}

fn one_line(message: &str) -> String {
    message.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Line of a byte offset, from 1.
fn line_at(text: &str, offset: usize) -> usize {
    text.as_bytes()[..offset.min(text.len())].split(|b| *b == b'\n').count()
}

/// Line of the value at a JSON pointer in a TOML document; if there is no such value, line of its nearest ancestor.
fn toml_line(text: &str, document: &Spanned<DeTable<'_>>, pointer: &str) -> usize {
    let mut segments = pointer.split('/').skip(1);
    let first = segments.next().and_then(|segment| within_entry(document.get_ref(), segment));
    let Some((mut span, mut value)) = first else { return line_at(text, document.span().start) };
    for segment in segments {
        let next = match value.get_ref() {
            DeValue::Table(table) => within_entry(table, segment),
            DeValue::Array(items) => {
                segment.parse().ok().and_then(|i: usize| items.get(i)).map(|item| (item.span(), item))
            }
            _ => None,
        };
        let Some((next_span, next_value)) = next else { break };
        (span, value) = (next_span, next_value);
    }
    line_at(text, span.start)
}

/// Place of a key in a table, and its value.
fn within_entry<'a, 'i>(table: &'a DeTable<'i>, key: &str) -> Option<(Range<usize>, &'a Spanned<DeValue<'i>>)> {
    table.iter().find(|(name, _)| name.get_ref() == key).map(|(name, value)| (name.span(), value))
}
