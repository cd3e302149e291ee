-- The schema of SQLite at version 19, for PostgreSQL 15 and later. The functions and operators at the beginning give expressions of SQLite
-- the same meaning, so that one text of a statement serves both.
--
-- Texts are compared byte by byte, as in SQLite. NaN is stored as null, so that "not null" is the guard against it, as there.

-- Truth values are written as 0 and 1 in conditions.
create function is_truth(truth boolean, number integer) returns boolean language sql immutable parallel safe
    return truth = (number <> 0);
create operator = (leftarg = boolean, rightarg = integer, function = is_truth);

-- A member of a JSON object in a text, given as 'member' or as '$.member'.
create function json_member(document text, path text) returns text language sql immutable parallel safe
    return document::jsonb ->> case when path like '$.%' then substr(path, 3) else path end;
create operator ->> (leftarg = text, rightarg = text, function = json_member);
create function json_part(document text, path text) returns text language sql immutable parallel safe
    return (document::json -> path)::text;
create operator -> (leftarg = text, rightarg = text, function = json_part);

-- The elements of a JSON list in a text.
create function json_each(list text) returns table (key bigint, value text) language sql immutable parallel safe as
    $$ select ordinality - 1, element from json_array_elements_text(list::json) with ordinality as elements (element, ordinality) $$;

create function iif(condition boolean, yes text, no text) returns text language sql immutable parallel safe
    return case when condition then yes else no end;
create function iif(condition boolean, yes bigint, no bigint) returns bigint language sql immutable parallel safe
    return case when condition then yes else no end;

create function json_valid(document text) returns integer language plpgsql immutable parallel safe as $$
begin
    perform document::json;
    return 1;
exception when others then
    return 0;
end $$;

-- The only row says whose database this is; writing to it shows that the database can be written.
create table application (
    name            text    not null primary key check (name = 'modalwatch'),
    probes          bigint  not null,
    -- A program that knows this version of the schema, or a later one, can use the database.
    compatible_from bigint  not null,
    -- Data are being moved into the database, or a move was broken off: no service may use it.
    moving          boolean not null
);
insert into application values ('modalwatch', 0, 1, false);

create table structure (
    structure_id  text collate "C"    not null primary key,
    definition    text collate "C"    not null,  -- canonical JSON, opaque here
    digest        text collate "C"    not null,  -- SHA-256 of the definition
    created_at_us bigint not null,
    updated_at_us bigint not null
);

create table measurement_batch (
    structure_id      text collate "C"    not null references structure (structure_id),
    batch_id          text collate "C"    not null,  -- UUIDv7
    source            text collate "C"    not null,
    idempotency_key   text collate "C",              -- the client's own, if it gave one
    content_digest    text collate "C"    not null,  -- SHA-256 of structure, source and measurements
    received_at_us    bigint not null,
    measured_from_us  bigint not null,
    measured_to_us    bigint not null check (measured_to_us >= measured_from_us),
    measurement_count bigint not null check (measurement_count > 0),
    state             text collate "C"    not null check (state in ('received', 'assessed', 'failed')),
    failure           text collate "C",              -- why the assessment failed
    primary key (structure_id, batch_id),
    unique (structure_id, idempotency_key)
);

create table measurement (
    structure_id   text collate "C"    not null,
    batch_id       text collate "C"    not null,
    ordinal        bigint not null,  -- order in which they came, from 0
    source         text collate "C"    not null,  -- that of the batch; here for the natural key
    measured_at_us bigint not null,
    frequency_hz   bytea    not null,  -- f64 for each mode, Hz, NaN = not identified
    std_hz         bytea,              -- f64 for each mode, Hz, NaN = not given
    covariates     text collate "C"    not null,  -- JSON object
    settings       text collate "C"    not null, mode_shapes text collate "C",  -- JSON object, parameter units
    primary key (structure_id, batch_id, ordinal),
    -- A measurement is known by where and when it was taken: a gateway that repeats itself adds nothing.
    unique (structure_id, source, measured_at_us),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
);

