//! Attacks from outside on the real program.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod definitions;
#[allow(dead_code, reason = "of the helpers of tests/api not all are used here")]
#[path = "../api/helpers.rs"]
mod helpers;
