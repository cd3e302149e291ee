//! Status of the connection to the broker.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Messages that wait so long without one being finished are a finding. Longer than all attempts to store one message, after which it is
/// put into quarantine.
const STALLED_AFTER: Duration = Duration::from_secs(20);

/// Status of the connection to the broker. Cloning is cheap.
#[derive(Debug, Clone, Default)]
pub struct MqttStatus {
    inner: Arc<Mutex<Inner>>,
}

#[derive(Debug, Clone, Default)]
struct Inner {
    used: bool,
    connected: bool,
    trouble: Option<String>,
    /// Messages that have arrived and are not finished: stored or in quarantine.
    waiting: usize,
    /// When a message was finished last, or arrived while none was waiting.
    progress: Option<Instant>,
}

impl MqttStatus {
    /// Whether batches can arrive: connected and subscribed.
    pub fn connected(&self) -> bool {
        self.lock().connected
    }

    /// Finding for `/readyz`; `None` if there is no broker, or if the connection works and messages are processed. Batches are still
    /// accepted over HTTP, and the connection is restored automatically, so the service is degraded but ready.
    pub fn finding(&self) -> Option<String> {
        self.finding_at(Instant::now())
    }

    fn finding_at(&self, now: Instant) -> Option<String> {
        let inner = self.lock().clone();
        if inner.used && !inner.connected {
            let trouble = inner.trouble.unwrap_or_else(|| "not connected yet".to_owned());
            return Some(format!("no batches from the MQTT broker: {trouble}"));
        }
        let still = now.duration_since(inner.progress?);
        (inner.waiting > 0 && still >= STALLED_AFTER).then(|| {
            format!(
                "{} MQTT messages wait, and none has been stored or put into quarantine for {} s",
                inner.waiting,
                still.as_secs()
            )
        })
    }

    pub(super) fn set(&self, connected: bool, trouble: Option<String>) {
        let mut inner = self.lock();
        (inner.used, inner.connected, inner.trouble) = (true, connected, trouble);
        metrics::gauge!("modalwatch_mqtt_connected").set(f64::from(u8::from(connected)));
    }

    /// Counts a message that has arrived.
    pub(super) fn arrived(&self) {
        let mut inner = self.lock();
        if inner.waiting == 0 {
            inner.progress = Some(Instant::now());
        }
        inner.waiting += 1;
        metrics::gauge!("modalwatch_mqtt_waiting_messages").set(inner.waiting as f64);
    }

    /// Counts a message that is stored, in quarantine, or given up because its processing failed.
    pub(super) fn finished(&self) {
        let mut inner = self.lock();
        inner.waiting = inner.waiting.saturating_sub(1);
        inner.progress = Some(Instant::now());
        metrics::gauge!("modalwatch_mqtt_waiting_messages").set(inner.waiting as f64);
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Inner> {
        self.inner.lock().expect("no holder of this lock panics")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_a_broker_there_is_nothing_to_report() {
        let status = MqttStatus::default();
        assert_eq!(status.finding(), None);
        status.set(false, None);
        assert!(status.finding().unwrap().contains("not connected yet"));
        status.set(true, None);
        assert_eq!(status.finding(), None);
    }

    #[test]
    fn messages_that_wait_without_progress_are_a_finding() {
        let status = MqttStatus::default();
        status.set(true, None);
        let later = Instant::now() + STALLED_AFTER;
        status.arrived();
        status.arrived();
        assert_eq!(status.finding(), None);
        assert!(status.finding_at(later + STALLED_AFTER).unwrap().starts_with("2 MQTT messages wait"));
        status.finished();
        assert_eq!(status.finding_at(later), None, "one has just been finished");
        status.finished();
        assert_eq!(status.finding_at(later + STALLED_AFTER), None, "none is waiting");
    }
}
