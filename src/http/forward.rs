//! Passing a request on to the node that serves, and its answer back, both as streams.
//!
//! The nodes are one service to the client: what it sent arrives as it was sent, and is answered as if it had asked the serving node itself.
//! If that node is not there, cannot be reached or ends during the request, the answer is a 503 with `Retry-After` that says whether a change
//! may have been made.

use std::net::SocketAddr;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use axum::body::{Body, Bytes, HttpBody as _};
use axum::extract::Request;
use axum::http::{header, request, HeaderMap, HeaderName, HeaderValue, Method, StatusCode, Version};
use axum::response::{IntoResponse as _, Response};
use futures_util::stream::{self, Stream};
use http_body_util::BodyExt as _;
use reqwest::redirect::Policy;
use tokio::sync::watch;
use tracing::warn;

use super::error::ApiError;
use super::node_header::{signed, FORWARDED};
use super::observe::REQUEST_ID;
use super::request::{broken_body, slow_body, BodyLimits};
use super::request_id::current_id;
use super::settings::HttpSettings;
use super::starting;
use crate::notify::client_builder;
use crate::store::server::{Node, Nodes};

/// Time for a connection to the serving node.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);

/// Time for the serving node to acknowledge bytes, after which its machine is taken for cut off.
const ACKNOWLEDGE_TIMEOUT: Duration = Duration::from_secs(20);

/// How long a read waits for the next node that serves, before it is repeated once.
const WAIT_FOR_NEXT: Duration = Duration::from_secs(1);

/// The largest body is cut off at this multiple of the limit: the serving node reads and refuses what is larger than its own limit.
const MULTIPLE_OF_LIMIT: usize = 9;

/// Value of `Retry-After`, seconds: a takeover from a node that ended takes about one.
const RETRY_AFTER_S: u32 = 1;

/// Headers of one connection, which are not passed on. Those that `Connection` names in addition are: a client could otherwise have a header
/// removed by which the serving node decides.
const OF_THE_CONNECTION: [HeaderName; 8] = [
    header::CONNECTION,
    HeaderName::from_static("keep-alive"),
    HeaderName::from_static("proxy-connection"),
    header::TE,
    header::TRAILER,
    header::TRANSFER_ENCODING,
    header::UPGRADE,
    // Answered by this node.
    header::EXPECT,
];

/// Passes requests on. Cloning is cheap.
#[derive(Clone)]
pub struct Forwarder {
    nodes: Nodes,
    client: reqwest::Client,
    limits: BodyLimits,
    /// Ends event streams, which do not end by themselves.
    stopping: Arc<watch::Sender<bool>>,
}

/// Why there is no answer of the serving node.
#[derive(Debug)]
enum Failure {
    /// No connection could be made: nothing was sent.
    NoConnection,
    /// The node ended or was replaced, or the connection to it broke.
    Lost,
    /// The body of the client ended early.
    Body(BodyFault),
}

/// What was wrong with the body of a client.
#[derive(Debug, Clone, Copy)]
enum BodyFault {
    Late,
    TooLarge,
    Broken,
}

/// A request without its body.
struct Head {
    parts: request::Parts,
    client: SocketAddr,
}

impl Forwarder {
    /// Passes requests on to the serving one of these nodes.
    ///
    /// # Errors
    /// If no HTTP client can be built.
    pub fn new(nodes: Nodes, settings: &HttpSettings) -> Result<Self, reqwest::Error> {
        let client = client_builder()
            .redirect(Policy::none())
            .no_proxy()
            .connect_timeout(CONNECT_TIMEOUT)
            .tcp_user_timeout(ACKNOWLEDGE_TIMEOUT)
            // Shorter than the serving node waits for the next header of an idle connection, so that it is never used while that closes it.
            .pool_idle_timeout(Duration::from_secs(settings.header_timeout_s) / 2)
            .build()?;
        let limits = BodyLimits {
            bytes: settings.max_body_bytes,
            bulk_bytes: settings.max_bulk_bytes,
            time: Duration::from_secs(settings.body_timeout_s),
        };
        Ok(Self { nodes, client, limits, stopping: Arc::default() })
    }

    /// Ends the event streams.
    pub fn stop(&self) {
        self.stopping.send_replace(true);
    }

