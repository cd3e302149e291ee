//! How a job ended.

/// How a job ended.
#[derive(Debug, Clone, PartialEq)]
pub enum JobEnd<T> {
    /// With a result.
    Done(T),
    /// With the reason of its failure.
    Failed(String),
    /// By a request.
    Cancelled,
}
