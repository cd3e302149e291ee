//! Checks of the data folder, its disk, the database and the backups.

use super::check::{size, Check};
use crate::clock;
use crate::config::Config;
use crate::quantity::Timestamp;
use crate::store::inspect::{inspect, unreadable_on_server, Inspection};
use crate::store::{backup, server, Error, FolderFigures};
use std::cmp::Ordering;

/// A warning is given if the newest backup is older, days.
const OLD_BACKUP_DAYS: i64 = 7;

/// Permissions, file system, free space and write-ahead log of the data folder.
pub fn folder(config: &Config) -> Vec<Check> {
    let dir = &config.data_dir;
    let shown = dir.display();
    if !dir.exists() {
        let next = "nothing to do: the service creates it at its start; give --data-dir if the data is elsewhere";
        return vec![Check::warn("data folder", format!("{shown} does not exist"), next)];
    }
    let mut checks = Vec::new();
    checks.push(match tempfile::Builder::new().prefix(".doctor-").tempfile_in(dir) {
        Ok(_) => Check::ok("data folder", format!("{shown} is writable")),
        Err(error) => {
            let next = format!("give the user of the service write permission: chown -R USER {shown}");
            Check::fail("data folder", format!("{shown} is not writable: {error}"), next)
        }
    });
    if others_may_read(dir) {
        let next = format!("chmod o-rwx {shown}");
        checks.push(Check::warn("permissions", format!("every user of this machine can read {shown}"), next));
    }
    let figures = match FolderFigures::of(dir) {
        Ok(figures) => figures,
        Err(error) => {
            checks.push(Check::fail("file system", error.to_string(), "check the mount"));
            return checks;
        }
    };
    let volume = &figures.volume;
    checks.push(match (volume.network, volume.file_system.as_str()) {
        (false, "fuse") => {
            let next = "make sure that it is a local disk: file locks over a network are unreliable and can corrupt a database";
            Check::warn("file system", "fuse: it is unknown whether the disk is local", next)
        }
        (false, kind) => Check::ok("file system", kind),
        (true, kind) if config.store.allow_network_filesystem => {
            let next = "move the data folder to a local disk and unset store.allow_network_filesystem";
            Check::warn("file system", format!("{kind}, a network file system, which the configuration allows"), next)
        }
        (true, kind) => {
            let next = "give a --data-dir on a local disk, or set store.allow_network_filesystem = true";
            Check::fail("file system", format!("{kind} is a network file system: the service refuses it"), next)
        }
    });
    let (free, floor) = (volume.free_bytes, config.store.min_free_bytes);
    let found = format!("{} of {} are free", size(free), size(volume.total_bytes));
    checks.push(if free < floor {
        let next = format!("free disk space: nothing is stored below store.min_free_bytes = {}", size(floor));
        Check::fail("free disk", found, next)
    } else if free < floor.saturating_mul(4).max(figures.database_bytes) {
        let next = "free disk space soon: a backup needs as much space as the database";
        Check::warn("free disk", found, next)
    } else {
        Check::ok("free disk", found)
    });
    let (wal, most) = (figures.wal_bytes, config.store.max_wal_bytes);
    let found = format!("{}, database {}", size(wal), size(figures.database_bytes));
    checks.push(if wal > most {
        let next = "end long reads (a backup, a large export); afterwards the log is written back to the database and truncated";
        Check::warn("write-ahead log", found, next)
    } else {
        Check::ok("write-ahead log", found)
    });
    checks
}

#[cfg(unix)]
fn others_may_read(dir: &std::path::Path) -> bool {
    use std::os::unix::fs::PermissionsExt as _;
    std::fs::metadata(dir).is_ok_and(|folder| folder.permissions().mode() & 0o004 != 0)
}

#[cfg(not(unix))]
fn others_may_read(_: &std::path::Path) -> bool {
    false
}

/// The checks of the database, and what was read from it.
pub struct DatabaseChecks {
    pub checks: Vec<Check>,
    /// `None` if the database could not be inspected.
    pub inspection: Option<Inspection>,
    /// Whether a service has it open.
    pub in_use: bool,
}

