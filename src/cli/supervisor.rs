//! Notifications to systemd: readiness, watchdog and stopping. Without systemd they do nothing.

use std::time::Duration;

use sd_notify::NotifyState;
use tokio::sync::watch;
use tracing::{info, warn};

use crate::http::server::Duty;
use crate::monitor::Monitor;

/// Reports that requests are passed on to another node, and notifies the watchdog until that ends: nothing of this process can hang then but
/// the process itself.
pub fn standing_by(mut duty: watch::Receiver<Duty>) {
    notify(&[NotifyState::Ready]);
    let mut allowed_us = 0;
    if !sd_notify::watchdog_enabled(false, &mut allowed_us) {
        return;
    }
    let every = Duration::from_micros(allowed_us) / 3;
    tokio::spawn(async move {
        while matches!(&*duty.borrow_and_update(), Duty::StandingBy(_)) {
            notify(&[NotifyState::Watchdog]);
            if matches!(tokio::time::timeout(every, duty.changed()).await, Ok(Err(_))) {
                return;
            }
        }
    });
}

/// Reports readiness, and starts to notify the watchdog if it is enabled.
///
/// The watchdog is notified while the writer task responds, even if the disk is full or fails: a restart would not help, and
/// would interrupt the reading that still works.
pub fn ready(monitor: Monitor) {
    notify(&[NotifyState::Ready]);
    let mut allowed_us = 0;
    if !sd_notify::watchdog_enabled(false, &mut allowed_us) {
        return;
    }
    let every = Duration::from_micros(allowed_us) / 3;
    info!(every_ms = every.as_millis() as u64, "Notifying the watchdog of systemd");
    tokio::spawn(async move {
        let mut ticks = tokio::time::interval(every);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            if monitor.upkeep().writer_responds().await {
                notify(&[NotifyState::Watchdog]);
            } else {
                warn!("The writer task does not respond: the watchdog of systemd is not notified");
            }
        }
    });
}

/// Reports readiness of a process that only computes.
pub fn computing() {
    notify(&[NotifyState::Ready]);
}

/// Reports that the service is stopping.
pub fn stopping() {
    notify(&[NotifyState::Stopping]);
}

fn notify(state: &[NotifyState]) {
    // Without NOTIFY_SOCKET this does nothing.
    if let Err(error) = sd_notify::notify(false, state) {
        warn!(%error, "Could not notify systemd: {error}");
    }
}
