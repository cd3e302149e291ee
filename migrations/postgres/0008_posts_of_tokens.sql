-- An idempotency key belongs to a source of a structure, so that no sender can take the keys of another one. Which token posted a batch is
-- stored, and a token can be limited to sources. A program of the version before works with these tables, but limits no token to sources.

alter table api_token add column sources text collate "C";  -- JSON list of the sources to which its posts are limited; null = all

-- Id of the token with which it was posted; null without one, and in rows from before.
alter table measurement_batch add column posted_by text collate "C";
alter table measurement_batch add unique (structure_id, source, idempotency_key);
alter table measurement_batch drop constraint measurement_batch_structure_id_idempotency_key_key;

-- The source of a key is that of its batch.
alter table further_key drop constraint further_key_pkey;
alter table further_key add primary key (structure_id, idempotency_key, batch_id);
