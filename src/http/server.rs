//! The accept loop. `axum::serve` 0.8 is not used because it has no time limit for the header of a request: a client
//! that never completes its header would keep its connection open for ever and prevent the service from stopping.
//!
//! `connections` limits how many are served, `slow_reader` ends those that take no answer.

use std::convert::Infallible;
use std::future::Future;
use std::net::{IpAddr, SocketAddr};
use std::pin::pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use axum::extract::ConnectInfo;
use axum::http::{header, HeaderValue, Request, Response};
use axum::response::IntoResponse as _;
use axum::Router;
use hyper::body::Incoming;
use hyper::server::conn::http1::Builder;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{watch, Mutex};
use tower::Service as _;
use tracing::{debug, info, warn};

use super::access::route::PROBES;
use super::access::{AccessControl, Key};
use super::connections::{Connections, Eviction, ReservePlace, Slot, PATIENCE};
use super::error::ApiError;
use super::node_header::{self, NotForUs};
use super::observe::given_id;
use super::presence::Presence;
use super::request_id::with_current_id;
use super::settings::HttpSettings;
use super::slow_reader::{Backlog, TimedWrites};
use super::standby::Standby;
use super::starting;
use crate::store::server::Nodes;

/// Pause after a failed accept: if the process has no free file descriptor, an immediate retry would loop.
const PAUSE_AFTER_FAILED_ACCEPT: Duration = Duration::from_millis(50);

/// Time in which a connection that has to leave the reserve may receive its refusal.
const LAST_WORDS: Duration = Duration::from_millis(250);

/// Value of `Retry-After` when no place became free, seconds.
const RETRY_AFTER_S: u32 = 5;

/// Bytes that the system takes from the service for a client that has not received them yet (Linux doubles the number). By default it takes
/// megabytes, which a thousand clients that receive nothing turn into gigabytes of memory and a second of copying.
const SEND_BUFFER_BYTES: usize = 128 * 1024;

/// Value of `Retry-After` for a request that another node passed on in error, seconds: it looks twice a second which node serves.
const RETRY_AFTER_MISTAKE_S: u32 = 1;

/// The routes of the service, and who may use them.
#[derive(Clone)]
pub struct Routes {
    pub(super) router: Router,
    pub(super) access: AccessControl,
    pub(super) nodes: Option<Nodes>,
}

impl Routes {
    /// Believes these nodes what they say of the requests that they pass on.
    #[must_use]
    pub fn with_nodes(self, nodes: Option<Nodes>) -> Self {
        Self { nodes, ..self }
    }
}

/// What the server does with requests.
#[derive(Clone)]
pub enum Duty {
    /// It answers the probes of supervisors, while structures and models are read.
    Starting,
    /// Another node serves the database: requests are passed on to it.
    StandingBy(Standby),
    /// It answers them.
    Serving(Routes),
}

impl Duty {
    /// Key under which the connections of an address are counted; `None` for a trusted proxy.
    fn connection_key(&self, peer: IpAddr) -> Option<Key> {
        match self {
            Self::Serving(routes) => routes.access.connection_key(peer),
            Self::StandingBy(standby) => standby.proxies.connection_key(peer),
            Self::Starting => Some(Key::of_address(Some(peer.to_canonical()))),
        }
    }

    /// Whether another node has taken over from this one, which has not noticed it yet.
    fn is_replaced(&self) -> impl Future<Output = bool> + Send + 'static {
        let nodes = match self {
            Self::Serving(routes) => routes.nodes.clone(),
            Self::Starting | Self::StandingBy(_) => None,
        };
        async move {
            match nodes {
                Some(nodes) => nodes.is_replaced().await,
                None => false,
            }
        }
    }

    /// Whether a request comes from another node of the database; it is then restored to what the client sent to that node.
    fn restore(&self, request: &mut Request<Body>) -> Result<bool, NotForUs> {
        match self {
            Self::Serving(Routes { nodes: Some(nodes), .. }) => node_header::restore(request, nodes),
            // Without other nodes the header means nothing.
            Self::Serving(_) => {
                request.headers_mut().remove(node_header::FORWARDED);
                Ok(false)
            }
            // Nodes that pass requests on to one another would do it for ever.
            Self::StandingBy(_) if request.headers().contains_key(node_header::FORWARDED) => Err(NotForUs),
            Self::StandingBy(_) | Self::Starting => Ok(false),
        }
    }
}

