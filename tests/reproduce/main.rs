//! The reproduction of the paper.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod fake;
mod program;
mod report;
