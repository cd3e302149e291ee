-- Computations that the service which serves the database shares with other processes: the assessments of batches that wait.
--
-- Nothing here is lasting. Whatever is missing is computed by the service itself, so these tables are neither moved nor needed in a copy.
-- Their times are those of the server's clock.

-- Processes that compute, and when they were last heard of.
create table computation_worker (
    worker   text collate "C" not null primary key,
    program  text collate "C" not null,  -- what must be equal for equal results
    heard_at timestamptz      not null
);

-- The number of a claim: each is larger than all before.
create sequence computation_fence;

-- The waiting batches of a structure whose first measurement is in one month.
create table computation_piece (
    structure_id          text collate "C" not null references structure (structure_id) on delete cascade,
    from_us               bigint           not null,  -- the month, from its first microsecond …
    to_us                 bigint           not null,  -- … to before this one
    -- What the batches are computed with.
    program               text collate "C" not null,
    structure_digest      text collate "C" not null,
    model_digest          text collate "C" not null,
    draws_per_measurement bigint           not null,
    draws_for_population  bigint           not null,
    first_received_us     bigint           not null,  -- arrival of the first of its batches: pieces are claimed in this order
    worker                text collate "C",           -- who computes it; null: nobody
    fence                 bigint           not null,  -- the number of the last claim
    attempts              bigint           not null,
    lease_until           timestamptz,                -- the claim holds until then unless it is renewed
    free_since            timestamptz      not null,  -- since when nobody has held it, apart from a lease that ran out
    primary key (structure_id, from_us)
);

-- Assessments that were computed and not yet stored by the service that serves the database.
create table computation_result (
    structure_id text collate "C" not null references structure (structure_id) on delete cascade,
    batch_id     text collate "C" not null,
    inputs       text collate "C" not null,  -- digest of all that the result depends on
    fence        bigint           not null,  -- the claim under which it was computed
    failed       boolean          not null,
    content      text             not null,  -- the assessment, or why it failed
    primary key (structure_id, batch_id)
);