create table assessment (
    structure_id          text collate "C"    not null,
    batch_id              text collate "C"    not null,
    model_digest          text collate "C"    not null,  -- of the trained baseline
    undamaged_version     bigint not null check (undamaged_version >= 0),  -- 0 = compared with none
    structure_digest      text collate "C"    not null,
    seed                  bigint not null,  -- the 64 bits of the seed
    draws_per_measurement bigint not null check (draws_per_measurement > 0),
    measurements_used     bigint not null check (measurements_used > 0),
    measurements_left_out bigint not null check (measurements_left_out >= 0),
    measurements_outside  bigint not null check (measurements_outside >= 0),
    misfit_percent        bytea    not null,  -- f64 for each mode, %
    assessed_at_us        bigint not null, effective_sample_size double precision, trust text collate "C", plotted bytea, joint text collate "C",
    primary key (structure_id, batch_id, model_digest, undamaged_version),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
);

create table undamaged_state (
    structure_id          text collate "C"    not null references structure (structure_id),
    version               bigint not null check (version > 0),
    model_digest          text collate "C"    not null,
    created_at_us         bigint not null,
    threshold_probability double precision    not null check (threshold_probability > 0 and threshold_probability <= 0.5),
    measurement_count     bigint not null, conditions text collate "C" not null default '{}', doubts text collate "C" not null default '[]', joint text collate "C", origin text collate "C",
    primary key (structure_id, version)
);

create table undamaged_batch (
    structure_id text collate "C"    not null,
    version      bigint not null,
    batch_id     text collate "C"    not null,
    primary key (structure_id, version, batch_id),
    foreign key (structure_id, version) references undamaged_state (structure_id, version),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
);

create table undamaged_quantity (
    structure_id text collate "C"    not null,
    version      bigint not null,
    quantity     text collate "C"    not null,
    position     bigint not null,
    mean         double precision    not null,  -- unit of the quantity
    std          double precision    not null check (std >= 0),
    threshold    double precision, detail text collate "C", mean_draws bytea, std_draws bytea,              -- null where no change is damage
    primary key (structure_id, version, quantity),
    foreign key (structure_id, version) references undamaged_state (structure_id, version)
);

create table quantity_assessment (
    structure_id          text collate "C"    not null,
    batch_id              text collate "C"    not null,
    model_digest          text collate "C"    not null,
    undamaged_version     bigint not null,
    quantity              text collate "C"    not null,
    position              bigint not null,  -- order of the quantities
    unit                  text collate "C"    not null,
    kind                  text collate "C"    not null check (kind in ('parameter', 'spring_stiffness', 'group')),
    mean                  double precision    not null,  -- unit; of the population behind the batch
    std                   double precision,              -- unit; null for one measurement
    variance_within       double precision    not null,  -- unit²
    variance_between      double precision,              -- unit²; null for one measurement
    edge_mass             double precision    not null check (edge_mass between 0 and 1),  -- –
    threshold             double precision,              -- unit; null without a comparison, and so the next
    probability_of_damage double precision check (probability_of_damage between 0 and 1),  -- –
    exceeds               boolean,
    relative_change       double precision,              -- –
    mean_low              double precision,              -- unit; 90 % credible interval, as all that follow
    mean_high             double precision,
    std_low               double precision,
    std_high              double precision,
    pooled_mean           double precision,              -- unit
    pooled_std            double precision,              -- unit
    probability_low       double precision check (probability_low between 0 and 1),
    probability_high      double precision check (probability_high between 0 and 1),
    pooled_probability    double precision check (pooled_probability between 0 and 1),
    change_low            double precision,
    change_high           double precision,
    group_name            text collate "C",              -- quantity of the group it cannot be told apart in
    primary key (structure_id, batch_id, model_digest, undamaged_version, quantity),
    foreign key (structure_id, batch_id, model_digest, undamaged_version)
        references assessment (structure_id, batch_id, model_digest, undamaged_version)
);

create table chart_point (
    structure_id      text collate "C"    not null,
    undamaged_version bigint not null,  -- 0 for the fit, which needs no undamaged state
    series            text collate "C"    not null,
    measured_to_us    bigint not null,  -- the point's place in time
    batch_id          text collate "C"    not null,
    shift             double precision    not null,  -- standard errors towards damage; for the fit, 1 = rejected
    shift_limit       double precision    not null,
    ewma_limit        double precision,              -- null = none
    probability_limit double precision,              -- probability of damage that stands at the limit
    held              boolean not null,
    ewma              double precision    not null,
    above             boolean not null,
    state             text collate "C"    not null check (state in ('normal', 'pending', 'alarming', 'recovering', 'silent')), slow double precision,
    primary key (structure_id, undamaged_version, series, measured_to_us, batch_id),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
);

