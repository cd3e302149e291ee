//! Operating the real program: backups, archives, models replaced under load, disks that fail, databases of earlier versions.

mod archive;
mod archive_references;
mod backup;
mod damaged_rows;
mod deployment;
mod doctor;
mod migration;
mod models;
mod monitoring;
mod output;
mod prometheus;
mod storage;
mod stored;
mod supervision;
mod world;
