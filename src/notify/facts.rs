//! An alarm as the triggers of the database write it into an event.

use serde::{Deserialize, Serialize};

use crate::alarm::severity::{AlarmFacts, BatchChange};
use crate::process::lasting::LastingChange;

/// An alarm as the triggers of the database write it.
#[derive(Debug, Deserialize)]
pub struct Facts {
    pub kind: String,
    pub series: String,
    pub undamaged_version: u32,
    pub opened_at_us: i64,
    pub opened_batch: Option<String>,
    pub ended_at_us: Option<i64>,
    pub withdrawn: u8,
    pub peak_shift: Option<f64>,
    pub noticed_at_us: i64,
    pub acknowledged_at_us: Option<i64>,
    pub acknowledged_by: Option<String>,
    pub acknowledgement_note: Option<String>,
    pub change: Option<LastingChange>,
    #[serde(default)]
    pub batch_change: Option<BatchChange>,
    /// What a person did; only in events about that.
    #[serde(default)]
    pub action: Option<ActionFacts>,
}

/// What a person did.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ActionFacts {
    pub kind: String,
    pub at_us: i64,
    pub author: String,
    pub text: Option<String>,
    pub reason: Option<String>,
    pub assignee: Option<String>,
}

impl Facts {
    /// What the severity follows from.
    pub fn alarm(&self) -> AlarmFacts<'_> {
        AlarmFacts { kind: &self.kind, change: self.change.as_ref(), batch_change: self.batch_change }
    }
}

impl ActionFacts {
    /// What was done, in a phrase after "the alarm".
    pub fn phrase(&self) -> String {
        let author = &self.author;
        match (self.kind.as_str(), &self.assignee) {
            ("assignment", Some(assignee)) => format!("was assigned to {assignee} by {author}"),
            ("assignment", None) => format!("is assigned to nobody any more, by {author}"),
            ("closing", _) => {
                let reason = self.reason.as_deref().unwrap_or("no reason").replace('_', " ");
                format!("was closed by {author} ({reason})")
            }
            ("reopening", _) => format!("was reopened by {author}"),
            _ => format!("was commented on by {author}"),
        }
    }
}
