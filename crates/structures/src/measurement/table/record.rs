//! The records of a table, read one at a time. What one costs in memory does not depend on the number of its cells, because a line of a
//! few megabytes may have as many cells as bytes.

use csv_core::{ReadRecordResult, Reader, ReaderBuilder};

/// Largest number of cells of a record that are kept; the others are only counted.
pub const MOST_CELLS: usize = 1_000;

/// Bytes of the cells of a record at the beginning; longer ones make room for themselves.
const USUAL_BYTES: usize = 1_024;

/// Bytes of the cells that are not kept, and number of these cells, that are looked at together.
const BYTES_BEYOND: usize = 4_096;
const CELLS_BEYOND: usize = 256;

/// The bytes of a table without the mark that some programs write before the first of them.
pub fn without_mark(bytes: &[u8]) -> &[u8] {
    bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes)
}

/// A record. Its memory is used again for the next one.
pub struct Record {
    /// The bytes of the cells that are kept, one cell after the other, of which the first `written` are in use.
    bytes: Vec<u8>,
    written: usize,
    /// Where each of these cells ends.
    ends: Vec<usize>,
    /// Number of all cells.
    count: usize,
    is_full: bool,
    /// Whether the cells that are not kept are empty.
    is_blank_beyond: bool,
    start: usize,
    line: u64,
}

impl Record {
    fn new() -> Self {
        Self {
            bytes: vec![0; USUAL_BYTES],
            written: 0,
            ends: vec![0; MOST_CELLS],
            count: 0,
            is_full: false,
            is_blank_beyond: true,
            start: 0,
            line: 1,
        }
    }

    fn begin(&mut self, start: usize, line: u64) {
        (self.written, self.count) = (0, 0);
        (self.is_full, self.is_blank_beyond) = (false, true);
        (self.start, self.line) = (start, line);
    }

    /// Lets the reader go on with the record; returns what it says, and how many bytes it has read.
    fn extend(&mut self, reader: &mut Reader, input: &[u8]) -> (ReadRecordResult, usize) {
        if self.is_full {
            let (mut bytes, mut ends) = ([0_u8; BYTES_BEYOND], [0_usize; CELLS_BEYOND]);
            let (said, read, written, ended) = reader.read_record(input, &mut bytes, &mut ends);
            self.is_blank_beyond &= bytes[..written].trim_ascii().is_empty();
            self.count += ended;
            return (said, read);
        }
        let (bytes, ends) = (&mut self.bytes[self.written..], &mut self.ends[self.count..]);
        let (said, read, written, ended) = reader.read_record(input, bytes, ends);
        self.written += written;
        self.count += ended;
        (said, read)
    }

    /// Makes room for a longer record of a table with this number of bytes.
    fn lengthen(&mut self, bytes_of_table: usize) {
        // The bytes that are not kept are no part of it.
        if !self.is_full {
            self.bytes.resize((2 * self.bytes.len()).min(bytes_of_table + 1), 0);
        }
    }

    fn text(&self, from: usize, to: usize) -> &str {
        let text = std::str::from_utf8(&self.bytes[from..to]);
        text.expect("the text of a table is UTF-8, and its cells end at ASCII signs").trim()
    }

    /// Number of its cells.
    pub fn count(&self) -> usize {
        self.count
    }

    /// A cell, one of the first [`MOST_CELLS`].
    pub fn cell(&self, index: usize) -> &str {
        let from = index.checked_sub(1).map_or(0, |before| self.ends[before]);
        self.text(from, self.ends[index])
    }

    /// The cells that are kept.
    pub fn cells(&self) -> impl Iterator<Item = &str> {
        (0..self.count.min(MOST_CELLS)).map(|index| self.cell(index))
    }

    /// Number of bytes of the cells that are kept.
    pub fn length(&self) -> usize {
        self.written
    }

    /// Whether it has nothing but empty cells.
    pub fn is_blank(&self) -> bool {
        self.is_blank_beyond && self.text(0, self.written).is_empty()
    }

    /// Index of its first byte in the table.
    pub fn start(&self) -> usize {
        self.start
    }

    /// Line of its first byte, from 1.
    pub fn line(&self) -> u64 {
        self.line
    }
}

/// Reads the records of a table in their order, or from any of them on.
pub struct Records<'a> {
    table: &'a [u8],
    reader: Reader,
    /// Index of the next byte, and its line.
    next: usize,
    line: u64,
    record: Record,
}

impl<'a> Records<'a> {
    /// The records from the beginning of a table, which is UTF-8.
    pub fn new(table: &'a [u8], separator: u8) -> Self {
        let reader = ReaderBuilder::new().delimiter(separator).build();
        Self { table, reader, next: 0, line: 1, record: Record::new() }
    }

    /// Goes to where a record begins.
    pub fn go_to(&mut self, start: usize, line: u64) {
        self.reader.reset();
        // Only the first bytes that a reader sees may be a mark that is left out.
        self.reader.read_record(b"\n", &mut [0], &mut [0]);
        (self.next, self.line) = (start, line);
    }

