//! The accept loop: our own, because `axum::serve` 0.8 sets no time limit for a request's header.
//!
//! A client that never ends its header would hold its connection for ever and keep the service from stopping.

use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::extract::ConnectInfo;
use axum::http::Request;
use axum::Router;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto::Builder;
use hyper_util::server::graceful::GracefulShutdown;
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tower::Service;
use tracing::{debug, info, warn};

use super::HttpSettings;

/// Pause after a failed accept: when the process is out of file handles, trying at once would spin.
const PAUSE_AFTER_FAILED_ACCEPT: Duration = Duration::from_millis(50);

/// File handles kept free of connections: for the database, its log, files of models, and what the service itself asks for.
const RESERVED_FILES: usize = 64;

/// Connections that may be open at a time: as many as wanted, unless the process may not have so many files.
///
/// Without this, idle connections take the last handle, and the database cannot be opened for the next reader.
fn most_connections(wanted: usize, files: Option<usize>) -> usize {
    let Some(files) = files else { return wanted };
    let possible = files.saturating_sub(RESERVED_FILES).max(files / 4).max(1);
    if possible < wanted {
        warn!("The limit of open files is {files}: at most {possible} connections at a time, not {wanted}; raise it with `ulimit -n`");
    }
    wanted.min(possible)
}

/// The soft limit of open files; `None` where it is not known or there is none.
fn open_files_limit() -> Option<usize> {
    let limits = std::fs::read_to_string("/proc/self/limits").ok()?;
    let line = limits.lines().find_map(|line| line.strip_prefix("Max open files"))?;
    line.split_whitespace().next()?.parse().ok()
}

/// Serves until `shutdown` is done, then lets open requests end within the drain time.
pub async fn run(listener: TcpListener, router: Router, settings: &HttpSettings, shutdown: impl Future<Output = ()>) {
    let mut builder = Builder::new(TokioExecutor::new()).http1_only();
    builder
        .http1()
        .timer(TokioTimer::new())
        .header_read_timeout(Duration::from_secs(settings.header_timeout_s))
        .keep_alive(true);
    let connections = Arc::new(Semaphore::new(most_connections(settings.max_connections, open_files_limit())));
    let graceful = GracefulShutdown::new();
    let mut shutdown = std::pin::pin!(shutdown);
    loop {
        let place = tokio::select! {
            place = Arc::clone(&connections).acquire_owned() => place.expect("the semaphore is never closed"),
            () = &mut shutdown => break,
        };
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
        // Answers are small; waiting to fill a packet would only add latency.
        let _ = stream.set_nodelay(true);
        let service = TowerToHyperService::new(WithPeer { router: router.clone(), peer });
        let connection = builder.serve_connection(TokioIo::new(stream), service).into_owned();
        let connection = graceful.watch(connection);
        tokio::spawn(async move {
            if let Err(error) = connection.await {
                debug!(%error, "A connection ended early: {error}");
            }
            drop(place);
        });
    }
    drop(listener);
    info!("Stopping: no new connections, open requests get {} s", settings.drain_s);
    if tokio::time::timeout(Duration::from_secs(settings.drain_s), graceful.shutdown()).await.is_err() {
        warn!("Some requests did not end in time and were cut off");
    }
}

/// The router, with the address of the connection among the extensions of each request.
#[derive(Clone)]
struct WithPeer {
    router: Router,
    peer: SocketAddr,
}

impl<B> Service<Request<B>> for WithPeer
where
    Router: Service<Request<B>>,
{
    type Response = <Router as Service<Request<B>>>::Response;
    type Error = <Router as Service<Request<B>>>::Error;
    type Future = <Router as Service<Request<B>>>::Future;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.router.poll_ready(context)
    }

    fn call(&mut self, mut request: Request<B>) -> Self::Future {
        request.extensions_mut().insert(ConnectInfo(self.peer));
        self.router.call(request)
    }
}
