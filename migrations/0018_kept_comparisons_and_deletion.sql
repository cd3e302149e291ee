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

-- Alarms of the kind not_assessed. A check of a column cannot be changed, so the table is made again, and that of the actions, which refers
-- to it; views and triggers are as before.
drop view alarm_facts;
drop view alarm_batch_change;

create table alarm_episode_2 (
    structure_id         text    not null references structure (structure_id),
    episode              integer not null check (episode > 0),
    kind                 text    not null check (kind in ('damage', 'simulation_does_not_fit', 'silence', 'not_assessed')),
    series               text    not null,  -- parameter of a damage alarm, 'simulation:fit', 'structure:silence', or 'structure:not_assessed'
    undamaged_version    integer not null,
    opened_at_us         integer not null,  -- time of the measurement that made it an alarm
    opened_batch         text,              -- null for silence
    ended_at_us          integer,           -- null while it lasts
    withdrawn            integer not null check (withdrawn in (0, 1)),  -- late data showed that there was none
    peak_shift           real    not null,  -- standard errors
    noticed_at_us        integer not null,  -- when the service raised it
    acknowledged_at_us   integer,
    acknowledged_by      text,
    acknowledgement_note text,
    grade                integer check (grade between 0 and 3),
    primary key (structure_id, episode)
) strict, without rowid;

insert into alarm_episode_2 select * from alarm_episode;

create table alarm_action_2 (
    action_id    integer primary key autoincrement,  -- order in which they were stored
    structure_id text    not null,
    episode      integer not null,
    uid          text    not null,  -- UUIDv7, the same in every installation that imports it
    kind         text    not null check (kind in ('comment', 'assignment', 'closing', 'reopening')),
    at_us        integer not null,
    author       text    not null,
    text         text,
    reason       text check ((kind = 'closing') = (reason is not null)),
    assignee     text check (kind = 'assignment' or assignee is null),  -- null = nobody any more
    imported     integer not null check (imported in (0, 1)),  -- from an archive: sends no messages
    foreign key (structure_id, episode) references alarm_episode_2 (structure_id, episode),
    unique (structure_id, uid)
) strict;

insert into alarm_action_2 select * from alarm_action;

drop table alarm_action;
drop table alarm_episode;
alter table alarm_episode_2 rename to alarm_episode;
alter table alarm_action_2 rename to alarm_action;

create index alarm_episode_by_series on alarm_episode (structure_id, kind, series, opened_at_us);

create index alarm_episode_open
    on alarm_episode (structure_id, kind, acknowledged_at_us) where ended_at_us is null and withdrawn = 0;

create index alarm_action_by_alarm on alarm_action (structure_id, episode, action_id);

create view alarm_facts as
    select structure_id, episode, kind as alarm_kind,
           json_object(
               'kind', kind, 'series', series, 'undamaged_version', undamaged_version,
               'opened_at_us', opened_at_us, 'opened_batch', opened_batch, 'ended_at_us', ended_at_us,
               'withdrawn', withdrawn, 'peak_shift', case when abs(peak_shift) < 1e300 then peak_shift end,
               'noticed_at_us', noticed_at_us, 'acknowledged_at_us', acknowledged_at_us,
               'acknowledged_by', acknowledged_by, 'acknowledgement_note', acknowledgement_note,
               'change', (select json(p.changes -> e.series) from process_point p
                          where p.structure_id = e.structure_id and p.undamaged_version = e.undamaged_version
                            and p.measured_to_us between e.opened_at_us and coalesce(e.ended_at_us, 9e18)
                            and p.changes -> e.series is not null
                          order by p.measured_to_us desc, p.batch_id desc limit 1),
               'batch_change', (select json(batch_change) from alarm_batch_change b
                                where b.structure_id = e.structure_id and b.episode = e.episode)) as facts
    from alarm_episode e;

