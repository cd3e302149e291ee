-- A point of a process whose changes are no JSON is passed over in the message of an alarm. Before, no alarm of its period could be opened,
-- changed or acknowledged.

drop view alarm_facts;

create view alarm_facts as
    select structure_id, episode, kind as alarm_kind,
           json_object(
               'kind', kind, 'series', series, 'undamaged_version', undamaged_version,
               'opened_at_us', opened_at_us, 'opened_batch', opened_batch, 'ended_at_us', ended_at_us,
               'withdrawn', withdrawn, 'peak_shift', case when abs(peak_shift) < 1e300 then peak_shift end,
               'noticed_at_us', noticed_at_us, 'acknowledged_at_us', acknowledged_at_us,
               'acknowledged_by', acknowledged_by, 'acknowledgement_note', acknowledgement_note,
               'change', (select json(case when json_valid(p.changes) then p.changes -> e.series end) from process_point p
                          where p.structure_id = e.structure_id and p.undamaged_version = e.undamaged_version
                            and p.measured_to_us between e.opened_at_us and coalesce(e.ended_at_us, 9e18)
                            and case when json_valid(p.changes) then p.changes -> e.series end is not null
                          order by p.measured_to_us desc, p.batch_id desc limit 1),
               'batch_change', (select json(batch_change) from alarm_batch_change b
                                where b.structure_id = e.structure_id and b.episode = e.episode)) as facts
    from alarm_episode e;
