//! Elementary functions in single precision without branches or calls, for loops that compile to vector instructions.
//!
//! The compiler vectorises a loop over them where fused multiplication and addition is available, inside `pulp::with_simd`.

/// Adding 1.5·2²³ rounds to the nearest integer and leaves that integer in the lowest bits of the significand.
const ROUND: f32 = 12_582_912.0;

/// exp(x) with a relative error below 3e-7. Arguments beyond ±87, near the limits of f32, are clamped to ±87.
///
/// Cody–Waite reduction to |r| ≤ ½ ln 2, then a polynomial of degree 6 in r.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    const LN_2_HIGH: f32 = 0.693_359_4;
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    let x = x.clamp(-87.0, 87.0);
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let whole = shifted - ROUND;
    let r = whole.mul_add(-LN_2_LOW, whole.mul_add(-LN_2_HIGH, x));
    let polynomial = r.mul_add(1.392_695e-3, 8.333_161e-3);
    let polynomial = r.mul_add(polynomial, 4.166_664e-2);
    let polynomial = r.mul_add(polynomial, 1.666_666_7e-1);
    let polynomial = r.mul_add(polynomial, 0.5);
    let polynomial = r.mul_add(polynomial, 1.0);
    let polynomial = r.mul_add(polynomial, 1.0);
    polynomial * power_of_whole(shifted)
}

/// 2ˣ for x between −100 and 100, with a relative error below 3e-7. Arguments outside are clamped: 2⁻¹⁰⁰ is negligible
/// compared with a weight of 1, but its products with squared deviations are not yet subnormal numbers, which are slow.
///
/// The nearest integer goes into the exponent, the remainder |r| ≤ ½ through a polynomial of degree 5.
#[inline(always)]
pub fn exp2(x: f32) -> f32 {
    let x = x.clamp(-100.0, 100.0);
    let shifted = x + ROUND;
    let r = x - (shifted - ROUND);
    let polynomial = r.mul_add(1.326_472_7e-3, 9.671_513e-3);
    let polynomial = r.mul_add(polynomial, 5.550_733_6e-2);
    let polynomial = r.mul_add(polynomial, 2.402_224_2e-1);
    let polynomial = r.mul_add(polynomial, std::f32::consts::LN_2);
    let polynomial = r.mul_add(polynomial, 1.0);
    polynomial * power_of_whole(shifted)
}

/// 2ⁿ, where `shifted` is the integer n plus [`ROUND`].
#[inline(always)]
fn power_of_whole(shifted: f32) -> f32 {
    f32::from_bits(shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127) << 23)
}

/// 1/x with a relative error below 2e-7, for x between 1 and 8e37.
///
/// Three Newton steps r ← r + r(1 − x r) from a first guess that negates the exponent. A vector division takes as long as
/// all other operations of a logistic function together.
#[inline(always)]
pub fn reciprocal(x: f32) -> f32 {
    let guess = f32::from_bits(0x7EF3_11C7_u32.wrapping_sub(x.to_bits()));
    let better = |r: f32| r.mul_add((-x).mul_add(r, 1.0), r);
    better(better(better(guess)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_holds_to_single_precision() {
        for i in -8_600..=8_600 {
            let x = i as f32 / 100.0;
            let exact = f64::from(x).exp();
            assert!((f64::from(exp(x)) / exact - 1.0).abs() < 3e-7, "at {x}");
        }
    }

    #[test]
    fn powers_of_two_hold_to_single_precision() {
        for i in 0..=2_000_000_u32 {
            let x = 100.0 - 200.0 * (f64::from(i) / 2e6) as f32;
            let relative = f64::from(exp2(x)) / f64::from(x).exp2() - 1.0;
            assert!(relative.abs() < 3e-7, "2^{x}: {relative}");
        }
        assert!(exp2(f32::NEG_INFINITY) < 1e-30 && exp2(-1e9) < 1e-30);
    }

    #[test]
    fn reciprocals_hold_to_single_precision() {
        for step in 0..=100_000 {
            let x = 10_f32.powf(37.9 * step as f32 / 100_000.0);
            assert!((f64::from(reciprocal(x)) * f64::from(x) - 1.0).abs() < 2e-7, "at {x}");
        }
    }
}
