//! Section `notify` of the configuration.

use reqwest::Url;
use serde::{Deserialize, Serialize};

use super::address::Guard;

/// Settings of webhooks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NotifySettings {
    /// Public URL of this service, such as `https://shm.example.org`; prefix of the links in messages.
    pub public_url: String,
    /// Time limit for the answer of a receiver, seconds.
    pub timeout_s: u64,
    /// Delay before the second attempt, seconds; each further delay is three times as long. After a failure the
    /// receiver gets no other message for this time either.
    pub first_retry_s: u64,
    /// Maximum delay between attempts, seconds.
    pub longest_retry_s: u64,
    /// Time after which a message that no attempt could deliver is given up as a dead letter, seconds.
    pub give_up_after_s: u64,
    /// Time for which the previous secret also signs after a rotation, seconds.
    pub secret_overlap_s: u64,
    /// Time for which delivered messages are kept in the list, days.
    pub keep_delivered_days: u64,
    /// Private addresses that webhooks may reach: `10.0.0.0/8`, `192.168.1.7`, `127.0.0.1:9999`.
    pub allow_private_targets: Vec<String>,
}

impl Default for NotifySettings {
    fn default() -> Self {
        Self {
            public_url: String::new(),
            timeout_s: 10,
            first_retry_s: 5,
            longest_retry_s: 1_800,
            give_up_after_s: 3 * 86_400,
            secret_overlap_s: 86_400,
            keep_delivered_days: 30,
            allow_private_targets: Vec::new(),
        }
    }
}

impl NotifySettings {
    /// The first invalid setting, its value, and the allowed values.
    pub fn problem(&self) -> Option<(&'static str, String, &'static str)> {
        let seconds = [
            ("notify.timeout_s", self.timeout_s, 120, "from 1 to 120"),
            ("notify.first_retry_s", self.first_retry_s, self.longest_retry_s, "from 1 to notify.longest_retry_s"),
            ("notify.longest_retry_s", self.longest_retry_s, 86_400, "from 1 to 86400"),
            ("notify.give_up_after_s", self.give_up_after_s, 30 * 86_400, "from 1 to 2592000"),
            ("notify.secret_overlap_s", self.secret_overlap_s, 30 * 86_400, "from 1 to 2592000"),
            ("notify.keep_delivered_days", self.keep_delivered_days, 3_650, "from 1 to 3650"),
        ];
        if let Some((key, value, _, must)) =
            seconds.into_iter().find(|(_, value, most, _)| !(1..=*most).contains(value))
        {
            return Some((key, value.to_string(), must));
        }
        let web = |url: &Url| ["http", "https"].contains(&url.scheme());
        if !self.public_url.is_empty() && !Url::parse(&self.public_url).is_ok_and(|url| web(&url)) {
            return Some(("notify.public_url", self.public_url.clone(), "empty or a URL with http or https"));
        }
        let target = Guard::new(&self.allow_private_targets).err()?;
        Some(("notify.allow_private_targets", target, "addresses, address:port or networks, such as 10.0.0.0/8"))
    }
}
