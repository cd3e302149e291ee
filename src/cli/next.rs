//! `--next`: the data of an earlier diagnosis, joined with what was measured after it.

use std::path::{Path, PathBuf};

use anyhow::{bail, Context as _};
use serde::Deserialize;

use super::tables::{read_tables, TableArgs, Tables};
use crate::discrepancy::data::Data;
use crate::discrepancy::describe::Cause;
use crate::measurement::ModalMeasurement;
use crate::quantity::{Digest, Timestamp};
use crate::simulator::Simulator;

/// What is needed of an earlier result.
#[derive(Deserialize)]
struct EarlierResult {
    structure: String,
    causes: Vec<Cause>,
    structure_digest: Digest,
    data_digest: Digest,
}

/// The causes that the earlier result names, the joined data, and notes on both tables.
pub(super) struct Joined {
    pub(super) earlier: Vec<Cause>,
    pub(super) data: Data,
    pub(super) notes: Vec<String>,
}

/// Reads an earlier result, checks that `data` and the structure are those that it was made from, and joins the rows of
/// `further` to them. The structure may have more modes than before, or mode shapes; the earlier rows then lack them.
///
/// # Errors
/// A file that is not the JSON of a diagnosis; a structure that differs in more than its modes; data with another digest; tables
/// that cannot be joined.
pub(super) fn join(
    simulator: &Simulator,
    earlier: &Path,
    (data, further): (&[PathBuf], &[PathBuf]),
    how: &TableArgs<'_>,
) -> anyhow::Result<Joined> {
    let text = std::fs::read_to_string(earlier).with_context(|| format!("cannot read {}", earlier.display()))?;
    let result: EarlierResult = serde_json::from_str(&text).with_context(|| {
        format!("{} is not the result of a diagnosis: write it with `modalwatch diagnose --json`", earlier.display())
    })?;
    let then = simulator_then(simulator, &result)?;
    let old = read_tables(&then, data, how)?;
    let digest = Data::new(&then, &old.measurements).digest;
    if digest != result.data_digest {
        bail!(
            "the files of --data are not those of {}: their digest is {digest}, and the result states {}; give the same files in the \
             same order, with the same --time, --settings and --ignore, and the new rows with --further",
            earlier.display(),
            result.data_digest
        );
    }
    let new = read_tables(simulator, further, how).context("the tables of --further")?;
    joined(simulator, result, old, new)
}

/// The simulator of the earlier diagnosis: the present one, or the same with fewer modes or without mode shapes.
fn simulator_then(simulator: &Simulator, earlier: &EarlierResult) -> anyhow::Result<Simulator> {
    if *simulator.digest() == earlier.structure_digest {
        return Ok(simulator.clone());
    }
    for modes in (1..=simulator.modes()).rev() {
        for shapes in [simulator.definition().mode_shapes.clone(), None] {
            let mut definition = simulator.definition().clone();
            (definition.modes, definition.mode_shapes) = (modes, shapes);
            if definition.digest() == earlier.structure_digest {
                return Simulator::new(definition).context("the structure of the earlier diagnosis");
            }
        }
    }
    bail!(
        "the structure {} is not that of the earlier diagnosis ({}): its digest is {}, and the result states {}; since then only `modes` \
         may have become larger, and `mode_shapes` may have been added",
        simulator.id(),
        earlier.structure,
        simulator.digest(),
        earlier.structure_digest
    );
}

/// Joins the rows of both tables.
fn joined(simulator: &Simulator, earlier: EarlierResult, old: Tables, new: Tables) -> anyhow::Result<Joined> {
    if old.timed != new.timed {
        let (with, without) = if old.timed { ("--data", "--further") } else { ("--further", "--data") };
        bail!(
            "the tables of {with} state times and those of {without} do not: state the time of every row, or of none"
        );
    }
    let modes = simulator.modes();
    let padded = |mut m: ModalMeasurement| {
        m.frequencies_hz.resize(modes, None);
        if let Some(stds) = &mut m.std_hz {
            stds.resize(modes, None);
        }
        if let Some(shapes) = &mut m.mode_shapes {
            shapes.resize(modes, None);
        }
        m
    };
    let before: Vec<ModalMeasurement> = old.measurements.into_iter().map(padded).collect();
    let mut after = new.measurements;
    if !new.timed {
        // The times only count rows: those of the further rows follow the earlier ones.
        let last = before.iter().map(|m| m.measured_at.micros()).max().unwrap_or_default() + 1_000_000;
        for m in &mut after {
            m.measured_at = Timestamp::from_micros(m.measured_at.micros() + last)?;
        }
    }
    let data = Data::joined(simulator, &before, &after);
    let data = if new.timed { data } else { data.by_order() };
    let mut notes = old.notes;
    notes.extend(new.notes.into_iter().map(|note| format!("further rows: {note}")));
    notes.push(format!(
        "{} rows of an earlier diagnosis and {} further rows are used together",
        before.len(),
        after.len()
    ));
    Ok(Joined { earlier: earlier.causes, data, notes })
}
