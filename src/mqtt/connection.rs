//! The connection to the broker: subscribes, passes messages on, acknowledges processed messages, and reconnects.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::Arc;
use std::time::Duration;

use rumqttc::{AsyncClient, Event, EventLoop, Packet, Publish, QoS, SubscribeReasonCode};
use tokio::sync::{mpsc, watch, OwnedSemaphorePermit, Semaphore};
use tokio::task::JoinHandle;
use tracing::{error, info, warn};

use super::message::Intake;
use super::settings::{MqttSettings, SettingError};
use super::status::MqttStatus;
use crate::monitor::Monitor;

/// Messages that may wait: one for each packet id of the protocol, and as many again of the connection before. A broker without a limit of
/// its own sends so many before it waits for an acknowledgement.
const WAITING: usize = 2 * u16::MAX as usize;

/// Size of the messages that may wait, bytes. When it is reached, the connection is not read, and the broker keeps further messages.
/// Until then everything is read at once: the answers to subscriptions and pings come behind the messages, and a connection whose ping is
/// not answered within an interval of the keep-alive is given up, with all acknowledgements that were not sent.
const WAITING_BYTES: usize = 64 << 20;

/// What a message takes beside its payload, bytes.
const OVERHEAD_BYTES: usize = 512;

/// Requests that may wait to be sent to the broker, most of them acknowledgements: one for each packet id, and some for subscriptions. The
/// loop that sends them also hands messages over, and waits while `WAITING_BYTES` of them are there; an acknowledgement that then had to
/// wait for a place in this queue would stop both for good.
const REQUESTS: usize = u16::MAX as usize + 64;

/// Maximum number of messages that are processed at a time.
const AT_A_TIME: usize = 8;

/// Shortest and longest delay before a reconnection.
const FIRST_DELAY: Duration = Duration::from_millis(500);
const LONGEST_DELAY: Duration = Duration::from_secs(30);

/// Delay before a refused subscription is repeated.
const SUBSCRIBE_AGAIN: Duration = Duration::from_secs(30);

/// A message and the number of the connection on which it arrived.
struct Arrived {
    connection: u64,
    publish: Publish,
    /// Its part of `WAITING_BYTES`.
    _bytes: OwnedSemaphorePermit,
}

/// A message that is being processed.
struct InWork {
    arrived: Arrived,
    work: JoinHandle<()>,
}

/// Receives batches from the broker until `stop` becomes true; returns `None` if no broker is configured.
///
/// # Errors
/// [`SettingError`] for settings or files that cannot be used. A failing connection is not an error: it is retried.
pub fn run(
    settings: &MqttSettings,
    monitor: Monitor,
    status: &MqttStatus,
    stop: watch::Receiver<bool>,
) -> Result<Option<JoinHandle<()>>, SettingError> {
    if settings.is_off() {
        return Ok(None);
    }
    let options = settings.options()?;
    let intake = Arc::new(Intake::new(monitor, settings)?);
    let (client, events) = AsyncClient::new(options, REQUESTS);
    status.set(false, None);
    // Incremented with every connection: an acknowledgement is only valid on the connection on which its message
    // arrived.
    let connection = Arc::new(AtomicU64::new(0));
    let (arrived, to_work) = mpsc::channel(WAITING);
    let (in_work, to_acknowledge) = mpsc::channel(AT_A_TIME);
    let (status, url) = (status.clone(), settings.url.clone());
    Ok(Some(tokio::spawn(async move {
        let filter = intake.filter();
        let working = tokio::spawn(work(to_work, in_work, intake));
        let acknowledging =
            tokio::spawn(acknowledge(to_acknowledge, client.clone(), Arc::clone(&connection), status.clone()));
        let room = Arc::new(Semaphore::new(WAITING_BYTES));
        let link = Link { client, filter, status, url, connection, arrived, room, trouble: None };
        link.hold(events, stop).await;
        // Unacknowledged messages are delivered again after the next start.
        working.abort();
        acknowledging.abort();
    })))
}

/// Starts to process messages in the order of their arrival.
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

