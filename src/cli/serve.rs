//! `modalwatch serve`: starts and stops all parts of the service.

use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;

use anyhow::Context as _;
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder};
use tokio::net::TcpListener;
use tokio::signal::unix::{signal, SignalKind};
use tokio::sync::{watch, Notify};
use tracing::{error, info};

use super::reload::Reloading;
use super::supervisor;
use crate::baseline::library::Library;
use crate::config::Config;
use crate::http::access::AccessControl;
use crate::http::{router, server, Service};
use crate::monitor::{declare_metrics, Error as MonitorError, Monitor, Reason};
use crate::mqtt::{self, MqttStatus};
use crate::notify::{Mailer, Notifier};
use crate::store::Store;

/// Upper bounds of the latency histogram buckets, s.
const BUCKETS_SECONDS: [f64; 12] = [0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0];

/// The result of a step of the start that writes. On a full disk the service starts without it, for reading, and says so.
fn or_later<E: std::fmt::Display + Into<anyhow::Error>>(
    what: &str,
    done: Result<(), E>,
    is_of_the_disk: impl FnOnce(&E) -> bool,
) -> anyhow::Result<()> {
    match done {
        Err(failure) if is_of_the_disk(&failure) => {
            error!("Could not {what}; the next start does it: {failure}");
            Ok(())
        }
        done => done.map_err(Into::into),
    }
}

/// A service that is listening.
pub struct Running {
    /// The address it listens on.
    pub address: SocketAddr,
    /// Completes when the service has stopped; an error if a part of it failed.
    pub task: tokio::task::JoinHandle<anyhow::Result<()>>,
    /// The monitor of the structures.
    pub monitor: Monitor,
}

/// Starts the service; it stops when `shutdown` completes.
///
/// # Errors
/// A data folder, database, models folder or address that cannot be used, with a remedy.
pub async fn start(config: Config, shutdown: impl Future<Output = ()> + Send + 'static) -> anyhow::Result<Running> {
    let library = Library::open(config.models_dir.as_deref())?;
    // Listening comes first, so that a second instance reports the used port rather than the locked database.
    let listener = TcpListener::bind(&config.http.listen).await.with_context(|| {
        format!(
            "cannot listen on {}: if another program uses the port, choose another with --listen",
            config.http.listen
        )
    })?;
    let address = listener.local_addr()?;
    let store = Store::open_with(&config.data_dir, &config.store).await?;
    let (place, largest_batch) = ((address, config.data_dir.as_path()), config.monitor.max_measurements);
    let access = AccessControl::open(store.clone(), &config.access, &config.http, place, largest_batch).await?;
    let limits = config.monitor.severity;
    let wake = Arc::new(Notify::new());
    let mailer = Mailer::new(store.clone(), config.email, config.notify.clone(), limits, Arc::clone(&wake))?;
    // Before the first batch is assessed, so that its alarms are addressed.
    or_later("set the recipients of e-mail", mailer.prepare().await, |error| error.disk_cause().is_some())?;
    let monitor = Monitor::open(store.clone(), library, config.monitor).await?;
    let upkeep = monitor.upkeep();
    upkeep.retention().set(config.retention);
    monitor.replay().resume_all();
    let on_disk = |error: &MonitorError| matches!(error, MonitorError::Store(error) if error.disk_cause().is_some());
    or_later("resume the jobs that a stop interrupted", monitor.jobs().resume().await, on_disk)?;
    monitor.deletions().resume().await?;
    upkeep.silence().watch();
    upkeep.retention().watch();
    upkeep.diagnoses().watch(config.diagnosis);
    let metrics = PrometheusBuilder::new()
        .set_buckets_for_metric(Matcher::Suffix("_seconds".to_owned()), &BUCKETS_SECONDS)?
        .install_recorder()?;
    let notifier = Notifier::new(store.clone(), config.notify, limits, wake).map_err(anyhow::Error::msg)?;
    let (stop, stopped) = watch::channel(false);
    let mut background =
        vec![tokio::spawn(notifier.clone().run(stopped.clone())), tokio::spawn(mailer.clone().run(stopped.clone()))];
    let broker = MqttStatus::default();
    background.extend(mqtt::run(&config.mqtt, monitor.clone(), &broker, stopped)?);
    let rights = access.clone();
    upkeep.report_findings_from(move || rights.findings());
    let sender = notifier.clone();
    upkeep.report_findings_from(move || {
        let broker = broker.finding().map(|it| Reason::new("mqtt_unavailable", it));
        let webhooks = sender.finding().map(|it| Reason::new("webhooks_failing", it));
        let mails = mailer.finding().map(|it| Reason::new("mail_failing", it));
        broker.into_iter().chain(webhooks).chain(mails).collect()
    });
    let router = router(Service { monitor: monitor.clone(), notifier, access, metrics }, &config.http);
    declare_metrics(store.file().sqlite_version());
    let (data_dir, baselines) = (config.data_dir.display().to_string(), upkeep.baselines_in_use());
    info!(%address, data_dir, baselines, "Listening on http://{address} with {baselines} trained models");
    let (events, jobs) = (monitor.events().clone(), monitor.jobs().clone());
    let task = tokio::spawn(async move {
        let shutdown = async {
            shutdown.await;
            supervisor::stopping();
            // Jobs that compute end at their next epoch or step, while open requests finish.
            jobs.stop().await;
            // Event streams do not end by themselves and would delay the shutdown up to its time limit.
            events.close();
            // Sending fails only if all background tasks have ended already.
            let _ = stop.send(true);
        };
        server::run(listener, router, &config.http, shutdown).await;
        let mut failed = 0;
        for task in background {
            if let Err(failure) = task.await {
                error!(error = %failure, "A background task panicked: {failure}");
                failed += 1;
            }
        }
        store.close().await;
        info!("Stopped");
        anyhow::ensure!(failed == 0, "{failed} parts of the service failed while it was running: its log names them");
        Ok(())
    });
    Ok(Running { address, task, monitor })
}

/// Runs the service until SIGTERM or SIGINT; a second signal ends the process immediately. SIGHUP reads the configuration again.
///
/// # Errors
/// Whatever prevents the service from starting.
pub async fn serve(config: Config, reloading: Reloading) -> anyhow::Result<()> {
    // Before the start is reported: SIGHUP may be sent as soon as the report is read.
    let hangups = Reloading::hangups()?;
    let running = start(config.clone(), stop_signal()?).await?;
    reloading.follow(hangups, running.monitor.clone(), config);
    supervisor::ready(running.monitor);
    println!("modalwatch listens on http://{}", running.address);
    running.task.await.context("the service panicked")?
}

/// Completes at the first SIGTERM or SIGINT.
///
/// # Errors
/// If no signal handler can be installed.
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
