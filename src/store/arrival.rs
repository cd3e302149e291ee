//! When batches arrived.

use super::batch::Batches;
use super::column::timestamp;
use super::error::Error;
use super::sql;
use crate::quantity::{StructureId, Timestamp};

/// When a batch arrived, and when its last measurement was taken.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Arrival {
    /// Its id. Those of the batches of a structure are in the order in which they were stored.
    pub batch_id: String,
    /// When it arrived, by the clock at that time.
    pub received_at: Timestamp,
    /// Time of its last measurement.
    pub measured_to: Timestamp,
}

impl Batches<'_> {
    /// The arrivals of the batches of a structure that were stored last, the last one first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn arrivals(self, structure: &StructureId, limit: usize) -> Result<Vec<Arrival>, Error> {
        let rows: Vec<(String, i64, i64)> = sql::query_as(
            "select batch_id, received_at_us, measured_to_us from measurement_batch
             where structure_id = $1 order by batch_id desc limit $2",
        )
        .bind(structure.as_str())
        .bind(limit as i64)
        .fetch_all(&self.database.reader)
        .await?;
        let arrival = |(batch_id, at, to): (String, i64, i64)| {
            Ok(Arrival { batch_id, received_at: timestamp("batch", at)?, measured_to: timestamp("batch", to)? })
        };
        rows.into_iter().map(arrival).collect()
    }

    /// When the first batch of a structure arrived.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn first_received(self, structure: &StructureId) -> Result<Option<Timestamp>, Error> {
        let row: Option<(i64,)> = sql::query_as(
            "select received_at_us from measurement_batch where structure_id = $1 order by batch_id limit 1",
        )
        .bind(structure.as_str())
        .fetch_optional(&self.database.reader)
        .await?;
        row.map(|(at,)| timestamp("batch", at)).transpose()
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{at, batch, bridge, open};
    use super::super::InsertBatch;

    #[tokio::test]
    async fn the_batch_that_was_stored_last_is_the_newest_although_the_clock_was_set_back() {
        let (store, _folder) = open().await;
        // Ids by a clock that was two hours ahead for the first two batches.
        let (ahead, right) = ("019f006d-dd00", "019f0000-0000");
        let mut ids = Vec::new();
        for (number, (clock, received_s)) in [(ahead, 7_200), (ahead, 7_201), (right, 2), (right, 3)].iter().enumerate()
        {
            let own = format!("{clock}-7000-8000-00000000000{number}");
            let given = batch(&format!("s{number}"), 0, None);
            let inserted = store.batches().insert_batch(&given, &own, at(*received_s)).await.unwrap();
            let InsertBatch::Inserted { batch_id, .. } = inserted else { panic!("{inserted:?}") };
            assert_eq!(batch_id == own, number < 2, "{batch_id}");
            assert!(store.batches().batch(&bridge(), &batch_id).await.unwrap().is_some());
            ids.push(batch_id);
        }
        assert!(ids.is_sorted_by(|a, b| a < b), "{ids:?}");
        let arrivals = store.batches().arrivals(&bridge(), 9).await.unwrap();
        let received: Vec<_> = arrivals.iter().map(|arrival| arrival.received_at).collect();
        assert_eq!(received, [at(3), at(2), at(7_201), at(7_200)], "the last one first");
        assert_eq!(store.batches().first_received(&bridge()).await.unwrap(), Some(at(7_200)));
        let overview = store.overview().structures().await.unwrap().0.remove(0);
        assert_eq!(overview.last_received_at, Some(at(3)));
    }
}
