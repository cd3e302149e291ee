//! Logs as JSON lines or as text for a terminal, and, with the feature `otel`, traces.
//!
//! The code has two kinds of spans. Spans of the crate's own targets add fields to log lines, such as the id of a
//! request. Spans of the target `modalwatch::spans` are for traces, do not appear in the log, and cost nothing if no
//! trace is sent.

use std::io::IsTerminal as _;

use serde::{Deserialize, Serialize};
use tracing_subscriber::layer::{Layer as _, SubscriberExt as _};
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{reload, EnvFilter};

#[cfg(not(feature = "otel"))]
mod no_traces;
#[cfg(feature = "otel")]
mod traces;

#[cfg(not(feature = "otel"))]
pub use no_traces::Traces;
#[cfg(feature = "otel")]
pub use traces::Traces;

/// Shape of the log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LogFormat {
    /// Text at a terminal, otherwise JSON.
    #[default]
    Auto,
    /// Text.
    Text,
    /// One JSON object per line.
    Json,
}

/// Section `log` of the configuration.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LogSettings {
    /// `error`, `warn`, `info`, `debug`, `trace`, or a filter such as `warn,modalwatch=debug`.
    pub level: String,
    /// Format of the lines.
    pub format: LogFormat,
    /// URL of the collector to which traces are sent, such as `http://localhost:4318`. If it is empty, the variable
    /// `OTEL_EXPORTER_OTLP_ENDPOINT` is used; if that is empty too, no traces are sent.
    pub otlp_endpoint: String,
}

impl Default for LogSettings {
    fn default() -> Self {
        Self { level: "info".to_owned(), format: LogFormat::Auto, otlp_endpoint: String::new() }
    }
}

/// The active log, whose level can be changed.
pub struct Log {
    change: Box<dyn Fn(EnvFilter) -> Result<(), String> + Send + Sync>,
}

impl Log {
    /// Changes the level.
    ///
    /// # Errors
    /// A message that names the level if it is not a valid filter; the previous level then stays.
    pub fn set_level(&self, level: &str) -> Result<(), String> {
        (self.change)(filter(level)?)
    }
}

/// Parses a level.
///
/// # Errors
/// A message that names the level if it is not a valid filter.
pub fn filter(level: &str) -> Result<EnvFilter, String> {
    let filter = EnvFilter::try_new(level)
        .map_err(|e| format!("log.level is {level:?}: {e}; try error, warn, info, debug or trace"))?;
    Ok(filter.add_directive("modalwatch::spans=off".parse().expect("a target and a level are a directive")))
}

/// Starts logging to standard error, and sending traces if they are configured. Standard output is reserved for
/// results.
///
/// # Errors
/// A message that names the level or the address of the collector if it is invalid.
pub fn start(settings: &LogSettings) -> Result<(Log, Traces), String> {
    let (filter, handle) = reload::Layer::new(filter(&settings.level)?);
    let traces = Traces::start(&settings.otlp_endpoint)?;
    let json = match settings.format {
        LogFormat::Json => true,
        LogFormat::Text => false,
        LogFormat::Auto => !std::io::stderr().is_terminal(),
    };
    let lines = tracing_subscriber::fmt::layer().with_writer(std::io::stderr);
    let lines = if json {
        lines.json().flatten_event(true).with_span_list(false).with_filter(filter).boxed()
    } else {
        lines.compact().with_filter(filter).boxed()
    };
    let registry = tracing_subscriber::registry().with(traces.layer()).with(lines);
    registry.try_init().map_err(|e| e.to_string())?;
    let change = move |filter| handle.reload(filter).map_err(|e| e.to_string());
    Ok((Log { change: Box::new(change) }, traces))
}
