//! A structure as JSON: any text gives a structure or problems with their place, never a panic and never an endless computation. An
//! accepted structure has finite frequencies, and its canonical form is the same structure.
#![no_main]

use libfuzzer_sys::fuzz_target;
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;

fuzz_target!(|text: &str| {
    let Ok(definition) = StructureDefinition::parse_json(text) else { return };
    let canonical = definition.canonical_json();
    let again = StructureDefinition::parse_json(&canonical).expect("the canonical form is read back");
    assert_eq!(again.canonical_json(), canonical);
    let Ok(simulator) = Simulator::new(definition) else { return };
    assert!(simulator.nominal_frequencies_hz().iter().all(|f| f.is_finite() && *f > 0.0));
    let (low, high) = simulator.frequency_limits_hz();
    assert!(low < high, "{low} to {high}");
    let again = Simulator::new(again).expect("the canonical form is accepted as well");
    assert_eq!(again.digest(), simulator.digest());
});
