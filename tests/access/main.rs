//! Tokens, limits, audit and headers, on the real program.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod audit;
#[path = "../api/helpers.rs"]
#[allow(dead_code, reason = "shared with tests/api, which uses all of it")]
mod helpers;
mod limits;
mod routes;
mod secrets;
mod start;
mod tokens;
mod world;
