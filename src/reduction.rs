//! Reduces long series to a size that can be plotted, without losing extremes, missing values or gaps.
//!
//! The time span of a series is divided into buckets of equal length. In each bucket, the first and the last row are kept,
//! and for each channel the rows with the smallest and the largest value and the first row with a missing value; of equal values, the
//! earliest. The result does not depend on the order in which the rows arrive, except among rows of the same time. The memory is that
//! of the kept rows and eight bytes per row.

use std::cmp::Ordering;
use std::sync::Arc;

/// A time without rows is a gap when it is longer than this number of median spacings.
pub const GAP_SPACINGS: i64 = 10;

/// Rows that a bucket keeps for a single channel: first, last, smallest, largest, missing.
const ROLES_OF_ONE_CHANNEL: usize = 5;

/// A row of a series: one value per channel at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct Row<T> {
    /// Microseconds since 1970.
    pub time_us: i64,
    /// One value per channel; NaN where it is missing.
    pub values: Vec<f64>,
    /// Data of the caller.
    pub tag: T,
}

/// A reduced series, in the order of time.
#[derive(Debug, Clone, PartialEq)]
pub struct Reduced<T> {
    /// The kept rows, unchanged.
    pub rows: Vec<Row<T>>,
    /// Gaps: the middle of the time without rows (microseconds), and the index of the kept row after it.
    pub gaps: Vec<(i64, usize)>,
    /// Whether rows were dropped.
    pub reduced: bool,
}

/// Receives the rows of a series one by one and keeps those that a plot needs.
#[derive(Debug)]
pub struct Reducer<T> {
    span: (i64, i64),
    points: usize,
    channels: usize,
    times: Vec<i64>,
    /// All rows, until there are more than `points`.
    all: Vec<Arc<Numbered<T>>>,
    buckets: Vec<Option<Box<Bucket<T>>>>,
}

/// A row with its number in the order of arrival.
#[derive(Debug)]
struct Numbered<T> {
    number: usize,
    row: Row<T>,
}

#[derive(Debug)]
struct Bucket<T> {
    first: Arc<Numbered<T>>,
    last: Arc<Numbered<T>>,
    smallest: Vec<Option<Arc<Numbered<T>>>>,
    largest: Vec<Option<Arc<Numbered<T>>>>,
    missing: Vec<Option<Arc<Numbered<T>>>>,
}

impl<T> Reducer<T> {
    /// A reducer for rows between two times, both inclusive, in microseconds since 1970. A series of at most `points` rows
    /// is kept unchanged; of a longer one at most 2·`points` rows per channel are kept.
    ///
    /// A row outside the times is assigned to the nearest bucket.
    pub fn new(span: (i64, i64), points: usize, channels: usize) -> Self {
        Self { span, points, channels, times: Vec::new(), all: Vec::new(), buckets: Vec::new() }
    }

    /// Number of buckets.
    pub fn buckets(&self) -> usize {
        (2 * self.points / ROLES_OF_ONE_CHANNEL).max(1)
    }

    /// Index of the bucket of a time.
    pub fn bucket(&self, time_us: i64) -> usize {
        let (from, to) = self.span;
        let length = (i128::from(to) - i128::from(from)).max(0) + 1;
        let place = (i128::from(time_us) - i128::from(from)) * self.buckets() as i128 / length;
        place.clamp(0, self.buckets() as i128 - 1) as usize
    }

    /// Adds a row with one value for each channel, `[channels]`. `tag` is called only if the row is kept; a later row can still
    /// replace it.
    pub fn push(&mut self, time_us: i64, values: &[f64], tag: impl FnOnce() -> T) {
        let pushed: Result<(), std::convert::Infallible> = self.try_push(time_us, values, || Ok(tag()));
        pushed.unwrap_or_else(|never| match never {});
    }

