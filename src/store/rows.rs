//! Many rows by few statements: what a statement costs lies mostly in handing it over.

use std::ops::Range;

/// Rows of the largest statement.
const MOST_ROWS: usize = 64;

/// Statements that insert 1, 2, 4 … rows, each beginning with `into`: few statements, which stay prepared, fit any number of rows.
///
/// The parameters are first the `common` columns, given by their places, which are the same in all rows; then the others, row
/// by row.
pub(super) fn insert_statements(into: &str, columns: usize, common: &[usize]) -> Vec<String> {
    let own = columns - common.len();
    let row = |row: usize| {
        let mut next = common.len() + own * row;
        let mut parameter = |column| {
            let shared = common.iter().position(|place| *place == column);
            let number = shared.unwrap_or_else(|| {
                next += 1;
                next - 1
            });
            format!("?{}", number + 1)
        };
        let parameters: Vec<String> = (0..columns).map(&mut parameter).collect();
        format!("({})", parameters.join(", "))
    };
    let statement = |power: u32| {
        let rows: Vec<String> = (0..1_usize << power).map(row).collect();
        format!("{into} values {}", rows.join(", "))
    };
    (0..=MOST_ROWS.ilog2()).map(statement).collect()
}

/// Which rows go into which of those statements.
pub(super) fn parts(rows: usize) -> impl Iterator<Item = (usize, Range<usize>)> {
    let mut first = 0;
    std::iter::from_fn(move || {
        let power = (rows - first).min(MOST_ROWS).checked_ilog2()?;
        let part = first..first + (1 << power);
        first = part.end;
        Some((power as usize, part))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_parts_are_all_rows_in_their_order() {
        for rows in 0..300 {
            let mut next = 0;
            for (power, part) in parts(rows) {
                assert_eq!((part.start, part.len()), (next, 1 << power));
                next = part.end;
            }
            assert_eq!(next, rows);
        }
    }

    #[test]
    fn common_columns_keep_their_parameter_and_the_others_count_on() {
        let statements = insert_statements("insert into t", 3, &[0, 2]);
        assert_eq!(statements[1], "insert into t values (?1, ?3, ?2), (?1, ?4, ?2)");
    }
}
