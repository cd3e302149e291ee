-- Mode shapes beside the frequencies of a measurement.

-- JSON: one entry a mode, a list with a number for each instrumented point, null where the shape was not identified.
alter table measurement add column mode_shapes text;  -- null without any, and in rows from before
