//! Faults from outside: the real program under kills, full and failing disks, jumping clocks, damaged files, hostile clients.
//!
//! `tests/README.md` lists every case with its test. A test whose tool is missing (`fiu-run`, `faketime`, the right to mount) is
//! recorded as skipped, by `tests/zz_skipped/needs.rs`.

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
#[allow(dead_code, reason = "not every test binary needs every kind of thing")]
#[path = "../zz_skipped/needs.rs"]
mod needs;
mod soak;
mod stop;