create view alarm_batch_change as
    select e.structure_id, e.episode,
           (select json_array(q.relative_change, q.change_low, q.change_high) from quantity_assessment q
            where q.structure_id = e.structure_id and q.undamaged_version = e.undamaged_version and q.quantity = e.series
              and q.relative_change is not null and q.change_low is not null and q.change_high is not null
              and q.batch_id = coalesce(
                  (select p.batch_id from chart_point p
                   where p.structure_id = e.structure_id and p.undamaged_version = e.undamaged_version and p.series = e.series
                     and p.measured_to_us between e.opened_at_us and coalesce(e.ended_at_us, 9e18) and p.above = 1
                   order by p.measured_to_us desc, p.batch_id desc limit 1), e.opened_batch)
            limit 1) as batch_change
    from alarm_episode e where e.kind = 'damage';

create trigger alarm_opened after insert on alarm_episode when new.withdrawn = 0
begin
    insert into outbox_event (message_id, kind, structure_id, episode, alarm_kind, facts, created_at_us)
        select 'msg_' || lower(hex(randomblob(16))), 'alarm.opened', structure_id, episode, alarm_kind, facts,
               cast(unixepoch('now', 'subsec') * 1000000 as integer)
        from alarm_facts where structure_id = new.structure_id and episode = new.episode;
    insert into outbox_event (message_id, kind, structure_id, episode, alarm_kind, facts, created_at_us)
        select 'msg_' || lower(hex(randomblob(16))), 'alarm.ended', structure_id, episode, alarm_kind, facts,
               cast(unixepoch('now', 'subsec') * 1000000 as integer)
        from alarm_facts where structure_id = new.structure_id and episode = new.episode and new.ended_at_us is not null;
end;

create trigger alarm_changed after update on alarm_episode
    when iif(new.withdrawn, 'withdrawn', iif(new.ended_at_us is null, 'reopened', 'ended'))
      <> iif(old.withdrawn, 'withdrawn', iif(old.ended_at_us is null, 'reopened', 'ended'))
begin
    insert into outbox_event (message_id, kind, structure_id, episode, alarm_kind, facts, created_at_us)
        select 'msg_' || lower(hex(randomblob(16))),
               'alarm.' || iif(new.withdrawn, 'withdrawn', iif(new.ended_at_us is null, 'reopened', 'ended')),
               structure_id, episode, alarm_kind, facts, cast(unixepoch('now', 'subsec') * 1000000 as integer)
        from alarm_facts where structure_id = new.structure_id and episode = new.episode;
end;

create trigger alarm_acknowledged after update on alarm_episode
    when old.acknowledged_at_us is null and new.acknowledged_at_us is not null
begin
    insert into outbox_event (message_id, kind, structure_id, episode, alarm_kind, facts, created_at_us)
        select 'msg_' || lower(hex(randomblob(16))), 'alarm.acknowledged', structure_id, episode, alarm_kind, facts,
               cast(unixepoch('now', 'subsec') * 1000000 as integer)
        from alarm_facts where structure_id = new.structure_id and episode = new.episode;
end;

create trigger alarm_worsened after update of grade on alarm_episode
    when old.grade is not null and new.grade > old.grade and new.withdrawn = 0
begin
    insert into outbox_event (message_id, kind, structure_id, episode, alarm_kind, facts, created_at_us)
        select 'msg_' || lower(hex(randomblob(16))), 'alarm.worsened', structure_id, episode, alarm_kind, facts,
               cast(unixepoch('now', 'subsec') * 1000000 as integer)
        from alarm_facts where structure_id = new.structure_id and episode = new.episode;
end;

create trigger alarm_acted_on after insert on alarm_action when new.imported = 0
begin
    insert into outbox_event (message_id, kind, structure_id, episode, alarm_kind, facts, created_at_us)
        select 'msg_' || lower(hex(randomblob(16))),
               case new.kind when 'comment' then 'alarm.commented' when 'assignment' then 'alarm.assigned'
                             when 'closing' then 'alarm.closed' else 'alarm.reopened' end,
               structure_id, episode, alarm_kind,
               json_set(facts, '$.action', json_object('kind', new.kind, 'at_us', new.at_us, 'author', new.author,
                   'text', new.text, 'reason', new.reason, 'assignee', new.assignee)),
               cast(unixepoch('now', 'subsec') * 1000000 as integer)
        from alarm_facts where structure_id = new.structure_id and episode = new.episode;
end;

