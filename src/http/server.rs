//! The accept loop. `axum::serve` 0.8 is not used because it has no time limit for the header of a request: a client
//! that never completes its header would keep its connection open for ever and prevent the service from stopping.

use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::extract::ConnectInfo;
use axum::http::Request;
use axum::Router;
use hyper::server::conn::http1::Builder;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use hyper_util::service::TowerToHyperService;
use rustix::process::{getrlimit, Resource};
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tower::Service;
use tracing::{debug, info, warn};

use super::settings::HttpSettings;

/// Pause after a failed accept: if the process has no free file descriptor, an immediate retry would loop.
const PAUSE_AFTER_FAILED_ACCEPT: Duration = Duration::from_millis(50);

/// File descriptors reserved for other uses than connections: database, log, model files, outgoing requests.
const RESERVED_FILES: usize = 64;

/// Maximum number of open connections: `wanted`, or fewer if the process may not open so many files. Otherwise idle
/// connections could use the last descriptor, and the database could not be opened for the next reader.
fn most_connections(wanted: usize, files: Option<usize>) -> usize {
    let Some(files) = files else { return wanted };
    let possible = files.saturating_sub(RESERVED_FILES).max(files / 4).max(1);
    if possible < wanted {
        warn!("The limit of open files is {files}: at most {possible} connections are accepted at a time instead of {wanted}; raise the limit with `ulimit -n`");
    }
    wanted.min(possible)
}

/// Soft limit of open files; `None` if there is no limit.
fn open_files_limit() -> Option<usize> {
    getrlimit(Resource::Nofile).current.and_then(|files| usize::try_from(files).ok())
}

/// Serves until `shutdown` completes, then lets open requests finish within the drain time.
pub async fn run(listener: TcpListener, router: Router, settings: &HttpSettings, shutdown: impl Future<Output = ()>) {
    let mut builder = Builder::new();
    builder
        .timer(TokioTimer::new())
        .header_read_timeout(Duration::from_secs(settings.header_timeout_s))
        .keep_alive(true);
    let connections = Arc::new(Semaphore::new(most_connections(settings.max_connections, open_files_limit())));
    let graceful = GracefulShutdown::new();
    let mut shutdown = std::pin::pin!(shutdown);
    loop {
        let permit = tokio::select! {
            permit = Arc::clone(&connections).acquire_owned() => permit.expect("the semaphore is never closed"),
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
        // Answers are small; waiting to fill a packet (Nagle) would only add latency.
        let _ = stream.set_nodelay(true);
        let service = TowerToHyperService::new(WithPeer { router: router.clone(), peer });
        let connection = graceful.watch(builder.serve_connection(TokioIo::new(stream), service));
        tokio::spawn(async move {
            if let Err(error) = connection.await {
                debug!(%error, "A connection ended early: {error}");
            }
            drop(permit);
        });
    }
    drop(listener);
    info!("Stopping: no new connections are accepted, open requests have {} s to finish", settings.drain_s);
    if tokio::time::timeout(Duration::from_secs(settings.drain_s), graceful.shutdown()).await.is_err() {
        warn!("Some requests did not finish in time and were aborted");
    }
}

/// The router; adds the peer address to the extensions of each request.
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
