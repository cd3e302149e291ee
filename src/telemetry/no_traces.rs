//! Replaces the exporter of traces in a program that was built without the feature `otel`.

use tracing_subscriber::layer::{Identity, Layer};
use tracing_subscriber::Registry;

/// The exporter of a program without the feature `otel`. It sends nothing.
#[derive(Default)]
pub struct Traces;

impl Traces {
    pub(super) fn start(endpoint: &str) -> Result<Self, String> {
        if endpoint.is_empty() {
            return Ok(Self);
        }
        Err("log.otlp_endpoint is set, but this program cannot send traces: build it with --features otel".to_owned())
    }

    #[expect(clippy::unused_self, reason = "has the signature of the exporter")]
    pub(super) fn layer(&self) -> impl Layer<Registry> {
        Identity::new()
    }

    /// Does nothing.
    pub fn end(self) {}
}
