//! Charts of the process behind an undamaged reference on frequencies measured at real bridges, over their seasons.
//!
//! The data are not part of the repository; without them the tests are counted as skipped.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod consoli;
mod estimates;
#[allow(dead_code, reason = "not every test binary needs every kind of thing")]
#[path = "../zz_skipped/needs.rs"]
mod needs;
mod sciri;
mod watch;
mod worlds;
mod z24;
