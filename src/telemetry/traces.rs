//! OpenTelemetry traces: a thread sends spans as protobuf over HTTP.
//!
//! The number of waiting spans is bounded: while the collector is unreachable, spans are dropped and nothing blocks.
//! Queue size, interval, sampling and the name of the service are set by the standard variables `OTEL_…`.

use std::time::Duration;

use opentelemetry::trace::TracerProvider as _;
use opentelemetry_otlp::{SpanExporter, WithExportConfig as _, WithHttpConfig as _};
use opentelemetry_sdk::trace::SdkTracerProvider;
use opentelemetry_sdk::Resource;
use reqwest::Certificate;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::Layer;
use tracing_subscriber::Registry;

/// Traces are sent if one of these variables is set; the exporter reads them.
const STANDARD_VARIABLES: [&str; 2] = ["OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT"];

/// Time limit for sending the last spans when the service stops.
const FINAL_SEND_LIMIT: Duration = Duration::from_secs(5);

/// The exporter of traces, if they are configured.
#[derive(Default)]
pub struct Traces(Option<SdkTracerProvider>);

impl Traces {
    /// Sends to `endpoint`, otherwise to the address in the standard variables; sends nothing if neither is set.
    pub(super) fn start(endpoint: &str) -> Result<Self, String> {
        let wanted = |name: &&str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
        if endpoint.is_empty() && !STANDARD_VARIABLES.iter().any(wanted) {
            return Ok(Self::default());
        }
        let wrong =
            |e: &dyn std::fmt::Display| format!("traces cannot be sent (log.otlp_endpoint, OTEL_EXPORTER_OTLP_…): {e}");
        // As `notify::client_builder` does, which this module may not use; an error means that it is installed already.
        let _ = rustls::crypto::ring::default_provider().install_default();
        // Mozilla's certificates are added because small container images have none, and the client cannot be built
        // without any.
        let mozilla = webpki_root_certs::TLS_SERVER_ROOT_CERTS.iter().filter_map(|der| Certificate::from_der(der).ok());
        let client = reqwest::blocking::Client::builder().tls_certs_merge(mozilla);
        // A blocking client cannot be created on an async thread.
        let client = std::thread::spawn(|| client.build()).join().map_err(|_| wrong(&"the client panicked"))?;
        let client = client.map_err(|e| wrong(&e))?;
        let mut exporter = SpanExporter::builder().with_http().with_http_client(client);
        if !endpoint.is_empty() {
            if !reqwest::Url::parse(endpoint).is_ok_and(|url| ["http", "https"].contains(&url.scheme())) {
                return Err(format!("log.otlp_endpoint is {endpoint:?}: it must be a URL with http or https"));
            }
            exporter = exporter.with_endpoint(format!("{}/v1/traces", endpoint.trim_end_matches('/')));
        }
        let exporter = exporter.build().map_err(|e| wrong(&e))?;
        // The variables that name the service take precedence over this name.
        let resource = match std::env::var_os("OTEL_SERVICE_NAME") {
            Some(_) => Resource::builder().build(),
            None => Resource::builder().with_service_name(env!("CARGO_PKG_NAME")).build(),
        };
        Ok(Self(Some(SdkTracerProvider::builder().with_resource(resource).with_batch_exporter(exporter).build())))
    }

    /// Layer that records the spans meant for traces.
    pub(super) fn layer(&self) -> impl Layer<Registry> {
        self.0.as_ref().map(|provider| {
            tracing_opentelemetry::layer()
                .with_tracer(provider.tracer(env!("CARGO_PKG_NAME")))
                .with_location(false)
                .with_threads(false)
                .with_target(false)
                .with_tracked_inactivity(false)
                .with_filter(Targets::new().with_target("modalwatch::spans", tracing::Level::INFO))
        })
    }

    /// Sends the remaining spans, for five seconds at most.
    pub fn end(self) {
        if let Some(Err(failure)) = self.0.map(|provider| provider.shutdown_with_timeout(FINAL_SEND_LIMIT)) {
            tracing::warn!(error = %failure, "Could not send the last spans: {failure}");
        }
    }
}
