//! The most probable of several values, and their 90 % interval.

/// The most probable of several values.
pub(super) struct MostProbable<T> {
    /// The value.
    pub(super) value: T,
    /// 5 % and 95 % quantiles, with the value between them.
    pub(super) interval: [T; 2],
    /// Σ p of all values over p of the most probable one.
    pub(super) total: f64,
}

/// The most probable of ascending values that are given with ln p, up to a constant; `None` without any.
pub(super) fn most_probable<T: Copy + PartialOrd>(logs: &[(T, f64)]) -> Option<MostProbable<T>> {
    let best = logs.iter().copied().max_by(|a, b| a.1.total_cmp(&b.1))?;
    let total: f64 = logs.iter().map(|(_, log)| (log - best.1).exp()).sum();
    let quantile = |level: f64| {
        let mut sum = 0.0;
        let reached = logs.iter().find(|(_, log)| {
            sum += (log - best.1).exp() / total;
            sum >= level
        });
        reached.map_or(best.0, |(value, _)| *value)
    };
    let (low, high) = (quantile(0.05), quantile(0.95));
    let interval = [if low < best.0 { low } else { best.0 }, if high > best.0 { high } else { best.0 }];
    Some(MostProbable { value: best.0, interval, total })
}
