//! Diagnoses that the service starts by itself: because of an alarm of the kind `simulation_does_not_fit`, or on schedule.
//!
//! What was started is stored before it runs, and every decision is made from what is stored, so that a restart repeats none.

use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tracing::{error, info};

use super::error::{Error, JobError};
use super::jobs::{DiagnosisRequest, Jobs};
use super::structures::ActiveStructures;
use super::supervise::supervise;
use crate::clock;
use crate::discrepancy::Holdout;
use crate::quantity::{StructureId, Timestamp};
use crate::store::{DiagnosisTrigger, LatestDiagnoses, NewAuditEntry, RejectedEpisode, Store};

/// Pause between two checks.
const EVERY: Duration = Duration::from_secs(5);

const MICROS_A_SECOND: i64 = 1_000_000;
const MICROS_A_DAY: i64 = 86_400 * MICROS_A_SECOND;

/// When the service starts a diagnosis by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DiagnosisSettings {
    /// Whether an alarm of the kind `simulation_does_not_fit` starts a diagnosis.
    pub after_rejected_episode: bool,
    /// Seconds between the alarm and the diagnosis, so that batches which arrive together are part of it.
    pub delay_s: u64,
    /// Days between two diagnoses of a structure with new batches; 0 = no schedule.
    pub every_days: u32,
}

impl Default for DiagnosisSettings {
    fn default() -> Self {
        Self { after_rejected_episode: true, delay_s: 60, every_days: 0 }
    }
}

impl DiagnosisSettings {
    /// The first setting out of range, as (key, value, allowed range); `None` when all are in range.
    pub fn problem(&self) -> Option<(&'static str, String, &'static str)> {
        if self.delay_s > 86_400 {
            return Some(("diagnosis.delay_s", self.delay_s.to_string(), "at most 86400"));
        }
        (self.every_days > 3_650).then(|| ("diagnosis.every_days", self.every_days.to_string(), "at most 3650"))
    }

    /// Whether any diagnosis is started.
    const fn is_on(&self) -> bool {
        self.after_rejected_episode || self.every_days > 0
    }

    /// Whether an alarm that was raised at `noticed_at` starts a diagnosis at the time `now`.
    fn follows(&self, noticed_at: Timestamp, now: Timestamp) -> bool {
        let waited = now.micros() - noticed_at.micros();
        // If the clock was set back since the alarm, there is no telling how long ago it was.
        let long_enough = waited < 0 || waited >= self.delay_s as i64 * MICROS_A_SECOND;
        self.after_rejected_episode && long_enough
    }

    /// Whether the schedule starts a diagnosis at the time `now`. `since` is the start of the latest one or, if there is none, the
    /// arrival of the first batch.
    fn is_scheduled(&self, since: Timestamp, now: Timestamp) -> bool {
        let span = i64::from(self.every_days) * MICROS_A_DAY;
        span > 0 && now.micros() - since.micros() >= span
    }
}

/// Whether the limits allow a diagnosis at the time `now` of a structure whose newest batch arrived at `received`: the last one that
/// the service started by itself is a day old, and a batch has arrived since the last one.
fn is_allowed(latest: LatestDiagnoses, received: Timestamp, now: Timestamp) -> bool {
    let rested = latest.automatic.is_none_or(|started| now.micros() - started.micros() >= MICROS_A_DAY);
    rested && latest.any.is_none_or(|started| received > started)
}

/// Starts diagnoses without a request.
#[derive(Clone)]
pub struct AutomaticDiagnoses {
    store: Store,
    structures: Arc<ActiveStructures>,
    jobs: Jobs,
}

impl AutomaticDiagnoses {
    pub(super) fn new(store: Store, structures: Arc<ActiveStructures>, jobs: Jobs) -> Self {
        Self { store, structures, jobs }
    }

    /// Starts diagnoses according to the settings for as long as the service runs, in the background.
    pub fn watch(&self, settings: DiagnosisSettings) {
        if !settings.is_on() {
            return;
        }
        let automatic = self.clone();
        supervise("diagnoses", move || {
            let automatic = automatic.clone();
            async move {
                let mut ticks = tokio::time::interval(EVERY);
                ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
                loop {
                    ticks.tick().await;
                    if let Err(failure) = automatic.check(settings, clock::now).await {
                        error!(error = %failure, "Could not start diagnoses: {failure}");
                    }
                }
            }
        });
    }

    /// Starts the diagnoses that are due.
    ///
    /// # Errors
    /// Those of the store, and those of the start of a diagnosis; the other structures are checked nevertheless.
    pub(super) async fn check(
        &self,
        settings: DiagnosisSettings,
        clock: impl Fn() -> Timestamp,
    ) -> Result<(), JobError> {
        let episodes = self.store.diagnoses().rejected_episodes().await?;
        let mut outcome = Ok(());
        for structure in self.structures.ids() {
            let episode = episodes.iter().find(|episode| episode.structure == structure);
            if episode.is_none() && settings.every_days == 0 {
                continue;
            }
            if let Err(failure) = self.check_one(&structure, episode, settings, clock()).await {
                outcome = Err(failure);
            }
        }
        outcome
    }

