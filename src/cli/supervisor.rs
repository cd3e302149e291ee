//! What a supervisor is told: systemd's readiness and watchdog. Without systemd, nothing.

use std::time::Duration;

use sd_notify::NotifyState;
use tracing::{info, warn};

use crate::monitor::Monitor;

/// Says that requests are taken, and begins to answer the watchdog, if there is one.
///
/// The watchdog is answered while the writer takes turns. A disk that is full or fails does not silence it: a restart would
/// not help, and would end the reading that still works.
pub fn ready(monitor: Monitor) {
    tell(&[NotifyState::Ready]);
    let mut allowed_us = 0;
    if !sd_notify::watchdog_enabled(false, &mut allowed_us) {
        return;
    }
    let every = Duration::from_micros(allowed_us) / 3;
    info!(every_ms = every.as_millis() as u64, "Answering the watchdog of systemd");
    tokio::spawn(async move {
        let mut ticks = tokio::time::interval(every);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            if monitor.upkeep().writer_responds().await {
                tell(&[NotifyState::Watchdog]);
            } else {
                warn!("The writer does not take turns: systemd's watchdog gets no answer");
            }
        }
    });
}

/// Says that the service ends.
pub fn stopping() {
    tell(&[NotifyState::Stopping]);
}

fn tell(state: &[NotifyState]) {
    // Without NOTIFY_SOCKET this does nothing.
    if let Err(error) = sd_notify::notify(false, state) {
        warn!(%error, "Could not tell systemd: {error}");
    }
}
