//! Reads structure definitions from TOML or JSON and locates every mistake.

use std::ops::Range;

use serde::de::DeserializeOwned;

use super::check;
use super::definition::{DefinitionError, DefinitionProblem, StructureDefinition};
use crate::quantity::{json_pointer, shown};

impl StructureDefinition {
    /// Reads and checks a TOML text.
    ///
    /// # Errors
    /// [`DefinitionError`] with the line and the JSON pointer of each mistake.
    pub fn parse_toml(text: &str) -> Result<Self, DefinitionError> {
        Self::from_toml(text)?.check(Some(text))
    }

    fn from_toml(text: &str) -> Result<Self, DefinitionError> {
        let syntax = |error: &toml::de::Error, pointer: String| {
            let line = error.span().map(|span| line_at(text, span.start));
            DefinitionError { problems: vec![DefinitionProblem { pointer, line, message: one_line(error.message()) }] }
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
        definition.check(Some(text))
    }

    /// Reads and checks a JSON text.
    ///
    /// # Errors
    /// [`DefinitionError`] with the JSON pointer of each mistake.
    pub fn parse_json(text: &str) -> Result<Self, DefinitionError> {
        from_json::<Self>(text)?.check(None)
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
        definition.check(None)
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
    fn check(self, toml: Option<&str>) -> Result<Self, DefinitionError> {
        match check::check(&self) {
            Ok(_) => Ok(self),
            Err(mut problems) => {
                for problem in &mut problems {
                    problem.line = toml.and_then(|text| toml_line(text, &problem.pointer));
                }
                Err(DefinitionError { problems })
            }
        }
    }
}

fn from_json<T: DeserializeOwned>(text: &str) -> Result<T, DefinitionError> {
    let mut deserializer = serde_json::Deserializer::from_str(text);
    let failed = |pointer: String, error: &serde_json::Error| DefinitionError {
        problems: vec![DefinitionProblem { pointer, line: Some(error.line()), message: error.to_string() }],
    };
    let value =
        serde_path_to_error::deserialize(&mut deserializer).map_err(|e| failed(json_pointer(e.path()), e.inner()))?;
    deserializer.end().map_err(|e| failed(String::new(), &e))?;
    Ok(value)
}

fn one_line(message: &str) -> String {
    message.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Line of a byte offset, from 1.
fn line_at(text: &str, offset: usize) -> usize {
    text.as_bytes()[..offset.min(text.len())].split(|b| *b == b'\n').count()
}

/// Line of the value at a JSON pointer in a TOML text; if there is no such value, line of its nearest ancestor.
fn toml_line(text: &str, pointer: &str) -> Option<usize> {
    use toml::de::{DeTable, DeValue};
    let document = DeTable::parse(text).ok()?;
    let mut value = DeValue::Table(document.get_ref().clone());
    let mut span: Range<usize> = document.span();
    for segment in pointer.split('/').skip(1) {
        let next = match &value {
            DeValue::Table(table) => {
                table.iter().find(|(key, _)| key.get_ref() == segment).map(|(key, value)| (key.span(), value.clone()))
            }
            DeValue::Array(items) => {
                segment.parse::<usize>().ok().and_then(|i| items.get(i)).map(|item| (item.span(), item.clone()))
            }
            _ => None,
        };
        let Some((next_span, next_value)) = next else { break };
        span = next_span;
        value = next_value.into_inner();
    }
    Some(line_at(text, span.start))
}
