//! Tables as spreadsheets and loggers write them: what is read, what is asked for, and how rows become batches.

use std::fmt::Write as _;
use std::ops::Deref;

use modalwatch::measurement::check::{EachCheck, Expectation, Problem, Purpose};
use modalwatch::measurement::table::options::{OptionTexts, TableOptions};
use modalwatch::measurement::table::plan::{plan, Plan};
use modalwatch::measurement::table::refused::Refused;
use modalwatch::measurement::table::split::Split;
use modalwatch::measurement::table::understood::Need;
use modalwatch::measurement::table::zone::Zone;
use modalwatch::measurement::table::{read, FoundRow, Layout};
use modalwatch::measurement::{Covariate, CovariateKind, CovariateValue, ModalMeasurement};
use modalwatch::quantity::Timestamp;
use proptest::prelude::*;

use crate::measurement::space;

fn covariates() -> Vec<Covariate> {
    let number = |name: &str| Covariate::new(name, CovariateKind::Number);
    vec![number("temperature_c"), number("wind_m_per_s")]
}

/// Options from `name=value` texts separated by `&`, as in a query without escapes.
fn options(query: &str) -> Result<TableOptions, Vec<Problem>> {
    let of = |name: &str| query.split('&').find_map(|pair| pair.strip_prefix(name)?.strip_prefix('='));
    TableOptions::parse(&OptionTexts {
        columns: of("columns"),
        ignore: of("ignore"),
        zone: of("zone"),
        date_order: of("date_order"),
        decimal: of("decimal"),
        unit: of("unit"),
        time_unit: of("time_unit"),
        split: of("split"),
    })
}

/// A plan of a table, with the measurements of its batches.
struct Planned {
    plan: Plan,
    batches: Vec<Vec<ModalMeasurement>>,
}

impl Deref for Planned {
    type Target = Plan;

    fn deref(&self) -> &Plan {
        &self.plan
    }
}

/// The plan of a table of a structure with two modes from 0.1 to 100 Hz.
fn planned(table: &[u8], query: &str) -> Planned {
    let options = options(query).unwrap_or_else(|problems| panic!("{query}: {problems:?}"));
    let (covariates, space) = (covariates(), space());
    let expectation = Expectation {
        purpose: Purpose::Assessment,
        modes: 2,
        frequency_limits_hz: (0.1, 100.0),
        covariates: &covariates,
        instrumented: None,
        space: &space,
        now: modalwatch::clock::now(),
        max_measurements: usize::MAX,
    };
    let layout = Layout { modes: 2, covariates: &covariates, points: &[] };
    let mut check = EachCheck::new(expectation);
    let plan = plan(read(table, &layout, &options), options.split, 5_000, |raw| check.check(raw));
    let contents = |batch| {
        let mut check = EachCheck::new(expectation);
        plan.measurements(table, batch, |raw| check.check(raw))
    };
    let batches = plan.batches.iter().map(contents).collect();
    Planned { plan, batches }
}

fn measurements(planned: &Planned) -> Vec<ModalMeasurement> {
    planned.batches.concat()
}

/// Three rows in the only way that needs no option.
const PLAIN: &str = "measured_at,f1_hz,f2_hz,temperature_c\n\
                     2026-03-01T11:00:00Z,1.25,3.5,4.5\n\
                     2026-03-13T11:30:00Z,1.26,,-5\n\
                     2026-03-30T10:00:00Z,1.2,3.375,\n";

