//! Writing many rows by few statements, because most of the cost of a statement is passing it to the database.

use std::ops::Range;
use std::sync::OnceLock;

/// Number of rows of the largest statement.
const MOST_ROWS: usize = 64;

/// Up to this number, all rows go into one statement. Larger numbers are split into statements of [`MOST_ROWS`] and of half as
/// many rows, so that few different statements have to be prepared.
const ANY_NUMBER: usize = MOST_ROWS / 2;

/// Statements with rows of values, one for each number of rows, built when first used: they insert the rows, or update stored ones from them.
///
/// The first parameters are the values that are the same in all rows, for the columns with the indices `common`. The values of
/// the other columns follow, row by row.
pub(super) struct RowStatements {
    before: &'static str,
    columns: usize,
    common: &'static [usize],
    clause: &'static str,
    of_rows: [OnceLock<String>; MOST_ROWS],
}

impl RowStatements {
    /// Statements that begin with `before`, for rows with this number of columns.
    pub const fn new(before: &'static str, columns: usize, common: &'static [usize]) -> Self {
        Self::with_clause(before, columns, common, "")
    }

    /// As [`Self::new`], with a clause after the values, such as ` on conflict …` or, for `update … from (`, `) as given where …`. Both
    /// databases call the columns of the values `column1`, `column2` …
    pub const fn with_clause(
        before: &'static str,
        columns: usize,
        common: &'static [usize],
        clause: &'static str,
    ) -> Self {
        Self { before, columns, common, clause, of_rows: [const { OnceLock::new() }; MOST_ROWS] }
    }

    /// The statement for a number of rows.
    ///
    /// # Panics
    /// For 0 or more than [`MOST_ROWS`] rows, which is a programming error.
    pub fn of(&self, rows: usize) -> &str {
        self.of_rows[rows - 1].get_or_init(|| {
            let rows: Vec<String> = (0..rows).map(|row| self.row(row)).collect();
            format!("{}values {}{}", self.before, rows.join(", "), self.clause)
        })
    }

    fn row(&self, row: usize) -> String {
        let mut next = self.common.len() + (self.columns - self.common.len()) * row;
        let parameter = |column| {
            let shared = self.common.iter().position(|place| *place == column);
            let number = shared.unwrap_or_else(|| {
                next += 1;
                next - 1
            });
            format!("${}", number + 1)
        };
        let parameters: Vec<String> = (0..self.columns).map(parameter).collect();
        format!("({})", parameters.join(", "))
    }
}

/// The ranges of rows that each go into one statement.
pub(super) fn parts(rows: usize) -> impl Iterator<Item = Range<usize>> {
    let mut first = 0;
    std::iter::from_fn(move || {
        let count = match rows - first {
            0 => return None,
            MOST_ROWS.. => MOST_ROWS,
            ANY_NUMBER.. => ANY_NUMBER,
            rest => rest,
        };
        let part = first..first + count;
        first = part.end;
        Some(part)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_parts_cover_all_rows_in_order() {
        for rows in 0..300 {
            let mut next = 0;
            for part in parts(rows) {
                assert_eq!(part.start, next);
                assert!((1..=MOST_ROWS).contains(&part.len()), "{part:?}");
                next = part.end;
            }
            assert_eq!(next, rows);
        }
    }

    #[test]
    fn common_columns_share_a_parameter_and_the_others_are_numbered_consecutively() {
        let statements = RowStatements::new("insert into t ", 3, &[0, 2]);
        assert_eq!(statements.of(1), "insert into t values ($1, $3, $2)");
        assert_eq!(statements.of(2), "insert into t values ($1, $3, $2), ($1, $4, $2)");
    }
}
