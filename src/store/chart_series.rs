//! The alarm charts over a time span, each time compared with the undamaged reference that was in use for it.

use std::collections::BTreeMap;

use futures_util::TryStreamExt as _;

use super::alarm::Alarms;
use super::error::Error;
use super::series::{bounds, Extent, Series, SeriesWindow};
use super::sql::{self, Whole};
use crate::quantity::StructureId;
use crate::reduction::{Reduced, Reducer};

/// An alarm chart over a window.
#[derive(Debug, Clone, PartialEq)]
pub struct ChartSeries {
    /// The parameter, or `simulation:fit`.
    pub chart: String,
    /// True if its newest points belong to a process, so that the values are the evidence on its fast and its slow chart.
    pub is_process: bool,
    /// Points by the time of the last measurement of their batch. The values are the shift and the moving average.
    pub points: Reduced<ChartMark>,
}

/// What a point of a chart has besides its values.
#[derive(Debug, Clone, PartialEq)]
pub struct ChartMark {
    /// The batch.
    pub batch: String,
    /// Limit of a single shift.
    pub shift_limit: f64,
    /// Limit of the moving average.
    pub ewma_limit: Option<f64>,
    /// True if the point does not change the chart, for example because of maintenance.
    pub held: bool,
    /// State of the chart after this point.
    pub state: String,
}

/// The part of a chart that belongs to one version of the undamaged reference, µs; the end is not part of it.
#[derive(Debug, Clone, Copy)]
struct Part {
    version: u32,
    from_us: i64,
    to_us: i64,
}

impl Series<'_> {
    /// The alarm charts: points of batches that end in the window. A new undamaged reference begins a new part of each chart; before its
    /// first point, the chart shows the batches as they were compared with the reference before it.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn chart_series(
        self,
        structure: &StructureId,
        window: SeriesWindow,
        extent: &Extent,
    ) -> Result<Vec<ChartSeries>, Error> {
        let mut all = Vec::new();
        for (chart, parts) in self.chart_parts(structure).await? {
            let mut reducer = Reducer::new(extent.span(), window.points, 2);
            let mut is_process = false;
            for part in parts {
                is_process = self.push_part(structure, &chart, part, window, &mut reducer).await?.unwrap_or(is_process);
            }
            all.push(ChartSeries { chart, is_process, points: reducer.finish() });
        }
        all.retain(|chart| !chart.points.rows.is_empty());
        Ok(all)
    }

    /// The parts of each chart of the newest reference, the earliest first. The fit is compared with no reference.
    async fn chart_parts(self, structure: &StructureId) -> Result<Vec<(String, Vec<Part>)>, Error> {
        let versions: Vec<(Whole<u32>,)> =
            sql::query_as("select version from undamaged_state where structure_id = $1 order by version desc")
                .bind(structure.as_str())
                .fetch_all(&self.database.reader)
                .await?;
        let newest = versions.first().map_or(0, |(version,)| version.0);
        let alarms = Alarms { database: self.database };
        let mut order = Vec::new();
        let mut parts = BTreeMap::<String, Vec<Part>>::new();
        for (version, chart) in alarms.chart_names(structure.as_str(), newest).await? {
            order.push(chart.clone());
            parts.insert(chart, vec![Part { version, from_us: i64::MIN, to_us: i64::MAX }]);
        }
        for (chart, parts) in parts.iter_mut().filter(|(_, parts)| parts[0].version > 0) {
            let mut to_us = i64::MAX;
            parts.clear();
            for (Whole(version),) in &versions {
                let (from_us,): (Option<i64>,) = sql::query_as(
                    "select min(measured_to_us) from chart_point
                     where structure_id = $1 and undamaged_version = $2 and series = $3",
                )
                .bind(structure.as_str())
                .bind(version)
                .bind(chart)
                .fetch_one(&self.database.reader)
                .await?;
                let Some(from_us) = from_us.filter(|from_us| *from_us < to_us) else { continue };
                parts.push(Part { version: *version, from_us, to_us });
                to_us = from_us;
            }
            parts.reverse();
        }
        Ok(order.into_iter().filter_map(|chart| parts.remove_entry(&chart)).collect())
    }

    /// Adds a part of a chart. Returns whether its last point belongs to a process; `None` without any point in the window.
    async fn push_part(
        self,
        structure: &StructureId,
        chart: &str,
        part: Part,
        window: SeriesWindow,
        reducer: &mut Reducer<ChartMark>,
    ) -> Result<Option<bool>, Error> {
        let (from, to) = bounds(window);
        let mut rows = sql::query(
            "select measured_to_us, shift, ewma, batch_id, shift_limit, ewma_limit, held, state, slow is not null from chart_point
             where structure_id = $1 and undamaged_version = $2 and series = $3
               and measured_to_us >= $4 and measured_to_us < $5
             order by measured_to_us, batch_id",
        )
        .bind(structure.as_str())
        .bind(part.version)
        .bind(chart)
        .bind(from.max(part.from_us))
        .bind(to.min(part.to_us))
        .fetch(&self.database.reader);
        let mut is_process = None;
        while let Some(row) = rows.try_next().await? {
            let values = [row.get(1)?, row.get(2)?];
            let mark = || {
                Ok(ChartMark {
                    batch: row.get(3)?,
                    shift_limit: row.get(4)?,
                    ewma_limit: row.get(5)?,
                    held: row.get(6)?,
                    state: row.get(7)?,
                })
            };
            reducer.try_push(row.get(0)?, &values, mark).map_err(|e: sqlx::Error| Error::from(e))?;
            is_process = Some(row.get(8)?);
        }
        Ok(is_process)
    }
}
