-- Diagnoses, trainings and extensions whose computation the service that serves the database leaves to a worker.
--
-- As with the other computations, nothing here is lasting: what is missing is computed by the service itself.

create table computation_job (
    job_id       text collate "C" not null,  -- of the diagnosis or training
    kind         text collate "C" not null,  -- diagnosis, extension, training
    structure_id text collate "C" not null references structure (structure_id) on delete cascade,
    program      text collate "C" not null,  -- what must be equal for equal results
    task         text             not null,  -- what is computed, JSON
    offered_by   text collate "C" not null,  -- the worker in the process of the service, which leaves it to others
    worker       text collate "C",           -- who computes it; null: nobody
    fence        bigint           not null,  -- the number of the last claim
    lease_until  timestamptz,                -- the claim holds until then unless it is renewed
    free_since   timestamptz      not null,  -- since when nobody has held it, apart from a lease that ran out
    progress     text,                       -- what it is doing, JSON
    failed       boolean,                    -- whether there is no result; null: it has not ended
    content      text,                       -- the result without the weights of its model, JSON; or why there is none
    weights      bytea,                      -- weights of the model that was trained
    primary key (job_id, kind)
);