    /// As [`Self::push`], for a tag whose creation can fail.
    ///
    /// # Errors
    /// The error of `tag`.
    pub fn try_push<E>(&mut self, time_us: i64, values: &[f64], tag: impl FnOnce() -> Result<T, E>) -> Result<(), E> {
        debug_assert_eq!(values.len(), self.channels, "one value per channel");
        let number = self.times.len();
        self.times.push(time_us);
        let whole = || {
            let row = Row { time_us, values: values.to_vec(), tag: tag()? };
            Ok(Arc::new(Numbered { number, row }))
        };
        if number < self.points {
            self.all.push(whole()?);
            return Ok(());
        }
        if self.buckets.is_empty() {
            self.buckets.resize_with(self.buckets(), || None);
            for kept in std::mem::take(&mut self.all) {
                let bucket = self.bucket(kept.row.time_us);
                Bucket::take(&mut self.buckets[bucket], kept.row.time_us, &kept.row.values, || Ok(Arc::clone(&kept)))?;
            }
        }
        let bucket = self.bucket(time_us);
        Bucket::take(&mut self.buckets[bucket], time_us, values, whole)
    }

    /// The kept rows, and the gaps between them.
    pub fn finish(mut self) -> Reduced<T> {
        let mut kept = self.all;
        kept.extend(self.buckets.into_iter().flatten().flat_map(|bucket| bucket.rows()));
        kept.sort_by_key(|row| (row.row.time_us, row.number));
        kept.dedup_by_key(|row| row.number);
        // A row can have several roles in its bucket; after removing duplicates one handle on it remains.
        let rows: Vec<Row<T>> = kept.into_iter().filter_map(Arc::into_inner).map(|row| row.row).collect();
        self.times.sort_unstable();
        Reduced { gaps: gaps(&self.times, &rows), reduced: rows.len() < self.times.len(), rows }
    }
}

impl<T> Bucket<T> {
    /// Offers a row to a bucket; `row` creates it, at most once, if it gets a role.
    fn take<E>(
        slot: &mut Option<Box<Self>>,
        time_us: i64,
        values: &[f64],
        row: impl FnOnce() -> Result<Arc<Numbered<T>>, E>,
    ) -> Result<(), E> {
        let Some(bucket) = slot else {
            let row = row()?;
            let none = || values.iter().map(|_| None).collect::<Vec<_>>();
            let mut bucket = Self {
                first: Arc::clone(&row),
                last: Arc::clone(&row),
                smallest: none(),
                largest: none(),
                missing: none(),
            };
            bucket.roles(time_us, values).into_iter().for_each(|role| bucket.put(role, &row));
            *slot = Some(Box::new(bucket));
            return Ok(());
        };
        let roles = bucket.roles(time_us, values);
        if !roles.is_empty() {
            let row = row()?;
            for role in roles {
                bucket.put(role, &row);
            }
        }
        Ok(())
    }

    /// The roles in which a row replaces the current one.
    fn roles(&self, time_us: i64, values: &[f64]) -> Vec<Role> {
        let mut roles = Vec::new();
        if time_us < self.first.row.time_us {
            roles.push(Role::First);
        }
        if time_us >= self.last.row.time_us {
            roles.push(Role::Last);
        }
        for (channel, value) in values.iter().enumerate() {
            if value.is_nan() {
                let earlier = self.missing[channel].as_ref().is_none_or(|held| time_us < held.row.time_us);
                roles.extend(earlier.then_some(Role::Missing(channel)));
                continue;
            }
            // Whether the value lies further out than that of the row that has a role now or, if they are equal, came earlier.
            let takes = |row: &Option<Arc<Numbered<T>>>, outwards: Ordering| {
                row.as_ref().is_none_or(|held| match value.partial_cmp(&held.row.values[channel]) {
                    Some(Ordering::Equal) => time_us < held.row.time_us,
                    found => found == Some(outwards),
                })
            };
            if takes(&self.smallest[channel], Ordering::Less) {
                roles.push(Role::Smallest(channel));
            }
            if takes(&self.largest[channel], Ordering::Greater) {
                roles.push(Role::Largest(channel));
            }
        }
        roles
    }

    /// Gives a role to a row, in place of the row that has it now.
    fn put(&mut self, role: Role, row: &Arc<Numbered<T>>) {
        let row = Arc::clone(row);
        match role {
            Role::First => self.first = row,
            Role::Last => self.last = row,
            Role::Smallest(channel) => self.smallest[channel] = Some(row),
            Role::Largest(channel) => self.largest[channel] = Some(row),
            Role::Missing(channel) => self.missing[channel] = Some(row),
        }
    }

    /// The kept rows, each once; all other handles on them are dropped.
    fn rows(self) -> Vec<Arc<Numbered<T>>> {
        let of_channels = [self.smallest, self.largest, self.missing].into_iter().flatten().flatten();
        let mut rows: Vec<_> = [self.first, self.last].into_iter().chain(of_channels).collect();
        rows.sort_by_key(|row| row.number);
        rows.dedup_by_key(|row| row.number);
        rows
    }
}