create table maintenance_window (
    structure_id  text collate "C"    not null references structure (structure_id),
    from_us       bigint not null,
    to_us         bigint not null check (to_us > from_us),
    reason        text collate "C"    not null,
    created_at_us bigint not null,
    primary key (structure_id, from_us, to_us)
);

create table diagnosis (
    diagnosis_id   text collate "C"    not null primary key,  -- UUIDv7
    structure_id   text collate "C"    not null references structure (structure_id),
    structure_digest text collate "C"  not null,              -- version that was diagnosed
    request        text collate "C"    not null,              -- JSON: batches, hold-out, seed, training
    state          text collate "C"    not null check (state in ('running', 'done', 'failed')),
    failure        text collate "C",                          -- why it failed
    result         text collate "C",                          -- JSON
    report         text collate "C",                          -- HTML
    created_at_us  bigint not null,
    finished_at_us bigint,
    extension_state   text collate "C" check (extension_state in ('running', 'done', 'failed')),
    extension_failure text collate "C",
    extension         text collate "C",                       -- JSON: what was added and left out, digests
    extended_at_us    bigint
, extension_begun_at_us bigint, started_by text collate "C" not null default 'requested'
    check (started_by in ('requested', 'rejected_episode', 'schedule')), alarm bigint, cancelled_at_us bigint, extension_cancelled_at_us bigint, extension_request text collate "C", extension_interruptions bigint not null default 0);

create table structure_version (
    structure_id  text collate "C"    not null references structure (structure_id),
    digest        text collate "C"    not null,  -- SHA-256 of the definition
    definition    text collate "C"    not null,  -- canonical JSON
    parent_digest text collate "C",              -- version that it extends
    diagnosis_id  text collate "C",              -- that made it
    created_at_us bigint not null,
    primary key (structure_id, digest)
);

create table trained_baseline (
    structure_id     text collate "C"    not null references structure (structure_id),
    structure_digest text collate "C"    not null,  -- version it was trained for
    model_digest     text collate "C"    not null,  -- SHA-256 of the manifest
    manifest         bytea    not null,
    weights          bytea    not null,  -- safetensors
    accepted         boolean not null,  -- used although it failed its calibration
    created_at_us    bigint not null,
    primary key (structure_id, structure_digest)
);

create table api_token (
    token_id          text collate "C"    not null primary key,  -- the public part of mw_<id>_<secret>
    name              text collate "C"    not null,
    ingest            boolean not null,
    read              boolean not null,
    admin             boolean not null,
    limited           boolean not null,  -- to the structures of api_token_structure
    digest            bytea    not null check (length(digest) = 32),  -- SHA-256 of the secret, which is kept nowhere
    previous_digest   bytea    check (length(previous_digest) = 32),  -- of the secret before the last rotation
    previous_until_us bigint,                                       -- and until when that one is good
    created_at_us     bigint not null,
    expires_at_us     bigint,
    revoked_at_us     bigint,  -- a revoked token stays: its id is in the audit, and the service stays closed
    check (ingest or read or admin),
    check ((previous_digest is null) = (previous_until_us is null))
);

create table api_token_structure (
    token_id     text collate "C" not null references api_token (token_id),
    structure_id text collate "C" not null,
    primary key (token_id, structure_id)
);

create table audit_entry (
    entry_id     bigint generated by default as identity primary key,
    at_us        bigint not null,
    actor        text collate "C"    not null,  -- id of the token, or 'local'
    actor_name   text collate "C",              -- name of the token then
    peer         text collate "C",              -- address of the client
    request_id   text collate "C",
    action       text collate "C"    not null,  -- method and route, or command
    structure_id text collate "C",
    subject      text collate "C",              -- path of what was changed or made
    status       bigint            -- HTTP status; 200 and 500 for a command
);

