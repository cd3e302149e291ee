-- Diagnoses that the service starts by itself.

-- Why a diagnosis was started: a request, an alarm of the kind simulation_does_not_fit, or the schedule.
alter table diagnosis add column started_by text not null default 'requested'
    check (started_by in ('requested', 'rejected_episode', 'schedule'));

alter table diagnosis add column alarm integer;  -- number of that alarm; null for the other two

create index diagnosis_of_alarm on diagnosis (structure_id, alarm, diagnosis_id desc) where alarm is not null;

-- The latest starts are looked up every few seconds, without reading the results.
create index diagnosis_started on diagnosis (structure_id, created_at_us, started_by);
