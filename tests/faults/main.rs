//! Faults from outside: the real program under kills, full and failing disks, jumping clocks, damaged files, hostile clients.
//!
//! `tests/README.md` lists every case with its test. What needs a tool that is not there (`fiu-run`, `faketime`, the right to
//! mount) says so in one line and passes.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod clients;
mod clock;
mod damage;
mod disk;
#[allow(dead_code, reason = "of the helpers of tests/api not all are used here")]
#[path = "../api/helpers.rs"]
mod helpers;
mod input;
mod io;
mod kit;
mod models;
mod soak;
mod stop;
