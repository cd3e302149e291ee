-- An idempotency key belongs to a source of a structure, so that no sender can take the keys of another one. Which token posted a batch is
-- stored, and a token can be limited to sources.
--
-- A constraint of a table cannot be changed, so the tables are made again. Other tables refer to the batches, which are missing for a moment:
-- whether each reference has its batch is looked at when the transaction ends.

alter table api_token add column sources text;  -- JSON list of the sources to which its posts are limited; null = all

-- The source of a key is that of its batch.
create table further_key_2 (
    structure_id    text not null,
    idempotency_key text not null,
    batch_id        text not null,
    primary key (structure_id, idempotency_key, batch_id),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
) strict, without rowid;

insert into further_key_2 select * from further_key;
drop table further_key;
alter table further_key_2 rename to further_key;
create index further_key_by_batch on further_key (structure_id, batch_id);

pragma defer_foreign_keys = on;
-- For each batch that goes and comes, the rows that refer to it are looked up.
create index undamaged_batch_by_batch on undamaged_batch (structure_id, batch_id);

create table kept_batch as select * from measurement_batch;
drop table measurement_batch;

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
    posted_by         text,              -- id of the token with which it was posted; null without one, and in rows from before
    primary key (structure_id, batch_id),
    unique (structure_id, source, idempotency_key)
) strict, without rowid;

insert into measurement_batch select *, null from kept_batch;
drop table kept_batch;
drop index undamaged_batch_by_batch;

create index measurement_batch_by_time on measurement_batch (structure_id, measured_from_us, batch_id);
create index measurement_batch_pending on measurement_batch (structure_id, received_at_us) where state = 'received';
create index measurement_batch_assessed
    on measurement_batch (structure_id, measured_from_us, batch_id) where state = 'assessed';

-- As before: they went with the table.
create trigger batch_counted after insert on measurement_batch
begin
    insert into structure_summary values (new.structure_id, 1, new.measured_to_us)
        on conflict (structure_id) do update
        set batches = batches + 1,
            last_measured_us = max(coalesce(last_measured_us, excluded.last_measured_us), excluded.last_measured_us);
end;

create trigger batch_uncounted after delete on measurement_batch
begin
    update structure_summary
        set batches = batches - 1,
            last_measured_us = iif(old.measured_to_us < last_measured_us, last_measured_us,
                (select max(measured_to_us) from measurement_batch where structure_id = old.structure_id))
        where structure_id = old.structure_id;
end;
