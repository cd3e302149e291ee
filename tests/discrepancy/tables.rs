//! Tables as people have them: every kind of mistake gets its sentence, a row that cannot be used is left out, counted and named, and
//! times are read in the unit that they are in.

use serde_json::Value;

use super::world::EPOCH_2024_S;
use super::{answer, celsius, chain_csv, chain_toml, list, refusal};

const ROWS: usize = 60;

/// The line of the row that is changed, and its index in the table.
const LINE: usize = 12;
const ROW: usize = LINE - 2;

fn weather() -> String {
    chain_csv(ROWS, "temperature_c", |_, rng| celsius(rng))
}

/// The table with the cells of each row replaced by those that `change` makes of them, from the row (from 0) and the cells.
fn changed(csv: &str, change: impl Fn(usize, &mut Vec<String>)) -> String {
    let mut lines: Vec<String> = csv.lines().map(str::to_owned).collect();
    for (row, line) in lines.iter_mut().skip(1).enumerate() {
        let mut cells: Vec<String> = line.split(',').map(str::to_owned).collect();
        change(row, &mut cells);
        *line = cells.join(",");
    }
    lines.join("\n") + "\n"
}

/// The table with another value in one cell of the row that is changed; columns from 0.
fn with_cell(column: usize, value: &str) -> String {
    changed(&weather(), |row, cells| {
        if row == ROW {
            value.clone_into(&mut cells[column]);
        }
    })
}

fn notes(answer: &Value) -> Vec<&str> {
    list(answer, "notes").iter().map(|note| note.as_str().unwrap()).collect()
}

/// A column of times as numbers, by row.
type Time<'a> = &'a dyn Fn(usize) -> f64;

/// Seconds after 1970 of a row of [`chain_csv`].
fn seconds(row: usize) -> f64 {
    (EPOCH_2024_S + 40_000 * row as i64) as f64
}

#[test]
fn a_row_that_cannot_be_used_is_left_out_and_named_and_strict_refuses_it() {
    let set = chain_csv(ROWS, "set_k1", |row, _| if row == ROW { "" } else { "4000" }.to_owned());
    let swapped = changed(&weather(), |row, cells| {
        if row == ROW {
            cells.swap(1, 2);
        }
    });
    let equal = changed(&weather(), |row, cells| {
        if row == ROW {
            cells[2] = cells[1].clone();
        }
    });
    let short = changed(&weather(), |row, cells| cells.truncate(if row == ROW { 3 } else { 5 }));
    let cases = [
        ("two equal frequencies", equal, "line 12", "modes 1 and 2 have the same frequency"),
        ("decreasing frequencies", swapped, "line 12", "is not below mode 2"),
        ("a frequency of 0", with_cell(2, "0"), "line 12, column f2_hz", "above 0"),
        ("a negative frequency", with_cell(2, "-7.5"), "line 12, column f2_hz", "above 0"),
        ("NaN", with_cell(2, "NaN"), "line 12, column f2_hz", "leave the cell empty"),
        ("an infinite frequency", with_cell(2, "inf"), "line 12, column f2_hz", "is not finite"),
        ("text for a frequency", with_cell(2, "n/a"), "line 12, column f2_hz", "\"n/a\" is not a number"),
        ("another unit", with_cell(2, "0.0000001"), "line 12, column f2_hz", "it seems to be in kHz"),
        ("text for a covariate", with_cell(4, "warm"), "line 12, column temperature_c", "\"warm\" is not a number"),
        ("an unreadable time", with_cell(0, "last Monday"), "line 12, column measured_at", "must be RFC 3339"),
        ("no time", with_cell(0, ""), "line 12, column measured_at", "measured_at is missing"),
        ("a time to come", with_cell(0, "2999-01-01T00:00:00Z"), "line 12, column measured_at", "in the future"),
        ("a number among dates", with_cell(0, "45000"), "line 12, column measured_at", "must be RFC 3339"),
        ("no setting", set, "line 12, column set_k1", "the setting of k1 is missing, which 59 of 60 rows have"),
        ("too few cells", short, "line 12", "3 cells, but the header has 5"),
    ];
    for (name, csv, place, reason) in cases {
        let answer = answer(&chain_toml(), &csv, &[]);
        let rows = answer["training_rows"].as_u64().unwrap() + answer["holdout_rows"].as_u64().unwrap();
        assert_eq!(rows, ROWS as u64 - 1, "{name}");
        let notes = notes(&answer);
        let note = notes.iter().find(|note| note.contains("1 of 60 rows cannot be used and are left out"));
        let note = note.unwrap_or_else(|| panic!("{name}: {notes:?}"));
        assert!(note.contains(&format!(": {place}: ")) && note.contains(reason), "{name}: {note}");
        let refused = refusal(&chain_toml(), &csv, &["--strict"]);
        assert!(
            refused.contains("--strict refuses") && refused.contains(place) && refused.contains(reason),
            "{name}: {refused}"
        );
    }
}

