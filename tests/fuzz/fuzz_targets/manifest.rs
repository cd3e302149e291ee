//! The manifest beside a weight file: any bytes give a trained model that passes its self-test or a refusal, never a panic, and
//! never more memory than the weight file requires.
#![no_main]

use std::sync::OnceLock;

use libfuzzer_sys::fuzz_target;
use modalwatch::baseline::library::find_structure;
use modalwatch::baseline::Baseline;
use modalwatch::simulator::Simulator;

fn simulator() -> &'static Simulator {
    static SIMULATOR: OnceLock<Simulator> = OnceLock::new();
    SIMULATOR.get_or_init(|| find_structure("three-dof").unwrap())
}

static WEIGHTS: &[u8] = include_bytes!("../../../models/three-dof/baseline.safetensors");

fuzz_target!(|bytes: &[u8]| {
    if let Ok(baseline) = Baseline::load(bytes, WEIGHTS, simulator()) {
        assert_eq!(baseline.space().len(), 3);
    }
});