#[test]
fn the_same_measurements_in_many_dialects_are_bit_identical() {
    let expected = measurements(&planned(PLAIN.as_bytes(), "split=none"));
    assert_eq!(expected.len(), 3);
    let german = "Datum;Frequenz 1 [Hz];Frequenz 2 [Hz];Temperature (°C)\r\n01.03.2026 12:00;1,25;3,5;4,5\r\n\
                  13.03.2026 12:30;1,26;n/a;-5\r\n30.03.2026 12:00;1,2;3,375;\r\n";
    let slashes = "Date\tTime\tMode 1 (Hz)\tMode 2 (Hz)\ttemperature\n3/1/2026\t12:00 PM\t1.25\t3.5\t4.5\n\
                   3/13/2026\t12:30 pm\t1.26\tNaN\t-5\n3/30/2026\t12:00:00 PM\t1.2\t3.375\t-\n";
    let dialects: Vec<(&str, String, &str)> = vec![
        ("German spreadsheet", german.to_owned(), "zone=Europe/Berlin"),
        ("byte order mark and sep=", format!("\u{feff}sep=;\r\n{german}"), "zone=europe/berlin"),
        ("American spreadsheet", slashes.to_owned(), "zone=Europe/Berlin"),
        ("American order stated", slashes.to_owned(), "zone=Europe/Berlin&date_order=mdy"),
        ("blank instead of T", PLAIN.replace('T', " ").replace('Z', ""), "zone=UTC"),
        ("UTC in the header", PLAIN.replace('Z', "").replace("measured_at", "time (UTC)"), ""),
        ("offsets", PLAIN.replace("11:00:00Z", "12:00+01:00").replace("10:00:00Z", "12:00:00+0200"), ""),
        (
            "a fixed offset",
            PLAIN.replace("11:00:00Z", "13:00").replace("11:30:00Z", "13:30").replace("10:00:00Z", "12:00"),
            "zone=+02:00",
        ),
        ("f1 and f2", PLAIN.replace("f1_hz,f2_hz", "f1,F2"), ""),
        ("hyphens", PLAIN.replace(",,", ",-,").replace("3.375,\n", "3.375,#NV\n"), ""),
        (
            "kelvin",
            PLAIN.replace("temperature_c", "Temperature [K]").replace("4.5\n", "277.65\n").replace(",-5", ",268.15"),
            "",
        ),
        ("quotes", format!("\"{}\"", PLAIN.trim_end().replace(',', "\",\"").replace('\n', "\"\n\"")), ""),
        ("other columns ignored", PLAIN.replace(",f1_hz", ",lab,f1_hz").replace("Z,", "Z,xy,"), "ignore=lab"),
        ("named columns", PLAIN.replace("f1_hz,f2_hz", "Erste Biegung,Zweite"), "columns=f1=Erste Biegung,f2=#3"),
        ("Unix time", unix(PLAIN), "time_unit=seconds"),
    ];
    for (name, text, query) in dialects {
        let plan = planned(text.as_bytes(), &format!("{query}&split=none"));
        assert_eq!((&plan.problems[..], plan.refused.first()), (&[][..], &[][..]), "{name}");
        // 277.65 K − 273.15 K is not 4.5 °C to the last bit.
        if name == "kelvin" {
            for (found, expected) in measurements(&plan).iter().zip(&expected) {
                let celsius = |m: &ModalMeasurement| match m.covariates.get("temperature_c") {
                    Some(CovariateValue::Number(value)) => *value,
                    other => panic!("{other:?}"),
                };
                if expected.covariates.is_empty() {
                    assert!(found.covariates.is_empty());
                } else {
                    assert!((celsius(found) - celsius(expected)).abs() < 1e-12);
                }
            }
        } else {
            assert_eq!(measurements(&plan), expected, "{name}:\n{text}");
        }
    }
}

fn unix(table: &str) -> String {
    let mut seconds = String::new();
    for line in table.lines() {
        match line.split_once(',').map(|(time, rest)| (Timestamp::parse(time), rest)) {
            Some((Ok(time), rest)) => writeln!(seconds, "{},{rest}", time.micros() / 1_000_000).unwrap(),
            _ => writeln!(seconds, "{line}").unwrap(),
        }
    }
    seconds
}

