//! Faults of the machine, of files and of clients, and attacks from outside.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod faults;
#[path = "api/helpers.rs"]
#[allow(dead_code, reason = "shared with other test binaries")]
mod helpers;
#[path = "zz_skipped/needs.rs"]
#[allow(dead_code, reason = "shared with other test binaries")]
mod needs;
mod redteam;

// What the fuzz targets import from the root of their own crate.
extern crate self as libfuzzer_sys;
pub(crate) use redteam::seeds::{fuzz_target, world};
