//! Checks of the trained models: each is loaded with its self-test, and its recorded calibration is reported.

use super::check::Check;
use crate::baseline::library::Library;
use crate::baseline::manifest::Outcome;
use crate::baseline::Baseline;
use crate::config::Config;
use crate::simulator::definition::StructureDefinition;
use crate::simulator::Simulator;
use crate::store::inspect::Inspection;

/// The models shipped with the program and those in the models folder.
pub fn library(config: &Config) -> Vec<Check> {
    let library = match Library::open(config.models_dir.as_deref()) {
        Ok(library) => library,
        Err(error) => return vec![Check::fail("models", error.to_string(), "correct models_dir")],
    };
    let mut checks = Vec::new();
    for refusal in library.refusals() {
        let next = "train it again with `modalwatch train`, or replace the files";
        checks.push(Check::fail("models", format!("{} is refused: {}", refusal.file, refusal.reason), next));
    }
    for (id, entry) in library.iter() {
        let name = format!("model of {id}");
        match &entry.baseline {
            Some(baseline) => checks.push(calibrated(name, baseline, &config.monitor.accept_uncalibrated)),
            None if library.refusals().iter().any(|refusal| refusal.structure.as_ref() == Some(id)) => {}
            None => {
                let next = format!("modalwatch train --structure {id}");
                checks.push(Check::warn(name, "the structure has no trained model", next));
            }
        }
    }
    checks
}

/// The models that the service trained itself, which are in the database.
pub fn trained(inspection: &Inspection) -> Vec<Check> {
    let mut checks = Vec::new();
    for (id, definition, stored) in &inspection.structures {
        let simulator = StructureDefinition::parse_json(definition).and_then(Simulator::new);
        let simulator = match simulator {
            Ok(simulator) => simulator,
            Err(error) => {
                let next = "use the version of modalwatch that stored it";
                checks.push(Check::fail(
                    format!("structure {id}"),
                    format!("its stored definition is refused: {error}"),
                    next,
                ));
                continue;
            }
        };
        let Some(stored) = stored else { continue };
        let name = format!("trained model of {id}");
        checks.push(match Baseline::load(&stored.manifest, &stored.weights, &simulator) {
            Ok(baseline) => {
                let accepted = if stored.accepted { vec![stored.model_digest.clone()] } else { Vec::new() };
                calibrated(name, &baseline, &accepted)
            }
            Err(error) => {
                let next = format!("go back to the previous version: DELETE /v1/structures/{id}/extension");
                Check::fail(name, error.to_string(), next)
            }
        });
    }
    checks
}

fn calibrated(name: String, baseline: &Baseline, accepted: &[String]) -> Check {
    let calibration = &baseline.manifest().calibration;
    let digest = baseline.digest().as_str();
    let short = digest.get(..12).unwrap_or(digest);
    match calibration.outcome() {
        Outcome::Passed => {
            return Check::ok(name, format!("{short}… loads, passes its self-test and its calibration"));
        }
        Outcome::NotMeasured => {
            let found = format!("{short}… loads and passes its self-test; its calibration was not measured, because it was made in a second");
            return Check::ok(name, found);
        }
        Outcome::Cautious => {
            let found = format!("{short}… is cautious, and may be used: {}", calibration.cautions.join("; "));
            return Check::warn(name, found, "train it again with more epochs for narrower intervals");
        }
        Outcome::Overconfident => {}
    }
    let found = format!("{short}… is overconfident: {}", calibration.failures.join("; "));
    if accepted.iter().any(|accepted| accepted == digest) {
        return Check::warn(
            name,
            format!("{found}; it is used nevertheless, because it was accepted"),
            "train it again with more samples or epochs",
        );
    }
    let next = format!("train it again with more samples or epochs, or add {digest} to monitor.accept_uncalibrated");
    Check::fail(name, found, next)
}