#[test]
fn units_that_the_header_or_the_sender_states_are_converted() {
    let radians = |header: &str| {
        format!("time,{header}\n2026-03-01T12:00Z,{},{}\n", std::f64::consts::TAU, 4.0 * std::f64::consts::TAU)
    };
    for (header, query) in [("f1 [rad/s],Mode 2 (rad/s)", ""), ("f1,f2", "unit=rad/s")] {
        let found = measurements(&planned(radians(header).as_bytes(), query));
        assert_eq!(found[0].complete_hz(), Some(vec![1.0, 4.0]), "{header}");
    }
    let milli = "time,f1 (mHz),f2 (kHz)\n2026-03-01T12:00Z,1250,0.003\n";
    assert_eq!(measurements(&planned(milli.as_bytes(), ""))[0].complete_hz(), Some(vec![1.25, 3.0]));
}

/// Each wrong or odd table with the options, where the first problem is, its sentence, and the option that is asked for.
#[test]
fn what_cannot_be_read_is_named_with_what_to_write() {
    let row = |header: &str, row: &str| format!("{header}\n{row}\n");
    let two = |time: &str| row("date,f1,f2", &format!("{time},1.25,3.5"));
    let cases: Vec<(String, &str, &str, &str, Option<Need>)> = vec![
        (String::new(), "", "line 1", "the table is empty: its first line must name the columns", None),
        ("PK\u{3}\u{4}xx".to_owned(), "", "line 1", "this is a workbook and not a table of text: save its sheet as CSV (UTF-8), and send that file", None),
        (",".repeat(1_000), "", "line 1", "the header has 1001 columns: at most 1000 are read", None),
        (two("2026-03-01 12:00:00"), "", "line 2, column date", "\"2026-03-01 12:00:00\" has no zone: write zone=Europe/Berlin or another zone of the IANA database (--zone on the command line), zone=UTC, or times with an offset such as 2026-03-01T12:00:00+01:00", Some(Need::Zone)),
        (two("2026-03-01"), "", "line 2, column date", "\"2026-03-01\" has no zone: write zone=", Some(Need::Zone)),
        (two("03/04/2026 12:00"), "zone=UTC", "line 2, column date", "\"03/04/2026 12:00\" may begin with the day or the month: write date_order=dmy for 31/12/2026 or date_order=mdy for 12/31/2026", Some(Need::DateOrder)),
        (two("45000.5"), "", "line 2, column date", "\"45000.5\" is a number: write time_unit=seconds (Unix time), milliseconds, serial-days (of a spreadsheet) or decimal-year, or times in RFC 3339 with an offset", Some(Need::TimeUnit)),
        (row("date;f1;f2", "2026-03-01T12:00Z;1,25;3.5"), "", "line 2", "\"1,25\" has a comma and \"3.5\" in line 2 a point: write decimal=comma or decimal=point", Some(Need::Decimal)),
        (row("date,f1,f2,Kommentar", "2026-03-01T12:00Z,1,2,x"), "", "line 1", "unknown column \"Kommentar\": write ignore=Kommentar to leave it out, or columns=TARGET=Kommentar to say what it is: time, f1_hz to f2_hz, std_f1_hz to std_f2_hz, set_<parameter>, temperature_c, wind_m_per_s; a covariate is declared in the structure file", Some(Need::Columns)),
        (row("date,f1", "2026-03-01T12:00Z,1"), "", "line 1", "missing column f2_hz: the structure has 2 modes; columns=f2=NAME says which column it is", Some(Need::Columns)),
        (row("date,f1,f2,f3", "2026-03-01T12:00Z,1,2,3"), "", "line 1", "column \"f3\": the structure has 2 modes; write ignore= to leave it out", Some(Need::Columns)),
        (row("date,f1,Mode 1,f2", "2026-03-01T12:00Z,1,2,3"), "", "line 1", "columns \"f1\" and \"Mode 1\" both mean f1_hz: write ignore=NAME for one of them", Some(Need::Columns)),
        (row("date,timestamp,f1,f2", "2026-03-01T12:00Z,2026-03-01T12:00Z,1,2"), "", "line 1", "columns \"date\", \"timestamp\" could all be the time: write ignore=NAME for the others", Some(Need::Columns)),
        (row("f1,f2", "1,2"), "", "line 1", "missing column measured_at, time or date: the time of each row, such as 2026-03-01T12:00:00Z; columns=time=NAME says which column it is", Some(Need::Columns)),
        (row("date,f1 (rpm),f2", "2026-03-01T12:00Z,1,2"), "", "line 1", "column \"f1 (rpm)\": \"rpm\" is not a unit of frequency: Hz, mHz, kHz and rad/s are known", Some(Need::Columns)),
        (row("date,f1,f2,Wind (km/h)", "2026-03-01T12:00Z,1,2,3"), "", "line 1", "column \"Wind (km/h)\": its unit \"km/h\" is not that of the covariate wind_m_per_s; convert the column, or name it without a unit if the numbers are right", Some(Need::Columns)),
        (two("2026-03-01T12:00Z"), "columns=f1=Biegung", "line 1", "the table has no column \"Biegung\"", Some(Need::Columns)),
        (two("2026-03-01T12:00Z"), "columns=f7=date", "line 1", "column \"date\": the structure has 2 modes; write ignore= to leave it out", Some(Need::Columns)),
        (two("2026-03-01T12:00Z"), "columns=damping=date", "line 1", "\"damping\" is not a target: a column can be time, date, time_of_day, f1 to f2, std_f1 to std_f2, set_<parameter>, temperature_c, wind_m_per_s", Some(Need::Columns)),
        (row("time (UTC),f1,f2", "2026-03-01 12:00,1,2"), "zone=Europe/Berlin", "line 1", "the header says that times are UTC, and zone names another zone: leave zone out", None),
        (format!("{PLAIN}2026-03-30T10:00:00Z,1,2\n"), "", "query/split", "the 3 measurements span 29.0 days, from 2026-03-01T11:00:00Z to 2026-03-30T10:00:00Z, and a batch shows one state of the structure: write split=1d for a batch a day, split=6h for shorter ones, split=gap:2h for a new batch after each pause of two hours, or split=none for a single batch", Some(Need::Split)),
    ];
    for (table, query, pointer, sentence, need) in cases {
        let plan = planned(table.as_bytes(), query);
        let problem = plan.problems.first().unwrap_or_else(|| panic!("nothing is wrong with\n{table}"));
        assert_eq!(problem.pointer, pointer, "{table}{problem:?}");
        assert!(problem.message.starts_with(sentence), "{table}{}", problem.message);
        assert_eq!(plan.needs.iter().copied().collect::<Vec<_>>(), Vec::from_iter(need), "{table}");
    }
    for (query, sentence) in [
        ("zone=Europe/Berln", "\"Europe/Berln\" is not a zone of the IANA time zone database: write one such as Europe/Berlin, America/New_York, UTC or +01:00"),
        ("zone=+25:00", "\"+25:00\" is not a zone of the IANA time zone database: write one such as"),
        ("date_order=ymd", "\"ymd\" is not an order of dates: write dmy (day first) or mdy (month first)"),
        ("decimal=;", "\";\" is not a decimal sign: write point or comma"),
        ("unit=MHz", "\"MHz\" is not a unit of frequency: Hz, mHz, kHz and rad/s are known"),
        ("split=daily", "\"daily\" is not a rule: write 1d for a batch a day, 6h or 30min for shorter ones, gap:2h for a new batch after a pause of two hours, or none for one batch"),
        ("split=0d", "\"0d\" is not a rule"),
        ("split=gap:9999999999d", "\"gap:9999999999d\" is not a rule"),
        ("time_unit=days", "days do not say when they begin: use seconds, milliseconds, serial-days or decimal-year"),
        ("columns=f1", "\"f1\" must read TARGET=COLUMN, such as f1=Erste Biegung or f1=#3 for the third column"),
    ] {
        let problem = options(query).unwrap_err().remove(0);
        assert_eq!(problem.pointer, format!("query/{}", query.split_once('=').unwrap().0));
        assert!(problem.message.starts_with(sentence), "{query}: {}", problem.message);
    }
}

