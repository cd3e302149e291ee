//! A change that is followed as long as it lasts.
//!
//! The test of [`change`](super::change) looks back over a window, and the filter takes a lasting change for weather after a while. A
//! change that was found is therefore followed from its onset: its score goes on beyond the window, so that the alarm does not end
//! because the process has become used to the damage. It ends when the later batches contradict it, or a change in the opposite
//! direction shows, as after a repair.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::change::{of_several, Score};
use super::filter::Innovation;
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
}

#[derive(Serialize, Deserialize)]
struct StoredMemory {
    followed: Option<Stored>,
    begin: Option<Timestamp>,
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
}

impl Followed {
    /// The change with the first of some innovations.
    pub(super) fn since(
        onset: Timestamp,
        onset_interval: [Timestamp; 2],
        innovations: &[Innovation],
        contributions: &DMatrix<f64>,
    ) -> Self {
        let (d, n) = contributions.shape();
        let recent = (DVector::zeros(d), DMatrix::zeros(d, d));
        let mut followed = Self { onset, onset_interval, score: Score::new(n, d), recent };
        for innovation in innovations {
            followed.add(innovation, contributions);
        }
        followed
    }

    /// Adds the next innovation.
    pub(super) fn add(&mut self, innovation: &Innovation, contributions: &DMatrix<f64>) {
        let (score, information) = (self.score.score.clone(), self.score.information.clone());
        self.score.add(innovation, contributions);
        self.recent.0 = MEMORY * &self.recent.0 + &self.score.score - score;
        self.recent.1 = MEMORY * &self.recent.1 + &self.score.information - information;
    }

    /// Its most likely losses as changes of the quantities, standardised, `[d]`.
    fn changes(&self, signs: &[f64]) -> DVector<f64> {
        let mut losses = vec![0.0; signs.len()];
        of_several(self.score.score.as_slice(), self.score.information.as_slice(), signs, &mut losses);
        DVector::from_fn(signs.len(), |k, _| signs[k] * losses[k])
    }

    /// What the states have taken of it, M δ, `[q + d]`.
    pub(super) fn taken(&self, signs: &[f64]) -> DVector<f64> {
        &self.score.taken * self.changes(signs)
    }

    /// Evidence that the last batches do not show the change any more.
    ///
    /// ```text
    ///  z = δᵀ(I δ − b) / √(δᵀ I δ),    δ: most likely losses; b, I: of the last batches
    /// ```
    pub(super) fn gone(&self, signs: &[f64]) -> f64 {
        let (change, (score, information)) = (self.changes(signs), &self.recent);
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
    pub(super) fn opposite(&self, other: &Score, signs: &[f64]) -> f64 {
        let change = self.changes(signs);
        let variance = change.dot(&(&other.information * &change));
        if variance > 0.0 {
            -change.dot(&other.score) / variance.sqrt()
        } else {
            0.0
        }
    }

    /// The loss of each quantity, standardised and positive towards damage: mean and standard deviation, `[d]`; `None` for one that is not
    /// informed. In quantity `only`, or in all with a damage direction.
    pub(super) fn losses(&self, signs: &[f64], only: Option<usize>) -> Vec<Option<(f64, f64)>> {
        let information = &self.score.information;
        let sought = |k: &usize| only.is_none_or(|only| only == *k) && signs[*k] != 0.0 && information[(*k, *k)] > 0.0;
        let places: Vec<usize> = (0..signs.len()).filter(sought).collect();
        let own = information.select_rows(&places).select_columns(&places);
        let mut found = vec![None; signs.len()];
        let Some(covariance) = own.cholesky().map(|factored| factored.inverse()) else { return found };
        let means = &covariance * self.score.score.select_rows(&places);
        for (place, k) in places.into_iter().enumerate() {
            found[k] = Some((signs[k] * means[place], covariance[(place, place)].sqrt()));
        }
        found
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
        };
        let memory = StoredMemory { followed: self.followed.as_ref().map(stored), begin: self.begin };
        serde_json::to_string(&memory).map(Some)
    }

    /// The inverse of [`Self::to_json`].
    ///
    /// # Errors
    /// Text of another form.
    pub fn from_json(text: Option<&str>) -> Result<Self, serde_json::Error> {
        let Some(text) = text else { return Ok(Self::default()) };
        let stored: StoredMemory = serde_json::from_str(text)?;
        Ok(Self { followed: stored.followed.map(Followed::try_from).transpose()?, begin: stored.begin })
    }
}

impl TryFrom<Stored> for Followed {
    type Error = serde_json::Error;

    fn try_from(stored: Stored) -> Result<Self, Self::Error> {
        use serde::de::Error as _;
        let d = stored.score.len();
        let fits = stored.recent_score.len() == d && stored.recent_information.len() == d * d;
        if d == 0 || !fits || stored.information.len() != d * d || !stored.taken.len().is_multiple_of(d) {
            return Err(serde_json::Error::custom("the lengths of the matrices do not fit"));
        }
        Ok(Self {
            onset: stored.onset,
            onset_interval: stored.onset_interval,
            score: Score {
                score: DVector::from_vec(stored.score),
                information: DMatrix::from_vec(d, d, stored.information),
                taken: DMatrix::from_vec(stored.taken.len() / d, d, stored.taken),
                // It follows from the next innovation.
                predicted: DMatrix::zeros(d, d),
            },
            recent: (DVector::from_vec(stored.recent_score), DMatrix::from_vec(d, d, stored.recent_information)),
        })
    }
}
