//! Units that the header of a table states, and the conversion to the unit of the service.

use std::f64::consts::TAU;

use serde::Serialize;

use crate::quantity::shown;

/// 0 °C in kelvin.
const CELSIUS_ZERO_K: f64 = 273.15;

/// Unit of frequencies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub enum FrequencyUnit {
    /// Hz.
    #[serde(rename = "Hz")]
    Hertz,
    /// mHz.
    #[serde(rename = "mHz")]
    Millihertz,
    /// kHz.
    #[serde(rename = "kHz")]
    Kilohertz,
    /// rad/s, 2π of which are 1 Hz.
    #[serde(rename = "rad/s")]
    RadPerSecond,
}

impl FrequencyUnit {
    /// Reads the name of a unit.
    ///
    /// # Errors
    /// A sentence for other text.
    pub fn parse(text: &str) -> Result<Self, String> {
        // A capital M would be mega.
        let lower = if text.starts_with('M') { text.to_owned() } else { text.to_ascii_lowercase() };
        match lower.as_str() {
            "hz" => Ok(Self::Hertz),
            "mhz" => Ok(Self::Millihertz),
            "khz" => Ok(Self::Kilohertz),
            "rad/s" | "rad/sec" | "rad s^-1" | "1/s rad" => Ok(Self::RadPerSecond),
            _ => Err(format!("{} is not a unit of frequency: Hz, mHz, kHz and rad/s are known", shown(text))),
        }
    }

    /// Its symbol.
    pub const fn symbol(self) -> &'static str {
        match self {
            Self::Hertz => "Hz",
            Self::Millihertz => "mHz",
            Self::Kilohertz => "kHz",
            Self::RadPerSecond => "rad/s",
        }
    }

    /// The conversion to Hz.
    pub const fn conversion(self) -> Conversion {
        match self {
            Self::Hertz => Conversion::None,
            Self::Millihertz => Conversion::Divided(1e3),
            Self::Kilohertz => Conversion::Divided(1e-3),
            Self::RadPerSecond => Conversion::Divided(TAU),
        }
    }
}

/// Conversion of the numbers of a column.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Conversion {
    /// The number as written.
    None,
    /// x / divisor.
    Divided(f64),
    /// x + summand.
    Shifted(f64),
    /// (x − 32) / 1.8: °F to °C.
    FromFahrenheit,
}

impl Conversion {
    /// The converted number.
    pub fn of(self, value: f64) -> f64 {
        match self {
            Self::None => value,
            Self::Divided(divisor) => value / divisor,
            Self::Shifted(summand) => value + summand,
            Self::FromFahrenheit => (value - 32.0) / 1.8,
        }
    }
}

/// The end of a name that stands for a unit, such as `c` for °C in `temperature_c`.
pub fn suffix(unit: &str) -> String {
    let unit = unit.trim().to_lowercase();
    match unit.as_str() {
        "°c" | "degc" | "deg c" | "celsius" | "ºc" => "c".to_owned(),
        "kelvin" => "k".to_owned(),
        "°f" | "degf" | "deg f" | "fahrenheit" | "ºf" => "f".to_owned(),
        "%" => "percent".to_owned(),
        "°" => "deg".to_owned(),
        other => {
            let plain = other.replace('/', "_per_").replace('²', "2").replace('³', "3");
            plain.chars().map(|c| if c.is_alphanumeric() { c } else { '_' }).collect()
        }
    }
}

/// The conversion of a temperature from one unit to another, by the ends of their names; `None` for other units.
pub fn between_temperatures(from: &str, to: &str) -> Option<Conversion> {
    match (from, to) {
        ("k", "c") => Some(Conversion::Shifted(-CELSIUS_ZERO_K)),
        ("c", "k") => Some(Conversion::Shifted(CELSIUS_ZERO_K)),
        ("f", "c") => Some(Conversion::FromFahrenheit),
        _ => None,
    }
}
