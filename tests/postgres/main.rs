//! The store on a PostgreSQL server, the program on it, and moving data there and back.
//!
//! Each test has a database of its own on a server that the first test starts in a temporary folder, on a free port, and that ends with the
//! tests. Without PostgreSQL the tests are skipped.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod claims;
#[path = "../store/contract/mod.rs"]
mod contract;
mod database;
mod differential;
mod failover;
#[path = "../api/helpers.rs"]
#[allow(dead_code, reason = "shared with the tests of the API")]
mod helpers;
#[path = "../zz_skipped/needs.rs"]
#[allow(dead_code, reason = "shared with other tests")]
mod needs;
mod opening;
mod server;
mod transfer;
mod workers;
mod world;
