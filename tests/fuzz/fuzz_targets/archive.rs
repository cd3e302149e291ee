//! An archive of a structure: any lines are imported or refused, never a panic. A refused archive leaves everything as it was; whatever
//! was stored can be read and exported again, and the import of that export changes nothing.
//!
//! The input is the lines without the last, which states the checksum: the target adds it.
#![no_main]

#[path = "../world.rs"]
mod world;

use data_encoding::HEXLOWER;
use libfuzzer_sys::fuzz_target;
use modalwatch::quantity::StructureId;
use sha2::{Digest as _, Sha256};

use crate::world::{with, World};

/// The lines with the last one.
fn whole(lines: &[u8]) -> Vec<u8> {
    let mut archive = lines.to_vec();
    if archive.last().is_some_and(|last| *last != b'\n') {
        archive.push(b'\n');
    }
    let count = archive.iter().filter(|byte| **byte == b'\n').count();
    let sha256 = HEXLOWER.encode(&Sha256::digest(&archive));
    archive.extend(format!("{{\"record\":\"end\",\"lines\":{count},\"sha256\":\"{sha256}\"}}\n").into_bytes());
    archive
}

/// The lines of a structure, without the first, which has the time of the export, and the last.
async fn exported(world: &World, structure: &StructureId) -> Vec<Vec<u8>> {
    let mut lines = world.monitor.archive().export(structure).await.expect("what is stored can be exported");
    let mut found = Vec::new();
    while let Some(line) = lines.recv().await {
        found.push(line.expect("what is stored can be read"));
    }
    found
}

/// All structures that are stored, with their lines.
async fn everything(world: &World) -> Vec<(StructureId, Vec<Vec<u8>>)> {
    let mut all = Vec::new();
    for structure in world.monitor.structures().ids() {
        let lines = exported(world, &structure).await;
        all.push((structure, lines[1..lines.len() - 1].to_vec()));
    }
    all
}

fuzz_target!(|lines: &[u8]| {
    with(async |world| {
        let before = everything(world).await;
        let path = world.folder.path().join("archive.ndjson");
        std::fs::write(&path, whole(lines)).unwrap();
        match world.monitor.archive().import(&path).await {
            Err(refused) => {
                assert!(!refused.to_string().is_empty());
                assert!(everything(world).await == before, "a refused archive has changed something: {refused}");
            }
            Ok(done) => {
                let own = exported(world, &done.structure).await;
                std::fs::write(&path, own.concat()).unwrap();
                let again = world.monitor.archive().import(&path).await.expect("an own archive is accepted");
                assert_eq!((again.batches_new, again.versions, again.notes), (0, 0, 0));
                let after = exported(world, &done.structure).await;
                assert!(
                    after[1..after.len() - 1] == own[1..own.len() - 1],
                    "the import of an own archive changes nothing"
                );
            }
        }
    });
});
