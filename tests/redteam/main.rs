//! Attacks on the running program: each test does what an attacker did, and measures that others are served.
//!
//! By default the program of this build is attacked. `MODALWATCH_BINARY=/path/to/modalwatch cargo test --release --test redteam` attacks
//! another build; settings that it does not know are left at its defaults. `seeds` runs the fuzz targets on this build.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

// The name by which the fuzz targets import their macro.
extern crate self as libfuzzer_sys;

mod definitions;
mod details;
#[path = "../api/helpers.rs"]
#[allow(dead_code, reason = "shared with tests/api, which uses all of it")]
mod helpers;
mod seeds;
mod slow_readers;
mod soak;
mod streams;
mod structures;
mod target;
pub(crate) use seeds::{fuzz_target, world};
