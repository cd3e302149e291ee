//! Tokens, scopes, and the decision whether a request is allowed. This module knows neither HTTP nor SQL.
//!
//! ```text
//!  mw_<id>_<secret>      held by the client: id of 16, secret of 52 characters of base32
//!      │      └────────  256 random bits, shown once; the service stores their SHA-256
//!      └───────────────  public: key of the database row, and name of the token in lists, logs and the audit
//! ```
//!
//! A plain SHA-256 is sufficient for a secret of 256 random bits, since nobody can try them all. Passwords, which
//! people choose, would need a slow hash.

mod admin_file;
mod grant;
mod table;
mod token;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

pub use admin_file::{read_admin_token, write_admin_token, Error as AdminFileError, ADMIN_FILE_TOKEN_NAME};
pub use grant::{allow, About, Actor, Denied, Grant, Need, Scope, Scopes};
pub use table::{Refused, TokenTable};
pub use token::{token_like, Malformed, NewToken, NoRandomness, SecretDigest, TokenId, TokenRecord, TokenText};

/// Access to the service before and without stored tokens.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AccessSettings {
    /// File with one token of the scope admin; only its owner and group may be able to read it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub admin_token_file: Option<PathBuf>,
    /// Serve a public address without any token. Everybody who reaches it may change everything.
    pub insecure_public: bool,
}
