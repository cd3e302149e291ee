-- The processes of this database: where other nodes reach them, and which of them holds the lock of the service. These tables belong to the
-- database and not to the data: they are not moved to another one. A program of the version before works without them.

create table node (
    node_id         text        not null primary key,  -- a new one for each start of a process
    url             text        not null,               -- address for other nodes
    program_version text        not null,
    roles           text        not null default 'api',
    -- Process of the server whose session holds the lock for this node; null while it stands by.
    lock_session    integer,
    started_at      timestamptz not null default clock_timestamp(),
    heartbeat_at    timestamptz not null default clock_timestamp()
);

-- By this secret a node knows that a request was forwarded by another node of this database.
create table node_secret (
    only_row boolean not null primary key default true check (only_row),
    secret   text    not null
);
-- Two times 122 random bits, without an extension of the server.
insert into node_secret (secret)
values (replace(gen_random_uuid()::text || gen_random_uuid()::text, '-', ''));

-- The process that has held the lock of the service last. One that loses the lock and takes it again has to be the same: otherwise another has
-- written in between, and what it knows is out of date.
alter table application add column held_by text;
