//! Moving a structure from one installation to another.
//!
//! An import stores what was measured and declared; the assessments are computed again. They are functions of measurements, trained
//! baseline, undamaged reference and seed, all of which are in the archive, so they are the same to the last bit. Each batch is compared
//! with the references that it was compared with, in the same order.

mod check;
mod error;
mod export;
mod import;
mod lines;

use std::path::Path;
use std::sync::Arc;

use tokio::sync::mpsc::Receiver;

pub use self::error::ImportError;
pub use self::import::Imported;
use super::assessor::Assessor;
use super::error::Error;
use super::replay::Replay;
use crate::quantity::StructureId;

/// Exports and imports structures.
#[derive(Clone)]
pub struct Archive {
    assessor: Arc<Assessor>,
    replay: Replay,
}

impl Archive {
    pub(super) fn new(assessor: Arc<Assessor>, replay: Replay) -> Self {
        Self { assessor, replay }
    }

    /// Returns the lines of the archive of a structure, each with its line end. If the export fails, the last item is an error.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::Store`].
    pub async fn export(&self, structure: &StructureId) -> Result<Receiver<Result<Vec<u8>, Error>>, Error> {
        export::export(&self.assessor, structure).await
    }

    /// Imports an archive: stores what is new in one transaction, assesses the batches that wait, and stores the acknowledgements. If it is
    /// interrupted after the transaction, or fails then, which a warning says, the next start of the service completes it. Repeating an
    /// import changes nothing.
    ///
    /// # Errors
    /// [`ImportError`]; then nothing was stored, unless the store failed at the end of the transaction.
    pub async fn import(&self, path: &Path) -> Result<Imported, ImportError> {
        import::import(&self.assessor, &self.replay, path).await
    }
}