/// Why a bucket keeps a row.
#[derive(Debug, Clone, Copy)]
enum Role {
    First,
    Last,
    Smallest(usize),
    Largest(usize),
    Missing(usize),
}

/// Longest spacing of rows that is not a gap, microseconds: [`GAP_SPACINGS`] times the median spacing of the ascending `times`,
/// microseconds, `[n]`. `None` if there are fewer than two different times.
pub fn longest_spacing(times: &[i64]) -> Option<i64> {
    let mut spacings: Vec<i64> =
        times.windows(2).map(|pair| pair[1].saturating_sub(pair[0])).filter(|spacing| *spacing > 0).collect();
    if spacings.is_empty() {
        return None;
    }
    let middle = (spacings.len() - 1) / 2;
    let (_, median, _) = spacings.select_nth_unstable(middle);
    Some(median.saturating_mul(GAP_SPACINGS))
}

/// For each pair of neighbouring kept rows the longest time without rows between them, if it is a gap.
fn gaps<T>(times: &[i64], rows: &[Row<T>]) -> Vec<(i64, usize)> {
    let Some(longest) = longest_spacing(times) else { return Vec::new() };
    let mut gaps = Vec::new();
    let mut upcoming = times.iter().copied().peekable();
    for (index, pair) in rows.windows(2).enumerate() {
        let (from, to) = (pair[0].time_us, pair[1].time_us);
        while upcoming.next_if(|time| *time <= from).is_some() {}
        let (mut last, mut widest) = (from, (0, from));
        while let Some(time) = upcoming.next_if(|time| *time <= to) {
            widest = widest.max((time.saturating_sub(last), last));
            last = time;
        }
        if widest.0 > longest {
            gaps.push((widest.1 + widest.0 / 2, index + 1));
        }
    }
    gaps
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Rows of a series in ascending order of time, with the values of `channels` channels.
    fn series(channels: usize) -> impl Strategy<Value = Vec<(i64, Vec<f64>)>> {
        let value = prop_oneof![9 => -1e3..1e3, 1 => Just(f64::NAN)];
        let step = prop_oneof![20 => 0_i64..1_000, 1 => 5_000_i64..100_000];
        let row = (step, prop::collection::vec(value, channels));
        prop::collection::vec(row, 0..700).prop_map(|rows| {
            let mut time = 0;
            let timed = rows.into_iter().map(|(step, values)| {
                time += step;
                (time, values)
            });
            timed.collect()
        })
    }

    fn reduce(input: &[(i64, Vec<f64>)], points: usize, channels: usize) -> (Reduced<usize>, Vec<usize>) {
        let span = input.iter().map(|row| row.0);
        let span = (span.clone().min().unwrap_or(0), span.max().unwrap_or(0));
        let mut reducer = Reducer::new(span, points, channels);
        let buckets = input.iter().map(|row| reducer.bucket(row.0)).collect();
        for (index, (time, values)) in input.iter().enumerate() {
            reducer.push(*time, values, || index);
        }
        (reducer.finish(), buckets)
    }

    fn same(a: &[f64], b: &[f64]) -> bool {
        a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits())
    }

    /// Checks the properties that every reduced series has, whatever the rows and their order.
    fn check(input: &[(i64, Vec<f64>)], points: usize, channels: usize) {
        let (left, buckets) = reduce(input, points, channels);
        assert!(left.rows.windows(2).all(|pair| pair[0].time_us <= pair[1].time_us), "in the order of time");
        for row in &left.rows {
            let (time, values) = &input[row.tag];
            assert!(*time == row.time_us && same(values, &row.values), "rows are unchanged");
        }
        let mut tags: Vec<usize> = left.rows.iter().map(|row| row.tag).collect();
        tags.sort_unstable();
        tags.dedup();
        assert_eq!(tags.len(), left.rows.len(), "no row twice");
        assert_eq!(left.reduced, left.rows.len() < input.len());
        if input.len() <= points {
            assert!(!left.reduced);
        }
        assert!(left.rows.len() <= (2 * points * channels).max(points), "{} rows", left.rows.len());
        for channel in 0..channels {
            for bucket in 0..=buckets.iter().copied().max().unwrap_or(0) {
                let of_input = || (0..input.len()).filter(|i| buckets[*i] == bucket).map(|i| input[i].1[channel]);
                let of_left = || left.rows.iter().filter(|r| buckets[r.tag] == bucket).map(|r| r.values[channel]);
                // `min` and `max` of f64 pass NaN over.
                assert_eq!(of_input().reduce(f64::min).map(f64::to_bits), of_left().reduce(f64::min).map(f64::to_bits));
                assert_eq!(of_input().reduce(f64::max).map(f64::to_bits), of_left().reduce(f64::max).map(f64::to_bits));
                assert_eq!(of_input().any(f64::is_nan), of_left().any(f64::is_nan), "a missing value stays visible");
            }
        }
        let mut times: Vec<i64> = input.iter().map(|row| row.0).collect();
        times.sort_unstable();
        let longest = longest_spacing(&times).unwrap_or(i64::MAX);
        for pair in times.windows(2).filter(|pair| pair[1] - pair[0] > longest) {
            let behind = left.rows.iter().position(|row| row.time_us >= pair[1]).expect("the last row is always kept");
            let (gap, _) = left.gaps.iter().find(|gap| gap.1 == behind).expect("a gap is marked");
            assert!(left.rows[behind - 1].time_us < *gap && *gap < left.rows[behind].time_us);
        }
        for (middle, behind) in &left.gaps {
            let next = times.partition_point(|time| time < middle);
            assert!(times[next] - times[next - 1] > longest, "a gap is where nothing was measured");
            assert!(left.rows[behind - 1].time_us < *middle && *middle < left.rows[*behind].time_us);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 200, ..ProptestConfig::default() })]

        #[test]
        fn extremes_missing_values_and_gaps_are_kept(
            (channels, input) in (1_usize..4).prop_flat_map(|channels| (Just(channels), series(channels))),
            points in 5_usize..150,
        ) {
            check(&input, points, channels);
        }

        #[test]
        fn the_order_of_arrival_does_not_matter(input in series(2).prop_shuffle(), points in 5_usize..150) {
            check(&input, points, 2);
        }

        #[test]
        fn of_equal_values_the_same_rows_are_kept_in_any_order_of_arrival(
            (steps, shuffled) in prop::collection::vec((1_i64..1_000, -1_i8..=1), 0..700).prop_flat_map(|steps| {
                (Just(steps.clone()), Just((0..steps.len()).collect::<Vec<_>>()).prop_shuffle())
            }),
            points in 5_usize..150,
        ) {
            let mut time_us = 0;
            let rows: Vec<(i64, Vec<f64>)> = steps
                .into_iter()
                .map(|(step, value)| {
                    time_us += step;
                    (time_us, vec![f64::from(value), 1.0])
                })
                .collect();
            let other: Vec<_> = shuffled.iter().map(|i| rows[*i].clone()).collect();
            let times = |input: &[_]| reduce(input, points, 2).0.rows.iter().map(|row| row.time_us).collect::<Vec<_>>();
            prop_assert_eq!(times(&rows), times(&other));
        }

        #[test]
        fn a_short_series_is_unchanged(input in series(2)) {
            let (left, _) = reduce(&input, input.len(), 2);
            let tags: Vec<usize> = left.rows.iter().map(|row| row.tag).collect();
            prop_assert_eq!(tags, (0..input.len()).collect::<Vec<_>>());
        }
    }

    #[test]
    fn one_spike_among_twenty_thousand_rows_is_kept() {
        let value = |i: i64| if i == 13_579 { 50.0 } else { (i as f64 * 0.37).sin() };
        let input: Vec<_> = (0..20_000).map(|i| (i * 600_000_000, vec![value(i)])).collect();
        let (left, _) = reduce(&input, 500, 1);
        assert!(left.rows.iter().any(|row| row.tag == 13_579));
        assert!(left.rows.len() <= 1_000 && left.gaps.is_empty(), "{} rows", left.rows.len());
    }

    #[test]
    fn extreme_times_do_not_overflow() {
        let mut reducer = Reducer::new((i64::MIN, i64::MAX), 5, 1);
        for time in [i64::MIN, -1, 0, 1, i64::MAX, 3, 4] {
            reducer.push(time, &[0.0], || ());
        }
        assert!(reducer.finish().rows.len() >= 2);
    }
}
