-- Undamaged references that a waiting batch is compared with, in the order of their position, instead of the newest one. Version 0: with
-- none. Written by an import, and where another trained model makes all batches wait.
create table kept_comparison (
    structure_id      text    not null,
    batch_id          text    not null,
    position          integer not null,
    undamaged_version integer not null check (undamaged_version >= 0),
    primary key (structure_id, batch_id, position),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
) strict, without rowid;

-- Acknowledgements and other actions on alarms of an archive, until the batches are assessed whose alarms they are about.
create table imported_action (
    structure_id text    not null references structure (structure_id),
    position     integer not null,
    record       text    not null,  -- JSON, a line of the archive
    primary key (structure_id, position)
) strict, without rowid;

-- Idempotency keys that came with a batch that was stored already without them.
create table further_key (
    structure_id    text not null,
    idempotency_key text not null,
    batch_id        text not null,
    primary key (structure_id, idempotency_key),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
) strict, without rowid;

create index further_key_by_batch on further_key (structure_id, batch_id);

-- Structures that are being deleted, in several transactions. The row goes with the last of them.
create table structure_deletion (
    structure_id    text    not null primary key references structure (structure_id),
    requested_at_us integer not null
) strict, without rowid;
