//! A change that is followed as long as it lasts.
//!
//! The test of [`change`](super::change) looks back over a window, and the filter takes a lasting change for weather after a while. A
//! change that was found is therefore followed from its onset: its score goes on beyond the window, so that the alarm does not end
//! because the process has become used to the damage. It ends when the later batches contradict it, or a change in the opposite
//! direction shows, as after a repair.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::direction::ChangeDirection;
use super::filter::Innovation;
use super::parts::{ChangePrior, Parts};
use super::score::{of_several, Courses, Score};
use structures::quantity::Timestamp;

/// Weight of a batch as a multiple of that of the next one, in the test whether a change has gone: five batches count.
const MEMORY: f64 = 0.8;

/// A change since a fixed onset.
#[derive(Debug, Clone, PartialEq)]
pub struct Followed {
    /// Time of the first batch after the onset.
    pub onset: Timestamp,
    /// Interval of 90 % for the onset.
    pub onset_interval: [Timestamp; 2],
    /// Its score.
    pub score: Score,
    /// Score b and information I of the last batches, in which each batch counts [`MEMORY`] times as much as the next one.
    recent: (DVector<f64>, DMatrix<f64>),
}

/// What a chain remembers beside the batches of its window.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Memory {
    /// The change that was found, as long as it lasts.
    pub followed: Option<Followed>,
    /// Time of the first batch that is tested: an earlier change has gone, and the batches that showed it are not looked at again.
    pub begin: Option<Timestamp>,
    /// Whether the change has been large enough for an alarm.
    pub alarmed: bool,
}

#[derive(Serialize, Deserialize)]
struct StoredMemory {
    followed: Option<Stored>,
    begin: Option<Timestamp>,
    /// Absent in what an earlier version of the program remembered, where each change raised an alarm.
    #[serde(default = "yes")]
    alarmed: bool,
}

const fn yes() -> bool {
    true
}

/// As it is stored: matrices by columns.
#[derive(Serialize, Deserialize)]
struct Stored {
    onset: Timestamp,
    onset_interval: [Timestamp; 2],
    score: Vec<f64>,
    information: Vec<f64>,
    taken: Vec<f64>,
    recent_score: Vec<f64>,
    recent_information: Vec<f64>,
    /// Absent in a change that an earlier version of the program followed, as a step.
    #[serde(default)]
    elapsed: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    growth_ends: Option<f64>,
}

impl Followed {
    /// The change with the first of some innovations. `growth_ends`: see [`Score`].
    pub(super) fn since(
        onset: Timestamp,
        onset_interval: [Timestamp; 2],
        growth_ends: Option<f64>,
        innovations: &[Innovation],
        contributions: &DMatrix<f64>,
    ) -> Self {
        let (d, n) = contributions.shape();
        let recent = (DVector::zeros(d), DMatrix::zeros(d, d));
        let score = Score::new(n, d, Courses::StepAndGrowth(growth_ends));
        let mut followed = Self { onset, onset_interval, score, recent };
        for innovation in innovations {
            followed.add(innovation, contributions);
        }
        followed
    }

    /// Adds the next innovation.
    pub(super) fn add(&mut self, innovation: &Innovation, contributions: &DMatrix<f64>) {
        let before = self.score.of_step();
        self.score.add(innovation, contributions);
        let now = self.score.of_step();
        self.recent = (MEMORY * &self.recent.0 + now.0 - before.0, MEMORY * &self.recent.1 + now.1 - before.1);
    }

    /// Its most likely losses as changes of the quantities, standardised, `[d]`.
    fn changes(&self, directions: &[ChangeDirection]) -> DVector<f64> {
        let mut losses = vec![0.0; directions.len()];
        let (score, information) = self.score.of_step();
        of_several(score.as_slice(), information.as_slice(), directions, &mut losses);
        DVector::from_fn(directions.len(), |k, _| directions[k].sign() * losses[k])
    }

    /// What the states have taken of it, M δ, `[q + d]`.
    pub(super) fn taken(&self, directions: &[ChangeDirection]) -> DVector<f64> {
        self.score.taken.columns(0, directions.len()) * self.changes(directions)
    }

