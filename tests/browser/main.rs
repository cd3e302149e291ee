//! The dashboard of the real program in a real browser.
//!
//! Needs `chromium`, and `axe-core` in `target/browser/` (`.ci/tools` installs both); without them the tests are recorded as
//! skipped.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod accessible;
mod chromium;
mod dashboard;
mod extension;
mod figures;
mod firefox;
mod guide;
#[allow(dead_code, reason = "of the helpers of tests/api some are enough here")]
#[path = "../api/helpers.rs"]
mod helpers;
mod hostile;
mod labels;
mod lasting_change;
#[allow(dead_code, reason = "not every test binary needs every kind of thing")]
#[path = "../zz_skipped/needs.rs"]
mod needs;
mod pages;
mod rejected;
mod saved;
mod shapes;
mod sign_in;
mod speed;
#[path = "../api/tower.rs"]
mod tower;
mod training;
mod units;
mod upload;
mod verdict;
mod walk;
#[allow(dead_code, unused_imports, reason = "of the worlds of tests/discrepancy only the frequencies are used here")]
#[path = "../discrepancy/world/mod.rs"]
mod world;
