//! The trained model that a command uses.

use std::path::Path;
use std::sync::Arc;

use anyhow::Context as _;

use crate::baseline::library::{find_structure, Library};
use crate::baseline::Baseline;
use crate::simulator::Simulator;

/// Loads the trained model of a structure: from the weights file `model` with its manifest beside it, otherwise the one shipped
/// with the program.
///
/// # Errors
/// A structure or model that is refused, or a structure without a shipped model.
pub fn load(structure: &str, model: Option<&Path>) -> anyhow::Result<Arc<Baseline>> {
    let simulator = find_structure(structure)?;
    let Some(weights) = model else {
        let shipped = Library::open(None)?.get(simulator.id()).and_then(|entry| entry.baseline.clone());
        return shipped
            .with_context(|| format!("no trained model of {} is shipped: give a file with --model", simulator.id()));
    };
    load_files(weights, &simulator)
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
