//! Export of a structure as an archive.

use data_encoding::HEXLOWER;
use sha2::{Digest as _, Sha256};
use tokio::sync::mpsc::{channel, Receiver};

use super::lines::line_of;
use crate::clock;
use crate::monitor::assessor::Assessor;
use crate::monitor::error::Error;
use crate::quantity::StructureId;
use crate::store::archive::{ArchivedModel, End, Head, Record, FORMAT, NOT_CARRIED};

/// Lines buffered between store and reader.
const BUFFERED: usize = 64;

/// Returns the lines of the archive of a structure, each with its line end. If the export fails, the last item is an error.
pub(super) async fn export(
    assessor: &Assessor,
    structure: &StructureId,
) -> Result<Receiver<Result<Vec<u8>, Error>>, Error> {
    let active = assessor.structures.get(structure)?;
    let mut models = assessor.store.archive().trained_models(structure).await?;
    if let Ok(baseline) = &active.baseline {
        let digest = baseline.digest().clone();
        if !models.iter().any(|model| model.model_digest == digest.as_str()) {
            let library = assessor.structures.library();
            let wanted = digest.clone();
            let files = tokio::task::spawn_blocking(move || library.files_of(&wanted)).await;
            if let Some(files) = files.map_err(|_| Error::Panicked)?.ok().flatten() {
                let version = baseline.manifest().structure_digest.to_string();
                let accepted = !baseline.manifest().calibration.failures.is_empty();
                models.push(ArchivedModel::new(&version, digest.as_str(), &files.manifest, &files.weights, accepted));
            }
        }
    }
    let head = Record::Archive(Head {
        format: FORMAT,
        structure: structure.clone(),
        exported_at: clock::now().to_string(),
        program_version: env!("CARGO_PKG_VERSION").to_owned(),
        settings: assessor.settings.of_answers(),
        not_carried: NOT_CARRIED.to_owned(),
    });
    let (records, mut taken) = channel(BUFFERED);
    let (lines, receiver) = channel(BUFFERED);
    let (store, id) = (assessor.store.clone(), structure.clone());
    tokio::spawn(async move {
        let sender = records.clone();
        let read = tokio::spawn(async move {
            // An error means that the receiver was dropped, which the other task notices by itself.
            let _ = sender.send(head).await;
            store.archive().export(&id, models, &sender).await
        });
        drop(records);
        let (mut hasher, mut count) = (Sha256::new(), 0_u64);
        while let Some(record) = taken.recv().await {
            let line = line_of(&record);
            hasher.update(&line);
            count += 1;
            if lines.send(Ok(line)).await.is_err() {
                return;
            }
        }
        let last = match read.await {
            Ok(Ok(())) => Ok(line_of(&Record::End(End { lines: count, sha256: HEXLOWER.encode(&hasher.finalize()) }))),
            Ok(Err(error)) => Err(Error::Store(error)),
            Err(_) => Err(Error::Panicked),
        };
        let _ = lines.send(last).await;
    });
    Ok(receiver)
}