    async fn check_one(
        &self,
        structure: &StructureId,
        episode: Option<&RejectedEpisode>,
        settings: DiagnosisSettings,
        now: Timestamp,
    ) -> Result<(), JobError> {
        let Some((trigger, alarm)) = self.due(structure, episode, settings, now).await? else { return Ok(()) };
        // The rejected batches are the newest measurements: held out, they would not be searched for causes.
        let holdout = if alarm.is_some() { Holdout::Last(0.0) } else { DiagnosisRequest::default().holdout };
        let Some(request) = self.jobs.request_for_all(structure, holdout).await? else { return Ok(()) };
        let entry = NewAuditEntry {
            structure: Some(structure.to_string()),
            ..NewAuditEntry::local(
                now,
                format!("start diagnosis ({})", trigger.as_str()),
                Some(format!("/v1/structures/{structure}/diagnoses")),
            )
        };
        let start = self.jobs.start_diagnosis(structure, request, (trigger, alarm));
        let record = self.store.audit().audited(entry, start).await?;
        let why = alarm.map_or_else(|| "on schedule".to_owned(), |alarm| format!("because of alarm {alarm}"));
        info!(structure.id = %structure, diagnosis = %record.id, "Started a diagnosis of {structure} {why}");
        Ok(())
    }

    /// Why a diagnosis of a structure is due, with the number of the alarm; `None` if it is not due.
    async fn due(
        &self,
        structure: &StructureId,
        episode: Option<&RejectedEpisode>,
        settings: DiagnosisSettings,
        now: Timestamp,
    ) -> Result<Option<(DiagnosisTrigger, Option<i64>)>, Error> {
        if self.jobs.is_busy(structure) {
            return Ok(None);
        }
        let tomorrow = Timestamp::from_micros(now.micros() + MICROS_A_DAY).unwrap_or(now);
        let latest = self.store.diagnoses().latest(structure, tomorrow).await?;
        let newest = self.store.batches().arrivals(structure, 1).await?;
        let Some(newest) = newest.first() else { return Ok(None) };
        if !is_allowed(latest, newest.received_at, now) {
            return Ok(None);
        }
        if let Some(episode) = episode.filter(|episode| settings.follows(episode.noticed_at, now)) {
            let version = self.structures.get(structure)?.simulator.digest().clone();
            // What the present version lacks is known; more batches would repeat the answer.
            let known = self.store.diagnoses().named_causes_since(structure, &version, episode.noticed_at).await?;
            if !known {
                return Ok(Some((DiagnosisTrigger::RejectedEpisode, Some(episode.alarm))));
            }
        }
        let first = if latest.any.is_none() { self.store.batches().first_received(structure).await? } else { None };
        let since = latest.any.or(first);
        let scheduled = since.is_some_and(|since| settings.is_scheduled(since, now));
        Ok(scheduled.then_some((DiagnosisTrigger::Schedule, None)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DAY: i64 = MICROS_A_DAY;

    fn at(micros: i64) -> Timestamp {
        Timestamp::from_micros(1_767_225_600_000_000 + micros).unwrap()
    }

    #[test]
    fn a_day_passes_between_two_diagnoses_and_each_has_a_new_batch() {
        let none = LatestDiagnoses::default();
        assert!(is_allowed(none, at(0), at(1)));
        let automatic = LatestDiagnoses { any: Some(at(0)), automatic: Some(at(0)) };
        assert!(!is_allowed(automatic, at(DAY - 2), at(DAY - 1)));
        assert!(is_allowed(automatic, at(DAY - 2), at(DAY)));
        assert!(!is_allowed(automatic, at(-1), at(3 * DAY)), "no new batch");
        // After a request nothing has to be waited for, but a diagnosis of the same batches would repeat its answer.
        let requested = LatestDiagnoses { any: Some(at(10)), automatic: None };
        assert!(!is_allowed(requested, at(9), at(DAY)));
        assert!(is_allowed(requested, at(11), at(12)));
    }

    #[test]
    fn a_scheduled_diagnosis_follows_the_one_before_it_after_the_days_of_the_settings() {
        let weekly = DiagnosisSettings { every_days: 7, ..DiagnosisSettings::default() };
        assert!(!weekly.is_scheduled(at(0), at(7 * DAY - 1)));
        assert!(weekly.is_scheduled(at(0), at(7 * DAY)));
        assert!(!DiagnosisSettings::default().is_scheduled(at(0), at(1_000 * DAY)), "there is no schedule by default");
    }

    #[test]
    fn an_alarm_is_followed_after_the_delay_unless_this_is_switched_off() {
        let settings = DiagnosisSettings { delay_s: 60, ..DiagnosisSettings::default() };
        assert!(!settings.follows(at(0), at(60 * MICROS_A_SECOND - 1)));
        assert!(settings.follows(at(0), at(60 * MICROS_A_SECOND)));
        assert!(settings.follows(at(0), at(-DAY)), "the clock was set back");
        let off = DiagnosisSettings { after_rejected_episode: false, ..settings };
        assert!(!off.follows(at(0), at(DAY)));
    }
}