create table webhook (
    webhook_id        text collate "C"    not null primary key,  -- UUIDv7
    url               text collate "C"    not null,
    secret            text collate "C"    not null,  -- whsec_…; in clear, since every message is signed with it
    previous_secret   text collate "C",              -- signs too until previous_until_us
    previous_until_us bigint,
    events            text collate "C"    not null,  -- JSON list of event kinds; empty = all
    alarm_kinds       text collate "C"    not null,  -- JSON list; empty = all
    structures        text collate "C"    not null,  -- JSON list of ids; empty = all
    enabled           boolean not null,
    created_at_us     bigint not null,
    updated_at_us     bigint not null
);

create table quarantine (
    message       bigint generated by default as identity primary key,
    topic         text collate "C"    not null,
    digest        text collate "C"    not null,  -- SHA-256 of the whole payload
    payload       bytea    not null,  -- its beginning, at most 64 KiB
    payload_bytes bigint not null,  -- of the whole
    reason        text collate "C"    not null,  -- the last one
    tries         bigint not null check (tries > 0),  -- how often it was tried, over all its arrivals
    first_at_us   bigint not null,
    last_at_us    bigint not null,
    unique (topic, digest)
);

create table structure_summary (
    structure_id     text collate "C"    not null primary key,
    batches          bigint not null check (batches >= 0),
    last_measured_us bigint  -- time of the latest measurement; null without batches
);

create table undamaged_process (
    structure_id text collate "C"    not null,
    version      bigint not null,
    process      text collate "C",              -- JSON; null if none could be fitted
    reason       text collate "C",              -- why there is none
    primary key (structure_id, version),
    foreign key (structure_id, version) references undamaged_state (structure_id, version)
);

create table process_point (
    structure_id      text collate "C"    not null,
    undamaged_version bigint not null,
    measured_to_us    bigint not null,  -- the batch's place in time
    batch_id          text collate "C"    not null,
    estimate          text collate "C"    not null,  -- JSON: means, covariance of their errors, covariates
    held              boolean not null,  -- compared, but not part of the chain
    known             bytea    not null,  -- f64: mean and covariance of the states after the batch
    changes           text collate "C", memory text collate "C",              -- JSON: onset and size on the charts above their limits; null without any
    primary key (structure_id, undamaged_version, measured_to_us, batch_id),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
);

create table training (
    training_id      text collate "C"    not null primary key,  -- UUIDv7
    structure_id     text collate "C"    not null references structure (structure_id),
    structure_digest text collate "C"    not null,              -- version that the model is for
    request          text collate "C"    not null,              -- JSON: samples, epochs, seed and so on
    state            text collate "C"    not null check (state in ('waiting', 'done', 'failed', 'cancelled')),
    interruptions    bigint not null default 0,    -- unexpected ends of the program since the last orderly one
    failure          text collate "C",                          -- why it failed
    result           text collate "C",                          -- JSON
    created_at_us    bigint not null,
    finished_at_us   bigint
);

create table note (
    note_id       text collate "C"    not null primary key,  -- UUIDv7
    structure_id  text collate "C"    not null references structure (structure_id),
    from_us       bigint not null,
    to_us         bigint check (to_us > from_us),  -- null for a moment
    text          text collate "C"    not null,
    author        text collate "C"    not null,
    created_at_us bigint not null
);

create table outbox_event (
    event_id      bigint generated by default as identity primary key,
    message_id    text collate "C"    not null unique,
    kind          text collate "C"    not null check (kind in
        ('alarm.opened', 'alarm.reopened', 'alarm.ended', 'alarm.withdrawn', 'alarm.acknowledged', 'alarm.worsened',
         'alarm.commented', 'alarm.assigned', 'alarm.closed')),
    structure_id  text collate "C"    not null references structure (structure_id),
    episode       bigint not null,
    alarm_kind    text collate "C"    not null,
    facts         text collate "C"    not null,  -- JSON: the alarm as it was then
    created_at_us bigint not null
);

create table webhook_delivery (
    delivery_id   bigint generated by default as identity primary key,
    webhook_id    text collate "C"    not null references webhook (webhook_id) on delete cascade,
    event_id      bigint not null references outbox_event (event_id),
    state         text collate "C"    not null check (state in ('pending', 'delivered', 'dead')),
    attempts      bigint not null,
    started_at_us bigint not null,
    next_at_us    bigint not null,
    last_at_us    bigint,
    last_status   bigint,
    last_error    text collate "C",
    unique (webhook_id, event_id)
);

