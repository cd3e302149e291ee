//! Logs: JSON lines for machines, short text for people at a terminal; and, with the feature `otel`, traces.
//!
//! Two kinds of spans stand in the code. Those of the crate's own targets give log lines their fields, such as the id of a
//! request. Those of the target `modalwatch::spans` are for traces, stay out of the log, and cost nothing where no trace is sent.

use std::io::IsTerminal as _;

use serde::{Deserialize, Serialize};
use tracing_subscriber::layer::{Layer as _, SubscriberExt as _};
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{reload, EnvFilter};

#[cfg(feature = "otel")]
mod traces;
#[cfg(not(feature = "otel"))]
mod traces {
    //! Stands for traces in a program that was built without them.

    use tracing_subscriber::layer::{Identity, Layer};
    use tracing_subscriber::Registry;

    /// Nothing is sent.
    #[derive(Default)]
    pub struct Traces;

    impl Traces {
        pub(super) fn start(endpoint: &str) -> Result<Self, String> {
            if endpoint.is_empty() {
                return Ok(Self);
            }
            Err("log.otlp_endpoint is set, and this program sends no traces: build it with --features otel".to_owned())
        }

        #[expect(clippy::unused_self, reason = "as the one that sends")]
        pub(super) fn layer(&self) -> impl Layer<Registry> {
            Identity::new()
        }

        /// Nothing is left to send.
        pub fn end(self) {}
    }
}

pub use traces::Traces;

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
    /// Where traces are sent to, such as `http://localhost:4318`; empty for where `OTEL_EXPORTER_OTLP_ENDPOINT` says, or for
    /// nowhere.
    pub otlp_endpoint: String,
}

impl Default for LogSettings {
    fn default() -> Self {
        Self { level: "info".to_owned(), format: LogFormat::Auto, otlp_endpoint: String::new() }
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
    let filter = EnvFilter::try_new(level)
        .map_err(|e| format!("log.level is {level:?}: {e}; try error, warn, info, debug or trace"))?;
    Ok(filter.add_directive("modalwatch::spans=off".parse().expect("a target and a level are a directive")))
}

/// Starts logging to standard error; standard output is for results. Starts sending traces where they are wanted.
///
/// # Errors
/// A sentence naming the level when it is no filter, or the address of the traces when it is none.
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
