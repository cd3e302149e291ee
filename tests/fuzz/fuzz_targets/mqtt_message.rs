//! A message of a broker, topic and payload: any bytes are stored as one batch or put into quarantine with a reason, never a panic and
//! never a message that waits. What was stored is in the history once, and the same message again changes nothing.
//!
//! The first line of the input is the topic, the rest the payload.
#![no_main]

#[path = "../world.rs"]
mod world;

use libfuzzer_sys::fuzz_target;
use modalwatch::mqtt::{Intake, MqttSettings};

use crate::world::{with, World};

/// Stored batches, and messages in quarantine.
async fn kept(world: &World) -> (usize, usize) {
    let structure = modalwatch::quantity::StructureId::parse("plain").unwrap();
    let batches = world.store.batches().batch_sizes(&structure).await.unwrap().len();
    let quarantined = world.store.quarantine().quarantined(None, 10_000).await.unwrap().len();
    (batches, quarantined)
}

fuzz_target!(|bytes: &[u8]| {
    let end = bytes.iter().position(|byte| *byte == b'\n').unwrap_or(bytes.len());
    // The client library takes only topics in UTF-8.
    let Ok(topic) = std::str::from_utf8(&bytes[..end]) else { return };
    let payload = bytes.get(end + 1..).unwrap_or_default();
    with(async |world| {
        let settings = MqttSettings { max_payload_bytes: 8_192, ..MqttSettings::default() };
        let intake = Intake::new(world.monitor.clone(), &settings).unwrap();
        let before = kept(world).await;
        intake.take(topic, payload).await;
        let after = kept(world).await;
        let more = (after.0 - before.0, after.1 - before.1);
        assert!([(0, 0), (1, 0), (0, 1)].contains(&more), "{more:?}");
        intake.take(topic, payload).await;
        assert_eq!(kept(world).await, after, "the same message again");
    });
});
