-- Where an undamaged reference comes from, JSON: the version that it extends, the first version of that chain, and the reason that was
-- given. Null for references of earlier versions of the program.
alter table undamaged_state add column origin text;

-- Messages about alarms carry the change that the batch shows which opened the alarm.
drop view alarm_facts;

create view alarm_facts as
    select structure_id, episode, kind as alarm_kind,
           json_object(
               'kind', kind, 'series', series, 'undamaged_version', undamaged_version,
               'opened_at_us', opened_at_us, 'opened_batch', opened_batch, 'ended_at_us', ended_at_us,
               'withdrawn', withdrawn, 'peak_shift', case when abs(peak_shift) < 1e300 then peak_shift end,
               'noticed_at_us', noticed_at_us, 'acknowledged_at_us', acknowledged_at_us,
               'acknowledged_by', acknowledged_by, 'acknowledgement_note', acknowledgement_note,
               'change', (select json(json_extract(changes, '$."' || series || '"')) from process_point p
                          where p.structure_id = e.structure_id and p.undamaged_version = e.undamaged_version
                            and p.batch_id = e.opened_batch)) as facts
    from alarm_episode e;

-- What the chain remembers after the batch, JSON: the change that is followed, and from when on is tested; null if nothing.
alter table process_point add column memory text;
