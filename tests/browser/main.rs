//! The dashboard of the real program in a real browser.
//!
//! Needs `chromium`, and `axe-core` in `target/browser/` (`.ci/tools` sees to both); without them the tests say so in
//! one line and pass.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod chromium;
mod dashboard;
mod extension;
#[allow(dead_code, reason = "of the helpers of tests/api some are enough here")]
#[path = "../api/helpers.rs"]
mod helpers;
mod sign_in;
