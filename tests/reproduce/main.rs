//! The reproduction of the paper.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod fake;
#[allow(dead_code, reason = "not every test binary needs every kind of thing")]
#[path = "../zz_skipped/needs.rs"]
mod needs;
mod program;
mod report;
