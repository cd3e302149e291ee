//! Columns of a table that state what a person did for a measurement, instead of a condition that was met.
//!
//! | column | content |
//! |---|---|
//! | `hung_kg_<point>` | mass of a body that was fixed to this mass or node, kg; empty or 0 if there was none |
//! | `weighed_kg_<mass>` | mass of this body as it was weighed in the conditions of the row, kg |
//! | `second_instrument` | 1 or `yes` if the frequencies were measured with a second instrument, which is taken to be free of the faults of the first |

use structures::measurement::CovariateValue;
use structures::simulator::Simulator;

/// Start of the name of a column with a known mass.
pub const HUNG_KG: &str = "hung_kg_";

/// Start of the name of a column with a weighed mass.
pub const WEIGHED_KG: &str = "weighed_kg_";

/// Name of the column that marks the rows of a second instrument.
pub const SECOND_INSTRUMENT: &str = "second_instrument";

/// Relative standard deviation of a known or weighed mass.
pub const WEIGHING_STD: f64 = 0.005;

/// What a column states.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Declared {
    /// A body fixed to this degree of freedom.
    Hung(usize),
    /// The mass of this body.
    Weighed(usize),
    /// The rows of a second instrument.
    SecondInstrument,
}

/// A body that was weighed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weighing {
    /// Index of the row.
    pub row: usize,
    /// Index of the body among the masses of the structure.
    pub mass: usize,
    /// Logarithm of the weighed mass over that of the structure file.
    pub log_ratio: f64,
}

impl Weighing {
    /// A weighing of `kg`; `None` if the value is missing or not positive.
    pub(super) fn new(simulator: &Simulator, row: usize, mass: usize, kg: f64) -> Option<Self> {
        let stated_kg = simulator.structure()?.masses()[mass].kg;
        (kg > 0.0).then(|| Self { row, mass, log_ratio: (kg / stated_kg).ln() })
    }
}

/// What the column of this name states; `None` for a covariate.
pub(super) fn declared(simulator: &Simulator, name: &str) -> Option<Declared> {
    if name == SECOND_INSTRUMENT {
        return Some(Declared::SecondInstrument);
    }
    let structure = simulator.structure()?;
    if let Some(point) = name.strip_prefix(HUNG_KG) {
        return structure.attachment_points().iter().find(|p| p.name == point).map(|p| Declared::Hung(p.dof));
    }
    let mass = name.strip_prefix(WEIGHED_KG)?;
    structure.masses().iter().position(|m| m.name == mass).map(Declared::Weighed)
}

/// Why a column cannot state what its name says, as a sentence; `None` if it is a covariate or in order.
pub fn mistake(simulator: &Simulator, name: &str) -> Option<String> {
    if declared(simulator, name).is_some() {
        return None;
    }
    let list = |names: Vec<&str>| if names.is_empty() { "none".to_owned() } else { names.join(", ") };
    let structure = simulator.structure();
    if let Some(point) = name.strip_prefix(HUNG_KG) {
        let points = structure.map_or(Vec::new(), |s| s.attachment_points().iter().map(|p| p.name.as_str()).collect());
        return Some(format!(
            "the column {name} names the point {point}, at which no mass can be hung: the points of this structure are {}",
            list(points)
        ));
    }
    let mass = name.strip_prefix(WEIGHED_KG)?;
    let masses = structure.map_or(Vec::new(), |s| s.masses().iter().map(|m| m.name.as_str()).collect());
    Some(format!("the column {name} names the body {mass}: the bodies of this structure are {}", list(masses)))
}

/// Whether a value of [`SECOND_INSTRUMENT`] marks a row: a number other than 0, `yes` or `true`.
pub(super) fn is_marked(value: &CovariateValue) -> bool {
    match value {
        CovariateValue::Number(number) => *number != 0.0,
        CovariateValue::Category(text) => matches!(text.as_str(), "yes" | "true"),
    }
}
