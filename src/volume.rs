//! The file system that a folder is on: its free space, and whether it is local.
//!
//! SQLite protects a database by file locks and shared memory. Network file systems guarantee neither.

use std::io;
use std::path::Path;

/// File system types on Linux: magic number, name, whether it is a network file system.
const KINDS: [(u32, &str, bool); 22] = [
    (0x0000_ef53, "ext4", false),
    (0x5846_5342, "xfs", false),
    (0x9123_683e, "btrfs", false),
    (0x2fc1_2fc1, "zfs", false),
    (0xf2f5_2010, "f2fs", false),
    (0x0102_1994, "tmpfs", false),
    (0x794c_7630, "overlay", false),
    (0x0000_4d44, "vfat", false),
    (0x2011_bab0, "exfat", false),
    (0xca45_1a4e, "bcachefs", false),
    (0x6573_5546, "fuse", false),
    (0x0000_6969, "nfs", true),
    (0x0000_517b, "smb", true),
    (0xfe53_4d42, "smb2", true),
    (0xff53_4d42, "cifs", true),
    (0x0102_1997, "9p", true),
    (0x5346_414f, "afs", true),
    (0x00c3_6400, "ceph", true),
    (0x7375_7245, "coda", true),
    (0x7461_636f, "ocfs2", true),
    (0x0116_1970, "gfs2", true),
    (0x0bd0_0bd0, "lustre", true),
];

/// A mounted file system.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Volume {
    /// Free space available to this user, bytes.
    pub free_bytes: u64,
    /// Size, bytes.
    pub total_bytes: u64,
    /// Name of the file system type, or its magic number in hexadecimal where the name is unknown.
    pub file_system: String,
    /// Whether it is a network file system.
    pub network: bool,
}

/// The file system that contains an existing folder or file.
///
/// # Errors
/// The error of the operating system.
pub fn of(path: &Path) -> io::Result<Volume> {
    let room = rustix::fs::statvfs(path)?;
    let (file_system, network) = kind(path)?;
    Ok(Volume {
        free_bytes: room.f_bavail.saturating_mul(room.f_frsize),
        total_bytes: room.f_blocks.saturating_mul(room.f_frsize),
        file_system,
        network,
    })
}

/// Free space on the volume of `path`, bytes: a single system call, cheap enough to make before each write.
///
/// # Errors
/// The error of the operating system.
pub fn free_bytes(path: &Path) -> io::Result<u64> {
    let room = rustix::fs::statvfs(path)?;
    Ok(room.f_bavail.saturating_mul(room.f_frsize))
}

#[cfg(target_os = "linux")]
fn kind(path: &Path) -> io::Result<(String, bool)> {
    Ok(named(rustix::fs::statfs(path)?.f_type as u32))
}

/// On other systems the magic numbers have other meanings.
#[cfg(not(target_os = "linux"))]
fn kind(_: &Path) -> io::Result<(String, bool)> {
    Ok(("unknown".to_owned(), false))
}

#[cfg(target_os = "linux")]
fn named(number: u32) -> (String, bool) {
    let known = KINDS.iter().find(|(known, ..)| *known == number);
    known.map_or_else(|| (format!("{number:#x}"), false), |(_, name, network)| ((*name).to_owned(), *network))
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn a_local_folder_has_free_space_and_is_not_on_a_network() {
        let volume = of(Path::new("/")).unwrap();
        assert!(!volume.network && volume.total_bytes >= volume.free_bytes && volume.total_bytes > 0, "{volume:?}");
        assert!(of(Path::new("/no/such/folder")).is_err());
    }

    #[test]
    fn network_file_systems_are_recognised() {
        // Numbers from linux/magic.h, repeated here on purpose.
        for (number, name, network) in [(0x6969, "nfs", true), (0xff53_4d42, "cifs", true), (0xef53, "ext4", false)] {
            assert_eq!(named(number), (name.to_owned(), network));
        }
        assert_eq!(named(0x1234_5678), ("0x12345678".to_owned(), false));
    }
}
