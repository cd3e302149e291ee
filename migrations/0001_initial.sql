-- Schema rules: every key begins with the structure, times are whole microseconds UTC since 1970, vectors are
-- little-endian f64 blobs in which NaN stands for a missing mode, results stand beside the digest of the baseline that
-- gave them. SQLite stores NaN in a real column as null, so "not null" is also the guard against NaN.

create table structure (
    structure_id  text    not null primary key,
    definition    text    not null,  -- canonical JSON, opaque here
    digest        text    not null,  -- SHA-256 of the definition
    created_at_us integer not null,
    updated_at_us integer not null
) strict, without rowid;

create table measurement_batch (
    structure_id      text    not null references structure (structure_id),
    batch_id          text    not null,  -- UUIDv7
    source            text    not null,
    idempotency_key   text,              -- the client's own, if it gave one
    content_digest    text    not null,  -- SHA-256 of structure, source and measurements
    received_at_us    integer not null,
    measured_from_us  integer not null,
    measured_to_us    integer not null check (measured_to_us >= measured_from_us),
    measurement_count integer not null check (measurement_count > 0),
    state             text    not null check (state in ('received', 'assessed', 'failed')),
    failure           text,              -- why the assessment failed
    primary key (structure_id, batch_id),
    unique (structure_id, idempotency_key)
) strict, without rowid;

create index measurement_batch_by_time on measurement_batch (structure_id, measured_from_us, batch_id);
-- What a restart has to go on with.
create index measurement_batch_pending on measurement_batch (structure_id, received_at_us) where state = 'received';

create table measurement (
    structure_id   text    not null,
    batch_id       text    not null,
    ordinal        integer not null,  -- order in which they came, from 0
    source         text    not null,  -- that of the batch; here for the natural key
    measured_at_us integer not null,
    frequency_hz   blob    not null,  -- f64 for each mode, Hz, NaN = not identified
    std_hz         blob,              -- f64 for each mode, Hz, NaN = not given
    covariates     text    not null,  -- JSON object
    settings       text    not null,  -- JSON object, parameter units
    primary key (structure_id, batch_id, ordinal),
    -- A measurement is known by where and when it was taken: a gateway that repeats itself adds nothing.
    unique (structure_id, source, measured_at_us),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
) strict, without rowid;

create table assessment (
    structure_id          text    not null,
    batch_id              text    not null,
    model_digest          text    not null,  -- of the trained baseline
    undamaged_version     integer not null check (undamaged_version >= 0),  -- 0 = compared with none
    structure_digest      text    not null,
    seed                  integer not null,  -- the 64 bits of the seed
    draws_per_measurement integer not null check (draws_per_measurement > 0),
    measurements_used     integer not null check (measurements_used > 0),
    measurements_left_out integer not null check (measurements_left_out >= 0),
    measurements_outside  integer not null check (measurements_outside >= 0),
    misfit_percent        blob    not null,  -- f64 for each mode, %
    assessed_at_us        integer not null,
    primary key (structure_id, batch_id, model_digest, undamaged_version),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
) strict, without rowid;

create table quantity_assessment (
    structure_id          text    not null,
    batch_id              text    not null,
    model_digest          text    not null,
    undamaged_version     integer not null,
    quantity              text    not null,
    position              integer not null,  -- order of the quantities
    unit                  text    not null,
    kind                  text    not null check (kind in ('parameter', 'spring_stiffness')),
    mean                  real    not null,  -- unit
    std                   real,              -- unit; null for one measurement
    variance_within       real    not null,  -- unit²
    variance_between      real,              -- unit²; null for one measurement
    edge_mass             real    not null check (edge_mass between 0 and 1),  -- –
    threshold             real,              -- unit; null without an undamaged state, and so the next three
    probability_of_damage real check (probability_of_damage between 0 and 1),  -- –
    exceeds               integer check (exceeds in (0, 1)),
    relative_change       real,              -- –
    primary key (structure_id, batch_id, model_digest, undamaged_version, quantity),
    foreign key (structure_id, batch_id, model_digest, undamaged_version)
        references assessment (structure_id, batch_id, model_digest, undamaged_version)
) strict, without rowid;

create index quantity_assessment_exceeding
    on quantity_assessment (structure_id, batch_id) where exceeds = 1;

create table undamaged_state (
    structure_id          text    not null references structure (structure_id),
    version               integer not null check (version > 0),
    model_digest          text    not null,
    created_at_us         integer not null,
    threshold_probability real    not null check (threshold_probability > 0 and threshold_probability <= 0.5),
    measurement_count     integer not null,
    primary key (structure_id, version)
) strict, without rowid;

create table undamaged_batch (
    structure_id text    not null,
    version      integer not null,
    batch_id     text    not null,
    primary key (structure_id, version, batch_id),
    foreign key (structure_id, version) references undamaged_state (structure_id, version),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
) strict, without rowid;

create table undamaged_quantity (
    structure_id text    not null,
    version      integer not null,
    quantity     text    not null,
    position     integer not null,
    mean         real    not null,  -- unit of the quantity
    std          real    not null check (std >= 0),
    threshold    real,              -- null where no change is damage
    primary key (structure_id, version, quantity),
    foreign key (structure_id, version) references undamaged_state (structure_id, version)
) strict, without rowid;