/// Each wrong row, with the options, its column and its sentence. The row before and the one after it are taken.
#[test]
fn rows_that_cannot_be_used_are_named_and_the_others_are_taken() {
    let cases: Vec<(&str, &str, &str, Option<&str>, &str)> = vec![
        (",", "2026-03-29T02:30,1.25,3.5", "zone=Europe/Berlin", Some("date"), "2026-03-29T02:30:00 did not exist in Europe/Berlin: the clocks were put forward; write the time with its offset"),
        (",", "2025-10-26T02:30,1.25,3.5", "zone=Europe/Berlin", Some("date"), "2025-10-26T02:30:00 was shown twice in Europe/Berlin when the clocks were put back: write the time with its offset, +02 or +01"),
        (",", "31.02.2026 12:00,1.25,3.5", "zone=UTC", Some("date"), "day 31 of month 2 of 2026 does not exist (read as day-month-year)"),
        (",", "01.03.26 12:00,1.25,3.5", "zone=UTC", Some("date"), "\"01.03.26\": write the year with four digits"),
        (",", "2026-02-30 12:00,1.25,3.5", "zone=UTC", Some("date"), "\"2026-02-30\" is not a day of the calendar"),
        (",", "12:00,1.25,3.5", "zone=UTC", Some("date"), "a time of day without a date: a column date is needed"),
        (",", "yesterday,1.25,3.5", "", Some("date"), "\"yesterday\" is not a time: write 2026-03-01T12:00:00Z, 2026-03-01 12:00:00 or 01.03.2026 12:00"),
        (",", "46023,1.25,3.5", "", Some("date"), "46023 is a number: name its unit by time_unit"),
        (",", "n/a,1.25,3.5", "", Some("date"), "measured_at is missing"),
        (",", "2099-01-01T00:00Z,1.25,3.5", "", Some("date"), "2099-01-01T00:00:00Z is in the future"),
        (",", "2026-03-01T11:00:00Z,1.25,3.5", "", Some("date"), "another measurement of this batch has the same time"),
        (",", "2026-03-01T12:00Z,n/a,NaN", "", None, "all modes are missing: omit the measurement"),
        (",", "2026-03-01T12:00Z,1.25,abc", "", Some("Mode 2 (Hz)"), "\"abc\" is not a number"),
        (",", "2026-03-01T12:00Z,1.25,\"3,5\"", "", Some("Mode 2 (Hz)"), "\"3,5\" is not a number: a decimal comma needs ';' or tab as separator"),
        (",", "2026-03-01T12:00Z,1.25,0", "", Some("Mode 2 (Hz)"), "0 Hz is not a valid natural frequency"),
        (",", "2026-03-01T12:00Z,1.25,inf", "", Some("Mode 2 (Hz)"), "\"inf\" is not finite: leave the cell empty for a missing value"),
        (",", "2026-03-01T12:00Z,1250,3.5", "", Some("f1"), "1250 Hz is far outside the range of this structure"),
        (",", "2026-03-01T12:00Z,1.25", "", None, "2 cells, but the header has 3"),
        (";", "2026-03-01T12:00Z;1.234,5;3,5", "decimal=comma", Some("f1"), "\"1.234,5\" is not a number: the numbers of this table have a decimal comma"),
    ];
    for (separator, row, query, column, sentence) in cases {
        let sign = if separator == ";" { "," } else { "." };
        let good = |time: &str| [time, &format!("1{sign}25"), &format!("3{sign}5")].join(separator);
        let header = ["date", "f1", "Mode 2 (Hz)"].join(separator);
        let table = format!("{header}\n{}\n{row}\n{}\n", good("2026-03-01T11:00:00Z"), good("2026-03-02T11:00:00Z"));
        let plan = planned(table.as_bytes(), &format!("{query}&split=1d"));
        assert_eq!(plan.problems, [], "{row}");
        assert_eq!((plan.understood.accepted, plan.understood.refused, plan.understood.batches), (2, 1, 2), "{row}");
        let refused = &plan.understood.refused_rows[0];
        assert_eq!((refused.line, refused.column.as_deref()), (3, column), "{row}: {}", refused.reason);
        assert!(refused.reason.starts_with(sentence), "{row}: {}", refused.reason);
    }
}

