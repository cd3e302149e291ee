//! Sizes of a flow.

use serde::{Deserialize, Serialize};

use super::permutation;
use structures::stats::Stream;

/// Sizes of a flow. They are part of the manifest, since they determine the shapes of all weights.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Architecture {
    /// Number of parameters d.
    pub parameters: usize,
    /// Number of modes m.
    pub modes: usize,
    /// Inputs per mode: the whitened log-frequency; with noise also its level and a mask; and one for each covariate
    /// effect.
    pub channels: usize,
    /// Number of conditional coupling units N.
    pub units: usize,
    /// Width of the hidden layers of every subnet.
    pub width: usize,
    /// Channels of the convolutions of the context network.
    pub context_channels: usize,
    /// Features that the context network computes, in addition to the observation itself.
    pub context_features: usize,
    /// Inputs that condition the units directly, without a context network: y is then `[n, fixed_context]` and S(y) = y. 0
    /// where there is a context network.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub fixed_context: usize,
    /// Bound α of each log-scale, in tenths: an integer, so that architectures can be compared exactly.
    pub clamp_tenths: u32,
    /// The fixed permutation before each unit.
    pub permutations: Vec<Vec<u32>>,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "serde hands over a reference")]
fn is_zero(value: &usize) -> bool {
    *value == 0
}

/// Sizes of a flow that do not depend on the structure.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FlowSettings {
    /// Number of conditional coupling units N.
    pub units: usize,
    /// Width of the hidden layers of every subnet.
    pub width: usize,
    /// Channels of the convolutions of the context network.
    pub context_channels: usize,
    /// Features that the context network computes, in addition to the observation itself.
    pub context_features: usize,
    /// Bound α of each log-scale, in tenths.
    pub clamp_tenths: u32,
}

impl Default for FlowSettings {
    fn default() -> Self {
        Self { units: 4, width: 64, context_channels: 16, context_features: 32, clamp_tenths: 30 }
    }
}

impl FlowSettings {
    /// The architecture for `parameters` unknowns and `modes` modes with `channels` inputs each; permutations are drawn
    /// from `stream`.
    pub fn architecture(&self, parameters: usize, modes: usize, channels: usize, stream: &mut Stream) -> Architecture {
        let permutations = (0..self.units).map(|_| permutation::random_order(parameters, stream)).collect();
        Architecture {
            parameters,
            modes,
            channels,
            units: self.units,
            width: self.width,
            context_channels: self.context_channels,
            context_features: self.context_features,
            fixed_context: 0,
            clamp_tenths: self.clamp_tenths,
            permutations,
        }
    }
}