    /// The node that serves.
    pub fn serving(&self) -> Option<Node> {
        self.nodes.serving().borrow().clone()
    }

    /// Whether this node itself serves, or is about to.
    pub fn is_own(&self, node: &Node) -> bool {
        node.id == self.nodes.own().id
    }

    /// Whether the address of a node leads to it.
    pub async fn reaches(&self, node: &Node) -> bool {
        let Ok(url) = format!("{}/healthz", node.url).parse::<reqwest::Url>() else { return false };
        let here = SocketAddr::from(([127, 0, 0, 1], 0));
        let value = signed(&self.nodes, &node.id, (&Method::GET, url.path()), (here, Version::HTTP_11));
        let asked = self.client.get(url).header(FORWARDED, value).timeout(CONNECT_TIMEOUT).send().await;
        asked.is_ok_and(|answer| answer.status() == StatusCode::OK)
    }

    /// The answer of the serving node to a request of a client.
    pub async fn answer(&self, client: SocketAddr, request: Request) -> Response {
        let (outcome, answer) = match self.passed_on(client, request).await {
            Ok(answer) => ("answered", answer),
            Err(Failure::NoConnection) => {
                let detail =
                    "no node serves the database at present, or this node cannot reach it: nothing was changed; \
                              repeat the request";
                ("no_service", ApiError::unavailable("no_service", detail, RETRY_AFTER_S).into_response())
            }
            Err(Failure::Lost) => {
                let detail = "the node that serves ended or was replaced during the request: whether a change was stored is not \
                              known, and a batch can be repeated safely: it is stored once";
                ("service_lost", ApiError::unavailable("service_lost", detail, RETRY_AFTER_S).into_response())
            }
            Err(Failure::Body(fault)) => ("refused", self.refusal(fault).into_response()),
        };
        metrics::counter!("modalwatch_forwarded_requests_total", "outcome" => outcome).increment(1);
        answer
    }

    async fn passed_on(&self, client: SocketAddr, request: Request) -> Result<Response, Failure> {
        let (parts, body) = request.into_parts();
        let Some(target) = self.serving() else { return Err(Failure::NoConnection) };
        let is_empty = body.is_end_stream();
        let is_read = is_empty && matches!(parts.method, Method::GET | Method::HEAD);
        let head = Head { parts, client };
        let first = self.ask(&target, &head, (!is_empty).then_some(body)).await;
        match first {
            Err(Failure::NoConnection | Failure::Lost) if is_read => {
                let Some(next) = self.next().await else { return first };
                self.ask(&next, &head, None).await
            }
            first => first,
        }
    }

    /// The node that serves, after one that did was not reached.
    async fn next(&self) -> Option<Node> {
        let mut serving = self.nodes.serving();
        self.nodes.look_again();
        let _ = tokio::time::timeout(WAIT_FOR_NEXT, serving.changed()).await;
        let next = serving.borrow().clone();
        next
    }

    async fn ask(&self, target: &Node, head: &Head, body: Option<Body>) -> Result<Response, Failure> {
        let uri = &head.parts.uri;
        if self.is_own(target) {
            return Ok(starting::answer(uri.path()));
        }
        let path = uri.path_and_query().map_or("/", |path| path.as_str());
        // `OPTIONS *` and the like have no path.
        let path = if path.starts_with('/') { path } else { "/" };
        let Ok(url) = format!("{}{path}", target.url).parse::<reqwest::Url>() else {
            return Err(Failure::NoConnection);
        };
        let sent = url.query().map_or_else(|| url.path().to_owned(), |query| format!("{}?{query}", url.path()));
        let mut headers = without_those_of_the_connection(&head.parts.headers);
        let method = &head.parts.method;
        let about = (head.client, head.parts.version);
        headers.insert(FORWARDED, signed(&self.nodes, &target.id, (method, &sent), about));
        if let Some(id) = current_id().and_then(|id| HeaderValue::from_str(&id).ok()) {
            headers.insert(REQUEST_ID, id);
        }
        let fault = Arc::new(OnceLock::new());
        let mut request = self.client.request(method.clone(), url).headers(headers);
        if let Some(body) = body {
            request = request.body(reqwest::Body::wrap_stream(limited(body, self.limits, Arc::clone(&fault))));
        }
        let mut serving = self.nodes.serving();
        let answer = tokio::select! {
            answer = request.send() => answer,
            () = replaced(&mut serving, target) => return Err(Failure::Lost),
        };
        let error = match (answer, fault.get()) {
            (Ok(answer), _) => return Ok(self.streamed(answer, target.clone())),
            (Err(_), Some(fault)) => return Err(Failure::Body(*fault)),
            (Err(error), None) => error,
        };
        warn!(%error, "The serving node {} does not answer: {error:?}", target.url);
        self.nodes.look_again();
        Err(if error.is_connect() { Failure::NoConnection } else { Failure::Lost })
    }

