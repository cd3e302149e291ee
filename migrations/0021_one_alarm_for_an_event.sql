-- One event is one alarm. With a process behind the undamaged reference, only the chart of all parameters together ('structure:joint') raises
-- alarms, and the alarm says which of them have changed. Before, each parameter had alarms of its own, and that of all together was held
-- back while one of them was there. Of the open alarms of a reference, the first one that was announced stays, as that of all together.

create table kept_alarm as
    select e.structure_id, e.undamaged_version, min(e.episode) as episode
    from alarm_episode e
    where e.kind = 'damage' and e.ended_at_us is null and e.withdrawn = 0 and e.held_back = 0
      and exists (select 1 from chart_point p where p.structure_id = e.structure_id and p.undamaged_version = e.undamaged_version
                  and p.series = 'structure:joint')
    group by e.structure_id, e.undamaged_version;

-- An alarm that is held back sends no messages.
update alarm_episode set withdrawn = 1, held_back = 1
where kind = 'damage' and ended_at_us is null and withdrawn = 0
  and exists (select 1 from kept_alarm k where k.structure_id = alarm_episode.structure_id
              and k.undamaged_version = alarm_episode.undamaged_version and k.episode <> alarm_episode.episode);

update alarm_episode set series = 'structure:joint'
where exists (select 1 from kept_alarm k where k.structure_id = alarm_episode.structure_id and k.episode = alarm_episode.episode);

-- The alarm goes on with the next batch.
update chart_point set state = 'alarming'
where series = 'structure:joint' and held = 0
  and exists (select 1 from kept_alarm k where k.structure_id = chart_point.structure_id and k.undamaged_version = chart_point.undamaged_version)
  and not exists (select 1 from chart_point later
                  where later.structure_id = chart_point.structure_id and later.undamaged_version = chart_point.undamaged_version
                    and later.series = chart_point.series and later.held = 0
                    and (later.measured_to_us, later.batch_id) > (chart_point.measured_to_us, chart_point.batch_id));

drop table kept_alarm;

-- What was never announced beside an alarm of its event.
update alarm_episode set withdrawn = 1 where held_back = 1;
