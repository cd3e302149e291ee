//! Claims of the crates below the service: laws, exact solutions by other methods, figures of the paper, and what is hidden in data.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod baseline;
mod discrepancy;
mod emulator;
mod flow;
mod measurement;
#[path = "zz_skipped/needs.rs"]
#[allow(dead_code, reason = "shared with other test binaries")]
mod needs;
mod physics;
mod posterior;
mod reference;
mod reproduce;
mod seasons;
