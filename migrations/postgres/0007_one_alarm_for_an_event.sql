-- One event is one alarm. With a process behind the undamaged reference, only the chart of all parameters together ('structure:joint') raises
-- alarms, and the alarm says which of them have changed. Before, each parameter had alarms of its own, and that of all together was held
-- back and not announced while one of them was there: the one of a parameter takes its place.

update alarm_episode as e set series = 'structure:joint'
where kind = 'damage' and series <> 'structure:joint' and ended_at_us is null and not withdrawn
  and exists (select 1 from alarm_episode j
              where j.structure_id = e.structure_id and j.undamaged_version = e.undamaged_version and j.series = 'structure:joint'
                and j.ended_at_us is null and not j.withdrawn and j.held_back)
  and episode = (select min(o.episode) from alarm_episode o
                 where o.structure_id = e.structure_id and o.undamaged_version = e.undamaged_version and o.kind = 'damage'
                   and o.series <> 'structure:joint' and o.ended_at_us is null and not o.withdrawn);

update alarm_episode set withdrawn = true where held_back;
delete from alarm_episode e
where held_back and not exists (select 1 from alarm_action a where a.structure_id = e.structure_id and a.episode = e.episode);

drop trigger alarm_opened on alarm_episode;
drop trigger alarm_announced on alarm_episode;
create trigger alarm_opened after insert on alarm_episode
    for each row when (not new.withdrawn) execute function alarm_opened();

create or replace function alarm_changed() returns trigger language plpgsql as $$
begin
    if alarm_state(new.withdrawn, new.ended_at_us) <> alarm_state(old.withdrawn, old.ended_at_us) then
        perform send_alarm('alarm.' || alarm_state(new.withdrawn, new.ended_at_us), new.structure_id, new.episode);
    end if;
    if old.acknowledged_at_us is null and new.acknowledged_at_us is not null then
        perform send_alarm('alarm.acknowledged', new.structure_id, new.episode);
    end if;
    if old.grade is not null and new.grade > old.grade and not new.withdrawn then
        perform send_alarm('alarm.worsened', new.structure_id, new.episode);
    end if;
    return null;
end $$;

alter table alarm_episode drop column held_back;
