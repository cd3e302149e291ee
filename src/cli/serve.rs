//! `modalwatch serve`: everything put together, and the way down.

use std::future::Future;
use std::net::SocketAddr;

use anyhow::Context as _;
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder};
use tokio::net::TcpListener;
use tokio::signal::unix::{signal, SignalKind};
use tracing::info;

use crate::baseline::library::Library;
use crate::config::Config;
use crate::http::{router, server};
use crate::monitor::Monitor;
use crate::store::Store;

/// Upper ends of the latency buckets, seconds.
const BUCKETS_SECONDS: [f64; 12] = [0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0];

/// A service that is listening.
pub struct Running {
    /// Where it listens.
    pub address: SocketAddr,
    /// Ends when the service has stopped.
    pub task: tokio::task::JoinHandle<()>,
}

/// Starts the service; it stops when `shutdown` is done.
///
/// # Errors
/// A folder, database, baseline folder or address that cannot be used, with what to do.
pub async fn start(config: Config, shutdown: impl Future<Output = ()> + Send + 'static) -> anyhow::Result<Running> {
    let library = Library::open(config.models_dir.as_deref())?;
    // The address first: a second instance should hear that the port is taken before anything else.
    let listener = TcpListener::bind(&config.http.listen).await.with_context(|| {
        format!("cannot listen on {}: is another service there? Choose another with --listen", config.http.listen)
    })?;
    let address = listener.local_addr()?;
    let store = Store::open(&config.data_dir).await?;
    let monitor = Monitor::open(store.clone(), library, config.monitor).await?;
    monitor.resume();
    monitor.watch_for_silence();
    let metrics = PrometheusBuilder::new()
        .set_buckets_for_metric(Matcher::Suffix("_seconds".to_owned()), &BUCKETS_SECONDS)?
        .install_recorder()?;
    let router = router(monitor.clone(), metrics, &config.http);
    let (data_dir, baselines) = (config.data_dir.display().to_string(), monitor.baselines_in_use());
    info!(%address, data_dir, baselines, "Listening on http://{address} with {baselines} trained baseline(s)");
    let task = tokio::spawn(async move {
        server::run(listener, router, &config.http, shutdown).await;
        store.close().await;
        info!("Stopped");
    });
    Ok(Running { address, task })
}

/// Runs the service until SIGTERM or SIGINT; a second one ends the process at once.
///
/// # Errors
/// Whatever keeps the service from starting.
pub async fn serve(config: Config) -> anyhow::Result<()> {
    let running = start(config, stop_signal()?).await?;
    println!("modalwatch listens on http://{}", running.address);
    running.task.await.context("the service ended by a panic")
}

/// Done at the first SIGTERM or SIGINT.
///
/// # Errors
/// When the process may not handle signals.
pub fn stop_signal() -> anyhow::Result<impl Future<Output = ()> + Send + 'static> {
    let (mut terminate, mut interrupt) = (signal(SignalKind::terminate())?, signal(SignalKind::interrupt())?);
    Ok(async move {
        let mut wait = async || {
            tokio::select! { _ = terminate.recv() => {}, _ = interrupt.recv() => {} }
        };
        wait().await;
        tokio::spawn(async move {
            tokio::select! { _ = terminate.recv() => {}, _ = interrupt.recv() => {} }
            std::process::exit(1);
        });
    })
}
