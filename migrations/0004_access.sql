-- Tokens and the audit: who may do what, and who did.

create table api_token (
    token_id          text    not null primary key,  -- the public part of mw_<id>_<secret>
    name              text    not null,
    ingest            integer not null check (ingest in (0, 1)),
    read              integer not null check (read in (0, 1)),
    admin             integer not null check (admin in (0, 1)),
    limited           integer not null check (limited in (0, 1)),  -- to the structures of api_token_structure
    digest            blob    not null check (length(digest) = 32),  -- SHA-256 of the secret, which is kept nowhere
    previous_digest   blob    check (length(previous_digest) = 32),  -- of the secret before the last rotation
    previous_until_us integer,                                       -- and until when that one is good
    created_at_us     integer not null,
    expires_at_us     integer,
    revoked_at_us     integer,  -- a revoked token stays: its id is in the audit, and the service stays closed
    check (ingest + read + admin > 0),
    check ((previous_digest is null) = (previous_until_us is null))
) strict, without rowid;

-- No foreign key on the structure: a token may be made before its structure is.
create table api_token_structure (
    token_id     text not null references api_token (token_id),
    structure_id text not null,
    primary key (token_id, structure_id)
) strict, without rowid;

-- Written before a change is tried; its status is added after. Without a status the program ended in between.
create table audit_entry (
    entry_id     integer not null primary key autoincrement,
    at_us        integer not null,
    actor        text    not null,  -- id of the token, or 'local'
    actor_name   text,              -- name of the token then
    peer         text,              -- address of the client
    request_id   text,
    action       text    not null,  -- method and route, or command
    structure_id text,
    subject      text,              -- path of what was changed or made
    status       integer            -- HTTP status; 200 and 500 for a command
) strict;

create index audit_entry_by_time on audit_entry (at_us, entry_id);