/// Serves until `shutdown` completes, then lets open requests finish within the drain time.
pub async fn run(
    listener: TcpListener,
    duty: watch::Receiver<Duty>,
    settings: &HttpSettings,
    shutdown: impl Future<Output = ()>,
) {
    let mut builder = Builder::new();
    builder
        .timer(TokioTimer::new())
        .header_read_timeout(Duration::from_secs(settings.header_timeout_s))
        .keep_alive(true);
    let connections = Arc::new(Connections::new(settings));
    let graceful = GracefulShutdown::new();
    let mut shutdown = pin!(shutdown);
    loop {
        let (stream, peer) = tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok(accepted) => accepted,
                Err(error) => {
                    warn!(%error, "Could not accept a connection: {error}");
                    tokio::time::sleep(PAUSE_AFTER_FAILED_ACCEPT).await;
                    continue;
                }
            },
            () = &mut shutdown => break,
        };
        // Answers are small; waiting to fill a packet (Nagle) would only add latency.
        let _ = stream.set_nodelay(true);
        let _ = rustix::net::sockopt::set_socket_send_buffer_size(&stream, SEND_BUFFER_BYTES);
        let key = duty.borrow().connection_key(peer.ip());
        let place = tokio::select! {
            place = place(&connections, key.as_ref()) => place,
            () = &mut shutdown => break,
        };
        let eviction = match &place {
            Place::Reserve(place) => Some(place.eviction()),
            Place::Served(_) => None,
        };
        let connection = Arc::new(Connection {
            peer,
            key,
            place: Mutex::new(place),
            eviction,
            is_served: AtomicBool::new(false),
            backlog: Arc::default(),
            connections: Arc::clone(&connections),
            duty: duty.clone(),
        });
        let limit = Duration::from_secs(settings.write_timeout_s);
        tokio::spawn(serve(stream, connection, &builder, &graceful, limit));
    }
    drop(listener);
    if let Duty::StandingBy(standby) = &*duty.borrow() {
        standby.stop();
    }
    info!("Stopping: no new connections are accepted, open requests have {} s to finish", settings.drain_s);
    if tokio::time::timeout(Duration::from_secs(settings.drain_s), graceful.shutdown()).await.is_err() {
        warn!("Some requests did not finish in time and were aborted");
    }
}

/// Where a connection is.
enum Place {
    Served(#[expect(dead_code, reason = "held until the connection ends")] Slot),
    Reserve(ReservePlace),
}

/// A place among the served connections if one is free, otherwise one in the reserve.
async fn place(connections: &Connections, key: Option<&Key>) -> Place {
    match connections.try_slot(key) {
        Some(slot) => Place::Served(slot),
        None => Place::Reserve(connections.reserve_place().await),
    }
}

/// Serves one connection until it ends, or until its place in the reserve is needed.
fn serve(
    stream: TcpStream,
    connection: Arc<Connection>,
    builder: &Builder,
    graceful: &GracefulShutdown,
    limit: Duration,
) -> impl Future<Output = ()> + Send + 'static {
    let service = {
        let connection = Arc::clone(&connection);
        service_fn(move |request| {
            let connection = Arc::clone(&connection);
            async move { Ok::<_, Infallible>(connection.answer(request).await) }
        })
    };
    let stream = TokioIo::new(TimedWrites::new(stream, limit, Arc::clone(&connection.backlog)));
    let serving = graceful.watch(builder.serve_connection(stream, service));
    async move {
        let mut serving = pin!(serving);
        let ended = tokio::select! {
            ended = &mut serving => Some(ended),
            () = connection.is_evicted() => {
                if connection.is_served.load(Ordering::Acquire) {
                    Some(serving.await)
                } else if connection.eviction.as_ref().is_some_and(Eviction::has_request) {
                    tokio::time::timeout(LAST_WORDS, serving).await.ok()
                } else {
                    None
                }
            }
        };
        if let Some(Err(error)) = ended {
            debug!(%error, "A connection ended early: {error}");
        }
    }
}

