-- What partitions of the measurements by month would cost: psql -f benches/partitions.sql on an empty database. Makes 200,000 measurements of
-- ten years in a table as the service has it, and in one with 120 partitions, and runs the statements of the service that read them.
\set ON_ERROR_STOP on
\set QUIET on
\pset tuples_only on
set client_min_messages = warning;
drop table if exists plain, parted;
create table plain (
    structure_id text collate "C" not null, batch_id text collate "C" not null, ordinal bigint not null, source text collate "C" not null,
    measured_at_us bigint not null, frequency_hz bytea not null, std_hz bytea, covariates text collate "C" not null,
    settings text collate "C" not null, mode_shapes text collate "C",
    primary key (structure_id, batch_id, ordinal), unique (structure_id, source, measured_at_us));
-- The keys of a partitioned table must have the column by which it is divided.
create table parted (like plain,
    primary key (structure_id, batch_id, ordinal, measured_at_us), unique (structure_id, source, measured_at_us))
    partition by range (measured_at_us);
do $$ begin
    for month in 0..119 loop
        execute format('create table parted_%s partition of parted for values from (%s) to (%s)', month,
            (extract(epoch from date '2016-01-01' + make_interval(months => month)) * 1e6)::bigint,
            (extract(epoch from date '2016-01-01' + make_interval(months => month + 1)) * 1e6)::bigint);
    end loop;
end $$;
-- 40,000 batches of five measurements, of 100 structures.
insert into plain
    select 's' || batch % 100, '01890000-0000-7000-8000-' || lpad(batch::text, 12, '0'), k, 'logger',
        (extract(epoch from timestamp '2016-01-01') * 1e6)::bigint + (batch / 100)::bigint * 788400000000 + k * 10000000,
        '\x0102030405060708'::bytea, null, '{}', '{}', null
    from generate_series(0, 39999) batch, generate_series(0, 4) k;
insert into parted select * from plain;
analyze plain, parted;

-- Milliseconds of a statement with a structure ($1), a batch ($2) and a time ($3), on average of a thousand.
create or replace function pg_temp.mean_ms(statement text) returns numeric language plpgsql as $$
declare
    started timestamptz;
    number integer;
begin
    execute 'prepare tried (text, text, bigint) as ' || statement;
    for round in 1..1100 loop
        if round = 101 then started = clock_timestamp(); end if;
        number = (round * 7919) % 40000;
        execute format('execute tried (%L, %L, %s)', 's' || number % 100, '01890000-0000-7000-8000-' || lpad(number::text, 12, '0'),
            (extract(epoch from timestamp '2016-01-01') * 1e6)::bigint + (number / 100)::bigint * 788400000000);
    end loop;
    deallocate tried;
    return round((extract(epoch from clock_timestamp() - started))::numeric, 3);
end $$;
select t || ': measurements of a batch, ms: ' || pg_temp.mean_ms(format(
    'select measured_at_us, frequency_hz from %s where structure_id = $1 and batch_id = $2 order by ordinal', t))
    from unnest(array['plain', 'parted', 'plain', 'parted']) t;
select t || ': whether one of 20 measurements is stored, ms: ' || pg_temp.mean_ms(format(
    'select k.n, m.batch_id from generate_series(1, 20) with ordinality k (second, n) cross join %s m where m.structure_id = $1
       and m.source = ''logger'' and $2 is not null and m.measured_at_us = $3 + 1000000 * k.second + 7 order by k.n limit 1', t))
    from unnest(array['plain', 'parted', 'plain', 'parted']) t;
select t || ': the same with the first and last time, by which the server can leave partitions out, ms: ' || pg_temp.mean_ms(format(
    'select k.n, m.batch_id from generate_series(1, 20) with ordinality k (second, n) cross join %s m where m.structure_id = $1
       and m.source = ''logger'' and $2 is not null and m.measured_at_us = $3 + 1000000 * k.second + 7
       and m.measured_at_us between $3 and $3 + 100000000 order by k.n limit 1', t))
    from unnest(array['plain', 'parted', 'plain', 'parted']) t;
select t || ': the measurement before a time, ms: ' || pg_temp.mean_ms(format(
    'select frequency_hz from %s where structure_id = $1 and source = ''logger'' and $2 is not null and measured_at_us < $3
       order by measured_at_us desc limit 1', t))
    from unnest(array['plain', 'parted', 'plain', 'parted']) t;
drop table plain, parted;
