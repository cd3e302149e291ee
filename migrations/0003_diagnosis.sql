-- Diagnoses (what the simulation gets wrong), versions of a structure, and baselines trained by the service itself.

create table diagnosis (
    diagnosis_id   text    not null primary key,  -- UUIDv7
    structure_id   text    not null references structure (structure_id),
    structure_digest text  not null,              -- version that was diagnosed
    request        text    not null,              -- JSON: batches, hold-out, seed, training
    state          text    not null check (state in ('running', 'done', 'failed')),
    failure        text,                          -- why it failed
    result         text,                          -- JSON
    report         text,                          -- HTML
    created_at_us  integer not null,
    finished_at_us integer,
    extension_state   text check (extension_state in ('running', 'done', 'failed')),
    extension_failure text,
    extension         text,                       -- JSON: what was added and left out, digests
    extended_at_us    integer
) strict, without rowid;

create index diagnosis_of_structure on diagnosis (structure_id, diagnosis_id desc);

create table structure_version (
    structure_id  text    not null references structure (structure_id),
    digest        text    not null,  -- SHA-256 of the definition
    definition    text    not null,  -- canonical JSON
    parent_digest text,              -- version that it extends
    diagnosis_id  text,              -- that made it
    created_at_us integer not null,
    primary key (structure_id, digest)
) strict, without rowid;

create table trained_baseline (
    structure_id     text    not null references structure (structure_id),
    structure_digest text    not null,  -- version it was trained for
    model_digest     text    not null,  -- SHA-256 of the manifest
    manifest         blob    not null,
    weights          blob    not null,  -- safetensors
    accepted         integer not null check (accepted in (0, 1)),  -- used although it failed its calibration
    created_at_us    integer not null,
    primary key (structure_id, structure_digest)
) strict, without rowid;