    /// Evidence that the last batches do not show the change any more.
    ///
    /// ```text
    ///  z = δᵀ(I δ − b) / √(δᵀ I δ),    δ: most likely losses; b, I: of the last batches
    /// ```
    pub(super) fn gone(&self, directions: &[ChangeDirection]) -> f64 {
        let (change, (score, information)) = (self.changes(directions), &self.recent);
        let variance = change.dot(&(information * &change));
        if variance > 0.0 {
            (variance - change.dot(score)) / variance.sqrt()
        } else {
            0.0
        }
    }

    /// Evidence that another change has the proportions of this one and the opposite direction.
    ///
    /// ```text
    ///  z = −δᵀb / √(δᵀ I δ),    δ: most likely losses of this change; b, I: of the other one
    /// ```
    pub(super) fn opposite(&self, other: &Score, directions: &[ChangeDirection]) -> f64 {
        let change = self.changes(directions);
        let (score, information) = other.of_step();
        let variance = change.dot(&(information * &change));
        if variance > 0.0 {
            -change.dot(&score) / variance.sqrt()
        } else {
            0.0
        }
    }

    /// Which quantities have changed, and by how much; `None` if the batches since the onset inform none.
    pub(super) fn parts(&self, prior: &ChangePrior) -> Option<Parts> {
        Parts::of(prior.hypotheses(&self.score).iter())
    }
}

impl Memory {
    /// As text for the store; `None` if there is nothing to remember.
    ///
    /// # Errors
    /// A number that is not finite.
    pub fn to_json(&self) -> Result<Option<String>, serde_json::Error> {
        if *self == Self::default() {
            return Ok(None);
        }
        let stored = |followed: &Followed| Stored {
            onset: followed.onset,
            onset_interval: followed.onset_interval,
            score: followed.score.score.as_slice().to_vec(),
            information: followed.score.information.as_slice().to_vec(),
            taken: followed.score.taken.as_slice().to_vec(),
            recent_score: followed.recent.0.as_slice().to_vec(),
            recent_information: followed.recent.1.as_slice().to_vec(),
            elapsed: followed.score.elapsed,
            growth_ends: followed.score.growth_ends,
        };
        let Self { followed, begin, alarmed } = self;
        let memory = StoredMemory { followed: followed.as_ref().map(stored), begin: *begin, alarmed: *alarmed };
        serde_json::to_string(&memory).map(Some)
    }

    /// The inverse of [`Self::to_json`].
    ///
    /// # Errors
    /// Text of another form.
    pub fn from_json(text: Option<&str>) -> Result<Self, serde_json::Error> {
        let Some(text) = text else { return Ok(Self::default()) };
        let stored: StoredMemory = serde_json::from_str(text)?;
        let StoredMemory { followed, begin, alarmed } = stored;
        Ok(Self { followed: followed.map(Followed::try_from).transpose()?, begin, alarmed })
    }
}

impl TryFrom<Stored> for Followed {
    type Error = serde_json::Error;

    fn try_from(stored: Stored) -> Result<Self, Self::Error> {
        use serde::de::Error as _;
        let (d, columns) = (stored.recent_score.len(), stored.score.len());
        let fits = d > 0 && [d, 2 * d].contains(&columns) && stored.recent_information.len() == d * d;
        if !fits || stored.information.len() != columns * columns || !stored.taken.len().is_multiple_of(columns) {
            return Err(serde_json::Error::custom("the lengths of the matrices do not fit"));
        }
        Ok(Self {
            onset: stored.onset,
            onset_interval: stored.onset_interval,
            score: Score {
                score: DVector::from_vec(stored.score),
                information: DMatrix::from_vec(columns, columns, stored.information),
                taken: DMatrix::from_vec(stored.taken.len() / columns, columns, stored.taken),
                // It follows from the next innovation.
                predicted: DMatrix::zeros(d, columns),
                elapsed: stored.elapsed,
                growth_ends: stored.growth_ends,
            },
            recent: (DVector::from_vec(stored.recent_score), DMatrix::from_vec(d, d, stored.recent_information)),
        })
    }
}
