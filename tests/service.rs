//! The real program over HTTP, MQTT, mail and its command line.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod access;
mod api;
mod commands;
#[path = "api/helpers.rs"]
#[allow(dead_code, reason = "shared with other test binaries")]
mod helpers;
#[path = "zz_skipped/needs.rs"]
#[allow(dead_code, reason = "shared with other test binaries")]
mod needs;
mod notify;
mod operations;
mod size;
