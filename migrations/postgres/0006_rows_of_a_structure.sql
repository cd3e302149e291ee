-- The server plans as if a single structure had all rows of a table.
--
-- A plan that a connection keeps is made for any structure, so that the server assumes the rows of an average one. Structures differ much: one
-- may have a million batches beside a thousand that have ten. For the large one the server would then read all its rows, and search them for
-- each batch of a list, instead of looking up each batch by its key. A key is never slow, whichever structure it is.

do $$
declare
    name text;
begin
    foreach name in array array[
        'measurement_batch', 'measurement', 'assessment', 'quantity_assessment', 'chart_point', 'process_point',
        'undamaged_batch', 'kept_comparison', 'alarm_episode', 'alarm_action', 'computation_result'] loop
        execute format('alter table %I alter column structure_id set (n_distinct = 1)', name);
        -- It holds from the next count of the rows on.
        execute format('analyze %I', name);
    end loop;
end $$;
