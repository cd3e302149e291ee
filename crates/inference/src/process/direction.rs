//! In which direction a change of a quantity is looked for.

use serde::{Deserialize, Serialize};

use structures::parameter::DamageDirection;

/// In which direction a change of a quantity is looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ChangeDirection {
    /// A decrease, which is damage.
    Decrease,
    /// An increase, which is damage.
    Increase,
    /// Either: a coordinate of the [misfit](super::misfit), which no state of the structure changes.
    Either,
    /// None: the quantity is only estimated.
    None,
}

impl From<DamageDirection> for ChangeDirection {
    fn from(direction: DamageDirection) -> Self {
        match direction {
            DamageDirection::Decrease => Self::Decrease,
            DamageDirection::Increase => Self::Increase,
            DamageDirection::None => Self::None,
        }
    }
}

impl ChangeDirection {
    /// Sign by which a change is multiplied so that one that is looked for is positive; 0 if none is.
    pub const fn sign(self) -> f64 {
        match self {
            Self::Decrease => -1.0,
            Self::Increase | Self::Either => 1.0,
            Self::None => 0.0,
        }
    }

    /// Whether a change in this direction is damage.
    pub const fn is_damage(self) -> bool {
        matches!(self, Self::Decrease | Self::Increase)
    }
}
