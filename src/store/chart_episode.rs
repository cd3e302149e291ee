//! The alarm episodes that the points of a chart open and end.

use super::alarm::{insert_episode, kind_of};
use super::chart_point::{state_of, ChartPosition, PointRow};
use super::error::Error;
use super::sql;
use super::transaction::Transaction;
use crate::assessment::NewChartPoint;
use crate::quantity::Timestamp;

/// A batch whose points on the charts are to be stored.
pub(super) struct Charted<'a> {
    pub structure: &'a str,
    pub position: ChartPosition,
    pub now: Timestamp,
    /// Whether the batch overlaps a maintenance window.
    pub maintained: bool,
    /// Version of the undamaged reference whose charts it is added to: the newest, or the one that the batch keeps; 0 if there is none.
    pub undamaged_version: u32,
    /// When the reference after that one was declared, µs: its alarms end then at the latest.
    pub succeeded_at_us: Option<i64>,
}

/// A stored episode: number, opening time and batch, end, and whether it was withdrawn.
type StoredEpisode = (i64, i64, Option<String>, Option<i64>, bool);

/// An episode as it follows from the points.
struct FoundEpisode {
    opened_at: i64,
    batch: String,
    ended_at: Option<i64>,
    peak: f64,
}

/// The episodes of a series from a point on: as stored, and as they follow from the points.
pub(super) struct Episodes {
    /// Stored episodes that begin at or after the point.
    stored: Vec<StoredEpisode>,
    /// The episode that is open just before the point: number and largest shift.
    running: Option<(i64, f64)>,
    /// Its end; `None` while it is open.
    running_end: Option<i64>,
    found: Vec<FoundEpisode>,
    /// Whether an episode is open at the last point passed.
    pub inside: bool,
}

impl Episodes {
    pub async fn of(
        transaction: &mut Transaction<'_>,
        batch: &Charted<'_>,
        new: &NewChartPoint,
        inside: bool,
        amended: bool,
    ) -> Result<Self, Error> {
        let mut episodes = Self { stored: Vec::new(), running: None, running_end: None, found: Vec::new(), inside };
        // Both statements have the same parameters: the series and the position in it.
        macro_rules! of_series {
            ($select:literal) => {
                sql::query_as($select)
                    .bind(batch.structure)
                    .bind(kind_of(&new.series))
                    .bind(&new.series)
                    .bind(new.undamaged_version)
                    .bind(batch.position.0)
                    .bind(&batch.position.1)
            };
        }
        if amended {
            let select = of_series!(
                "select episode, opened_at_us, opened_batch, ended_at_us, withdrawn from alarm_episode
                 where structure_id = $1 and kind = $2 and series = $3 and undamaged_version = $4
                   and (opened_at_us, opened_batch) >= ($5, $6) order by opened_at_us, opened_batch"
            );
            episodes.stored = select.fetch_all(&mut *transaction).await?;
        }
        if inside {
            let select = of_series!(
                "select episode, peak_shift from alarm_episode
                 where structure_id = $1 and kind = $2 and series = $3 and undamaged_version = $4 and withdrawn = 0
                   and (opened_at_us, opened_batch) < ($5, $6) order by opened_at_us desc, opened_batch desc limit 1"
            );
            episodes.running = select.fetch_optional(&mut *transaction).await?;
        }
        Ok(episodes)
    }

    /// Proceeds to the next point.
    pub fn pass(&mut self, row: &PointRow) -> Result<(), Error> {
        let inside = state_of(&row.state)?.in_episode();
        match (self.inside, inside) {
            (false, true) => self.found.push(FoundEpisode {
                opened_at: row.measured_to_us,
                batch: row.batch_id.clone(),
                ended_at: None,
                peak: row.shift,
            }),
            (true, false) => match self.found.last_mut() {
                Some(last) => last.ended_at = Some(row.measured_to_us),
                None => self.running_end = Some(row.measured_to_us),
            },
            _ => {}
        }
        self.inside = inside;
        if inside && !row.held {
            match (self.found.last_mut(), &mut self.running) {
                (Some(last), _) => last.peak = last.peak.max(row.shift),
                (None, Some((_, peak))) => *peak = peak.max(row.shift),
                (None, None) => {}
            }
        }
        Ok(())
    }

    /// Leaves the episodes that open after a position as they are, because no point changes there.
    pub fn keep_after(&mut self, position: &ChartPosition) {
        self.stored.retain(|(_, at, batch, ..)| (*at, batch.clone().unwrap_or_default()) <= *position);
    }

    /// Stores the episodes. Returns whether any episode exists or existed.
    pub async fn store(
        mut self,
        transaction: &mut Transaction<'_>,
        batch: &Charted<'_>,
        new: &NewChartPoint,
    ) -> Result<bool, Error> {
        let structure = batch.structure;
        let latest_end = batch.succeeded_at_us.filter(|_| new.undamaged_version > 0);
        let any = self.running.is_some() || new.raises_alarms && !self.found.is_empty() || !self.stored.is_empty();
        if let Some((number, peak)) = self.running {
            sql::query(
                "update alarm_episode set ended_at_us = $1, peak_shift = $2 where structure_id = $3 and episode = $4",
            )
            .bind(self.running_end.or(latest_end))
            .bind(peak)
            .bind(structure)
            .bind(number)
            .execute(&mut *transaction)
            .await?;
        }
        for found in self.found {
            if !new.raises_alarms {
                break;
            }
            // The same episode was opened by the same batch or, since late data can move its beginning, overlaps in time.
            let (found_end, never) = (found.ended_at.unwrap_or(i64::MAX), i64::MAX);
            let same_batch = |s: &StoredEpisode| s.2.as_ref() == Some(&found.batch);
            let overlaps = |s: &StoredEpisode| !s.4 && s.1 <= found_end && found.opened_at <= s.3.unwrap_or(never);
            let known = self.stored.iter().position(same_batch).or_else(|| self.stored.iter().position(overlaps));
            if let Some(index) = known {
                let (number, ..) = self.stored.remove(index);
                sql::query(
                    "update alarm_episode set opened_at_us = $1, opened_batch = $2, ended_at_us = $3, withdrawn = false,
                         peak_shift = $4 where structure_id = $5 and episode = $6",
                )
                .bind(found.opened_at)
                .bind(&found.batch)
                .bind(found.ended_at.or(latest_end))
                .bind(found.peak)
                .bind(structure)
                .bind(number)
                .execute(&mut *transaction)
                .await?;
                continue;
            }
            let ended_at = found.ended_at.or(latest_end);
            let row = (new.undamaged_version, found.opened_at, Some(found.batch.as_str()), ended_at, found.peak);
            insert_episode(transaction, structure, &new.series, row, batch.now).await?;
        }
        for (number, ..) in self.stored {
            sql::query("update alarm_episode set withdrawn = true where structure_id = $1 and episode = $2")
                .bind(structure)
                .bind(number)
                .execute(&mut *transaction)
                .await?;
        }
        Ok(any)
    }
}
