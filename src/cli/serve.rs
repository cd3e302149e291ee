//! `modalwatch serve`: starts and stops all parts of the service.

use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use tokio::signal::unix::{signal, SignalKind};
use tokio::sync::{oneshot, watch, Notify};
use tokio::task::JoinHandle;
use tracing::{error, info, warn};

use super::reload::Reloading;
use super::working::{self, Working};
use super::{node, recorder, supervisor};
use crate::baseline::library::Library;
use crate::config::Config;
use crate::http::access::AccessControl;
use crate::http::server::Duty;
use crate::http::{router, server, HttpSettings, Service};
use crate::monitor::automatic_diagnoses::DiagnosisSettings;
use crate::monitor::{declare_metrics, Error as MonitorError, Monitor, Reason};
use crate::mqtt::{self, MqttStatus};
use crate::notify::{Mailer, Notifier};
use crate::store::Store;

/// Time that the parts behind the requests have for their end even if the requests have used up the whole drain time.
const SHORTEST_END: Duration = Duration::from_secs(1);

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
    pub task: JoinHandle<anyhow::Result<()>>,
    /// The monitor of the structures.
    pub monitor: Monitor,
}

/// The server, which answers supervisors while structures and models are read.
struct Listening {
    address: SocketAddr,
    /// Receives what the server does with requests.
    duty: watch::Sender<Duty>,
    /// Ends the server when it is dropped.
    end: oneshot::Sender<()>,
    server: tokio::task::JoinHandle<()>,
}

impl Listening {
    /// Begins to listen. The second value completes when the server has ended.
    async fn begin(http: &HttpSettings) -> anyhow::Result<(Self, oneshot::Receiver<()>)> {
        let listener = working::listen(http).await?;
        let address = listener.local_addr()?;
        let (duty, received) = watch::channel(Duty::Starting);
        let (end, told) = oneshot::channel::<()>();
        let (has_ended, ended) = oneshot::channel::<()>();
        let settings = http.clone();
        let server = async move {
            server::run(listener, received, &settings, async { drop(told.await) }).await;
            drop(has_ended);
        };
        Ok((Self { address, duty, end, server: tokio::spawn(server) }, ended))
    }
}

/// Starts the service; it stops when `shutdown` completes.
///
/// # Errors
/// A data folder, database, models folder or address that cannot be used, with a remedy.
pub async fn start(config: Config, shutdown: impl Future<Output = ()> + Send + 'static) -> anyhow::Result<Running> {
    let (listening, _) = Listening::begin(&config.http).await?;
    start_on(listening, config, shutdown).await
}

