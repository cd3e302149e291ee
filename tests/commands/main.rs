//! The commands as a person or a script runs them: exit status, sentences about mistakes, rehearsals, and what is shown of a structure.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod check;
mod demo;
mod design;
#[path = "../api/helpers.rs"]
#[allow(dead_code, reason = "shared with tests/api, which uses all of it")]
mod helpers;
mod mistakes;
mod new;
mod simulate;
mod words;
mod world;
