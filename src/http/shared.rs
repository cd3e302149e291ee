//! The state that all handlers share.

use std::sync::Arc;

use metrics_exporter_prometheus::PrometheusHandle;
use tokio::sync::Semaphore;

use super::access::{AccessControl, Shares};
use super::request::BodyLimits;
use super::table_room::TableRoom;
use crate::monitor::Monitor;
use crate::notify::Notifier;

/// State that every handler receives.
#[derive(Clone)]
pub struct Shared {
    pub(super) monitor: Monitor,
    pub(super) notifier: Notifier,
    pub(super) metrics: Arc<PrometheusHandle>,
    pub(super) limits: BodyLimits,
    /// Permits for event streams.
    pub(super) streams: Arc<Semaphore>,
    /// Event streams of each token.
    pub(super) token_streams: Arc<Shares>,
    /// Computations of each client that run or wait.
    pub(super) computations: Arc<Shares>,
    /// Permits for reading a series.
    pub(super) series: Arc<Semaphore>,
    /// Room for tables in memory.
    pub(super) table_room: Arc<TableRoom>,
    pub(super) access: AccessControl,
    /// Maximum number of structures with metrics of their own.
    pub(super) metrics_structures: usize,
}