/// Acknowledges messages in the order of their arrival, as the protocol requires.
async fn acknowledge(
    mut in_work: mpsc::Receiver<InWork>,
    client: AsyncClient,
    connection: Arc<AtomicU64>,
    status: MqttStatus,
) {
    while let Some(InWork { arrived, work }) = in_work.recv().await {
        let worked = work.await;
        status.finished();
        if let Err(panicked) = worked {
            // The message is not acknowledged, so the broker delivers it again on the next connection.
            error!(error = %panicked, "The processing of an MQTT message failed: {panicked}");
            continue;
        }
        // Packet ids restart with a new session: an old id could acknowledge a message that was not processed.
        if arrived.connection == connection.load(Ordering::SeqCst) {
            if let Err(failure) = client.ack(&arrived.publish).await {
                warn!(error = %failure, "Could not acknowledge an MQTT message: {failure}");
            }
        }
    }
}

/// The connection.
struct Link {
    client: AsyncClient,
    filter: String,
    status: MqttStatus,
    url: String,
    connection: Arc<AtomicU64>,
    arrived: mpsc::Sender<Arrived>,
    /// Bytes that further messages may take.
    room: Arc<Semaphore>,
    /// The last failure, so that repeated failures are logged once.
    trouble: Option<String>,
}

impl Link {
    async fn hold(mut self, mut events: EventLoop, mut stop: watch::Receiver<bool>) {
        let mut delay = FIRST_DELAY;
        loop {
            let event = tokio::select! {
                () = stopped(&mut stop) => return,
                event = events.poll() => event,
            };
            match event {
                Ok(event) => {
                    if matches!(event, Event::Incoming(Packet::ConnAck(_))) {
                        delay = FIRST_DELAY;
                    }
                    tokio::select! {
                        () = stopped(&mut stop) => return,
                        () = self.take(event) => {}
                    }
                }
                Err(failure) => {
                    // This comes first, because messages of the next connection must not be acknowledged by packet ids
                    // of this one.
                    self.connection.fetch_add(1, Ordering::SeqCst);
                    self.lost(failure.to_string());
                    tokio::select! {
                        () = stopped(&mut stop) => return,
                        () = tokio::time::sleep(delay) => {}
                    }
                    delay = (2 * delay).min(LONGEST_DELAY);
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
                // The subscription is repeated even if the broker has kept the session, because the topic may have
                // changed since the session began.
                self.subscribe(Duration::ZERO);
            }
            Event::Incoming(Packet::SubAck(answer)) => {
                if answer.return_codes.contains(&SubscribeReasonCode::Failure) {
                    let trouble = format!("the subscription to {} was refused", self.filter);
                    error!(broker = %self.url, topic = %self.filter, "The MQTT broker {}: {trouble}", self.url);
                    self.status.set(false, Some(trouble));
                    self.subscribe(SUBSCRIBE_AGAIN);
                } else {
                    self.status.set(true, None);
                }
            }
            Event::Incoming(Packet::Publish(publish)) => {
                let connection = self.connection.load(Ordering::SeqCst);
                self.status.arrived();
                // Waits while too many bytes are there.
                let bytes = (publish.payload.len() + publish.topic.len() + OVERHEAD_BYTES).min(WAITING_BYTES) as u32;
                let room = Arc::clone(&self.room).acquire_many_owned(bytes).await;
                let room = room.expect("the semaphore is never closed");
                // The receiver lives as long as this task.
                let _ = self.arrived.send(Arrived { connection, publish, _bytes: room }).await;
            }
            _ => {}
        }
    }

    /// Subscribes in a separate task, because the request queue is emptied by the loop that calls this.
    ///
    /// With a quality of service of 1, whatever the senders use: a message may then come twice, and the database recognises it. With 2,
    /// rumqttc 0.25 would forget at a reconnection which messages it had received (`MqttState::clean`), and end each further connection
    /// at the first PUBREL that the broker repeats (`StateError::Unsolicited`).
    fn subscribe(&self, after: Duration) {
        let (client, filter) = (self.client.clone(), self.filter.clone());
        tokio::spawn(async move {
            tokio::time::sleep(after).await;
            if let Err(failure) = client.subscribe(filter, QoS::AtLeastOnce).await {
                warn!(error = %failure, "Could not subscribe at the MQTT broker: {failure}");
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

/// Completes when the service stops.
async fn stopped(stop: &mut watch::Receiver<bool>) {
    // Without a sender no stop signal can come, and the service has ended.
    let _ = stop.wait_for(|stopped| *stopped).await;
}