#[test]
fn many_bad_rows_are_counted_and_the_first_are_named() {
    let csv = changed(&weather(), |row, cells| {
        if row % 8 == 0 {
            "0".clone_into(&mut cells[3]);
        }
    });
    let answer = answer(&chain_toml(), &csv, &[]);
    let notes = notes(&answer);
    let note = notes.iter().find(|note| note.starts_with("8 of 60 rows cannot be used")).unwrap();
    assert!(note.contains("line 2, column f3_hz") && note.contains("line 34, column f3_hz"), "{note}");
    assert!(!note.contains("line 42") && note.contains("and 3 more"), "{note}");

    // Modes that are out of order in many rows are a property of the data, which the diagnosis has to explain.
    let csv = changed(&weather(), |row, cells| {
        if row % 2 == 0 {
            cells.swap(1, 2);
        }
    });
    let answer = super::answer(&chain_toml(), &csv, &[]);
    assert_eq!(answer["training_rows"], 45);
    let notes = self::notes(&answer);
    assert!(
        notes.iter().any(|note| note.contains("30 of 60 measurements have modes") && note.contains("too many")),
        "{notes:?}"
    );
}

#[test]
fn what_concerns_the_whole_table_is_refused_with_its_reason() {
    let numbers = |value: &dyn Fn(usize) -> String| changed(&weather(), |row, cells| cells[0] = value(row));
    let zeros = changed(&weather(), |_, cells| "0".clone_into(&mut cells[1]));
    let cases: [(&str, String, &[&str], &[&str]); 10] = [
        ("no usable row", zeros, &[], &["none of 60 rows can be used", "line 2, column f1_hz", "and 40 more"]),
        ("no time column", weather(), &["--time", "when"], &["no column when", "--time"]),
        ("a unit without times", weather(), &["--time-unit", "days"], &["--time-unit days", "--time"]),
        ("an unknown unit", weather(), &["--time-unit", "hours"], &["hours", "serial-days", "decimal-year"]),
        (
            "nanoseconds",
            numbers(&|row| format!("{:e}", 1e9 * seconds(row))),
            &[],
            &["not plausible times", "milliseconds", "RFC 3339"],
        ),
        (
            "an unknown parameter",
            weather(),
            &["--settings", "k9=temperature_c"],
            &["\"k9\" is not a parameter", "which has k1"],
        ),
        (
            "a setting without a column",
            weather(),
            &["--settings", "k1=position"],
            &["missing column \"position\"", "k1"],
        ),
        ("a malformed setting", weather(), &["--settings", "k1"], &["PARAMETER=COLUMN"]),
        (
            "a column of an unknown setting",
            weather().replacen("temperature_c", "set_k9", 1),
            &[],
            &["set_k9", "which has k1"],
        ),
        ("a missing mode", weather().replacen("f3_hz", "third_hz", 1), &[], &["missing column f3_hz", "3 modes"]),
    ];
    for (name, csv, options, words) in cases {
        let refused = refusal(&chain_toml(), &csv, options);
        assert!(words.iter().all(|word| refused.contains(word)), "{name}: {words:?} in {refused:?}");
    }
}

