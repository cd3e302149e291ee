//! Batches from an MQTT broker.
//!
//! A message is acknowledged after its batch was committed, or after it was put into quarantine because it can never
//! become a batch. Until then the broker keeps it, so that it survives a crash of either program. A message may arrive
//! twice; the database recognises a batch by its content and a measurement by source and time, so that it is stored
//! once.

mod connection;
mod message;
mod settings;
mod status;
mod topic;

pub use connection::run;
pub use message::Intake;
pub use settings::{MqttSettings, SettingError};
pub use status::MqttStatus;
