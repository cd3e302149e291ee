//! Round numbers along an axis.

/// Ticks of an axis, with as many decimals as are needed to distinguish them.
#[derive(Debug, Clone, PartialEq)]
pub struct Ticks {
    /// Positions.
    pub at: Vec<f64>,
    decimals: usize,
}

impl Ticks {
    /// About `most` steps of 1, 2 or 5 times a power of ten between `low` and `high`; no ticks for an empty range.
    pub fn between(low: f64, high: f64, most: usize) -> Self {
        let raw = (high - low) / most as f64;
        if !(raw.is_finite() && raw > 0.0) {
            return Self { at: Vec::new(), decimals: 0 };
        }
        let power = 10_f64.powf((raw.log10() + 1e-9).floor());
        let step = power * [1.0, 2.0, 5.0].into_iter().find(|m| m * power >= raw * (1.0 - 1e-9)).unwrap_or(10.0);
        let (first, last) = ((low / step - 1e-9).ceil() as i64, (high / step + 1e-9).floor() as i64);
        let decimals = (-(step.log10() + 1e-9).floor()).clamp(0.0, 12.0) as usize;
        Self { at: (first..=last).map(|i| i as f64 * step).collect(), decimals }
    }

    /// Number of characters of the longest label.
    pub fn widest(&self) -> usize {
        self.at.iter().map(|tick| self.label(*tick).chars().count()).max().unwrap_or(0)
    }

    /// The number of a tick, with a true minus sign.
    pub fn label(&self, tick: f64) -> String {
        // Adding 0 turns −0 into 0.
        format!("{:.*}", self.decimals, tick + 0.0).replace('-', "−")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_their_labels_differ() {
        let labels = |low, high, most| {
            let ticks = Ticks::between(low, high, most);
            ticks.at.iter().map(|t| ticks.label(*t)).collect::<Vec<_>>().join(" ")
        };
        assert_eq!(labels(3.02, 5.1, 5), "3.5 4.0 4.5 5.0");
        assert_eq!(labels(0.0, 0.12, 5), "0.00 0.05 0.10");
        assert_eq!(labels(-0.021, 0.02, 4), "−0.02 0.00 0.02");
        assert_eq!(labels(1000.0, 4100.0, 4), "1000 2000 3000 4000");
        assert_eq!(labels(1.0, 1.0, 5), "");
    }
}
