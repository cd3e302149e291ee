//! What a node answers while another one serves the database: how it is itself, and everything else by passing it on.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::extract::{ConnectInfo, Request, State};
use axum::http::{header, StatusCode};
use axum::response::{IntoResponse as _, Response};
use axum::routing::{any, get};
use axum::{middleware, Json, Router};
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::sync::Mutex;

use super::access::{headers, NotANetwork, Proxies};
use super::forward::Forwarder;
use super::observe;
use super::operations::{self, Readiness};
use super::settings::HttpSettings;
use crate::monitor::Reason;
use crate::store::server::Nodes;

/// How long it is believed that the serving node was reached, or was not.
const KNOWN_FOR: Duration = Duration::from_millis(500);

/// Why a node cannot stand by.
#[derive(Debug, thiserror::Error)]
pub enum StandbyError {
    /// A trusted proxy is not an address or network.
    #[error("http.trusted_proxies: {0}")]
    Proxy(#[from] NotANetwork),
    /// No HTTP client can be built.
    #[error("requests cannot be passed on to other nodes: {0}")]
    Client(#[from] reqwest::Error),
}

/// The routes of a node that stands by.
#[derive(Clone)]
pub struct Standby {
    pub(super) router: Router,
    pub(super) proxies: Arc<Proxies>,
    forwarder: Forwarder,
}

struct Inner {
    forwarder: Forwarder,
    metrics: PrometheusHandle,
    reached: Mutex<Option<(Instant, Result<String, Reason>)>>,
}

impl Standby {
    /// Passes requests on to the serving one of these nodes.
    ///
    /// # Errors
    /// [`StandbyError`].
    pub fn new(nodes: Nodes, metrics: PrometheusHandle, settings: &HttpSettings) -> Result<Self, StandbyError> {
        let forwarder = Forwarder::new(nodes, settings)?;
        let proxies = Arc::new(Proxies::parse(&settings.trusted_proxies)?);
        metrics::gauge!("modalwatch_serving").set(0.0);
        let inner = Arc::new(Inner { forwarder: forwarder.clone(), metrics, reached: Mutex::default() });
        // Other methods than GET are refused by the serving node, with the same words as ever.
        let router = Router::new()
            .route("/healthz", get(operations::health).fallback(forward))
            .route("/readyz", get(ready).fallback(forward))
            .route("/metrics", get(metrics_of_this_node).fallback(forward))
            .route("/", any(forward))
            .route("/{*path}", any(forward))
            .fallback(forward)
            .layer(middleware::from_fn(headers::secure))
            .layer(middleware::from_fn(observe::with_id_and_log))
            .with_state(inner);
        Ok(Self { router, proxies, forwarder })
    }

    /// Ends the event streams, which would delay a stop.
    pub(super) fn stop(&self) {
        self.forwarder.stop();
    }
}

async fn forward(
    State(inner): State<Arc<Inner>>,
    ConnectInfo(client): ConnectInfo<SocketAddr>,
    request: Request,
) -> Response {
    inner.forwarder.answer(client, request).await
}

/// `GET /readyz`: 200 while requests can be passed on.
async fn ready(State(inner): State<Arc<Inner>>) -> Response {
    let reached = inner.reached().await;
    let status = if reached.is_ok() { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    (status, Json(Readiness::of_standby(reached))).into_response()
}

/// `GET /metrics`: of this process. Those of the structures are at the serving node.
async fn metrics_of_this_node(State(inner): State<Arc<Inner>>) -> Response {
    let _ = inner.reached().await;
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], inner.metrics.render()).into_response()
}

impl Inner {
    /// The address of the serving node if it can be reached, otherwise the reason.
    async fn reached(&self) -> Result<String, Reason> {
        let mut known = self.reached.lock().await;
        if let Some((at, reached)) = known.as_ref().filter(|(at, _)| at.elapsed() < KNOWN_FOR) {
            let _ = at;
            return reached.clone();
        }
        let reached = match self.forwarder.serving() {
            None => Err(Reason::new(
                "no_service",
                "no node serves the database: this one takes over as soon as the database lets it, unless the service that holds it is of a \
                 version that does not register itself",
            )),
            Some(node) if self.forwarder.is_own(&node) => {
                Err(Reason::new("starting", "this node takes over: it reads its structures and trained models"))
            }
            Some(node) if self.forwarder.reaches(&node).await => Ok(node.url),
            Some(node) => Err(Reason::new(
                "node_unreachable",
                format!(
                    "the serving node cannot be reached at {}: check the network between the nodes, and store.node_url of that node",
                    node.url
                ),
            )),
        };
        metrics::gauge!("modalwatch_ready").set(f64::from(u8::from(reached.is_ok())));
        *known = Some((Instant::now(), reached.clone()));
        reached
    }
}