#[test]
fn settings_beyond_the_prior_and_unnamed_columns_are_no_mistakes() {
    let set = chain_csv(ROWS, "position", |row, _| if row == ROW { "9000" } else { "4000" }.to_owned());
    let answer = answer(&chain_toml(), &set, &["--settings", "k1=position", "--strict"]);
    let summary = answer["summary"].as_str().unwrap();
    assert!(summary.contains("k1 lies outside the prior") && summary.contains("1 of 45 rows"), "{summary}");

    // The first column numbers the rows, as data frames write it.
    let numbered: String = weather()
        .lines()
        .enumerate()
        .map(|(line, text)| match line {
            0 => format!(",{text}\n"),
            line => format!("{},{text}\n", line - 1),
        })
        .collect();
    let answer = super::answer(&chain_toml(), &numbered, &["--strict"]);
    assert!(self::notes(&answer).contains(&"column 1 has no name: it is not read"), "{answer}");
}

#[test]
fn numeric_times_are_read_as_what_they_look_like() {
    // All frequencies fall by 1 % in the middle: what is found in time does not depend on the unit.
    let dated = changed(&weather(), |row, cells| {
        for cell in &mut cells[1..4] {
            let factor = if row >= ROWS / 2 { 0.99 } else { 1.0 };
            *cell = super::world::number(factor * cell.parse::<f64>().unwrap());
        }
    });
    let expected = answer(&chain_toml(), &dated, &[]);
    assert_eq!(expected["causes"][0]["covariate"], "time", "{}", expected["summary"]);
    let days = |row: usize| (seconds(row) - seconds(0)) / 86_400.0;
    let cases: [(&str, Time, Option<&str>, &str, bool); 8] = [
        ("days", &days, None, "read as days since an unknown start", true),
        ("days of a campaign", &|row| days(row) - 7.0, None, "read as days since an unknown start", true),
        (
            "Unix seconds",
            &seconds,
            None,
            "read as seconds since 1970-01-01 UTC (Unix time) (2024-01-01T00:00:00Z to",
            true,
        ),
        ("Unix milliseconds", &|row| 1e3 * seconds(row), None, "read as milliseconds since 1970-01-01 UTC", true),
        (
            "seconds from the start",
            &|row| seconds(row) - seconds(0),
            None,
            "read as seconds since an unknown start",
            true,
        ),
        (
            "seconds that are named",
            &|row| 6e-4 * days(row) * 86_400.0,
            Some("seconds"),
            "read as seconds since an unknown start",
            false,
        ),
        (
            "serial days",
            &|row| 45_292.0 + days(row),
            None,
            "serial days of a spreadsheet, which count from 1899-12-30 (2024-01-01T00:00:00Z",
            false,
        ),
        (
            "decimal years",
            &|row| 2024.0 + days(row) / 366.0,
            None,
            "read as decimal years (2024-01-01T00:00:00Z",
            false,
        ),
    ];
    for (name, time, unit, note, exact) in cases {
        let csv = changed(&dated, |row, cells| cells[0] = time(row).to_string()).replacen("measured_at", "when", 1);
        let options = unit.map_or_else(Vec::new, |unit| vec!["--time-unit", unit]);
        let mut found = answer(&chain_toml(), &csv, &[&["--time", "when"], options.as_slice()].concat());
        let read =
            notes(&found).into_iter().find(|note| note.starts_with("column when holds numbers")).unwrap().to_owned();
        assert!(read.contains(note), "{name}: {read}");
        assert_eq!(read.contains("--time-unit"), unit.is_none(), "{name}: {read}");
        assert_eq!(found["causes"][0]["covariate"], "time", "{name}: {}", found["summary"]);
        if exact {
            let mut expected = expected.clone();
            for answer in [&mut found, &mut expected] {
                (answer["notes"], answer["data_digest"]) = (Value::Null, Value::Null);
            }
            assert_eq!(found, expected, "{name}");
        }
    }
    // 0, 60, 120, … can be days or seconds: both are said.
    let csv = changed(&dated, |row, cells| cells[0] = (60 * row).to_string());
    let found = answer(&chain_toml(), &csv, &[]);
    let notes = notes(&found);
    let read = notes.iter().find(|note| note.starts_with("column measured_at holds numbers from 0 to 3540")).unwrap();
    assert!(
        read.contains("days since an unknown start") && read.contains("--time-unit seconds reads them so"),
        "{read}"
    );
}
