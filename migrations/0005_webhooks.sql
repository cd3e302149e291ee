-- Webhooks and their outbox. Triggers fill it inside the transaction that changes an alarm: a crash cannot lose a message
-- between the two, and an alarm that is only written again as it was sends none.

create table webhook (
    webhook_id        text    not null primary key,  -- UUIDv7
    url               text    not null,
    secret            text    not null,  -- whsec_…; in clear, since every message is signed with it
    previous_secret   text,              -- signs too until previous_until_us
    previous_until_us integer,
    events            text    not null,  -- JSON list of event kinds; empty = all
    alarm_kinds       text    not null,  -- JSON list; empty = all
    structures        text    not null,  -- JSON list of ids; empty = all
    enabled           integer not null check (enabled in (0, 1)),
    created_at_us     integer not null,
    updated_at_us     integer not null
) strict, without rowid;

create table outbox_event (
    event_id      integer primary key autoincrement,  -- order of the messages
    message_id    text    not null unique,  -- the same at every attempt: receivers know a message by it
    kind          text    not null check (kind in
        ('alarm.opened', 'alarm.reopened', 'alarm.ended', 'alarm.withdrawn', 'alarm.acknowledged')),
    structure_id  text    not null references structure (structure_id),
    episode       integer not null,
    alarm_kind    text    not null,
    facts         text    not null,  -- JSON: the alarm as it was then
    created_at_us integer not null
) strict;

create index outbox_event_by_age on outbox_event (created_at_us);

-- One row for each message and webhook that wants it.
create table webhook_delivery (
    delivery_id   integer primary key autoincrement,
    webhook_id    text    not null references webhook (webhook_id) on delete cascade,
    event_id      integer not null references outbox_event (event_id),
    state         text    not null check (state in ('pending', 'delivered', 'dead')),
    attempts      integer not null,
    started_at_us integer not null,  -- retries count from here; later than the event when a dead letter is sent again
    next_at_us    integer not null,  -- of the next attempt, while pending
    last_at_us    integer,
    last_status   integer,           -- HTTP; null when there was no answer
    last_error    text,              -- null when it was taken
    unique (webhook_id, event_id)
) strict;

create index webhook_delivery_waiting on webhook_delivery (webhook_id, delivery_id) where state = 'pending';
create index webhook_delivery_dead on webhook_delivery (webhook_id) where state = 'dead';
create index webhook_delivery_of_event on webhook_delivery (event_id);

-- An alarm as a message says it. An infinite shift has no JSON number.
create view alarm_facts as
    select structure_id, episode, kind as alarm_kind,
           json_object(
               'kind', kind, 'series', series, 'undamaged_version', undamaged_version,
               'opened_at_us', opened_at_us, 'opened_batch', opened_batch, 'ended_at_us', ended_at_us,
               'withdrawn', withdrawn, 'peak_shift', case when abs(peak_shift) < 1e300 then peak_shift end,
               'noticed_at_us', noticed_at_us, 'acknowledged_at_us', acknowledged_at_us,
               'acknowledged_by', acknowledged_by, 'acknowledgement_note', acknowledgement_note) as facts
    from alarm_episode;

-- A batch that comes late may show an alarm that has ended already.
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

create trigger outbox_event_addressed after insert on outbox_event
begin
    insert into webhook_delivery (webhook_id, event_id, state, attempts, started_at_us, next_at_us)
        select webhook_id, new.event_id, 'pending', 0, new.created_at_us, new.created_at_us from webhook
        where enabled = 1
          and (events = '[]' or exists (select 1 from json_each(events) where value = new.kind))
          and (alarm_kinds = '[]' or exists (select 1 from json_each(alarm_kinds) where value = new.alarm_kind))
          and (structures = '[]' or exists (select 1 from json_each(structures) where value = new.structure_id));
end;
