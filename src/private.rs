//! Files and folders that only their owner can use, whatever the mask of the process (umask) says.
//!
//! The database holds the signing secrets of webhooks, and whoever can open the lock file can keep the service from starting.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::Path;

/// Permission bits of a file and of a folder that only their owner can use.
#[cfg(unix)]
const FILE: u32 = 0o600;
#[cfg(unix)]
const FOLDER: u32 = 0o700;

/// Creates a folder and its missing parents; folders that exist keep their permissions.
///
/// # Errors
/// A folder that cannot be created.
pub fn create_folder(path: &Path) -> io::Result<()> {
    let mut builder = fs::DirBuilder::new();
    builder.recursive(true);
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, FOLDER);
    builder.create(path)
}

/// Opens a file with `options`; a file that this creates is its owner's only.
///
/// # Errors
/// A file that cannot be opened.
pub fn open(options: &mut OpenOptions, path: &Path) -> io::Result<File> {
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(options, FILE);
    options.open(path)
}

/// A temporary folder inside `parent` that is removed when it is dropped.
///
/// # Errors
/// A folder that cannot be created.
pub fn temporary_folder(prefix: &str, parent: &Path) -> io::Result<tempfile::TempDir> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(prefix);
    #[cfg(unix)]
    builder.permissions(<fs::Permissions as std::os::unix::fs::PermissionsExt>::from_mode(FOLDER));
    builder.tempdir_in(parent)
}

/// Takes a file or folder, and all that is in it, from everybody but the owner. What is missing, links, and what belongs to somebody
/// else stay as they are.
///
/// # Errors
/// Permissions that cannot be changed, or a folder that cannot be listed, although they belong to this user.
#[cfg(unix)]
pub fn narrow(path: &Path) -> io::Result<()> {
    use std::os::unix::fs::PermissionsExt as _;
    let metadata = match fs::symlink_metadata(path) {
        Ok(metadata) if metadata.is_symlink() => return Ok(()),
        Ok(metadata) => metadata,
        Err(missing) if missing.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(other) => return Err(other),
    };
    let mode = metadata.permissions().mode() & 0o777;
    // The owner's own bits stay: a backup may be kept read-only.
    if mode & 0o077 != 0 {
        match fs::set_permissions(path, fs::Permissions::from_mode(mode & 0o700)) {
            // It belongs to somebody else.
            Err(refused) if refused.kind() == io::ErrorKind::PermissionDenied => return Ok(()),
            changed => changed?,
        }
    }
    if !metadata.is_dir() {
        return Ok(());
    }
    let entries = match fs::read_dir(path) {
        // A backup that another user has made.
        Err(refused) if refused.kind() == io::ErrorKind::PermissionDenied => return Ok(()),
        entries => entries?,
    };
    for entry in entries {
        narrow(&entry?.path())?;
    }
    Ok(())
}

/// Without Unix permissions there is nothing to change.
///
/// # Errors
/// None.
#[cfg(not(unix))]
pub fn narrow(_: &Path) -> io::Result<()> {
    Ok(())
}

#[cfg(unix)]
#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    fn mode(path: &Path) -> u32 {
        fs::symlink_metadata(path).unwrap().permissions().mode() & 0o777
    }

    #[test]
    fn only_the_owner_keeps_permissions_and_links_are_not_followed() {
        let outside = tempfile::tempdir().unwrap();
        let other = outside.path().join("other");
        fs::write(&other, "").unwrap();
        fs::set_permissions(&other, fs::Permissions::from_mode(0o644)).unwrap();

        let folder = temporary_folder(".draft-", outside.path()).unwrap();
        assert_eq!(mode(folder.path()), 0o700);
        let (inner, read_only) = (folder.path().join("a/b"), folder.path().join("a/read-only"));
        create_folder(&inner).unwrap();
        assert_eq!(mode(&inner), 0o700);
        fs::set_permissions(&inner, fs::Permissions::from_mode(0o755)).unwrap();
        fs::write(&read_only, "").unwrap();
        fs::set_permissions(&read_only, fs::Permissions::from_mode(0o444)).unwrap();
        std::os::unix::fs::symlink(&other, folder.path().join("a/link")).unwrap();
        narrow(folder.path()).unwrap();
        assert_eq!((mode(&inner), mode(&read_only), mode(&other)), (0o700, 0o400, 0o644));
        narrow(&folder.path().join("missing")).unwrap();
    }
}