/// A connection, as its requests see it.
struct Connection {
    peer: SocketAddr,
    /// The address for which it counts; `None` for a trusted proxy.
    key: Option<Key>,
    place: Mutex<Place>,
    /// `None` for a connection that was served from the beginning.
    eviction: Option<Eviction>,
    is_served: AtomicBool,
    backlog: Arc<Backlog>,
    connections: Arc<Connections>,
    duty: watch::Receiver<Duty>,
}

impl Connection {
    async fn is_evicted(&self) {
        match self.eviction.clone() {
            Some(mut eviction) => eviction.happens().await,
            None => std::future::pending().await,
        }
    }

    async fn answer(&self, request: Request<Incoming>) -> Response<Body> {
        // A client that sends further requests without taking the answers to the earlier ones is not worked for.
        self.backlog.taken().await;
        let mut request = request.map(Body::new);
        let duty = self.duty.borrow().clone();
        request.extensions_mut().insert(ConnectInfo(self.peer));
        let Ok(is_of_node) = duty.restore(&mut request) else {
            let detail = "another node passed this request on, and this node is not the one that serves: repeat it";
            let refusal = async { ApiError::unavailable("no_service", detail, RETRY_AFTER_MISTAKE_S).into_response() };
            // The node that passed it on gives the answer this id too.
            return match given_id(request.headers()).map(str::to_owned) {
                Some(id) => with_current_id(id, refusal).await,
                None => refusal.await,
            };
        };
        let is_probe = PROBES.contains(&request.uri().path());
        if !is_probe {
            if duty.is_replaced().await {
                let detail =
                    "another node serves the database since this one was suspended or cut off: repeat the request";
                return closing(ApiError::unavailable("no_service", detail, RETRY_AFTER_MISTAKE_S).into_response());
            }
            let headers = request.headers();
            let is_known = || match &duty {
                _ if is_of_node => true,
                Duty::Serving(routes) => routes.access.knows(headers),
                Duty::Starting | Duty::StandingBy(_) => false,
            };
            if let Err(refusal) = self.served(is_known).await {
                return closing(refusal.into_response());
            }
        }
        let (_awaited, presence) = Presence::begin();
        let mut router = match duty {
            Duty::Serving(routes) => routes.router,
            Duty::StandingBy(standby) => standby.router,
            Duty::Starting => return closing(starting::answer(request.uri().path())),
        };
        request.extensions_mut().insert(presence);
        let answer = router.call(request).await.unwrap_or_else(|never| match never {});
        if is_probe && matches!(*self.place.lock().await, Place::Reserve(_)) {
            return closing(answer);
        }
        answer
    }

    /// Waits until this connection is among the served ones. A request of a known client, with a valid token or through another node, does
    /// not count for its address.
    async fn served(&self, is_known: impl FnOnce() -> bool) -> Result<(), ApiError> {
        let mut place = self.place.lock().await;
        if matches!(*place, Place::Served(_)) {
            return Ok(());
        }
        let is_known = is_known();
        let key = self.key.as_ref().filter(|_| !is_known);
        if let Some(eviction) = &self.eviction {
            eviction.note_request();
        }
        let slot = tokio::select! {
            slot = self.connections.slot(key) => Some(slot),
            () = self.is_evicted() => None,
            () = tokio::time::sleep(PATIENCE) => None,
        };
        let Some(slot) = slot else {
            metrics::counter!("modalwatch_connections_refused_total").increment(1);
            let detail =
                "all connections are in use, in all or by this address: try again, and keep fewer connections open";
            return Err(ApiError::unavailable("too_many_connections", detail, RETRY_AFTER_S));
        };
        self.is_served.store(true, Ordering::Release);
        *place = Place::Served(slot);
        Ok(())
    }
}

/// An answer after which the connection is closed.
fn closing(mut answer: Response<Body>) -> Response<Body> {
    answer.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
    answer
}
