-- What the overview says of each structure, kept by the statements that change it: counting a million batches takes a second.

create table structure_summary (
    structure_id     text    not null primary key,
    batches          integer not null check (batches >= 0),
    last_measured_us integer  -- time of the latest measurement; null without batches
) strict, without rowid;

insert into structure_summary
    select structure_id, count(*), max(measured_to_us) from measurement_batch group by structure_id;

create trigger batch_counted after insert on measurement_batch
begin
    insert into structure_summary values (new.structure_id, 1, new.measured_to_us)
        on conflict (structure_id) do update
        set batches = batches + 1,
            last_measured_us = max(coalesce(last_measured_us, excluded.last_measured_us), excluded.last_measured_us);
end;

-- The latest measurement is looked for again only when it is the one that goes.
create trigger batch_uncounted after delete on measurement_batch
begin
    update structure_summary
        set batches = batches - 1,
            last_measured_us = iif(old.measured_to_us < last_measured_us, last_measured_us,
                (select max(measured_to_us) from measurement_batch where structure_id = old.structure_id))
        where structure_id = old.structure_id;
end;

-- Alarms that last are few among all there were.
create index alarm_episode_open
    on alarm_episode (structure_id, kind, acknowledged_at_us) where ended_at_us is null and withdrawn = 0;

-- What a plot over time needs of an assessment: f64, p-value, 1 = rejected, number of findings, then for each quantity by its
-- position mean, the ends of its interval, probability of damage, the ends of its interval; NaN = none. Null in rows from
-- before, whose quantities are read instead.
alter table assessment add column plotted blob;