#[test]
fn the_order_of_dates_is_taken_from_the_table_where_it_is_certain() {
    let table = |dates: [&str; 2]| format!("date,f1,f2\n{},1.25,3.5\n{},1.25,3.5\n", dates[0], dates[1]);
    for (dates, query, first) in [
        (["03/04/2026", "25/04/2026"], "", "2026-04-03T00:00:00Z"),
        (["03/04/2026", "04/25/2026"], "", "2026-03-04T00:00:00Z"),
        (["03/04/2026", "05/04/2026"], "date_order=dmy", "2026-04-03T00:00:00Z"),
        (["03.04.2026", "05.04.2026"], "", "2026-04-03T00:00:00Z"),
        (["03.04.2026", "05.04.2026"], "date_order=mdy", "2026-03-04T00:00:00Z"),
        (["2026/03/04", "20260405"], "", "2026-03-04T00:00:00Z"),
    ] {
        let plan = planned(table(dates).as_bytes(), &format!("zone=UTC&split=none&{query}"));
        assert_eq!(plan.problems, [], "{dates:?}");
        assert_eq!(measurements(&plan)[0].measured_at.to_string(), first, "{dates:?}");
    }
    // Dates that contradict each other decide nothing.
    let plan = planned(table(["25/04/2026", "04/25/2026"]).as_bytes(), "zone=UTC&split=none");
    assert!(plan.needs.contains(&Need::DateOrder), "{:?}", plan.problems);
}

