//! Logs: JSON lines for machines, short text for people at a terminal.

use std::io::IsTerminal as _;

use serde::{Deserialize, Serialize};
use tracing_subscriber::EnvFilter;

/// Shape of the log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LogFormat {
    /// Text at a terminal, JSON otherwise.
    #[default]
    Auto,
    /// Text.
    Text,
    /// One JSON object a line.
    Json,
}

/// What is logged, and how.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LogSettings {
    /// `error`, `warn`, `info`, `debug`, `trace`, or a filter such as `warn,modalwatch=debug`.
    pub level: String,
    /// Shape of the lines.
    pub format: LogFormat,
}

impl Default for LogSettings {
    fn default() -> Self {
        Self { level: "info".to_owned(), format: LogFormat::Auto }
    }
}

/// A log that runs, whose level can be changed.
pub struct Log {
    change: Box<dyn Fn(EnvFilter) -> Result<(), String> + Send + Sync>,
}

impl Log {
    /// Changes what is logged from now on.
    ///
    /// # Errors
    /// A sentence naming the level when it is no filter; the level before stays.
    pub fn set_level(&self, level: &str) -> Result<(), String> {
        (self.change)(filter(level)?)
    }
}

/// Checks a level.
///
/// # Errors
/// A sentence naming it when it is no filter.
pub fn filter(level: &str) -> Result<EnvFilter, String> {
    EnvFilter::try_new(level).map_err(|e| format!("log.level is {level:?}: {e}; try error, warn, info, debug or trace"))
}

/// Starts logging to standard error; standard output is for results.
///
/// # Errors
/// A sentence naming the level when it is no filter.
pub fn start(settings: &LogSettings) -> Result<Log, String> {
    let filter = filter(&settings.level)?;
    let json = match settings.format {
        LogFormat::Json => true,
        LogFormat::Text => false,
        LogFormat::Auto => !std::io::stderr().is_terminal(),
    };
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    if json {
        let builder = builder.json().flatten_event(true).with_span_list(false).with_filter_reloading();
        let handle = builder.reload_handle();
        builder.try_init().map_err(|e| e.to_string())?;
        Ok(Log { change: Box::new(move |filter| handle.reload(filter).map_err(|e| e.to_string())) })
    } else {
        let builder = builder.compact().with_filter_reloading();
        let handle = builder.reload_handle();
        builder.try_init().map_err(|e| e.to_string())?;
        Ok(Log { change: Box::new(move |filter| handle.reload(filter).map_err(|e| e.to_string())) })
    }
}
