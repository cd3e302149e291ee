//! The trained model that a command uses.

use std::path::Path;
use std::sync::Arc;

use anyhow::Context as _;

use crate::baseline::library::{find_structure, Library};
use crate::baseline::Baseline;

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
    let read = |path: &Path| std::fs::read(path).with_context(|| format!("cannot read {}", path.display()));
    let loaded = Baseline::load(&read(&weights.with_extension("json"))?, &read(weights)?, &simulator);
    Ok(loaded.with_context(|| format!("{} is refused", weights.display()))?.into())
}
