//! `modalwatch serve`: everything put together, and the way down.

use std::future::Future;
use std::net::SocketAddr;

use anyhow::Context as _;
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder};
use tokio::net::TcpListener;
use tokio::signal::unix::{signal, SignalKind};
use tokio::sync::watch;
use tracing::{error, info};

use super::reload::Reloading;
use super::supervisor;
use crate::baseline::library::Library;
use crate::config::Config;
use crate::http::access::AccessControl;
use crate::http::{router, server, Service};
use crate::monitor::{declare_metrics, Monitor, Reason};
use crate::mqtt::{self, MqttStatus};
use crate::notify::Notifier;
use crate::store::Store;

/// Upper ends of the latency buckets, seconds.
const BUCKETS_SECONDS: [f64; 12] = [0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0];

/// A service that is listening.
pub struct Running {
    /// Where it listens.
    pub address: SocketAddr,
    /// Ends when the service has stopped.
    pub task: tokio::task::JoinHandle<()>,
    /// What it works with.
    pub monitor: Monitor,
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
    let store = Store::open_with(&config.data_dir, &config.store).await?;
    let (place, largest_batch) = ((address, config.data_dir.as_path()), config.monitor.max_measurements);
    let access = AccessControl::open(store.clone(), &config.access, &config.http, place, largest_batch).await?;
    let monitor = Monitor::open(store.clone(), library, config.monitor).await?;
    let upkeep = monitor.upkeep();
    upkeep.retention().set(config.retention);
    monitor.replay().resume_all();
    upkeep.silence().watch();
    upkeep.retention().watch();
    let metrics = PrometheusBuilder::new()
        .set_buckets_for_metric(Matcher::Suffix("_seconds".to_owned()), &BUCKETS_SECONDS)?
        .install_recorder()?;
    let notifier = Notifier::new(store.clone(), config.notify).map_err(anyhow::Error::msg)?;
    let (stop, stopped) = watch::channel(false);
    let mut background = vec![tokio::spawn(notifier.clone().run(stopped.clone()))];
    let broker = MqttStatus::default();
    background.extend(mqtt::run(&config.mqtt, monitor.clone(), &broker, stopped)?);
    let rights = access.clone();
    upkeep.report_findings_from(move || rights.findings());
    let sender = notifier.clone();
    upkeep.report_findings_from(move || {
        let broker = broker.finding().map(|it| Reason::new("mqtt_unavailable", it));
        broker.into_iter().chain(sender.finding().map(|it| Reason::new("webhooks_failing", it))).collect()
    });
    let router = router(Service { monitor: monitor.clone(), notifier, access, metrics }, &config.http);
    declare_metrics(store.file().sqlite_version());
    let (data_dir, baselines) = (config.data_dir.display().to_string(), upkeep.baselines_in_use());
    info!(%address, data_dir, baselines, "Listening on http://{address} with {baselines} trained baseline(s)");
    let events = monitor.events().clone();
    let task = tokio::spawn(async move {
        let shutdown = async {
            shutdown.await;
            supervisor::stopping();
            // Event streams never end by themselves: open ones would hold the drain up to its limit.
            events.close();
            // Those who listen may have ended already.
            let _ = stop.send(true);
        };
        server::run(listener, router, &config.http, shutdown).await;
        for task in background {
            if let Err(failure) = task.await {
                error!(error = %failure, "A background task ended by a panic: {failure}");
            }
        }
        store.close().await;
        info!("Stopped");
    });
    Ok(Running { address, task, monitor })
}

/// Runs the service until SIGTERM or SIGINT; a second one ends the process at once. SIGHUP reads the configuration again.
///
/// # Errors
/// Whatever keeps the service from starting.
pub async fn serve(config: Config, reloading: Reloading) -> anyhow::Result<()> {
    // Before anything is said to listen: whoever reads that may send it at once.
    let hangups = Reloading::hangups()?;
    let running = start(config.clone(), stop_signal()?).await?;
    reloading.follow(hangups, running.monitor.clone(), config);
    supervisor::ready(running.monitor);
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