create table mail_recipient (
    address     text collate "C" not null primary key,
    events      text collate "C" not null,  -- JSON list of event kinds
    alarm_kinds text collate "C" not null   -- JSON list; empty = all
);

create table mail_delivery (
    delivery_id   bigint generated by default as identity primary key,
    address       text collate "C"    not null,
    event_id      bigint not null references outbox_event (event_id),
    state         text collate "C"    not null check (state in ('pending', 'delivered', 'skipped', 'dead')),  -- skipped: below the least severity
    attempts      bigint not null,
    started_at_us bigint not null,
    next_at_us    bigint not null,
    last_at_us    bigint,
    last_error    text collate "C",
    unique (address, event_id)
);

create table kept_comparison (
    structure_id      text collate "C"    not null,
    batch_id          text collate "C"    not null,
    position          bigint not null,
    undamaged_version bigint not null check (undamaged_version >= 0),
    primary key (structure_id, batch_id, position),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
);

create table imported_action (
    structure_id text collate "C"    not null references structure (structure_id),
    position     bigint not null,
    record       text collate "C"    not null,  -- JSON, a line of the archive
    primary key (structure_id, position)
);

create table further_key (
    structure_id    text collate "C" not null,
    idempotency_key text collate "C" not null,
    batch_id        text collate "C" not null,
    primary key (structure_id, idempotency_key),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
);

create table structure_deletion (
    structure_id    text collate "C"    not null primary key references structure (structure_id),
    requested_at_us bigint not null
);

create table alarm_episode (
    structure_id         text collate "C"    not null references structure (structure_id),
    episode              bigint not null check (episode > 0),
    kind                 text collate "C"    not null check (kind in ('damage', 'simulation_does_not_fit', 'silence', 'not_assessed')),
    series               text collate "C"    not null,  -- parameter of a damage alarm, 'simulation:fit', 'structure:silence', or 'structure:not_assessed'
    undamaged_version    bigint not null,
    opened_at_us         bigint not null,  -- time of the measurement that made it an alarm
    opened_batch         text collate "C",              -- null for silence
    ended_at_us          bigint,           -- null while it lasts
    withdrawn            boolean not null,  -- late data showed that there was none
    peak_shift           double precision    not null,  -- standard errors
    noticed_at_us        bigint not null,  -- when the service raised it
    acknowledged_at_us   bigint,
    acknowledged_by      text collate "C",
    acknowledgement_note text collate "C",
    grade                bigint check (grade between 0 and 3),
    -- The alarm of a single parameter has announced the event: this one sends no messages of its own.
    held_back            boolean not null default false,
    primary key (structure_id, episode)
);

create table alarm_action (
    action_id    bigint generated by default as identity primary key,  -- order in which they were stored
    structure_id text collate "C"    not null,
    episode      bigint not null,
    uid          text collate "C"    not null,  -- UUIDv7, the same in every installation that imports it
    kind         text collate "C"    not null check (kind in ('comment', 'assignment', 'closing', 'reopening')),
    at_us        bigint not null,
    author       text collate "C"    not null,
    text         text collate "C",
    reason       text collate "C" check ((kind = 'closing') = (reason is not null)),
    assignee     text collate "C" check (kind = 'assignment' or assignee is null),  -- null = nobody any more
    imported     boolean not null,  -- from an archive: sends no messages
    foreign key (structure_id, episode) references alarm_episode (structure_id, episode),
    unique (structure_id, uid)
);

create index measurement_batch_by_time on measurement_batch (structure_id, measured_from_us, batch_id);
create index measurement_batch_pending on measurement_batch (structure_id, received_at_us) where state = 'received';
create index quantity_assessment_exceeding
    on quantity_assessment (structure_id, batch_id) where exceeds;
create index chart_point_by_batch on chart_point (structure_id, batch_id);
create index diagnosis_of_structure on diagnosis (structure_id, diagnosis_id desc);
create index audit_entry_by_time on audit_entry (at_us, entry_id);
create index measurement_batch_assessed
    on measurement_batch (structure_id, measured_from_us, batch_id) where state = 'assessed';
