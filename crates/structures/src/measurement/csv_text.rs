//! Texts in the cells of CSV tables that spreadsheets open.
//!
//! A spreadsheet takes a text that begins with `=`, `+`, `-` or `@`, or with a tab or line break before it, for a formula and computes it.
//! Such a text is written with an apostrophe before it, which spreadsheets take for a mark of text, and read without it.

/// Beginnings of formulas.
const FORMULA: [char; 7] = ['=', '+', '-', '@', '\t', '\r', '\n'];

/// Whether a text, without apostrophes before it, begins like a formula.
fn is_like_a_formula(text: &str) -> bool {
    text.trim_start_matches('\'').starts_with(FORMULA)
}

/// A text as it is written to a cell.
pub fn guarded(text: String) -> String {
    if is_like_a_formula(&text) {
        format!("'{text}")
    } else {
        text
    }
}

/// A text that was read from a cell.
pub fn unguarded(cell: &str) -> &str {
    cell.strip_prefix('\'').filter(|_| is_like_a_formula(cell)).unwrap_or(cell)
}

#[cfg(test)]
mod tests {
    use super::{guarded, unguarded};

    #[test]
    fn formulas_are_texts_and_every_text_is_read_as_it_was() {
        for formula in ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1", "\n=1", "'=1", "''-1"] {
            assert_eq!(guarded(formula.to_owned()), format!("'{formula}"));
            assert_eq!(unguarded(&guarded(formula.to_owned())), formula);
        }
        for plain in ["east", "'east", "", "'", "5-1", "a=b"] {
            assert_eq!((guarded(plain.to_owned()).as_str(), unguarded(plain)), (plain, plain));
        }
    }
}
