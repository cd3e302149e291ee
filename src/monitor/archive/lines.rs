//! The lines of an archive: one JSON record each, the last with a checksum of all before it.

use std::fs::File;
use std::io::{BufRead as _, BufReader};
use std::path::Path;

use data_encoding::HEXLOWER;
use sha2::{Digest as _, Sha256};

use super::error::ImportError;
use crate::store::archive::{Head, Record, FORMAT};

/// Largest length of a line, bytes; the lines with the weights of a trained baseline are the longest.
const LONGEST_LINE: usize = 1 << 30;

/// A record as a line of JSON with its line end.
pub(super) fn line_of(record: &Record) -> Vec<u8> {
    let mut line = serde_json::to_vec(record).expect("a record is plain data");
    line.push(b'\n');
    line
}

/// Reads a whole archive and returns its head; checks the first and the last line, the number of lines, the SHA-256, and each record
/// by `check`.
pub(super) fn check_whole(
    path: &Path,
    mut check: impl FnMut(&Head, Record) -> Result<(), ImportError>,
) -> Result<Head, ImportError> {
    let incomplete = |what: &str| ImportError::NotWhole(what.to_owned());
    let mut head: Option<Head> = None;
    let mut ended = false;
    each_line(path, |number, record| {
        if ended {
            return Err(incomplete("something follows its last line"));
        }
        match (number, record) {
            (1, Record::Archive(found)) if (1..=FORMAT).contains(&found.format) => head = Some(found),
            (1, Record::Archive(found)) => {
                let reason = format!("it has format {}, but this program reads formats 1 to {FORMAT}", found.format);
                return Err(ImportError::Line { line: 1, reason });
            }
            (1, _) => return Err(incomplete("its first line is missing")),
            (_, Record::End(_)) => ended = true,
            (_, record) => {
                let head = head.as_ref().ok_or_else(|| incomplete("its first line is missing"))?;
                check(head, record).map_err(|error| error.at_line(number))?;
            }
        }
        Ok(())
    })?;
    if !ended {
        return Err(incomplete("its last line is missing"));
    }
    head.ok_or_else(|| incomplete("it is empty"))
}

/// Passes each record of an archive to `take`; the last is checked against all before it.
pub(super) fn each_line(
    path: &Path,
    mut take: impl FnMut(u64, Record) -> Result<(), ImportError>,
) -> Result<(), ImportError> {
    let failed = |source| ImportError::File { path: path.to_owned(), source };
    let mut reader = BufReader::new(File::open(path).map_err(failed)?);
    let (mut hasher, mut line, mut number) = (Sha256::new(), Vec::new(), 0_u64);
    loop {
        line.clear();
        let read =
            std::io::Read::take(&mut reader, LONGEST_LINE as u64).read_until(b'\n', &mut line).map_err(failed)?;
        if read == 0 {
            return Ok(());
        }
        number += 1;
        let record: Record = serde_json::from_slice(&line).map_err(|e| ImportError::Line {
            line: number,
            reason: format!("this is not a record of an archive: {e}"),
        })?;
        if let Record::End(end) = &record {
            let found = HEXLOWER.encode(&hasher.finalize_reset());
            if end.lines != number - 1 || end.sha256 != found {
                let difference = format!(
                    "it has {} lines with SHA-256 {found}, but its last line states {} lines with SHA-256 {}",
                    number - 1,
                    end.lines,
                    end.sha256
                );
                return Err(ImportError::NotWhole(difference));
            }
        }
        hasher.update(&line);
        take(number, record)?;
    }
}