    /// The answer of the serving node, whose body is passed on as it comes. It breaks off if that node is replaced: an end would look as if it
    /// were complete.
    fn streamed(&self, answer: reqwest::Response, target: Node) -> Response {
        let mut passed = Response::new(Body::empty());
        *passed.status_mut() = answer.status();
        *passed.headers_mut() = without_those_of_the_connection(answer.headers());
        let media_type = answer.headers().get(header::CONTENT_TYPE).map(HeaderValue::as_bytes).unwrap_or_default();
        let is_event_stream = media_type.starts_with(b"text/event-stream");
        let (serving, stopping) = (self.nodes.serving(), self.stopping.subscribe());
        let chunks = stream::unfold((answer, serving, stopping, target), move |mut state| async move {
            let (answer, serving, stopping, target) = (&mut state.0, &mut state.1, &mut state.2, &state.3);
            let chunk = tokio::select! {
                chunk = answer.chunk() => chunk.map_err(std::io::Error::other),
                () = replaced(serving, target) => Err(std::io::Error::other("the serving node was replaced")),
                _ = stopping.wait_for(|stopping| *stopping), if is_event_stream => Ok(None),
            };
            chunk.transpose().map(|chunk| (chunk, state))
        });
        *passed.body_mut() = Body::from_stream(chunks);
        passed
    }

    fn refusal(&self, fault: BodyFault) -> ApiError {
        match fault {
            BodyFault::Late => slow_body(self.limits.time),
            BodyFault::Broken => broken_body(),
            BodyFault::TooLarge => {
                let detail = format!("the body is larger than {} bytes: split it", self.limits.bulk_bytes);
                ApiError::new(StatusCode::PAYLOAD_TOO_LARGE, "body_too_large", detail)
            }
        }
    }
}

/// Completes when another node serves than `target`. If none serves, it may be this one again after a moment.
async fn replaced(serving: &mut watch::Receiver<Option<Node>>, target: &Node) {
    let another = |found: &Option<Node>| found.as_ref().is_some_and(|found| found.id != target.id);
    if serving.wait_for(another).await.is_err() {
        // The list of nodes is no longer watched: this process ends.
        std::future::pending::<()>().await;
    }
}

fn without_those_of_the_connection(headers: &HeaderMap) -> HeaderMap {
    let mut headers = headers.clone();
    for name in OF_THE_CONNECTION {
        headers.remove(name);
    }
    headers
}

/// The body of a client as a stream, within the limits of any route. The time counts only while more of it is wanted.
fn limited(
    body: Body,
    limits: BodyLimits,
    fault: Arc<OnceLock<BodyFault>>,
) -> impl Stream<Item = Result<Bytes, std::io::Error>> + Send + 'static {
    let most = limits.bulk_bytes.max(limits.bytes).saturating_mul(MULTIPLE_OF_LIMIT);
    stream::unfold((body, 0_usize), move |(mut body, mut total)| {
        let fault = Arc::clone(&fault);
        async move {
            let found = loop {
                match tokio::time::timeout(limits.time, body.frame()).await {
                    Err(_) => break BodyFault::Late,
                    Ok(None) => return None,
                    Ok(Some(Err(_))) => break BodyFault::Broken,
                    Ok(Some(Ok(frame))) => {
                        let Ok(data) = frame.into_data() else { continue };
                        total = total.saturating_add(data.len());
                        if total > most {
                            break BodyFault::TooLarge;
                        }
                        return Some((Ok(data), (body, total)));
                    }
                }
            };
            let _ = fault.set(found);
            Some((Err(std::io::Error::other("the body of the client ended early")), (Body::empty(), total)))
        }
    })
}
