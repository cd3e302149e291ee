//! The store on SQLite and on PostgreSQL, and several nodes that share a server.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

#[path = "api/helpers.rs"]
#[allow(dead_code, reason = "shared with other test binaries")]
mod helpers;
#[path = "zz_skipped/needs.rs"]
#[allow(dead_code, reason = "shared with other test binaries")]
mod needs;
mod postgres;
mod store;
