-- One event is announced once. An alarm of all parameters together ('structure:joint') whose event the alarm of a single parameter has
-- announced at the same time or before sends no messages of its own, until no such alarm covers it any more.

alter table alarm_episode add column held_back integer not null default 0 check (held_back in (0, 1));

drop trigger alarm_opened;
drop trigger alarm_changed;
drop trigger alarm_worsened;

create trigger alarm_opened after insert on alarm_episode when new.withdrawn = 0 and new.held_back = 0
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

create trigger alarm_announced after update of held_back on alarm_episode when old.held_back = 1 and new.held_back = 0
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
    when new.held_back = 0 and old.held_back = 0
     and iif(new.withdrawn, 'withdrawn', iif(new.ended_at_us is null, 'reopened', 'ended'))
      <> iif(old.withdrawn, 'withdrawn', iif(old.ended_at_us is null, 'reopened', 'ended'))
begin
    insert into outbox_event (message_id, kind, structure_id, episode, alarm_kind, facts, created_at_us)
        select 'msg_' || lower(hex(randomblob(16))),
               'alarm.' || iif(new.withdrawn, 'withdrawn', iif(new.ended_at_us is null, 'reopened', 'ended')),
               structure_id, episode, alarm_kind, facts, cast(unixepoch('now', 'subsec') * 1000000 as integer)
        from alarm_facts where structure_id = new.structure_id and episode = new.episode;
end;

create trigger alarm_worsened after update of grade on alarm_episode
    when old.grade is not null and new.grade > old.grade and new.withdrawn = 0 and new.held_back = 0
begin
    insert into outbox_event (message_id, kind, structure_id, episode, alarm_kind, facts, created_at_us)
        select 'msg_' || lower(hex(randomblob(16))), 'alarm.worsened', structure_id, episode, alarm_kind, facts,
               cast(unixepoch('now', 'subsec') * 1000000 as integer)
        from alarm_facts where structure_id = new.structure_id and episode = new.episode;
end;
