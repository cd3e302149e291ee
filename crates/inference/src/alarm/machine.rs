//! The state machine of an alarm.

use serde::{Deserialize, Serialize};

/// State of an alarm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// No point above the limit.
    Normal,
    /// A point is above the limit, but not yet enough of them for an alarm.
    Pending,
    /// An alarm.
    Alarming,
    /// Below the limit after an alarm, but not yet for long enough.
    Recovering,
    /// No batch arrived for too long.
    Silent,
}

/// What changes the state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// A point above the limit that does not yet raise an alarm.
    Exceeds,
    /// A point above the limit, with enough others in the window to raise an alarm.
    Confirmed,
    /// A point below the limit, with too few consecutive ones to end an alarm.
    Clears,
    /// Enough consecutive points below the limit.
    Cleared,
    /// No batch for too long.
    Silence,
}

impl State {
    /// All states.
    pub const ALL: [Self; 5] = [Self::Normal, Self::Pending, Self::Alarming, Self::Recovering, Self::Silent];

    /// The name in tables and answers.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Normal => "normal",
            Self::Pending => "pending",
            Self::Alarming => "alarming",
            Self::Recovering => "recovering",
            Self::Silent => "silent",
        }
    }

    /// The state after an event.
    ///
    /// | | exceeds | confirmed | clears | cleared | silence |
    /// |---|---|---|---|---|---|
    /// | normal | pending | alarming | normal | normal | silent |
    /// | pending | pending | alarming | pending | normal | silent |
    /// | alarming | alarming | alarming | recovering | normal | alarming |
    /// | recovering | alarming | alarming | recovering | normal | recovering |
    /// | silent | pending | alarming | normal | normal | silent |
    ///
    /// An open alarm stays open when the instrument falls silent.
    #[must_use]
    pub const fn after(self, event: Event) -> Self {
        use Event::{Cleared, Clears, Confirmed, Exceeds, Silence};
        match (self, event) {
            (_, Confirmed) | (Self::Alarming, Exceeds | Silence) | (Self::Recovering, Exceeds) => Self::Alarming,
            (Self::Normal | Self::Pending | Self::Silent, Exceeds) | (Self::Pending, Clears) => Self::Pending,
            (Self::Alarming | Self::Recovering, Clears) | (Self::Recovering, Silence) => Self::Recovering,
            (Self::Normal | Self::Pending | Self::Silent, Silence) => Self::Silent,
            (_, Cleared) | (Self::Normal | Self::Silent, Clears) => Self::Normal,
        }
    }

    /// True during an episode, which lasts from the alarm to its end.
    pub const fn in_episode(self) -> bool {
        matches!(self, Self::Alarming | Self::Recovering)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_transition_is_the_one_of_the_table() {
        use Event::{Cleared, Clears, Confirmed, Exceeds, Silence};
        use State::{Alarming, Normal, Pending, Recovering, Silent};
        let events = [Exceeds, Confirmed, Clears, Cleared, Silence];
        let table = [
            (Normal, [Pending, Alarming, Normal, Normal, Silent]),
            (Pending, [Pending, Alarming, Pending, Normal, Silent]),
            (Alarming, [Alarming, Alarming, Recovering, Normal, Alarming]),
            (Recovering, [Alarming, Alarming, Recovering, Normal, Recovering]),
            (Silent, [Pending, Alarming, Normal, Normal, Silent]),
        ];
        assert_eq!(table.map(|(state, _)| state), State::ALL);
        for (state, row) in table {
            for (event, expected) in events.into_iter().zip(row) {
                assert_eq!(state.after(event), expected, "{state:?} after {event:?}");
            }
        }
    }

    #[test]
    fn an_episode_begins_with_a_confirmation_and_ends_only_when_cleared() {
        let events = [Event::Exceeds, Event::Confirmed, Event::Clears, Event::Silence, Event::Exceeds, Event::Cleared];
        let mut state = State::Normal;
        let inside = events.map(|event| {
            state = state.after(event);
            state.in_episode()
        });
        assert_eq!(inside, [false, true, true, true, true, false]);
    }
}
