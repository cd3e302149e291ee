//! Notification about alarms: webhooks for other programs, mails for people.
//!
//! Triggers of the database write an event to the outbox in the same transaction that changes the alarm. Each message
//! is then sent at least once: until its receiver accepts it, or until it has failed for days and is given up as a dead
//! letter. A slow or unreachable receiver does not delay the others. The messages of one alarm are sent in order; a
//! refused message delays only the later ones of the same alarm.

mod address;
mod backoff;
mod deliver;
mod email_settings;
mod facts;
mod mail;
mod mailer;
mod message;
mod notifier;
mod settings;

pub use email_settings::{EmailSettingError, EmailSettings, Encryption};
pub use mailer::Mailer;
pub use message::EVENT_KINDS;
pub use notifier::{client_builder, install_tls_provider, new_secret, Attempt, Notifier};
pub use settings::NotifySettings;