create index diagnosis_of_alarm on diagnosis (structure_id, alarm, diagnosis_id desc) where alarm is not null;
create index diagnosis_started on diagnosis (structure_id, created_at_us, started_by);
create index process_point_by_batch on process_point (structure_id, batch_id);
create index training_of_structure on training (structure_id, training_id desc);
create index training_created on training (created_at_us);
create index note_by_time on note (structure_id, from_us);
create index outbox_event_by_age on outbox_event (created_at_us);
create index outbox_event_of_alarm on outbox_event (structure_id, episode, event_id);
create index webhook_delivery_waiting on webhook_delivery (webhook_id, delivery_id) where state = 'pending';
create index webhook_delivery_dead on webhook_delivery (webhook_id) where state = 'dead';
create index webhook_delivery_of_event on webhook_delivery (event_id);
create index webhook_delivery_by_time on webhook_delivery (webhook_id, next_at_us) where state = 'pending';
create index mail_delivery_by_time on mail_delivery (next_at_us) where state = 'pending';
create index mail_delivery_dead on mail_delivery (delivery_id) where state = 'dead';
create index mail_delivery_of_event on mail_delivery (event_id);
create index further_key_by_batch on further_key (structure_id, batch_id);
create index alarm_episode_by_series on alarm_episode (structure_id, kind, series, opened_at_us);
create index alarm_episode_open
    on alarm_episode (structure_id, kind, acknowledged_at_us) where ended_at_us is null and not withdrawn;
create index alarm_action_by_alarm on alarm_action (structure_id, episode, action_id);

create function count_batch() returns trigger language plpgsql as $$
begin
    if tg_op = 'INSERT' then
        insert into structure_summary as known values (new.structure_id, 1, new.measured_to_us)
            on conflict (structure_id) do update
            set batches = known.batches + 1,
                last_measured_us = greatest(known.last_measured_us, excluded.last_measured_us);
    else
        update structure_summary
            set batches = batches - 1,
                last_measured_us = case when old.measured_to_us < last_measured_us then last_measured_us else
                    (select max(measured_to_us) from measurement_batch where structure_id = old.structure_id) end
            where structure_id = old.structure_id;
    end if;
    return null;
end $$;
create trigger batch_counted after insert or delete on measurement_batch for each row execute function count_batch();

create view alarm_batch_change as
    select e.structure_id, e.episode,
           (select json_build_array(q.relative_change::numeric, q.change_low::numeric, q.change_high::numeric)::text from quantity_assessment q
            where q.structure_id = e.structure_id and q.undamaged_version = e.undamaged_version and q.quantity = e.series
              and q.relative_change is not null and q.change_low is not null and q.change_high is not null
              and q.batch_id = coalesce(
                  (select p.batch_id from chart_point p
                   where p.structure_id = e.structure_id and p.undamaged_version = e.undamaged_version and p.series = e.series
                     and p.measured_to_us between e.opened_at_us and coalesce(e.ended_at_us, 9223372036854775807) and p.above
                   order by p.measured_to_us desc, p.batch_id desc limit 1), e.opened_batch)
            limit 1) as batch_change
    from alarm_episode e where e.kind = 'damage';

create view alarm_facts as
    select structure_id, episode, kind as alarm_kind,
           json_build_object(
               'kind', kind, 'series', series, 'undamaged_version', undamaged_version,
               'opened_at_us', opened_at_us, 'opened_batch', opened_batch, 'ended_at_us', ended_at_us,
               'withdrawn', withdrawn::int, 'peak_shift', case when abs(peak_shift) < 1e300 then peak_shift::numeric end,
               'noticed_at_us', noticed_at_us, 'acknowledged_at_us', acknowledged_at_us,
               'acknowledged_by', acknowledged_by, 'acknowledgement_note', acknowledgement_note,
               'change', (select p.changes::json -> e.series from process_point p
                          where p.structure_id = e.structure_id and p.undamaged_version = e.undamaged_version
                            and p.measured_to_us between e.opened_at_us and coalesce(e.ended_at_us, 9223372036854775807)
                            and p.changes::json -> e.series is not null
                          order by p.measured_to_us desc, p.batch_id desc limit 1),
               'batch_change', (select batch_change::json from alarm_batch_change b
                                where b.structure_id = e.structure_id and b.episode = e.episode))::text as facts
    from alarm_episode e;

