//! Texts in the cells of CSV tables that spreadsheets open.
//!
//! A spreadsheet takes a text that begins with `=`, `+`, `-` or `@` for a formula and computes it, also in full width, and behind blanks or
//! characters that are not seen. At which character it ends a cell depends on the settings of the person who opens the table: what follows a
//! semicolon, a tab or a line break in a text may become a cell of its own. Each part of a text that begins like a formula is written with an
//! apostrophe before it, which spreadsheets take for a mark of text, and read without it.

/// Characters at which a spreadsheet may end a cell within a text. For a comma, which separates the cells, a cell is in quotation marks.
const ENDS: [char; 4] = [';', '\t', '\r', '\n'];

/// Characters for which a cell is in quotation marks: those at which some program ends a cell, and the mark itself.
const QUOTED: [char; 6] = [',', ';', '\t', '"', '\r', '\n'];

/// Beginnings of formulas.
const FORMULA: [char; 8] = ['=', '+', '-', '@', '＝', '＋', '－', '＠'];

/// Whether a formula may begin behind this character: a blank, or one that is not seen.
fn is_passed_over(c: char) -> bool {
    let is_unseen = matches!(
        c,
        '\u{ad}' | '\u{180e}' | '\u{200b}'..='\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2060}'..='\u{206f}' | '\u{feff}'
    );
    is_unseen || c.is_whitespace() || c.is_control()
}

/// Whether a part of a text begins like a formula. Apostrophes do not count, so that a part is one with its guard and without it.
fn is_like_a_formula(part: &str) -> bool {
    part.trim_start_matches(|c: char| c == '\'' || is_passed_over(c)).starts_with(FORMULA)
}

/// The parts of a text that may become cells, each with the character at its end.
fn parts(text: &str) -> impl Iterator<Item = &str> {
    text.split_inclusive(ENDS)
}

/// A text as it is written to a cell.
pub fn guarded(text: String) -> String {
    if !parts(&text).any(is_like_a_formula) {
        return text;
    }
    parts(&text).flat_map(|part| [if is_like_a_formula(part) { "'" } else { "" }, part]).collect()
}

/// A text that was read from a cell.
pub fn unguarded(cell: &str) -> String {
    parts(cell).map(|part| part.strip_prefix('\'').filter(|_| is_like_a_formula(part)).unwrap_or(part)).collect()
}

/// Adds a row to a table, in the form of RFC 4180 with line feeds.
pub fn add_row(table: &mut String, cells: impl IntoIterator<Item = String>) {
    for (index, cell) in cells.into_iter().enumerate() {
        if index > 0 {
            table.push(',');
        }
        if cell.contains(QUOTED) {
            table.extend(["\"", &cell.replace('"', "\"\""), "\""]);
        } else {
            table.push_str(&cell);
        }
    }
    table.push('\n');
}

#[cfg(test)]
mod tests {
    use super::{add_row, guarded, unguarded};

    #[test]
    fn formulas_are_texts_wherever_a_cell_may_begin_and_every_text_is_read_as_it_was() {
        for (formula, written) in [
            ("=1+1", "'=1+1"),
            ("+1", "'+1"),
            ("-1", "'-1"),
            ("@SUM(A1)", "'@SUM(A1)"),
            ("'=1", "''=1"),
            ("''-1", "'''-1"),
            ("\t=1", "\t'=1"),
            ("\r\n=1", "\r\n'=1"),
            (";=1", ";'=1"),
            ("a;=1;b", "a;'=1;b"),
            ("a\t@b", "a\t'@b"),
            ("-1;'+2", "'-1;''+2"),
            (" =1", "' =1"),
            ("a; \u{a0}=1", "a;' \u{a0}=1"),
            ("\u{feff}=1", "'\u{feff}=1"),
            ("\u{200b}' \u{200b}-1", "'\u{200b}' \u{200b}-1"),
            ("＝1", "'＝1"),
            ("＋1", "'＋1"),
            ("－1", "'－1"),
            ("\u{3000}＠A1", "'\u{3000}＠A1"),
        ] {
            assert_eq!(guarded(formula.to_owned()), written, "{formula:?}");
            assert_eq!(unguarded(written), formula, "{written:?}");
        }
        for plain in ["east", "'east", "", "'", " ", "';", "5-1", "a=b", "a; b", "a;\u{feff}", "a\tb;c", "a,=1"] {
            assert_eq!((guarded(plain.to_owned()).as_str(), unguarded(plain).as_str()), (plain, plain));
        }
    }

    #[test]
    fn a_cell_with_a_character_at_which_some_program_ends_it_is_in_quotation_marks() {
        let cells = ["a", "b;c", "d\te", "f,g", "h\"i", "", "j\nk"];
        let mut table = String::new();
        add_row(&mut table, cells.map(str::to_owned));
        add_row(&mut table, ["1".to_owned()]);
        assert_eq!(table, "a,\"b;c\",\"d\te\",\"f,g\",\"h\"\"i\",,\"j\nk\"\n1\n");
        let mut reader = csv::ReaderBuilder::new().has_headers(false).flexible(true).from_reader(table.as_bytes());
        assert_eq!(reader.records().next().unwrap().unwrap().iter().collect::<Vec<_>>(), cells);
    }
}
