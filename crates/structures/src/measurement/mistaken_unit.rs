//! Units in which frequencies are given by mistake.

use std::f64::consts::TAU;

/// What numbers are that are taken for frequencies in Hz.
#[derive(Debug, Clone, Copy)]
pub struct MistakenUnit {
    /// The quantity and its unit, as in "read as periods in s".
    pub name: &'static str,
    /// The frequency in Hz that a number stands for.
    pub in_hz: fn(f64) -> f64,
}

/// The units that are known.
pub const MISTAKEN_UNITS: [MistakenUnit; 5] = [
    MistakenUnit { name: "rad/s", in_hz: |number| number / TAU },
    MistakenUnit { name: "kHz", in_hz: |number| number * 1e3 },
    MistakenUnit { name: "mHz", in_hz: |number| number * 1e-3 },
    MistakenUnit { name: "rpm", in_hz: |number| number / 60.0 },
    MistakenUnit { name: "periods in s", in_hz: |number| 1.0 / number },
];
