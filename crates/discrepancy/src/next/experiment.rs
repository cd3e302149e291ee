//! The measurements that a person could make next: what is done, and in which conditions.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::condition::Condition;
use structures::measurement::CovariateValue;

/// What is done in a further measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = MeasurementKind)]
pub enum Kind {
    /// The shapes of the measured modes.
    ModeShapes,
    /// The mode above those measured.
    FurtherMode,
    /// The frequencies with a known mass fixed to a point.
    HungMass,
    /// The frequencies with a second instrument, and nothing else.
    SecondInstrument,
    /// The mass of a body, and the frequencies if a second instrument is used.
    Weighing,
    /// The frequencies at a value of a covariate beyond those met so far.
    FurtherRange,
    /// The frequencies in conditions in which two covariates do not vary together.
    IndependentCovariates,
    /// The frequencies at settings near the ends of their range.
    FurtherSettings,
    /// More rows as those at hand.
    MoreRows,
}

impl Kind {
    /// Whether such a measurement differs from those at hand by its conditions only.
    pub(super) fn is_of_conditions(self) -> bool {
        matches!(self, Self::FurtherRange | Self::IndependentCovariates | Self::FurtherSettings)
    }
}

/// A possible measurement.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Experiment {
    pub(super) kind: Kind,
    /// The conditions in which rows are measured; each has the same number of rows.
    pub(super) conditions: Vec<Condition>,
    /// Number of modes that are measured; 0 if no frequency is measured.
    pub(super) modes: usize,
    /// Degree of freedom, and kg, of a mass that is hung.
    pub(super) hung: Option<(usize, f64)>,
    /// Body that is weighed.
    pub(super) weighed: Option<usize>,
    /// Whether the frequencies are measured with a second instrument.
    pub(super) second_instrument: bool,
    /// Degrees of freedom at which mode shapes are measured.
    pub(super) points: Vec<usize>,
    /// Name of the point, body, covariate or setting.
    pub(super) place: Option<String>,
}

impl Experiment {
    /// Number of things to arrange for it: something done to the structure or measured on it, a second instrument, mode shapes
    /// beside something else, conditions that were not met so far.
    pub(super) fn effort(&self) -> usize {
        let act = !self.kind.is_of_conditions() && !matches!(self.kind, Kind::MoreRows | Kind::SecondInstrument);
        let beside = self.kind != Kind::ModeShapes && !self.points.is_empty();
        let arranged = self.conditions.iter().any(|c| !c.changed.is_empty() || !c.set.is_empty());
        [act, self.second_instrument, beside, arranged].into_iter().filter(|part| *part).count()
    }
}

/// A measurement that would distinguish the candidates of a diagnosis.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct NextMeasurement {
    /// What is done.
    pub kind: Kind,
    /// The point of a hung mass, the body that is weighed, or the covariate or setting whose range is extended.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub place: Option<String>,
    /// The mass that is hung, kg.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub kg: Option<f64>,
    /// Whether the frequencies are measured with a second instrument.
    pub second_instrument: bool,
    /// Number, from 1, of the further mode.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mode: Option<usize>,
    /// The points at which mode shapes are measured.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub points: Vec<String>,
    /// The conditions in which to measure, as values of covariates and settings; an empty one stands for the present conditions.
    #[schema(value_type = Vec<Object>)]
    pub conditions: Vec<BTreeMap<String, CovariateValue>>,
    /// Number of rows in each condition, with which `probability_after` is computed.
    pub repeats: usize,
    /// Expected probability of the right candidate without a further measurement.
    pub probability_now: f64,
    /// Expected probability of the right candidate after the measurement.
    pub probability_after: f64,
    /// Standard error of `probability_after` from the number of simulated measurements.
    pub standard_error: f64,
    /// Smallest number of rows in each condition with which the expected probability reaches 0.95; `null` if 100 rows do not
    /// suffice.
    pub repeats_to_95: Option<usize>,
    /// The measurement in a sentence.
    pub sentence: String,
}
