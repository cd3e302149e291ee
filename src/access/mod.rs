//! Who may do what: tokens, scopes, and the decision on a request. Knows neither HTTP nor SQL.
//!
//! ```text
//!  mw_<id>_<secret>      what a client holds: id 16, secret 52 characters of base32
//!      │      └────────  256 random bits, shown once; stored is their SHA-256
//!      └───────────────  public: finds the row, and names the token in lists, logs and the audit
//! ```
//!
//! A plain SHA-256 is enough for a secret of 256 random bits: nobody can try them all. (Passwords, which people choose,
//! would need a slow hash.)

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

/// Who gets in before and without the stored tokens.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AccessSettings {
    /// A file with one token that counts as admin; readable by its owner (and group) only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub admin_token_file: Option<PathBuf>,
    /// Serve a public address without any token. Everybody who reaches it may do everything.
    pub insecure_public: bool,
}