-- Microseconds since 1970.
create function now_us() returns bigint language sql volatile
    return (extract(epoch from clock_timestamp()) * 1000000)::bigint;

create function send_alarm(message text, of_structure text, of_episode bigint, action jsonb default null) returns void language sql as $$
    insert into outbox_event (message_id, kind, structure_id, episode, alarm_kind, facts, created_at_us)
        select 'msg_' || replace(gen_random_uuid()::text, '-', ''), message, structure_id, episode, alarm_kind,
               case when action is null then facts else (facts::jsonb || jsonb_build_object('action', action))::text end, now_us()
        from alarm_facts where structure_id = of_structure and episode = of_episode
$$;

create function alarm_state(withdrawn boolean, ended_at_us bigint) returns text language sql immutable
    return case when withdrawn then 'withdrawn' when ended_at_us is null then 'reopened' else 'ended' end;

create function alarm_opened() returns trigger language plpgsql as $$
begin
    perform send_alarm('alarm.opened', new.structure_id, new.episode);
    if new.ended_at_us is not null then
        perform send_alarm('alarm.ended', new.structure_id, new.episode);
    end if;
    return null;
end $$;
create trigger alarm_opened after insert on alarm_episode
    for each row when (not new.withdrawn and not new.held_back) execute function alarm_opened();
create trigger alarm_announced after update of held_back on alarm_episode
    for each row when (old.held_back and not new.held_back) execute function alarm_opened();

create function alarm_changed() returns trigger language plpgsql as $$
begin
    if not (new.held_back or old.held_back)
        and alarm_state(new.withdrawn, new.ended_at_us) <> alarm_state(old.withdrawn, old.ended_at_us) then
        perform send_alarm('alarm.' || alarm_state(new.withdrawn, new.ended_at_us), new.structure_id, new.episode);
    end if;
    if old.acknowledged_at_us is null and new.acknowledged_at_us is not null then
        perform send_alarm('alarm.acknowledged', new.structure_id, new.episode);
    end if;
    if old.grade is not null and new.grade > old.grade and not new.withdrawn and not new.held_back then
        perform send_alarm('alarm.worsened', new.structure_id, new.episode);
    end if;
    return null;
end $$;
create trigger alarm_changed after update on alarm_episode for each row execute function alarm_changed();

create function alarm_acted_on() returns trigger language plpgsql as $$
begin
    perform send_alarm(
        case new.kind when 'comment' then 'alarm.commented' when 'assignment' then 'alarm.assigned'
                      when 'closing' then 'alarm.closed' else 'alarm.reopened' end,
        new.structure_id, new.episode,
        jsonb_build_object('kind', new.kind, 'at_us', new.at_us, 'author', new.author, 'text', new.text, 'reason', new.reason,
            'assignee', new.assignee));
    return null;
end $$;
create trigger alarm_acted_on after insert on alarm_action
    for each row when (not new.imported) execute function alarm_acted_on();

create function outbox_event_addressed() returns trigger language plpgsql as $$
begin
    insert into webhook_delivery (webhook_id, event_id, state, attempts, started_at_us, next_at_us)
        select webhook_id, new.event_id, 'pending', 0, new.created_at_us, new.created_at_us from webhook
        where enabled
          and (events = '[]' or exists (select 1 from json_each(events) where value = new.kind))
          and (alarm_kinds = '[]' or exists (select 1 from json_each(alarm_kinds) where value = new.alarm_kind))
          and (structures = '[]' or exists (select 1 from json_each(structures) where value = new.structure_id));
    insert into mail_delivery (address, event_id, state, attempts, started_at_us, next_at_us)
        select address, new.event_id, 'pending', 0, new.created_at_us, new.created_at_us from mail_recipient
        where exists (select 1 from json_each(events) where value = new.kind)
          and (alarm_kinds = '[]' or exists (select 1 from json_each(alarm_kinds) where value = new.alarm_kind));
    return null;
end $$;
create trigger outbox_event_addressed after insert on outbox_event for each row execute function outbox_event_addressed();
