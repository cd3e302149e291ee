//! The store on a PostgreSQL server, the program on it, and moving data there and back.
//!
//! Each test has a database of its own on a server that the first test starts in a temporary folder, on a free port, and that ends with the
//! tests. Without PostgreSQL the tests are skipped.

mod access;
mod attacks;
mod claims;
mod cluster;
#[path = "../store/contract/mod.rs"]
#[allow(clippy::duplicate_mod, reason = "the same tests with another database")]
mod contract;
mod database;
mod differential;
mod failover;
mod forwarding;
mod jobs;
mod node;
mod opening;
mod plans;
#[path = "../notify/receiver.rs"]
#[allow(dead_code, reason = "shared with the tests of webhooks")]
mod receiver;
mod recovery;
mod server;
mod transfer;
mod under_load;
mod workers;
mod world;
