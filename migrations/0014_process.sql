-- The process behind an undamaged reference, and the batches that are compared with it.

create table undamaged_process (
    structure_id text    not null,
    version      integer not null,
    process      text,              -- JSON; null if none could be fitted
    reason       text,              -- why there is none
    primary key (structure_id, version),
    foreign key (structure_id, version) references undamaged_state (structure_id, version)
) strict, without rowid;

create table process_point (
    structure_id      text    not null,
    undamaged_version integer not null,
    measured_to_us    integer not null,  -- the batch's place in time
    batch_id          text    not null,
    estimate          text    not null,  -- JSON: means, covariance of their errors, covariates
    held              integer not null check (held in (0, 1)),  -- compared, but not part of the chain
    known             blob    not null,  -- f64: mean and covariance of the states after the batch
    changes           text,              -- JSON: onset and size on the charts above their limits; null without any
    primary key (structure_id, undamaged_version, measured_to_us, batch_id),
    foreign key (structure_id, batch_id) references measurement_batch (structure_id, batch_id)
) strict, without rowid;

create index process_point_by_batch on process_point (structure_id, batch_id);

-- Evidence on the slow chart of a process; null on the other charts, whose moving average follows from the shifts.
alter table chart_point add column slow real;
