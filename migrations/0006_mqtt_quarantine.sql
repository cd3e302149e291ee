-- Messages from the broker that can never become a batch, and why. Acknowledged all the same, so that they do not come again
-- for ever.

create table quarantine (
    message       integer primary key autoincrement,
    topic         text    not null,
    digest        text    not null,  -- SHA-256 of the whole payload
    payload       blob    not null,  -- its beginning, at most 64 KiB
    payload_bytes integer not null,  -- of the whole
    reason        text    not null,  -- the last one
    tries         integer not null check (tries > 0),  -- how often it was tried, over all its arrivals
    first_at_us   integer not null,
    last_at_us    integer not null,
    unique (topic, digest)
) strict;