#[test]
fn days_begin_at_midnight_of_the_zone_also_when_clocks_change() {
    let mut table = "time,f1,f2\n".to_owned();
    // Every half hour of 72 hours around the change of clocks in Berlin, 2026-03-29 01:00 UTC.
    let start = Timestamp::parse("2026-03-27T23:00:00Z").unwrap();
    for i in 0..144 {
        let time = Timestamp::from_micros(start.micros() + i * 1_800_000_000).unwrap();
        writeln!(table, "{time},1.25,3.5").unwrap();
    }
    let sizes = |query: &str| planned(table.as_bytes(), query).batches.iter().map(Vec::len).collect::<Vec<_>>();
    // 28 March has 24 hours, 29 March 23, 30 March 24, and the last hour belongs to the 31st.
    assert_eq!(sizes("split=1d&zone=Europe/Berlin"), [48, 46, 48, 2]);
    assert_eq!(sizes("split=1d"), [2, 48, 48, 46]);
    assert_eq!(sizes("split=gap:30min"), [144]);
    assert_eq!(sizes("split=gap:29min").len(), 144);
}

prop_compose! {
    /// A row: minutes after 2026-01-01, and what is wrong with it, if anything.
    fn row()(minutes in 0_i64..400_000, wrong in prop::sample::select(vec!["", "", "", "", "time", "cells", "number", "empty"])) -> (i64, &'static str) {
        (minutes, wrong)
    }
}

