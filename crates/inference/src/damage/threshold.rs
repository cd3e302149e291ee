//! The damage threshold and the probability of damage.

use structures::parameter::DamageDirection;
use structures::quantity::Probability;
use structures::stats;

/// The damage threshold δ: values below it (for a loss) or above it (for a growth) indicate damage. In the unit of `mean` and
/// `std`; `None` when no change of this quantity indicates damage.
///
/// ```text
///  δ = μ_ud + Φ⁻¹(p) σ_ud      for a loss,       δ = μ_ud − Φ⁻¹(p) σ_ud      for a growth
/// ```
///
/// Source: Wang et al. (2025), Eq. 21 with p = 0.05 (Φ⁻¹ = −1.645).
pub fn threshold(mean: f64, std: f64, direction: DamageDirection, probability: Probability) -> Option<f64> {
    let distance = stats::normal_quantile(probability.get()) * std;
    match direction {
        DamageDirection::Decrease => Some(mean + distance),
        DamageDirection::Increase => Some(mean - distance),
        DamageDirection::None => None,
    }
}

/// Share of the pooled samples on the damaged side of δ, in [0, 1]; `None` when no change of this quantity indicates damage.
///
/// Source: Wang et al. (2025), §4: P(x < δ), here counted in the pool itself rather than from a density fitted to it.
pub fn probability_of_damage(pool: &[f64], threshold: f64, direction: DamageDirection) -> Option<f64> {
    let damaged: fn(f64, f64) -> bool = match direction {
        DamageDirection::Decrease => |x, delta| x < delta,
        DamageDirection::Increase => |x, delta| x > delta,
        DamageDirection::None => return None,
    };
    Some(pool.iter().filter(|x| damaged(**x, threshold)).count() as f64 / pool.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_threshold_and_target_probabilities_follow_from_its_populations() {
        let level = Probability::new(0.05).unwrap();
        let delta = threshold(4.0, 0.3, DamageDirection::Decrease, level).unwrap();
        assert!((delta - 3.5065).abs() < 1e-4); // Fig. 6
        let target = |mean: f64, std: f64, undamaged: f64| {
            let delta = threshold(undamaged, std, DamageDirection::Decrease, level).unwrap();
            stats::normal_cdf((delta - mean) / std)
        };
        // Table 4: 37.76 %, 99.96 %, 99.99 %. The paper computes with 1.645 for 1.64485, which moves the first by 0.005 %,
        // and prints two decimals cut off rather than rounded (37.765 % and 99.992 %): together 0.015 %.
        assert!((target(3.6, 0.3, 4.0) - 0.3776).abs() < 1.5e-4);
        assert!((target(4.5, 0.1, 5.0) - 0.9996).abs() < 1.5e-4);
        assert!(target(4.8, 0.2, 6.0) > 0.9999);
    }

    #[test]
    fn an_increase_is_damage_if_the_direction_of_damage_says_so() {
        let pool = [1.0, 2.0, 3.0, 4.0];
        assert_eq!(probability_of_damage(&pool, 2.5, DamageDirection::Decrease), Some(0.5));
        assert_eq!(probability_of_damage(&pool, 3.5, DamageDirection::Increase), Some(0.25));
        assert_eq!(probability_of_damage(&pool, 2.5, DamageDirection::None), None);
    }
}
