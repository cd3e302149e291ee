//! The checks that every request passes before its handler: authentication, rate limit, authorisation, audit.
//!
//! ```text
//!  request → no token in the URL → grant (of the token, or none on an open service) → rate limit → authorisation
//!          → audit entry, if the request changes something → handler → status of the entry → answer
//! ```
//!
//! A service without a stored token and without an admin token file is *open*: every request may change everything. It
//! is open only on a loopback address, and only to requests that come directly from this machine.

mod client;
mod control;
mod denial;
mod guard;
pub mod headers;
mod issue;
mod journal;
mod limit;
pub mod route;
mod shares;

pub use client::{Client, Key, NotANetwork, Proxies};
pub use control::{AccessControl, Error};
pub use guard::guard;
pub use shares::{Share, Shares};
