//! The trained model that a command uses.

use std::path::Path;
use std::sync::Arc;

use anyhow::Context as _;

use crate::baseline::library::{find_structure, Library};
use crate::baseline::starting::{is_corrected_by_simulation, starting_model};
use crate::baseline::Baseline;
use crate::simulator::Simulator;

/// The trained model of a structure, see [`present_model`]; where there is none, one that is made in a second if the simulation corrects its draws,
/// with a line that says so.
///
/// # Errors
/// A structure or model that is refused, or a structure without a trained model that needs one.
pub fn load(structure: &str, model: Option<&Path>) -> anyhow::Result<Arc<Baseline>> {
    let simulator = find_structure(structure)?;
    if let Some(present) = present_model(structure, &simulator, model)? {
        return Ok(present);
    }
    let id = simulator.id();
    anyhow::ensure!(
        is_corrected_by_simulation(&simulator),
        "there is no trained model of this version of {id}, and its measurements cannot be answered without one: train one with `modalwatch train \
         --structure {structure} --out FOLDER`, and give its file with --model"
    );
    eprintln!(
        "note: there is no trained model of this version of {id}: one was made in about a second, whose draws are weighed by the simulation. Its \
         calibration was not measured; `modalwatch calibrate` measures it, and `modalwatch train` makes one that is measured"
    );
    Ok(Arc::new(starting_model(&simulator)?.baseline))
}

/// The trained model of a structure, if there is one: from the weights file `model`; otherwise the `baseline.safetensors` in the
/// folder of the structure file; otherwise the one shipped with the program for the same version of the structure.
///
/// `structure`: the structure file, or the id of a shipped structure, from which `simulator` was built.
///
/// # Errors
/// A weights file that was named and is refused. A model that was found and is refused is not an error; a line about it is printed.
pub fn present_model(
    structure: &str,
    simulator: &Simulator,
    model: Option<&Path>,
) -> anyhow::Result<Option<Arc<Baseline>>> {
    if let Some(weights) = model {
        return load_files(weights, simulator).map(Some);
    }
    let beside = Path::new(structure).with_file_name("baseline.safetensors");
    if Path::new(structure).exists() && beside.exists() {
        match load_files(&beside, simulator) {
            Ok(found) => return Ok(Some(found)),
            Err(refused) => eprintln!("note: {refused:#}"),
        }
    }
    let shipped = Library::open(None)?.get(simulator.id()).and_then(|entry| entry.baseline.clone());
    Ok(shipped.filter(|baseline| baseline.simulator().digest() == simulator.digest()))
}

/// Loads a trained model from its weights file, with its manifest beside it.
fn load_files(weights: &Path, simulator: &Simulator) -> anyhow::Result<Arc<Baseline>> {
    let read = |path: &Path| std::fs::read(path).with_context(|| format!("cannot read {}", path.display()));
    let loaded = Baseline::load(&read(&weights.with_extension("json"))?, &read(weights)?, simulator);
    Ok(loaded.with_context(|| format!("{} is refused", weights.display()))?.into())
}
