//! Tokens, limits, audit and headers, on the real program.

mod audit;
mod limits;
mod routes;
mod secrets;
mod sources;
mod start;
mod tokens;
pub mod world;
