//! The reproduction of the paper.

mod fake;
mod program;
mod report;