fn written(rows: &[(i64, &'static str)]) -> String {
    let mut table = "time,f1,f2\n".to_owned();
    for (minutes, wrong) in rows {
        let time = Timestamp::from_micros(1_767_225_600_000_000 + minutes * 60_000_000).unwrap();
        let f = 1.0 + (*minutes % 97) as f64 / 1000.0;
        let line = match *wrong {
            "time" => format!("noon,{f},3.5"),
            "cells" => format!("{time},{f}"),
            "number" => format!("{time},{f},x"),
            "empty" => format!("{time},,"),
            _ => format!("{time},{f},3.5"),
        };
        writeln!(table, "{line}").unwrap();
    }
    table
}

/// Of the rows that are refused, 100 are kept and all are counted, whatever is wrong with them.
#[test]
fn of_many_refused_rows_a_hundred_are_kept_and_all_are_counted() {
    for (row, reason) in [
        ("a", "1 cells, but the header has 3"),
        ("a,1.25,3.5", "\"a\" is not a time"),
        ("2026-03-01T12:00Z,x,3.5", "\"x\" is not a number"),
        ("2026-03-01T12:00Z,,", "all modes are missing: omit the measurement"),
        ("2026-03-01T11:00Z,1.25,3.5", "another measurement of this batch has the same time"),
    ] {
        let table = format!("time,f1,f2\n2026-03-01T11:00Z,1.25,3.5\n{}", format!("{row}\n\n").repeat(5_000));
        let plan = planned(table.as_bytes(), "split=1d");
        assert_eq!(
            (plan.understood.rows, plan.understood.accepted, plan.understood.refused),
            (5_001, 1, 5_000),
            "{row}"
        );
        assert_eq!((plan.refused.count(), plan.refused.first().len()), (5_000, 100), "{row}");
        let lines: Vec<u64> = plan.understood.refused_rows.iter().map(|refused| refused.line).collect();
        assert_eq!(lines, (0..100_u64).map(|index| 3 + 2 * index).collect::<Vec<_>>(), "{row}");
        assert!(plan.understood.refused_rows.iter().all(|refused| refused.reason.starts_with(reason)), "{row}");
    }
}

/// Lines and cells as long as a table, of which the last is a number of two million digits: the first second of 1970.
#[test]
fn long_lines_and_cells_are_named() {
    let long = 2_000_000;
    let header = planned(",".repeat(long).as_bytes(), "");
    assert_eq!(header.problems[0].message, "the header has 2000001 columns: at most 1000 are read");
    let quoted = planned(format!("\"time,f1,f2\n{}", "x".repeat(long)).as_bytes(), "");
    assert_eq!(
        quoted.problems[0].message,
        "the header has 2000011 bytes: at most 262144 are read; is a quotation mark missing?"
    );
    let rows = ["a".to_owned(), ",".repeat(long), format!("{}x", ",".repeat(long)), "-".repeat(long), "0".repeat(long)];
    let table = format!("time,f1,f2\n2026-03-01T11:00Z,1.25,3.5\n{},1,3\n", rows.join(",1,3\n"));
    let plan = planned(table.as_bytes(), "time_unit=seconds&split=none");
    assert_eq!((plan.understood.rows, plan.understood.accepted), (6, 2), "{:?}", plan.problems);
    let reasons: Vec<&str> = plan.understood.refused_rows.iter().map(|refused| refused.reason.as_str()).collect();
    assert!(reasons[0].starts_with("\"a\" is not a time"), "{reasons:?}");
    assert_eq!(reasons[1..3], ["2000003 cells, but the header has 3", "2000003 cells, but the header has 3"]);
    assert!(reasons[3].starts_with("\"-----") && reasons[3].len() < 400, "{}", reasons[3]);
    let blank = planned(format!("time,f1,f2\n{}\n", ",".repeat(long)).as_bytes(), "");
    assert_eq!(blank.understood.rows, 0);
}

proptest! {
    #[test]
    fn no_row_is_lost(rows in prop::collection::vec(row(), 1..60), split in prop::sample::select(vec!["none", "1d", "6h", "45min", "gap:2h", "7d"])) {
        let plan = planned(written(&rows).as_bytes(), &format!("split={split}"));
        let understood = &plan.understood;
        prop_assert_eq!(understood.rows, rows.len());
        prop_assert_eq!(understood.accepted + understood.refused, rows.len());
        prop_assert_eq!(measurements(&plan).len(), understood.accepted);
        prop_assert_eq!(plan.refused.count(), understood.refused);
        // A row is refused if it is wrong, or if a row before it that can be read has the same time.
        let expected: std::collections::BTreeSet<i64> =
            rows.iter().filter(|(_, wrong)| wrong.is_empty()).map(|(minutes, _)| *minutes).collect();
        prop_assert!(understood.accepted <= expected.len());
    }

    #[test]
    fn a_table_that_is_split_and_joined_is_the_whole(rows in prop::collection::vec(row(), 1..60), split in prop::sample::select(vec!["1d", "6h", "45min", "gap:2h", "7d"]), zone in prop::sample::select(vec!["UTC", "America/New_York", "+05:30"])) {
        let table = written(&rows);
        let whole = planned(table.as_bytes(), "split=none");
        let parts = planned(table.as_bytes(), &format!("split={split}&zone={zone}"));
        prop_assert_eq!(measurements(&parts), measurements(&whole));
        prop_assert!(parts.batches.iter().all(|batch| !batch.is_empty()));
        // Each interval holds one batch, and each pause separates two.
        let (split, zone) = (Split::parse(split).unwrap(), Zone::parse(zone).unwrap());
        for pair in parts.batches.windows(2) {
            let (last, first) = (pair[0].last().unwrap().measured_at, pair[1][0].measured_at);
            prop_assert!(last < first);
            let is_one_interval = split.interval(last, &zone) == split.interval(first, &zone);
            prop_assert!(!(is_one_interval && split.joins(last.micros(), first.micros())));
        }
        for (batch, planned) in parts.batches.iter().zip(&parts.plan.batches) {
            let ends = (batch[0].measured_at, batch.last().unwrap().measured_at);
            prop_assert_eq!((ends, batch.len()), ((planned.from, planned.to), planned.count()));
        }
    }

    #[test]
    fn no_bytes_make_the_reader_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        planned(&bytes, "split=1d&zone=UTC");
    }

    #[test]
    fn no_table_like_text_makes_the_reader_panic(
        text in "(date|time|Mode [0-3] \\(Hz\\)|f1|f2|std f1|temperature \\[K\\]|[,;\t\n\r\":/. 0-9a-zé-]){0,80}",
        query in prop::sample::select(vec!["split=1d", "zone=Europe/Berlin", "time_unit=serial-days&zone=Asia/Tokyo", "date_order=mdy&decimal=comma"]),
    ) {
        planned(text.as_bytes(), query);
    }
}

#[test]
fn the_stated_unit_of_a_covariate_decides_over_its_name() {
    let air = |unit: Option<&str>| Covariate {
        unit: unit.map(str::to_owned),
        ..Covariate::new("air", CovariateKind::Number)
    };
    let understood = |covariate: Covariate, header: &str| {
        let covariates = [covariate];
        let layout = Layout { modes: 1, covariates: &covariates, points: &[] };
        let text = format!("measured_at,f1_hz,{header}\n2026-03-01T12:00:00Z,2.5,285.65\n");
        let mut air = None;
        let take = |row: FoundRow, _: &mut Refused| air = row.raw.covariates.get("air").cloned();
        read(text.as_bytes(), &layout, &options("split=none").unwrap()).each_row(&mut Refused::new(0), take);
        air
    };
    let celsius = |value: Option<CovariateValue>| match value {
        Some(CovariateValue::Number(value)) => value,
        other => panic!("{other:?}"),
    };
    assert!((celsius(understood(air(Some("°C")), "Air (K)")) - 12.5).abs() < 1e-9);
    assert!((celsius(understood(air(Some("K")), "Air (K)")) - 285.65).abs() < 1e-9);
    // Without a unit the header cannot be compared with anything.
    assert_eq!(understood(air(None), "Air (K)"), None);
    assert_eq!(air(Some("°C")).unit(), Some("°C"));
    assert_eq!(Covariate::new("deck_c", CovariateKind::Number).unit(), Some("°C"));
    assert_eq!(Covariate::new("wind_m_per_s", CovariateKind::Number).unit(), Some("m/s"));
    assert_eq!((air(None).unit(), Covariate::new("team_c", CovariateKind::Category).unit()), (None, None));
}
