//! The connection to the broker: subscribe, hand messages on, acknowledge what is settled, come back after a loss.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::Arc;
use std::time::Duration;

use rumqttc::{AsyncClient, Event, EventLoop, Packet, Publish, QoS, SubscribeReasonCode};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tracing::{error, info, warn};

use super::message::Intake;
use super::{MqttSettings, MqttStatus, SettingError, Topic};
use crate::monitor::Monitor;

/// Messages that wait here. When they are too many the connection is not read any further: the broker keeps the rest.
const WAITING: usize = 64;

/// Messages that are worked on at a time.
const AT_A_TIME: usize = 8;

/// First and longest pause before the next attempt to connect.
const FIRST_PAUSE: Duration = Duration::from_millis(500);
const LONGEST_PAUSE: Duration = Duration::from_secs(30);

/// Pause before asking again for a subscription that the broker refused.
const SUBSCRIBE_AGAIN: Duration = Duration::from_secs(30);

/// A message and the connection that it came by.
struct Arrived {
    connection: u64,
    publish: Publish,
}

/// A message being worked on.
struct InWork {
    arrived: Arrived,
    work: JoinHandle<()>,
}

/// Takes batches from the broker until `stop` becomes true; returns at once when there is no broker.
///
/// # Errors
/// [`SettingError`] for settings or files that cannot be used; trouble with the broker is no error, it heals.
pub fn run(
    settings: &MqttSettings,
    monitor: Monitor,
    status: &MqttStatus,
    stop: watch::Receiver<bool>,
) -> Result<Option<JoinHandle<()>>, SettingError> {
    if settings.is_off() {
        return Ok(None);
    }
    let (options, topic) = (settings.options()?, Topic::new(&settings.topic)?);
    let (client, events) = AsyncClient::new(options, 2 * WAITING);
    status.set(false, None);
    let intake = Arc::new(Intake { monitor, topic: topic.clone(), max_payload_bytes: settings.max_payload_bytes });
    // Raised with every connection: an acknowledgement may go only to the connection that its message came by.
    let connection = Arc::new(AtomicU64::new(0));
    let (arrived, to_work) = mpsc::channel(WAITING);
    let (in_work, to_acknowledge) = mpsc::channel(AT_A_TIME);
    let (status, url) = (status.clone(), settings.url.clone());
    Ok(Some(tokio::spawn(async move {
        let working = tokio::spawn(work(to_work, in_work, intake));
        let acknowledging = tokio::spawn(acknowledge(to_acknowledge, client.clone(), Arc::clone(&connection)));
        let link = Link { client, filter: topic.filter(), status, url, connection, arrived, trouble: None };
        link.hold(events, stop).await;
        // What is not acknowledged comes again after the next start.
        working.abort();
        acknowledging.abort();
    })))
}

/// Starts the work on messages, in the order they came.
async fn work(mut arrived: mpsc::Receiver<Arrived>, in_work: mpsc::Sender<InWork>, intake: Arc<Intake>) {
    while let Some(arrived) = arrived.recv().await {
        let (intake, topic, payload) =
            (Arc::clone(&intake), arrived.publish.topic.clone(), arrived.publish.payload.clone());
        let work = tokio::spawn(async move { intake.take(&topic, payload).await });
        if in_work.send(InWork { arrived, work }).await.is_err() {
            return;
        }
    }
}

/// Acknowledges messages in the order they came, as the protocol demands.
async fn acknowledge(mut in_work: mpsc::Receiver<InWork>, client: AsyncClient, connection: Arc<AtomicU64>) {
    while let Some(InWork { arrived, work }) = in_work.recv().await {
        if let Err(panicked) = work.await {
            // Not acknowledged: it comes again after the next connection.
            error!(error = %panicked, "The work on an MQTT message broke off: {panicked}");
            continue;
        }
        // Packet ids begin anew with a new session: an old one could acknowledge a message that nobody has read yet.
        if arrived.connection == connection.load(Ordering::SeqCst) {
            if let Err(failure) = client.ack(&arrived.publish).await {
                warn!(error = %failure, "Could not acknowledge an MQTT message: {failure}");
            }
        }
    }
}

/// The connection itself.
struct Link {
    client: AsyncClient,
    filter: String,
    status: MqttStatus,
    url: String,
    connection: Arc<AtomicU64>,
    arrived: mpsc::Sender<Arrived>,
    /// The last trouble, so that the log has each once.
    trouble: Option<String>,
}

impl Link {
    async fn hold(mut self, mut events: EventLoop, mut stop: watch::Receiver<bool>) {
        let mut pause = FIRST_PAUSE;
        loop {
            let event = tokio::select! {
                () = stopped(&mut stop) => return,
                event = events.poll() => event,
            };
            match event {
                Ok(event) => {
                    if matches!(event, Event::Incoming(Packet::ConnAck(_))) {
                        pause = FIRST_PAUSE;
                    }
                    tokio::select! {
                        () = stopped(&mut stop) => return,
                        () = self.take(event) => {}
                    }
                }
                Err(failure) => {
                    // Before anything else: what comes by the next connection is not acknowledged by this one's numbers.
                    self.connection.fetch_add(1, Ordering::SeqCst);
                    self.lost(failure.to_string());
                    tokio::select! {
                        () = stopped(&mut stop) => return,
                        () = tokio::time::sleep(pause) => {}
                    }
                    pause = (2 * pause).min(LONGEST_PAUSE);
                }
            }
        }
    }

    async fn take(&mut self, event: Event) {
        match event {
            Event::Incoming(Packet::ConnAck(_)) => {
                self.trouble = None;
                self.status.set(false, Some("connected, not subscribed yet".to_owned()));
                info!(broker = %self.url, "Connected to the MQTT broker {}", self.url);
                // Always, not only without a session: the topic may be another one since the session began.
                self.subscribe(Duration::ZERO);
            }
            Event::Incoming(Packet::SubAck(answer)) => {
                if answer.return_codes.contains(&SubscribeReasonCode::Failure) {
                    let trouble = format!("it refused the subscription of {}", self.filter);
                    error!(broker = %self.url, topic = %self.filter, "The MQTT broker {}: {trouble}", self.url);
                    self.status.set(false, Some(trouble));
                    self.subscribe(SUBSCRIBE_AGAIN);
                } else {
                    self.status.set(true, None);
                }
            }
            Event::Incoming(Packet::Publish(publish)) => {
                let connection = self.connection.load(Ordering::SeqCst);
                // Waits when many wait already; the other end lives as long as this task.
                let _ = self.arrived.send(Arrived { connection, publish }).await;
            }
            _ => {}
        }
    }

    /// Asks for the topic, in a task of its own: the queue of requests is emptied by the loop that calls this.
    fn subscribe(&self, after: Duration) {
        let (client, filter) = (self.client.clone(), self.filter.clone());
        tokio::spawn(async move {
            tokio::time::sleep(after).await;
            if let Err(failure) = client.subscribe(filter, QoS::AtLeastOnce).await {
                warn!(error = %failure, "Could not ask the MQTT broker for the topic: {failure}");
            }
        });
    }

    fn lost(&mut self, reason: String) {
        if self.trouble.as_ref() != Some(&reason) {
            warn!(broker = %self.url, error = %reason, "No connection to the MQTT broker {}: {reason}", self.url);
        }
        self.status.set(false, Some(reason.clone()));
        self.trouble = Some(reason);
    }
}

/// Done when the service stops.
async fn stopped(stop: &mut watch::Receiver<bool>) {
    // Without a sender there is nobody left to stop it.
    let _ = stop.wait_for(|stopped| *stopped).await;
}
