//! What the assessment of a batch is computed from, wherever it is computed: by the service that serves the database, or by a worker.

use std::sync::Arc;

use super::settings::MonitorSettings;
use crate::assessment::{self, Assessment, Context, Draws, Earlier};
use crate::baseline::{assessment_seed, Baseline};
use crate::damage::UndamagedReference;
use crate::quantity::{Digest, Hertz, Timestamp};
use crate::store::{BatchRecord, ReferenceRecord};

/// Numbers of posterior samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Counts {
    /// Of each measurement in the pool.
    pub per_measurement: usize,
    /// Of each measurement for the population.
    pub for_population: usize,
}

impl Counts {
    /// Those of the settings.
    pub(super) const fn of(settings: &MonitorSettings) -> Self {
        Self { per_measurement: settings.draws_per_measurement, for_population: settings.draws_for_population }
    }

    /// With the seed for a batch.
    pub(super) fn draws(self, baseline: &Baseline, content_digest: &Digest) -> Draws {
        Draws {
            per_measurement: self.per_measurement,
            for_population: self.for_population,
            seed: assessment_seed(content_digest, baseline.digest()),
        }
    }
}

/// All that the assessment of a batch depends on.
pub(super) struct Computation {
    baseline: Arc<Baseline>,
    record: Arc<BatchRecord>,
    earlier: Earlier,
    undamaged: Option<Arc<ReferenceRecord>>,
    draws: Draws,
}

impl Computation {
    /// The computation for a batch; `earlier` is what was measured before it, and `undamaged` is the reference that it is compared with if the two are comparable.
    pub(super) fn new(
        baseline: Arc<Baseline>,
        record: Arc<BatchRecord>,
        earlier: Earlier,
        undamaged: Option<Arc<ReferenceRecord>>,
        counts: Counts,
    ) -> Self {
        let undamaged = undamaged.filter(|undamaged| is_comparable(&baseline, &record, undamaged));
        let draws = counts.draws(&baseline, &record.content_digest);
        Self { baseline, record, earlier, undamaged, draws }
    }

    /// The trained baseline.
    pub(super) fn baseline(&self) -> &Baseline {
        &self.baseline
    }

    /// The undamaged reference that the batch is compared with.
    pub(super) fn undamaged(&self) -> Option<&UndamagedReference> {
        self.undamaged.as_deref().map(|record| &record.state)
    }

    /// Computes the assessment.
    ///
    /// # Errors
    /// [`assessment::Error`].
    pub(super) fn assess(&self, assessed_at: Timestamp) -> Result<Assessment, assessment::Error> {
        let context = Context { undamaged: self.undamaged(), earlier: Some(&self.earlier) };
        assessment::assess(&self.baseline, &self.record.batch.measurements, context, self.draws, assessed_at)
    }

    /// Digest of everything that the result depends on: two computations with equal digests have the same result, bit for bit. `program` is
    /// what must be equal of the program and its machine.
    pub(super) fn inputs(&self, program: &str) -> Digest {
        let frequency = |frequency: &Option<Hertz>| match frequency {
            Some(hertz) => hertz.get().to_le_bytes(),
            None => f64::NAN.to_le_bytes(),
        };
        let Earlier { previous, rows } = &self.earlier;
        let previous = match previous {
            Some(frequencies) => [1].into_iter().chain(frequencies.iter().flat_map(frequency)).collect::<Vec<u8>>(),
            None => vec![0],
        };
        let earlier: Vec<u8> = rows.iter().flatten().flat_map(frequency).collect();
        let undamaged = self.undamaged.as_ref().map_or_else(Vec::new, |record| {
            let (version, created_us) = (record.state.version, record.created_at.micros());
            [&version.to_le_bytes()[..], &created_us.to_le_bytes(), record.model_digest.as_str().as_bytes()].concat()
        });
        let numbers = [self.draws.per_measurement as u64, self.draws.for_population as u64, self.draws.seed];
        Digest::of(&[
            program.as_bytes(),
            self.baseline.simulator().digest().as_str().as_bytes(),
            self.baseline.digest().as_str().as_bytes(),
            self.record.batch_id.as_bytes(),
            self.record.content_digest.as_str().as_bytes(),
            &previous,
            &earlier,
            &undamaged,
            &numbers.map(u64::to_le_bytes).concat(),
        ])
    }
}

/// Whether a batch is compared with an undamaged reference: one made with the same trained baseline and without the batch.
pub(super) fn is_comparable(baseline: &Baseline, record: &BatchRecord, undamaged: &ReferenceRecord) -> bool {
    undamaged.model_digest == *baseline.digest() && !undamaged.batches.contains(&record.batch_id)
}
