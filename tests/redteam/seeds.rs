//! The fuzz targets of `tests/fuzz` on the inputs from which fuzzing starts, and on damaged copies of them.
//!
//! `tests/fuzz/run` looks for new inputs for hours and has a workspace of its own. Here each target is compiled and run for seconds, so that
//! a change of an interface or of what it promises is seen with the change.

use std::path::{Path, PathBuf};

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// Damaged copies of each input.
const COPIES: usize = 24;

/// What a target is given, made of bytes as `libfuzzer_sys` does it.
pub trait Input {
    fn of(bytes: &[u8]) -> Option<&Self>;
}

impl Input for [u8] {
    fn of(bytes: &[u8]) -> Option<&Self> {
        Some(bytes)
    }
}

impl Input for str {
    fn of(bytes: &[u8]) -> Option<&Self> {
        std::str::from_utf8(bytes).ok()
    }
}

/// Takes the place of the macro of `libfuzzer_sys`: the target as a function.
mod target {
    macro_rules! fuzz_target {
        (|$input:ident: &$kind:ty| $body:block) => {
            pub fn run(bytes: &[u8]) {
                if let Some($input) = <$kind as crate::redteam::seeds::Input>::of(bytes) $body
            }
        };
    }
    pub(crate) use fuzz_target;
}
pub(crate) use target::fuzz_target;

/// The monitor of the targets that store something.
#[path = "../fuzz/world.rs"]
#[allow(clippy::duplicate_mod, clippy::await_holding_refcell_ref, reason = "one thread runs one input at a time")]
pub mod world;

#[path = "../fuzz/fuzz_targets/archive.rs"]
#[allow(
    unused_attributes,
    dead_code,
    clippy::duplicate_mod,
    clippy::await_holding_refcell_ref,
    clippy::naive_bytecount,
    reason = "a program of its own"
)]
mod archive;
#[path = "../fuzz/fuzz_targets/csv_table.rs"]
#[allow(unused_attributes, reason = "a program of its own")]
mod csv_table;
#[path = "../fuzz/fuzz_targets/json_batch.rs"]
#[allow(unused_attributes, reason = "a program of its own")]
mod json_batch;
#[path = "../fuzz/fuzz_targets/manifest.rs"]
#[allow(unused_attributes, reason = "a program of its own")]
mod manifest;
#[path = "../fuzz/fuzz_targets/mqtt_message.rs"]
#[allow(
    unused_attributes,
    dead_code,
    clippy::duplicate_mod,
    clippy::await_holding_refcell_ref,
    reason = "a program of its own"
)]
mod mqtt_message;
#[path = "../fuzz/fuzz_targets/structure_json.rs"]
#[allow(unused_attributes, reason = "a program of its own")]
mod structure_json;
#[path = "../fuzz/fuzz_targets/structure_toml.rs"]
#[allow(unused_attributes, reason = "a program of its own")]
mod structure_toml;
#[path = "../fuzz/fuzz_targets/table_columns.rs"]
#[allow(unused_attributes, reason = "a program of its own")]
mod table_columns;

/// A copy of which a part is missing, repeated or replaced by other bytes.
fn damaged(input: &[u8], rng: &mut ChaCha8Rng) -> Vec<u8> {
    let place = |rng: &mut ChaCha8Rng| rng.random_range(0..=input.len());
    let (a, b) = (place(rng), place(rng));
    let (from, to) = (a.min(b), a.max(b));
    match rng.random_range(0..4) {
        0 => input[..to].to_vec(),
        1 => [&input[..from], &input[to..]].concat(),
        2 => [&input[..to], &input[from..]].concat(),
        _ => {
            let mut copy = input.to_vec();
            for _ in 0..4 {
                if let Some(byte) = copy.get_mut(place(rng)) {
                    *byte = rng.random();
                }
            }
            copy
        }
    }
}

/// Runs a target on each file and on damaged copies of it. A panic of the target is the failure; the file was printed before.
fn run(target: fn(&[u8]), files: impl IntoIterator<Item = impl AsRef<Path>>) {
    let mut count = 0;
    for file in files {
        println!("{}", file.as_ref().display());
        let input = std::fs::read(file).unwrap();
        target(&input);
        count += 1;
        let mut rng = ChaCha8Rng::seed_from_u64(count);
        for _ in 0..COPIES {
            target(&damaged(&input, &mut rng));
        }
    }
    assert!(count > 0, "no input");
}

/// What is in a folder of the repository, in the order of the names.
fn entries(folder: &str) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
    let mut paths: Vec<PathBuf> = folder.read_dir().unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    paths
}

/// The inputs of `tests/fuzz/seeds` for a target.
fn seeds(name: &str) -> Vec<PathBuf> {
    entries(&format!("tests/fuzz/seeds/{name}"))
}

#[test]
fn archives() {
    run(archive::run, seeds("archive"));
}

#[test]
fn batches() {
    run(json_batch::run, seeds("json_batch"));
}

#[test]
fn tables() {
    run(csv_table::run, seeds("csv_table"));
    run(table_columns::run, seeds("table_columns"));
}

#[test]
fn messages_of_a_broker() {
    run(mqtt_message::run, seeds("mqtt_message"));
}

#[test]
fn structures() {
    run(structure_json::run, seeds("structure_json"));
    let shipped = entries("models").into_iter().map(|model| model.join("structure.toml")).filter(|file| file.is_file());
    run(structure_toml::run, seeds("structure_toml").into_iter().chain(shipped));
}

#[test]
fn manifests_of_models() {
    run(manifest::run, [Path::new(env!("CARGO_MANIFEST_DIR")).join("models/three-dof/baseline.json")]);
}
