//! A model that is made in about a second, so that a structure is assessed before its model is trained.
//!
//! Where the simulation weighs every draw, the network only says where to look first, so that one that was hardly trained mostly gives the answers of
//! a trained one and takes longer. Its calibration is not measured: of eight random structures, one of six parameters had intervals that are too
//! narrow (`tests/baseline/forty.rs`).

use super::observation::DEFAULT_NOISE_RANGE;
use super::start::{starts_at_fit, weighs_every_draw};
use super::train::{prepare, Error, Trained};
use crate::flow::train::TrainSettings;
use crate::flow::FlowSettings;
use structures::simulator::Simulator;

/// Simulated pairs, and epochs.
const SAMPLES: usize = 2_000;
const EPOCHS: usize = 2;

/// Whether the simulation of a structure weighs the draws of any model, so that one that was hardly trained can answer.
pub fn is_corrected_by_simulation(simulator: &Simulator) -> bool {
    simulator.is_noisy() && weighs_every_draw(simulator) && !starts_at_fit(simulator)
}

/// Makes a model in about a second. The same simulator gives the same bytes.
///
/// # Errors
/// As [`super::train::train`].
pub fn starting_model(simulator: &Simulator) -> Result<Trained, Error> {
    let settings = TrainSettings { epochs: EPOCHS, ..TrainSettings::default() };
    let prepared = prepare(simulator, SAMPLES, DEFAULT_NOISE_RANGE, &FlowSettings::default(), &settings)?;
    let mut ongoing = prepared.begin(simulator, &settings)?;
    ongoing.first_round(|_| {})?;
    ongoing.uncalibrated()
}
