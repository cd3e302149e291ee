//! The dashboard of the real program in a real browser.
//!
//! Needs `chromium`, and `axe-core` in `target/browser/` (`.ci/tools` installs both); without them the tests are recorded as
//! skipped.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

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
#[allow(dead_code, reason = "not every test binary needs every kind of thing")]
#[path = "../zz_skipped/needs.rs"]
mod needs;
mod pages;
mod rejected;
mod sign_in;
mod speed;
mod training;
mod upload;
mod verdict;
mod walk;