/// As [`start`], on an address on which the server listens. (Listening comes first, so that a second instance reports the used port rather
/// than the locked database.)
async fn start_on(
    listening: Listening,
    config: Config,
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> anyhow::Result<Running> {
    let Listening { address, duty, end, server } = listening;
    let metrics = recorder::install()?;
    let nodes = node::join(&config, address, &duty, &metrics).await?;
    let models_dir = config.models_dir.clone();
    let library = tokio::task::spawn_blocking(move || Library::open(models_dir.as_deref())).await??;
    // It computes also while this process stands by.
    let working = working::begin(&config).await?;
    let store = Store::open_with(&config.data_dir, &config.store).await?;
    if let (Some(nodes), Some(session)) = (&nodes, store.file().lock_session()) {
        nodes.announce(session);
    }
    let (place, largest_batch) = ((address, config.data_dir.as_path()), config.monitor.max_measurements);
    let access = AccessControl::open(store.clone(), &config.access, &config.http, place, largest_batch).await?;
    let (limits, wake) = (config.monitor.severity, Arc::new(Notify::new()));
    let mailer = Mailer::new(store.clone(), config.email, config.notify.clone(), limits, Arc::clone(&wake))?;
    // Before the first batch is assessed, so that its alarms are addressed.
    or_later("set the recipients of e-mail", mailer.prepare().await, |error| error.disk_cause().is_some())?;
    let disabled = Notifier::prepare(&store).await;
    or_later("disable webhooks that cannot be read", disabled, |error| error.disk_cause().is_some())?;
    let monitor = Monitor::open(store.clone(), library, config.monitor).await?;
    let upkeep = monitor.upkeep();
    upkeep.retention().set(config.retention);
    if config.store.url.is_some() {
        let own = working.as_ref().map_or("", |working| working.worker.id()).to_owned();
        monitor.share(own, Duration::from_secs(config.store.takeover_s)).await?;
    }
    resume(&monitor, config.diagnosis).await?;
    let notifier = Notifier::new(store.clone(), config.notify, limits, wake).map_err(anyhow::Error::msg)?;
    let (stop, stopped) = watch::channel(false);
    let mut background =
        vec![tokio::spawn(notifier.clone().run(stopped.clone())), tokio::spawn(mailer.clone().run(stopped.clone()))];
    let broker = MqttStatus::default();
    let end_of_worker = working.map(|Working { task, end, .. }| {
        background.push(task);
        end
    });
    background.extend(mqtt::run(&config.mqtt, monitor.clone(), &broker, stopped)?);
    let rights = access.clone();
    upkeep.report_findings_from(move || rights.findings());
    let sender = notifier.clone();
    upkeep.report_findings_from(move || findings_of_messages(&broker, &sender, &mailer));
    let routes =
        router(Service { monitor: monitor.clone(), notifier, access, metrics }, &config.http).with_nodes(nodes.clone());
    declare_metrics(monitor.database());
    let (data_dir, baselines) = (config.data_dir.display().to_string(), upkeep.baselines_in_use());
    info!(%address, data_dir, baselines, "Listening on http://{address} with {baselines} trained models");
    let (events, jobs) = (monitor.events().clone(), monitor.jobs().clone());
    duty.send_replace(Duty::Serving(routes));
    let drain = Duration::from_secs(config.http.drain_s);
    let task = tokio::spawn(async move {
        let taken_over = tokio::select! { () = shutdown => None, taken = store.file().taken_over() => Some(taken) };
        if let Some(taken) = &taken_over {
            error!("Stopping: {taken}");
        }
        let begun = Instant::now();
        supervisor::stopping();
        // Jobs that compute end at their next epoch or step, while open requests finish.
        background.push(jobs.stop());
        // Event streams do not end by themselves and would delay the shutdown up to its time limit.
        events.close();
        // Sending fails only if all background tasks, or the server, have ended already.
        let _ = stop.send(true);
        drop(end_of_worker);
        drop(end);
        let served = server.await;
        if let Err(failure) = &served {
            error!(%failure, "The server panicked: {failure}");
        }
        drop((duty, nodes));
        let left = drain.saturating_sub(begun.elapsed()).max(SHORTEST_END);
        let ended = end_parts(background, usize::from(served.is_err()), &store, left).await;
        taken_over.map_or(ended, |taken| Err(taken.into()))
    });
    Ok(Running { address, task, monitor })
}

/// Resumes what an earlier run has left undone, and begins what recurs.
async fn resume(monitor: &Monitor, diagnosis: DiagnosisSettings) -> anyhow::Result<()> {
    monitor.replay().resume_all();
    let on_disk = |error: &MonitorError| matches!(error, MonitorError::Store(error) if error.disk_cause().is_some());
    or_later("resume the jobs that a stop interrupted", monitor.jobs().resume().await, on_disk)?;
    monitor.deletions().resume().await?;
    let upkeep = monitor.upkeep();
    upkeep.silence().watch();
    upkeep.retention().watch();
    upkeep.diagnoses().watch(diagnosis);
    upkeep.trainings().watch();
    Ok(())
}

/// What is wrong with the connections by which batches come in and messages go out.
fn findings_of_messages(broker: &MqttStatus, notifier: &Notifier, mailer: &Mailer) -> Vec<Reason> {
    let broker = broker.finding().map(|it| Reason::new("mqtt_unavailable", it));
    let webhooks = notifier.finding().map(|it| Reason::new("webhooks_failing", it));
    let mails = mailer.finding().map(|it| Reason::new("mail_failing", it));
    broker.into_iter().chain(webhooks).chain(mails).collect()
}

/// Waits for the end of all parts behind the requests and closes the database, within a time limit. `failed`: parts that have failed before.
async fn end_parts(
    background: Vec<JoinHandle<()>>,
    failed: usize,
    store: &Store,
    limit: Duration,
) -> anyhow::Result<()> {
    let ended = async {
        let mut failed = failed;
        for task in background {
            if let Err(failure) = task.await {
                error!(error = %failure, "A background task panicked: {failure}");
                failed += 1;
            }
        }
        // A request that was aborted may still hold a connection to the database.
        store.close().await;
        failed
    };
    // Whatever is cut off is repeated by the next start: a write is complete or absent, a message is sent again.
    let Ok(failed) = tokio::time::timeout(limit, ended).await else {
        warn!("Stopped before all parts had ended: the next start completes what they were doing");
        return Ok(());
    };
    info!("Stopped");
    anyhow::ensure!(failed == 0, "{failed} parts of the service failed while it was running: its log names them");
    Ok(())
}

/// Runs the service until SIGTERM or SIGINT; a second signal ends the process immediately. SIGHUP reads the configuration again.
///
/// # Errors
/// Whatever prevents the service from starting.
pub async fn serve(config: Config, reloading: Reloading) -> anyhow::Result<()> {
    // Before the start is reported: SIGHUP may be sent as soon as the report is read.
    let hangups = Reloading::hangups()?;
    let (before_listening, shutdown) = (first_signal()?, stop_signal()?);
    if !config.roles.api {
        return working::run(config, hangups, shutdown).await;
    }
    let (listening, server_ended) = Listening::begin(&config.http).await?;
    let running = tokio::select! {
        biased;
        running = start_on(listening, config.clone(), shutdown) => Some(running?),
        // A start with many large structures takes minutes, and a standby waits for ever.
        () = before_listening => None,
    };
    let Some(running) = running else {
        supervisor::stopping();
        // The requests that a standby has passed on are answered.
        let _ = server_ended.await;
        info!("Stopped during the start");
        return Ok(());
    };
    reloading.follow(hangups, running.monitor.clone(), config);
    supervisor::ready(running.monitor);
    println!("modalwatch listens on http://{}", running.address);
    running.task.await.context("the service panicked")?
}

/// Completes at the first SIGTERM or SIGINT; the next one ends the process immediately.
///
/// # Errors
/// If no signal handler can be installed.
pub fn stop_signal() -> anyhow::Result<impl Future<Output = ()> + Send + 'static> {
    let (mut terminate, mut interrupt) = (signal(SignalKind::terminate())?, signal(SignalKind::interrupt())?);
    Ok(async move {
        tokio::select! { _ = terminate.recv() => {}, _ = interrupt.recv() => {} }
        tokio::spawn(async move {
            tokio::select! { _ = terminate.recv() => {}, _ = interrupt.recv() => {} }
            std::process::exit(1);
        });
    })
}

/// Completes at the first SIGTERM or SIGINT.
fn first_signal() -> anyhow::Result<impl Future<Output = ()>> {
    let (mut terminate, mut interrupt) = (signal(SignalKind::terminate())?, signal(SignalKind::interrupt())?);
    Ok(async move {
        tokio::select! { _ = terminate.recv() => {}, _ = interrupt.recv() => {} }
    })
}
