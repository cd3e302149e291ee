-- What people do with an alarm, notes on the time line, the severity of alarms, and messages by mail.

-- The largest grade that an alarm has had: 0 slight, 1 moderate, 2 severe, 3 critical; null before it was graded.
alter table alarm_episode add column grade integer check (grade between 0 and 3);

-- What people did with alarms. Rows are only ever added: two people who act at the same time both leave a trace.
create table alarm_action (
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
    foreign key (structure_id, episode) references alarm_episode (structure_id, episode),
    unique (structure_id, uid)
) strict;

create index alarm_action_by_alarm on alarm_action (structure_id, episode, action_id);

create table note (
    note_id       text    not null primary key,  -- UUIDv7
    structure_id  text    not null references structure (structure_id),
    from_us       integer not null,
    to_us         integer check (to_us > from_us),  -- null for a moment
    text          text    not null,
    author        text    not null,
    created_at_us integer not null
) strict, without rowid;

create index note_by_time on note (structure_id, from_us);

-- More kinds of events. SQLite changes a check only by a new table; the deliveries move along, because they refer to it.
drop trigger alarm_opened;
drop trigger alarm_changed;
drop trigger alarm_acknowledged;
drop trigger outbox_event_addressed;
drop view alarm_facts;

create table outbox_event_2 (
    event_id      integer primary key autoincrement,
    message_id    text    not null unique,
    kind          text    not null check (kind in
        ('alarm.opened', 'alarm.reopened', 'alarm.ended', 'alarm.withdrawn', 'alarm.acknowledged', 'alarm.worsened',
         'alarm.commented', 'alarm.assigned', 'alarm.closed')),
    structure_id  text    not null references structure (structure_id),
    episode       integer not null,
    alarm_kind    text    not null,
    facts         text    not null,  -- JSON: the alarm as it was then
    created_at_us integer not null
) strict;

insert into outbox_event_2 select * from outbox_event;

create table webhook_delivery_2 (
    delivery_id   integer primary key autoincrement,
    webhook_id    text    not null references webhook (webhook_id) on delete cascade,
    event_id      integer not null references outbox_event_2 (event_id),
    state         text    not null check (state in ('pending', 'delivered', 'dead')),
    attempts      integer not null,
    started_at_us integer not null,
    next_at_us    integer not null,
    last_at_us    integer,
    last_status   integer,
    last_error    text,
    unique (webhook_id, event_id)
) strict;

insert into webhook_delivery_2 select * from webhook_delivery;

drop table webhook_delivery;
drop table outbox_event;
alter table outbox_event_2 rename to outbox_event;
alter table webhook_delivery_2 rename to webhook_delivery;

create index outbox_event_by_age on outbox_event (created_at_us);
create index outbox_event_of_alarm on outbox_event (structure_id, episode, event_id);
create index webhook_delivery_waiting on webhook_delivery (webhook_id, delivery_id) where state = 'pending';
create index webhook_delivery_dead on webhook_delivery (webhook_id) where state = 'dead';
create index webhook_delivery_of_event on webhook_delivery (event_id);
create index webhook_delivery_by_time on webhook_delivery (webhook_id, next_at_us) where state = 'pending';

-- The recipients of the configuration, written at each start.
create table mail_recipient (
    address     text not null primary key,
    events      text not null,  -- JSON list of event kinds
    alarm_kinds text not null   -- JSON list; empty = all
) strict, without rowid;

-- One row for each event and recipient.
create table mail_delivery (
    delivery_id   integer primary key autoincrement,
    address       text    not null,
    event_id      integer not null references outbox_event (event_id),
    state         text    not null check (state in ('pending', 'delivered', 'skipped', 'dead')),  -- skipped: below the least severity
    attempts      integer not null,
    started_at_us integer not null,
    next_at_us    integer not null,
    last_at_us    integer,
    last_error    text,
    unique (address, event_id)
) strict;

create index mail_delivery_by_time on mail_delivery (next_at_us) where state = 'pending';
create index mail_delivery_dead on mail_delivery (delivery_id) where state = 'dead';
create index mail_delivery_of_event on mail_delivery (event_id);

-- The change is the one that the newest batch of the alarm shows; without a process behind the reference it is that of the newest
-- batch by itself. The point of the batch that opens an alarm is stored after the alarm.
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

-- The change of its quantity in the newest batch of a damage alarm: [change, low, high], relative to the reference.
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

-- Late data write episodes again: only one that is in another state than before is news.
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

-- The first grade of an alarm is that of its opening, which was announced.
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

create trigger outbox_event_addressed after insert on outbox_event
begin
    insert into webhook_delivery (webhook_id, event_id, state, attempts, started_at_us, next_at_us)
        select webhook_id, new.event_id, 'pending', 0, new.created_at_us, new.created_at_us from webhook
        where enabled = 1
          and (events = '[]' or exists (select 1 from json_each(events) where value = new.kind))
          and (alarm_kinds = '[]' or exists (select 1 from json_each(alarm_kinds) where value = new.alarm_kind))
          and (structures = '[]' or exists (select 1 from json_each(structures) where value = new.structure_id));
    insert into mail_delivery (address, event_id, state, attempts, started_at_us, next_at_us)
        select address, new.event_id, 'pending', 0, new.created_at_us, new.created_at_us from mail_recipient
        where exists (select 1 from json_each(events) where value = new.kind)
          and (alarm_kinds = '[]' or exists (select 1 from json_each(alarm_kinds) where value = new.alarm_kind));
end;
