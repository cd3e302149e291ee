-- Models that the service trains for a structure by request.
create table training (
    training_id      text    not null primary key,  -- UUIDv7
    structure_id     text    not null references structure (structure_id),
    structure_digest text    not null,              -- version that the model is for
    request          text    not null,              -- JSON: samples, epochs, seed and so on
    state            text    not null check (state in ('waiting', 'done', 'failed', 'cancelled')),
    interruptions    integer not null default 0,    -- unexpected ends of the program since the last orderly one
    failure          text,                          -- why it failed
    result           text,                          -- JSON
    created_at_us    integer not null,
    finished_at_us   integer
) strict, without rowid;

create index training_of_structure on training (structure_id, training_id desc);
create index training_created on training (created_at_us);

-- Jobs that somebody ended have the state 'failed' and a time here.
alter table diagnosis add column cancelled_at_us integer;
alter table diagnosis add column extension_cancelled_at_us integer;

-- How an extension is trained, JSON, so that it can begin again after a stop of the service. Null in rows from before.
alter table diagnosis add column extension_request text;
alter table diagnosis add column extension_interruptions integer not null default 0;
