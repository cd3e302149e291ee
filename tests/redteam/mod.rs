//! Attacks on the running program: each test does what an attacker did, and measures that others are served.
//!
//! By default the program of this build is attacked. `MODALWATCH_BINARY=/path/to/modalwatch cargo test --release --test robustness redteam::` attacks
//! another build; settings that it does not know are left at its defaults. `seeds` runs the fuzz targets on this build.

mod definitions;
mod details;
mod open_requests;
pub mod seeds;
mod slow_readers;
mod soak;
mod streams;
mod structures;
mod tables;
mod target;
