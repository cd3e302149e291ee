//! Status of the connection to the broker.

use std::sync::{Arc, Mutex};

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
}

impl MqttStatus {
    /// Whether batches can arrive: connected and subscribed.
    pub fn connected(&self) -> bool {
        self.lock().connected
    }

    /// Finding for `/readyz`; `None` if there is no broker or the connection works. Batches are still accepted over
    /// HTTP, and the connection is restored automatically, so the service is degraded but ready.
    pub fn finding(&self) -> Option<String> {
        let inner = self.lock().clone();
        (inner.used && !inner.connected).then(|| {
            let trouble = inner.trouble.unwrap_or_else(|| "not connected yet".to_owned());
            format!("no batches from the MQTT broker: {trouble}")
        })
    }

    pub(super) fn set(&self, connected: bool, trouble: Option<String>) {
        *self.lock() = Inner { used: true, connected, trouble };
        metrics::gauge!("modalwatch_mqtt_connected").set(f64::from(u8::from(connected)));
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
}