/// SQLite, integrity and schema of a database that no service has open.
pub async fn database(config: &Config) -> DatabaseChecks {
    let only = |check: Check, in_use: bool| DatabaseChecks { checks: vec![check], inspection: None, in_use };
    let restore =
        "restore a backup: modalwatch restore --from BACKUP --replace, which keeps the present file under another name";
    if let Some(url) = &config.store.url {
        let looked = async { Ok::<_, Error>((server::look(url).await?, unreadable_on_server(url).await?)) };
        return match looked.await {
            Ok((found, unreadable)) => {
                let used = if found.in_use { "used by a running service" } else { "no service uses it" };
                let reached = Check::ok("database", format!("{url}: PostgreSQL {}, {used}", found.version));
                let mut checks = only(reached, found.in_use);
                checks.checks.push(stored_texts(&unreadable, "restore a backup of the server"));
                checks
            }
            Err(error) => {
                only(Check::fail("database", error.to_string(), "correct store.url, or start the server"), false)
            }
        };
    }
    let inspection = match inspect(&config.data_dir).await {
        Ok(Some(inspection)) => inspection,
        Ok(None) => return only(Check::ok("database", "none yet: the service creates it at its start"), false),
        Err(Error::Locked(_)) => {
            return only(Check::ok("database", "in use by a running service, which checked it at its start"), true);
        }
        Err(error @ (Error::NotADatabase(_) | Error::Foreign { .. })) => {
            return only(Check::fail("database", error.to_string(), "give another --data-dir"), false);
        }
        Err(error) => return only(Check::fail("database", error.to_string(), restore), false),
    };
    let mut checks = Vec::new();
    checks.push(if inspection.sqlite_is_safe {
        Check::ok("SQLite", inspection.sqlite_version.clone())
    } else {
        let found = format!("{} can corrupt a database", inspection.sqlite_version);
        Check::fail("SQLite", found, "build modalwatch with the bundled SQLite, 3.51.3 or later")
    });
    checks.push(if !inspection.foreign.is_empty() {
        let found = format!("another program has changed the schema: {}", inspection.foreign.join("; "));
        Check::fail("integrity", found, restore)
    } else if !inspection.unreadable.is_empty() {
        stored_texts(&inspection.unreadable, restore)
    } else if inspection.damage.is_empty() && inspection.dangling_rows == 0 {
        Check::ok("integrity", "all pages and references are intact, and stored texts can be read")
    } else {
        let dangling = format!("{} rows refer to rows that do not exist", inspection.dangling_rows);
        let found = if inspection.damage.is_empty() { dangling } else { inspection.damage.join("; ") };
        Check::fail("integrity", found, restore)
    });
    let (found, known) = (inspection.schema_version, inspection.known_schema);
    checks.push(match found.cmp(&known) {
        Ordering::Greater => {
            let found = format!("version {found}, newer than version {known} of this program");
            Check::fail("schema", found, "use a newer modalwatch")
        }
        Ordering::Less => {
            let next = "nothing to do: the service updates the schema at its start; make a backup before";
            Check::warn("schema", format!("version {found}, older than version {known} of this program"), next)
        }
        Ordering::Equal => Check::ok("schema", format!("version {found}")),
    });
    DatabaseChecks { checks, inspection: Some(inspection), in_use: false }
}

/// Whether all stored texts can be read.
fn stored_texts(unreadable: &[String], next: &'static str) -> Check {
    if unreadable.is_empty() {
        Check::ok("integrity", "stored texts can be read")
    } else {
        Check::fail("integrity", format!("stored data cannot be read: {}", unreadable.join("; ")), next)
    }
}

/// Folders of backups and restorations that were broken off; `None` if there are none.
pub fn left_behind(config: &Config) -> Option<Check> {
    let folders = [config.data_dir.clone(), config.data_dir.join(backup::FOLDER)];
    let left: Vec<String> =
        folders.iter().flat_map(|folder| backup::left_behind(folder)).map(|path| path.display().to_string()).collect();
    let next = "nothing to do: the next start of the service or the next backup removes them";
    (!left.is_empty()).then(|| Check::warn("broken-off backups", left.join(", "), next))
}

/// The backups in the data folder; `None` if there is neither a backup nor data.
pub fn backups(config: &Config, has_data: bool) -> Option<Check> {
    let folder = config.data_dir.join(backup::FOLDER);
    let entries = std::fs::read_dir(&folder).into_iter().flatten().flatten();
    let newest =
        entries.filter_map(|entry| backup::read_manifest(&entry.path()).ok()).max_by_key(|m| m.created_at.clone());
    let next = "modalwatch backup --out DIR, with DIR on another disk";
    let Some(newest) = newest else {
        return has_data.then(|| Check::warn("backups", format!("none in {}", folder.display()), next));
    };
    let made = Timestamp::parse(&newest.created_at).map_or(0, Timestamp::micros);
    let days = (clock::now().micros() - made) / 86_400_000_000;
    let found = format!("the newest in {} was made {}", folder.display(), newest.created_at);
    Some(if days > OLD_BACKUP_DAYS { Check::warn("backups", found, next) } else { Check::ok("backups", found) })
}
