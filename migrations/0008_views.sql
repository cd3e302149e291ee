-- For the overview and the list of jobs.

-- The newest assessed batch of a structure, however many wait behind it.
create index measurement_batch_assessed
    on measurement_batch (structure_id, measured_from_us, batch_id) where state = 'assessed';

alter table diagnosis add column extension_begun_at_us integer;  -- null in rows from before
