//! Which assessment of a batch is the current one: the one that was stored last.

/// Order of the assessments of a batch in which the current one is first.
pub(super) const CURRENT_FIRST: &str = "assessed_at_us desc, undamaged_version desc, model_digest";

/// Condition that an assessment `a` is the current one of its batch: the first in the order [`CURRENT_FIRST`].
pub(super) const IS_CURRENT: &str = "not exists (
    select 1 from assessment n where n.structure_id = a.structure_id and n.batch_id = a.batch_id
       and (n.assessed_at_us > a.assessed_at_us or n.assessed_at_us = a.assessed_at_us
            and (n.undamaged_version > a.undamaged_version or n.undamaged_version = a.undamaged_version
                 and n.model_digest < a.model_digest)))";
