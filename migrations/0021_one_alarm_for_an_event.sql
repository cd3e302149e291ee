-- One event is one alarm. With a process behind the undamaged reference, only the chart of all parameters together ('structure:joint') raises
-- alarms, and the alarm says which of them have changed. Before, each parameter had alarms of its own, and that of all together was held
-- back and not announced while one of them was there: the one of a parameter takes its place.

update alarm_episode as e set series = 'structure:joint'
where kind = 'damage' and series <> 'structure:joint' and ended_at_us is null and withdrawn = 0
  and exists (select 1 from alarm_episode j
              where j.structure_id = e.structure_id and j.undamaged_version = e.undamaged_version and j.series = 'structure:joint'
                and j.ended_at_us is null and j.withdrawn = 0 and j.held_back = 1)
  and episode = (select min(o.episode) from alarm_episode o
                 where o.structure_id = e.structure_id and o.undamaged_version = e.undamaged_version and o.kind = 'damage'
                   and o.series <> 'structure:joint' and o.ended_at_us is null and o.withdrawn = 0);

update alarm_episode set withdrawn = 1 where held_back = 1;
delete from alarm_episode
where held_back = 1
  and not exists (select 1 from alarm_action a where a.structure_id = alarm_episode.structure_id and a.episode = alarm_episode.episode);

drop trigger alarm_opened;
drop trigger alarm_announced;
drop trigger alarm_changed;
drop trigger alarm_worsened;

alter table alarm_episode drop column held_back;

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

create trigger alarm_worsened after update of grade on alarm_episode
    when old.grade is not null and new.grade > old.grade and new.withdrawn = 0
begin
    insert into outbox_event (message_id, kind, structure_id, episode, alarm_kind, facts, created_at_us)
        select 'msg_' || lower(hex(randomblob(16))), 'alarm.worsened', structure_id, episode, alarm_kind, facts,
               cast(unixepoch('now', 'subsec') * 1000000 as integer)
        from alarm_facts where structure_id = new.structure_id and episode = new.episode;
end;
