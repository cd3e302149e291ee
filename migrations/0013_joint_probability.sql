-- Correlations of the parameters, and the joint probability that any of them is beyond its threshold.

-- JSON; null where the correlations are not estimated, and in rows from before.
alter table undamaged_state add column joint text;
alter table assessment add column joint text;
