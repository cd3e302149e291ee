//! modalwatch
pub mod assessment;
pub mod baseline;
pub mod cli;
pub mod config;
pub mod damage;
pub mod flow;
pub mod http;
pub mod measurement;
pub mod monitor;
pub mod parameter;
pub mod physics;
pub mod posterior;
pub mod quantity;
pub mod simulator;
pub mod stats;
pub mod store;
pub mod telemetry;
