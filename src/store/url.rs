//! The setting `store.url`: the database of a PostgreSQL server.

use std::fmt;
use std::str::FromStr as _;

use serde::{Deserialize, Deserializer, Serialize, Serializer};
use sqlx_postgres::PgConnectOptions;

use crate::quantity::shown;

/// Schemes of a PostgreSQL URL.
const SCHEMES: [&str; 2] = ["postgres", "postgresql"];

/// URL of a database of a PostgreSQL server, such as `postgres://user:password@host:5432/database`.
///
/// A password can also come from the variable `PGPASSWORD` or from a password file of PostgreSQL. It is never shown: as a text, the URL has
/// `***` in its place.
#[derive(Clone, PartialEq, Eq)]
pub struct DatabaseUrl(String);

/// Why a text is not a URL of a database.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum UrlError {
    /// The URL of a SQLite file.
    #[error(
        "the SQLite database is the file modalwatch.sqlite of the data folder: leave store.url out and set data_dir (--data-dir)"
    )]
    Sqlite,
    /// Another scheme, or none.
    #[error("{0} is not the URL of a PostgreSQL database, which is like postgres://user:password@host:5432/database")]
    Scheme(String),
    /// The server or the database is missing or unreadable.
    #[error("{url}: {reason}; a URL is like postgres://user:password@host:5432/database")]
    Part {
        /// The URL, without its password.
        url: String,
        /// What is wrong with it.
        reason: String,
    },
}

impl DatabaseUrl {
    /// Reads a URL.
    ///
    /// # Errors
    /// [`UrlError`], which never has the password.
    pub fn parse(text: &str) -> Result<Self, UrlError> {
        let text = text.trim();
        let (scheme, rest) = text.split_once(':').ok_or_else(|| UrlError::Scheme(shown(text)))?;
        if scheme.eq_ignore_ascii_case("sqlite") {
            return Err(UrlError::Sqlite);
        }
        if !SCHEMES.contains(&scheme) || !rest.starts_with("//") {
            // Before the scheme is known to be one of a database, the text may be anything, also a secret in the wrong place.
            return Err(UrlError::Scheme(format!("a text that begins with {}", shown(scheme))));
        }
        let url = Self(text.to_owned());
        let part = |reason: String| UrlError::Part { url: url.to_string(), reason };
        let options = PgConnectOptions::from_str(text).map_err(|error| part(error.to_string()))?;
        match options.get_database() {
            None | Some("") => Err(part("it names no database".to_owned())),
            Some(_) => Ok(url),
        }
    }

    /// How to connect.
    ///
    /// # Errors
    /// Never, after [`Self::parse`], unless a file that it names has gone.
    pub(super) fn options(&self) -> Result<PgConnectOptions, sqlx::Error> {
        PgConnectOptions::from_str(&self.0)
    }
}

impl fmt::Display for DatabaseUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (scheme, rest) = self.0.split_once("//").unwrap_or(("postgres:", &self.0));
        // The last @ ends the user: all before it may belong to a password that was not encoded, also what looks like options.
        write!(f, "{scheme}//")?;
        let rest = if let Some((user, place)) = rest.rsplit_once('@') {
            let (name, password) = user.split_once(':').map_or((user, ""), |(name, _)| (name, ":***"));
            write!(f, "{name}{password}@")?;
            place
        } else {
            rest
        };
        let (address, options) =
            rest.split_once('?').map_or((rest, None), |(address, options)| (address, Some(options)));
        f.write_str(address)?;
        let Some(options) = options else { return Ok(()) };
        let shown: Vec<&str> =
            options.split('&').map(|option| if may_be_shown(option) { option } else { "***" }).collect();
        write!(f, "?{}", shown.join("&"))
    }
}

/// Whether an option of a URL is none with a password, also under a name that is written with escapes.
fn may_be_shown(option: &str) -> bool {
    let name = option.split_once('=').map_or(option, |(name, _)| name).to_ascii_lowercase();
    name.chars().all(|c| c.is_ascii_alphanumeric() || "_-.".contains(c)) && !name.contains("pass")
}

impl fmt::Debug for DatabaseUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}

impl Serialize for DatabaseUrl {
    /// With `***` for the password, for `modalwatch config print`.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for DatabaseUrl {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        Self::parse(&text).map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_password_is_never_shown() {
        for (text, shown) in [
            ("postgres://watch:secret@db.example:5433/shm", "postgres://watch:***@db.example:5433/shm"),
            ("postgresql://watch:s%40cret@db/shm?sslmode=require", "postgresql://watch:***@db/shm?sslmode=require"),
            ("postgres://watch@db/shm", "postgres://watch@db/shm"),
            ("postgres://db/shm?user=watch&password=secret", "postgres://db/shm?user=watch&***"),
            ("postgres://watch@db/shm?PassWord=secret&sslmode=require", "postgres://watch@db/shm?***&sslmode=require"),
            ("postgres://watch@db/shm?p%61ssword=secret", "postgres://watch@db/shm?***"),
            ("postgres://watch:sec@ret@db/shm", "postgres://watch:***@db/shm"),
            (" postgres://[::1]:5432/shm ", "postgres://[::1]:5432/shm"),
        ] {
            let url = DatabaseUrl::parse(text).unwrap();
            assert_eq!(url.to_string(), shown);
            assert_eq!(format!("{url:?}"), shown);
            assert_eq!(serde_json::to_string(&url).unwrap(), format!("\"{shown}\""));
        }
    }

    #[test]
    fn a_text_that_is_no_url_of_a_database_is_refused_with_the_form_of_one() {
        for (text, says) in [
            ("sqlite:/var/lib/modalwatch", "leave store.url out"),
            ("mysql://root:secret@db/shm", "postgres://user:password@host:5432/database"),
            ("my database", "postgres://user:password@host:5432/database"),
            ("postgres://watch:secret@db", "names no database"),
            ("postgres://watch:secret@db:port/shm", "postgres://user:password@host:5432/database"),
            ("postgres://watch:secret?secret@db/shm", "postgres://watch:***@db/shm"),
            ("postgres://watch:a@secret?secret@db/shm", "postgres://watch:***@db/shm"),
            ("postgres://watch:secret/secret@db/shm", "postgres://watch:***@db/shm"),
            ("postgres://watch:secret#secret@db/shm", "postgres://watch:***@db/shm"),
        ] {
            let error = DatabaseUrl::parse(text).unwrap_err().to_string();
            assert!(error.contains(says), "{text}: {error}");
            assert!(!error.contains("secret"), "{error}");
        }
    }
}
