-- The population behind a batch beside its pool, trust in every answer, alarm charts and episodes, maintenance windows.
-- Rows from before keep their meaning: `mean` and `std` were those of the pool then, and the new columns stay null.

alter table assessment add column effective_sample_size real;  -- mean over measurements; null in rows from before
alter table assessment add column trust text;                  -- JSON

create table quantity_assessment_2 (
    structure_id          text    not null,
    batch_id              text    not null,
    model_digest          text    not null,
    undamaged_version     integer not null,
    quantity              text    not null,
    position              integer not null,  -- order of the quantities
    unit                  text    not null,
    kind                  text    not null check (kind in ('parameter', 'spring_stiffness', 'group')),
    mean                  real    not null,  -- unit; of the population behind the batch
    std                   real,              -- unit; null for one measurement
    variance_within       real    not null,  -- unit²
    variance_between      real,              -- unit²; null for one measurement
    edge_mass             real    not null check (edge_mass between 0 and 1),  -- –
    threshold             real,              -- unit; null without a comparison, and so the next
    probability_of_damage real check (probability_of_damage between 0 and 1),  -- –
    exceeds               integer check (exceeds in (0, 1)),
    relative_change       real,              -- –
    mean_low              real,              -- unit; 90 % credible interval, as all that follow
    mean_high             real,
    std_low               real,
    std_high              real,
    pooled_mean           real,              -- unit
    pooled_std            real,              -- unit
    probability_low       real check (probability_low between 0 and 1),
    probability_high      real check (probability_high between 0 and 1),
    pooled_probability    real check (pooled_probability between 0 and 1),
    change_low            real,
    change_high           real,
    group_name            text,              -- quantity of the group it cannot be told apart in
    primary key (structure_id, batch_id, model_digest, undamaged_version, quantity),
    foreign key (structure_id, batch_id, model_digest, undamaged_version)
        references assessment (structure_id, batch_id, model_digest, undamaged_version)
) strict, without rowid;

insert into quantity_assessment_2
    select structure_id, batch_id, model_digest, undamaged_version, quantity, position, unit, kind, mean, std,
           variance_within, variance_between, edge_mass, threshold, probability_of_damage, exceeds, relative_change,
           null, null, null, null, null, null, null, null, null, null, null, null
    from quantity_assessment;

drop table quantity_assessment;
alter table quantity_assessment_2 rename to quantity_assessment;

create index quantity_assessment_exceeding
    on quantity_assessment (structure_id, batch_id) where exceeds = 1;

alter table undamaged_state add column conditions text not null default '{}';  -- JSON: covariates it saw
alter table undamaged_state add column doubts text not null default '[]';      -- JSON: sentences
alter table undamaged_quantity add column detail text;       -- JSON: interval of δ, pooled δ, chart reference
alter table undamaged_quantity add column mean_draws blob;   -- f64, unit; posterior draws of the mean
alter table undamaged_quantity add column std_draws blob;    -- f64, unit; paired with them

-- One row a batch on each chart. `series` is the parameter of a damage chart, or 'simulation:fit'.
create table chart_point (
    structure_id      text    not null,
    undamaged_version integer not null,  -- 0 for the fit, which needs no undamaged state
    series            text    not null,
    measured_to_us    integer not null,  -- the point's place in time
    batch_id          text    not null,
    shift             real    not null,  -- standard errors towards damage; for the fit, 1 = rejected
    shift_limit       real    not null,
    ewma_limit        real,              -- null = none
    probability_limit real,              -- probability of damage that stands at the limit
    held              integer not null check (held in (0, 1)),
    ewma              real    not null,
    above             integer not null check (above in (0, 1)),
    state             text    not null check (state in ('normal', 'pending', 'alarming', 'recovering', 'silent')),
    primary key (structure_id, undamaged_version, series, measured_to_us, batch_id),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
) strict, without rowid;

create index chart_point_by_batch on chart_point (structure_id, batch_id);

create table alarm_episode (
    structure_id         text    not null references structure (structure_id),
    episode              integer not null check (episode > 0),
    kind                 text    not null check (kind in ('damage', 'simulation_does_not_fit', 'silence')),
    series               text    not null,  -- parameter of a damage alarm, 'simulation:fit', or 'structure:silence'
    undamaged_version    integer not null,
    opened_at_us         integer not null,  -- time of the measurement that made it an alarm
    opened_batch         text,              -- null for silence
    ended_at_us          integer,           -- null while it lasts
    withdrawn            integer not null check (withdrawn in (0, 1)),  -- late data showed that there was none
    peak_shift           real    not null,  -- standard errors
    noticed_at_us        integer not null,  -- when the service raised it
    acknowledged_at_us   integer,
    acknowledged_by      text,
    acknowledgement_note text,
    primary key (structure_id, episode)
) strict, without rowid;

create index alarm_episode_by_series on alarm_episode (structure_id, kind, series, opened_at_us);

create table maintenance_window (
    structure_id  text    not null references structure (structure_id),
    from_us       integer not null,
    to_us         integer not null check (to_us > from_us),
    reason        text    not null,
    created_at_us integer not null,
    primary key (structure_id, from_us, to_us)
) strict, without rowid;
