//! The admin token file: a token outside the database, for the first start and for the case that all other tokens are
//! lost.

use std::io::Write as _;
use std::os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};

use super::grant::Scope;
use super::token::{Malformed, NewToken, NoRandomness, TokenRecord, TokenText};
use crate::clock;

/// Name of the token in lists and in the audit.
pub const ADMIN_FILE_TOKEN_NAME: &str = "admin token file";

/// Permission bits of users other than owner and group.
const RIGHTS_OF_OTHERS: u32 = 0o007;

/// Why the file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// It cannot be read or written.
    #[error("the admin token file {path} cannot be used: {source}")]
    File {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// Other users of this machine could read the token.
    #[error("the admin token file {path} has the mode {mode:03o}: every user of this machine could use it; run chmod 600 {path}")]
    OpenToOthers {
        /// The file.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// It contains no token.
    #[error("the admin token file {path} contains no token ({source}): create one with modalwatch token file {path}")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The format of a token.
        source: Malformed,
    },
    /// The operating system provided no random numbers.
    #[error(transparent)]
    Random(#[from] NoRandomness),
}

/// Reads the token; only its digest is kept.
///
/// # Errors
/// [`Error`] if the file is missing, contains no token, or can be used by other users than owner and group.
pub fn read_admin_token(path: &Path) -> Result<TokenRecord, Error> {
    let failed = |source| Error::File { path: path.to_owned(), source };
    let mode = std::fs::metadata(path).map_err(failed)?.permissions().mode() & 0o777;
    if mode & RIGHTS_OF_OTHERS != 0 {
        return Err(Error::OpenToOthers { path: path.to_owned(), mode });
    }
    let text = std::fs::read_to_string(path).map_err(failed)?;
    let text = TokenText::parse(text.trim()).map_err(|source| Error::Malformed { path: path.to_owned(), source })?;
    let new = NewToken {
        name: ADMIN_FILE_TOKEN_NAME.to_owned(),
        scopes: [Scope::Admin].into_iter().collect(),
        structures: None,
        sources: None,
        expires_at: None,
    };
    Ok(new.record(&text, clock::now()))
}

/// Creates a token and writes it to a new file that only its owner can read.
///
/// # Errors
/// [`Error`], also if the file exists.
pub fn write_admin_token(path: &Path) -> Result<TokenText, Error> {
    let failed = |source| Error::File { path: path.to_owned(), source };
    let text = TokenText::generate()?;
    let mut file = std::fs::File::options().write(true).create_new(true).mode(0o600).open(path).map_err(failed)?;
    writeln!(file, "{}", text.reveal()).and_then(|()| file.sync_all()).map_err(failed)?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_written_token_reads_back_and_is_admin() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("admin");
        let text = write_admin_token(&path).unwrap();
        let record = read_admin_token(&path).unwrap();
        assert!(record.id == *text.id() && record.manages_service());
        assert!(matches!(write_admin_token(&path), Err(Error::File { .. })), "it is never overwritten");
    }

    #[test]
    fn a_file_for_everybody_or_without_a_token_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("admin");
        write_admin_token(&path).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o644)).unwrap();
        assert!(matches!(read_admin_token(&path), Err(Error::OpenToOthers { mode: 0o644, .. })));
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o640)).unwrap();
        assert!(read_admin_token(&path).is_ok(), "a group may be given it");
        std::fs::write(&path, "secret").unwrap();
        let error = read_admin_token(&path).unwrap_err().to_string();
        assert!(error.contains("modalwatch token file") && !error.contains("secret"), "{error}");
    }
}
