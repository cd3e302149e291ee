//! Operating the real program: backups, archives, models replaced under load, disks that fail, databases of earlier versions.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod archive;
mod archive_references;
mod backup;
mod damaged_rows;
mod deployment;
mod doctor;
#[path = "../api/helpers.rs"]
#[allow(dead_code, reason = "shared with the tests of the API")]
mod helpers;
mod migration;
mod models;
mod monitoring;
mod output;
mod prometheus;
mod storage;
mod stored;
mod supervision;
mod world;
