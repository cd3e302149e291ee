//! The real program on a free port with its own SQLite file.

mod alarms;
mod automatic_diagnosis;
mod bad_input;
mod batches;
mod bulk;
mod changes;
mod condition_report;
mod dependence;
mod diagnosis;
mod docs;
mod export;
mod from_accelerometers;
mod history;
mod hostile;
mod lasting_change;
mod learned;
mod not_judged;
mod openapi;
mod operations;
mod order;
mod overview;
mod reference;
mod reference_extension;
mod replay_view;
mod restart;
mod ruler_frame;
mod tables;
mod together;
mod tower;
mod trainings;
mod uploads;
mod views;
#[allow(dead_code, unused_imports, reason = "of the worlds of tests/discrepancy only the frequencies are used here")]
#[path = "../discrepancy/world/mod.rs"]
mod world;
mod z24;
