//! Reproduction of the paper: both of its cases by all three methods, over many repetitions, compared with its printed values.
//!
//! Source: Wang et al. (2025), MSSP 232, 112743; sections 5 and 6, Tables 3 to 10, Figures 8 to 22.

mod case1;
mod case2;
mod paper;
pub mod report;
mod result;
mod trial;

pub use case1::case1;
pub use case2::{case2, configurations};
pub use result::{
    Accuracy, Case, Compared, Configuration, LawFit, Machine, Method, MethodSamples, Quantity, Reproduction, Rig, Row,
    Settings, Spread, State, Time,
};
