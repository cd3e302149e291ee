//! The store on a SQLite file.

mod contract;
mod database;