    /// Index and line of the next byte.
    pub fn place(&self) -> (usize, u64) {
        (self.next, self.line)
    }

    /// Reads the next record; `None` at the end of the table. Empty lines are passed over.
    pub fn read_next(&mut self) -> Option<&Record> {
        while let Some(byte @ (b'\r' | b'\n')) = self.table.get(self.next).copied() {
            self.line += u64::from(byte == b'\n');
            self.next += 1;
        }
        if self.next == self.table.len() {
            return None;
        }
        self.record.begin(self.next, self.line);
        let before = self.reader.line();
        loop {
            // Without further bytes the reader ends the record.
            let (said, read) = self.record.extend(&mut self.reader, &self.table[self.next..]);
            self.next += read;
            match said {
                ReadRecordResult::Record => break,
                ReadRecordResult::End => return None,
                ReadRecordResult::OutputFull => self.record.lengthen(self.table.len()),
                ReadRecordResult::OutputEndsFull => self.record.is_full = true,
                ReadRecordResult::InputEmpty => {}
            }
        }
        self.line += self.reader.line() - before;
        Some(&self.record)
    }

    /// Reads the next record that is not blank.
    pub fn next_row(&mut self) -> Option<&Record> {
        while self.read_next().is_some() {
            if !self.record.is_blank() {
                return Some(&self.record);
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::measurement::csv::{line_of, reader};

    type Found = Vec<(u64, Vec<String>)>;

    fn found(table: &str) -> Found {
        let (mut records, mut found) = (Records::new(table.as_bytes(), b';'), Vec::new());
        let mut places = Vec::new();
        while let Some(record) = records.read_next() {
            assert_eq!(record.is_blank(), record.cells().all(str::is_empty), "{table:?}");
            found.push((record.line(), record.cells().map(str::to_owned).collect()));
            places.push((record.start(), record.line()));
        }
        // Each of them can be found again, in any order.
        let mut again: Found = Vec::new();
        for (start, line) in places.into_iter().rev() {
            records.go_to(start, line);
            let record = records.read_next().unwrap();
            again.push((record.line(), record.cells().map(str::to_owned).collect()));
        }
        again.reverse();
        assert_eq!(again, found, "{table:?}");
        found
    }

    fn expected(table: &str) -> Found {
        let records = reader(table, b';').into_records().map(Result::unwrap);
        records.map(|record| (line_of(table, &record), record.iter().map(str::to_owned).collect())).collect()
    }

    #[test]
    fn records_are_those_of_the_reader_that_keeps_all() {
        for table in [
            "",
            "\n\r\n",
            "a",
            "a;b\r\nc;d",
            "\"a\n;\"\"b\";c\n\n\nd",
            "a\rb\r\n\rc",
            "\"not ended\n;x",
            ";;\n ; \n",
            "é; ü \n",
        ] {
            assert_eq!(found(table), expected(table), "{table:?}");
        }
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for _ in 0..20_000 {
            let length = rng.random_range(0..30);
            let table: String =
                (0..length).map(|_| ['a', ';', '"', '\n', '\r', ' ', 'é'][rng.random_range(0..7)]).collect();
            assert_eq!(found(&table), expected(&table), "{table:?}");
        }
    }

    #[test]
    fn the_cells_of_a_long_line_are_counted_and_few_are_kept() {
        for count in [MOST_CELLS - 1, MOST_CELLS, MOST_CELLS + 1, MOST_CELLS + CELLS_BEYOND, 1_000_000] {
            for end in ["", "\n", "\r\nx"] {
                let table = format!("{}{end}", "7;".repeat(count - 1));
                let mut records = Records::new(table.as_bytes(), b';');
                let record = records.read_next().unwrap();
                assert_eq!((record.count(), record.cells().count()), (count, count.min(MOST_CELLS)), "{end:?}");
                assert!(record.length() <= MOST_CELLS && record.bytes.len() <= USUAL_BYTES && !record.is_blank());
                let next = records.read_next().map(|record| (record.line(), record.cell(0).to_owned()));
                assert_eq!(next, (end == "\r\nx").then(|| (2, "x".to_owned())));
            }
        }
        let blank = |table: &str| Records::new(table.as_bytes(), b';').read_next().unwrap().is_blank();
        assert!(blank(&";".repeat(5_000)) && !blank(&format!("{}x", ";".repeat(5_000))));
    }

    #[test]
    fn a_long_cell_is_kept_whole() {
        let table = format!("\"{}\";b\nc", "é\n".repeat(100_000));
        let mut records = Records::new(table.as_bytes(), b';');
        let record = records.read_next().unwrap();
        assert_eq!((record.cell(0), record.cell(1)), ("é\n".repeat(100_000).trim(), "b"));
        assert!(record.bytes.len() <= table.len() + 1);
        assert_eq!(records.read_next().map(|record| (record.line(), record.start())), Some((100_002, table.len() - 1)));
    }
}
