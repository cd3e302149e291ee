//! The role `worker` of `modalwatch serve`: a worker beside the API in one process, or a process that only computes.

use std::future::Future;
use std::time::Duration;

use anyhow::Context as _;
use tokio::net::TcpListener;
use tokio::signal::unix::Signal;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tracing::{info, warn};

use super::{recorder, supervisor};
use crate::config::Config;
use crate::http::{worker, HttpSettings};
use crate::monitor::{declare_metrics, Worker, WorkerSettings};
use crate::store;

/// A worker that runs. It gives back what it has not finished, and ends, when this is dropped.
pub struct Working {
    /// The worker.
    pub worker: Worker,
    /// Completes when it has ended.
    pub task: JoinHandle<()>,
    /// Ends the worker when it is dropped.
    pub end: watch::Sender<bool>,
}

/// Starts the worker of this process, if it has this role and a database that can be shared.
///
/// # Errors
/// A database that cannot be used, with a remedy.
pub async fn begin(config: &Config) -> anyhow::Result<Option<Working>> {
    let Some(url) = config.store.url.as_ref().filter(|_| config.roles.worker) else { return Ok(None) };
    let store = store::open_beside(&config.data_dir, url).await?;
    let settings = WorkerSettings {
        compute: config.monitor.compute,
        lease: Duration::from_secs(config.store.takeover_s),
        models_dir: config.models_dir.clone(),
    };
    let (end, ended) = watch::channel(false);
    let worker = Worker::new(store.clone(), settings);
    let running = worker.clone();
    let task = tokio::spawn(async move {
        running.run(ended).await;
        store.close().await;
    });
    Ok(Some(Working { worker, task, end }))
}

/// Binds the address of the service.
///
/// # Errors
/// If another program uses it.
pub async fn listen(http: &HttpSettings) -> anyhow::Result<TcpListener> {
    TcpListener::bind(&http.listen).await.with_context(|| {
        let listen = &http.listen;
        format!("cannot listen on {listen}: if another program uses the port, choose another with --listen")
    })
}

/// Computes until `shutdown` completes.
///
/// # Errors
/// A database or address that cannot be used, with a remedy.
pub async fn run(config: Config, mut hangups: Signal, shutdown: impl Future<Output = ()>) -> anyhow::Result<()> {
    let listener = listen(&config.http).await?;
    let address = listener.local_addr()?;
    let metrics = recorder::install()?;
    let Some(Working { worker, task, end }) = begin(&config).await? else {
        anyhow::bail!("a process that only computes needs a PostgreSQL database: set store.url");
    };
    declare_metrics(worker.database());
    tokio::spawn(async move {
        while hangups.recv().await.is_some() {
            warn!("SIGHUP: the settings of a worker take effect at the next start");
        }
    });
    supervisor::computing();
    println!("modalwatch listens on http://{address}");
    info!(%address, "Listening on http://{address}, computing only");
    worker::run(listener, worker, metrics, &config.http, shutdown).await;
    info!("Stopping: what is not finished is given back");
    supervisor::stopping();
    drop(end);
    if tokio::time::timeout(Duration::from_secs(config.http.drain_s), task).await.is_err() {
        warn!("Stopped before the worker had ended: what it holds is computed by others when its lease has ended");
    }
    Ok(())
}
