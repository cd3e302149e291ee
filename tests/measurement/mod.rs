//! Tables of measurements: no input causes a panic, and a table that was written is read back unchanged.

mod tables;

use std::collections::BTreeMap;

use modalwatch::measurement::body::RawBatch;
use modalwatch::measurement::check::{check_each, check_measurements, Expectation, Purpose};
use modalwatch::measurement::csv::{read, CsvOptions};
use modalwatch::measurement::csv_output::write;
use modalwatch::measurement::shape::InstrumentedPoints;
use modalwatch::measurement::{Covariate, CovariateKind, CovariateValue, ModalMeasurement};
use modalwatch::parameter::{DamageDirection, Parameter, ParameterSpace, PriorForm};
use modalwatch::quantity::{Hertz, Timestamp};
use proptest::prelude::*;

fn covariates() -> Vec<Covariate> {
    vec![Covariate::new("temperature_c", CovariateKind::Number), Covariate::new("Operator", CovariateKind::Category)]
}

fn space() -> ParameterSpace {
    let parameter = Parameter {
        name: "k1".to_owned(),
        unit: "N/m".to_owned(),
        lower: 0.5,
        upper: 9.0,
        damage: DamageDirection::Decrease,
        form: PriorForm::Uniform,
    };
    ParameterSpace::new(vec![parameter])
}

fn options() -> CsvOptions {
    CsvOptions::default()
}

prop_compose! {
    fn measurement()(
        micros in 0_i64..1_700_000_000_000_000,
        step in prop::collection::vec(0.001_f64..3.0, 3),
        missing in 0_usize..4,
        std in prop::option::of(0.001_f64..0.1),
        temperature in prop::option::of(-40.0_f64..50.0),
        operator in prop::option::of("[A-Za-z;,\"äß]{1,8}"),
        k1 in prop::option::of(0.5_f64..9.0),
    ) -> ModalMeasurement {
        let mut sum = 0.1;
        let frequencies = step.iter().enumerate().map(|(mode, s)| {
            sum += s;
            (mode != missing).then(|| Hertz::new(sum).unwrap())
        });
        let covariates = [
            temperature.map(|t| ("temperature_c".to_owned(), CovariateValue::Number(t))),
            operator.map(|o| ("Operator".to_owned(), CovariateValue::Category(o))),
        ];
        ModalMeasurement {
            measured_at: Timestamp::from_micros(micros).unwrap(),
            frequencies_hz: frequencies.collect(),
            std_hz: std.map(|s| vec![Some(s), None, Some(2.0 * s)]),
            mode_shapes: None,
            covariates: covariates.into_iter().flatten().collect(),
            settings: k1.map(|k| BTreeMap::from([("k1".to_owned(), k)])).unwrap_or_default(),
        }
    }
}

proptest! {
    #[test]
    fn what_is_written_is_read_back(mut rows in prop::collection::vec(measurement(), 1..20)) {
        rows.sort_by_key(|m| m.measured_at);
        rows.dedup_by_key(|m| m.measured_at);
        let (covariates, space) = (covariates(), space());
        let expectation = Expectation {
            purpose: Purpose::Assessment,
            modes: 3,
            frequency_limits_hz: (0.01, 100.0),
            covariates: &covariates,
            instrumented: None,
            space: &space,
            now: modalwatch::clock::now(),
            max_measurements: 100,
        };
        let raw = read(write(&rows).as_bytes(), 3, &covariates, &options()).unwrap();
        prop_assert_eq!(check_measurements(raw, &expectation).unwrap(), rows);
    }

    #[test]
    fn no_bytes_make_the_reader_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        let _ = read(&bytes, 3, &covariates(), &options());
    }

    #[test]
    fn no_table_like_text_makes_the_reader_panic(text in "(measured_at|f[0-4]_hz|std_f1_hz|set_k|[,;\t\n\r\"0-9.a-zé-]){0,60}") {
        let _ = read(text.as_bytes(), 3, &covariates(), &options());
    }
}

/// Variants of a table that spreadsheets and loggers write: each contains the same two measurements.
#[test]
fn the_ways_a_table_is_written_are_read_alike() {
    let (covariates, space) = (covariates(), space());
    let expectation = Expectation {
        purpose: Purpose::Assessment,
        modes: 3,
        frequency_limits_hz: (0.01, 100.0),
        covariates: &covariates,
        instrumented: None,
        space: &space,
        now: modalwatch::clock::now(),
        max_measurements: 100,
    };
    let plain = "measured_at,f1_hz,f2_hz,f3_hz,std_f1_hz,temperature_c,Operator,set_k1\n\
                 2026-01-01T00:00:00Z,0.41,0.74,0.93,0.001,-3.5,anna,4.5\n\
                 2026-01-01T00:10:00Z,0.42,,0.94,,,,\n";
    let of = |text: &str| check_measurements(read(text.as_bytes(), 3, &covariates, &options()).unwrap(), &expectation);
    let expected = of(plain).unwrap();
    assert_eq!((expected.len(), expected[1].frequencies_hz[1]), (2, None));
    let semicolons = plain.replace(',', ";");
    let with_each_line = |f: &dyn Fn(&str) -> String| plain.lines().map(f).collect::<String>();
    let cases: Vec<(&str, String)> = vec![
        ("byte order mark", format!("\u{feff}{plain}")),
        ("CRLF", plain.replace('\n', "\r\n")),
        ("CR alone", plain.replace('\n', "\r")),
        ("no newline at the end", plain.trim_end().to_owned()),
        ("newlines at the end", format!("{plain}\n\n")),
        ("empty lines", plain.replace('\n', "\n\n")),
        ("lines of separators", format!("{plain},,,,,,,\n")),
        ("blanks about cells", plain.replace(',', " , ")),
        ("blanks at the ends of lines", with_each_line(&|line| format!("{line}  \t\n"))),
        ("semicolons", semicolons.clone()),
        ("semicolons and decimal commas", semicolons.replace("0.", "0,").replace("-3.5", "-3,5").replace("4.5", "4,5")),
        ("tabs", plain.replace(',', "\t")),
        (
            "tabs and decimal commas",
            plain.replace(',', "\t").replace("0.", "0,").replace("3.5", "3,5").replace("4.5", "4,5"),
        ),
        ("upper case", plain.replacen("measured_at,f1_hz,f2_hz", "Measured_At,F1_Hz,F2_HZ", 1)),
        ("case of covariates", plain.replacen("temperature_c,Operator", "Temperature_C,operator", 1)),
        ("quotes", with_each_line(&|line| format!("\"{}\"\n", line.replace(',', "\",\"")))),
        ("columns without a name", with_each_line(&|line| format!("{line},,\n"))),
        ("sep=", format!("sep=;\r\n{}", semicolons.replace('\n', "\r\n"))),
        ("all at once", format!("\u{feff}SEP=;\r\n{};;", semicolons.replace('\n', ";;\r\n").replace("0.", "0,"))),
    ];
    for (name, text) in cases {
        assert_eq!(of(&text), Ok(expected.clone()), "{name}:\n{text}");
    }
}

/// Mode shapes come in JSON only: each measurement is judged by itself, and named.
#[test]
fn measurements_are_judged_one_by_one() {
    let text = r#"{"measurements": [
        {"measured_at": "2026-01-01T00:00:00Z", "frequencies_hz": [1, 2], "mode_shapes": [[1, 0.5], null]},
        {"measured_at": "2026-01-01T00:01:00Z", "frequencies_hz": [1, 2], "mode_shapes": [[1, 0.5, 2], null]},
        {"measured_at": "2026-01-01T00:02:00Z", "frequencies_hz": [1, 2, 3]},
        {"measured_at": "2026-01-01T00:03:00Z", "frequencies_hz": [1, null], "settings": {"k1": 90}},
        {"measured_at": "2026-01-01T00:03:00Z", "frequencies_hz": [1, 2]},
        {"measured_at": "1969-01-01T00:00:00Z", "frequencies_hz": [1, -2]}
    ]}"#;
    let points = InstrumentedPoints {
        names: vec!["roof".to_owned(), "floor".to_owned()],
        nominal: vec![vec![0.9, 0.45], vec![-0.45, 0.9]],
    };
    let space = space();
    let expectation = |purpose| Expectation {
        purpose,
        modes: 2,
        frequency_limits_hz: (0.01, 100.0),
        covariates: &[],
        instrumented: Some(&points),
        space: &space,
        now: modalwatch::clock::now(),
        max_measurements: 100,
    };
    let of = |purpose| {
        let raw = RawBatch::of_post(text.as_bytes(), None).unwrap().measurements;
        let each = check_each(raw, &expectation(purpose)).into_iter();
        each.map(|checked| checked.err().map_or_else(String::new, |p| format!("{}: {}", p.pointer, p.message)))
            .collect()
    };
    let reasons = [
        ["", ""],
        ["/measurements/1/mode_shapes/0: 3 numbers, expected 2"; 2],
        ["/measurements/2/frequencies_hz: 3 frequencies, expected 2"; 2],
        ["/measurements/3/settings/k1: 90 N/m is outside the prior of k1", ""],
        ["/measurements/4/measured_at: another measurement of this batch has the same time"; 2],
        [
            "/measurements/5/measured_at: 1969-01-01T00:00:00Z is before 1970",
            "/measurements/5/frequencies_hz/1: -2 Hz is not a valid natural frequency",
        ],
    ];
    for (purpose, column) in [(Purpose::Assessment, 0), (Purpose::Diagnosis, 1)] {
        let found: Vec<String> = of(purpose);
        assert_eq!(found.len(), reasons.len());
        for (found, expected) in found.iter().zip(reasons) {
            let expected = expected[column];
            assert!(
                found.starts_with(expected) && found.is_empty() == expected.is_empty(),
                "{found} instead of {expected}"
            );
        }
    }
}

#[test]
fn invalid_or_ambiguous_values_are_refused_with_their_line() {
    let refused = |text: &str| read(text.as_bytes(), 3, &covariates(), &options()).unwrap_err().remove(0);
    for (text, place, message) in [
        (
            "measured_at;f1_hz;f2_hz;f3_hz\n\n2026-01-01T00:00:00Z;1.234,5;1;1\n",
            "line 3, column f1_hz",
            "is not a number",
        ),
        ("measured_at,f1_hz,f2_hz,f3_hz,\r\n2026-01-01T00:00:00Z,1,1,1,7\r\n", "line 2", "column without a name"),
        ("measured_at,f1_hz,f2_hz,f3_hz\r\n\r\n2026-01-01T00:00:00Z,1,x,1", "line 3, column f2_hz", "is not a number"),
        ("sep=;\nmeasured_at;f1_hz;f2_hz\n", "line 2", "missing column f3_hz"),
        ("measured_at,f1_hz,F1_HZ,f2_hz,f3_hz\n", "line 1", "appears twice"),
        ("", "line 1", "empty"),
    ] {
        let problem = refused(text);
        assert_eq!(problem.pointer, place, "{text}: {problem:?}");
        assert!(problem.message.contains(message), "{text}: {problem:?}");
    }
}

/// The shape of each mode of a row; `None` for a mode without one.
type RowShapes = Vec<Option<Vec<f64>>>;

/// Reads a table of a structure with two modes and the instrumented points `m2` and `m4`.
fn with_shapes(table: &str) -> Result<Vec<Option<RowShapes>>, String> {
    let options = CsvOptions { points: vec!["m2".to_owned(), "m4".to_owned()], ..options() };
    let rows = read(table.as_bytes(), 2, &[], &options).map_err(|problems| problems[0].message.clone())?;
    Ok(rows.into_iter().map(|row| row.mode_shapes).collect())
}

#[test]
fn a_table_carries_mode_shapes_in_columns_of_modes_and_points() {
    // The columns may come in any order, and those of a mode may be left out.
    let header = "measured_at,f1_hz,f2_hz,phi2_m4,PHI2_m2";
    let table = format!(
        "{header}\n2026-03-01T12:00:00Z,1.0,2.0,-0.5,0.25\n2026-03-01T13:00:00Z,1.0,2.0,,\n2026-03-01T14:00:00Z,1.0,2.0,4,3\n"
    );
    let shape = |m2: f64, m4: f64| Some(vec![None, Some(vec![m2, m4])]);
    assert_eq!(with_shapes(&table).unwrap(), [shape(0.25, -0.5), None, shape(3.0, 4.0)]);
}

#[test]
fn incomplete_shapes_in_a_table_are_refused_with_what_is_missing() {
    let row = "2026-03-01T12:00:00Z,1.0,2.0";
    let cases = [
        ("phi1_m2", "0.1", "missing column phi1_m4"),
        (
            "phi1_m2,phi1_m3",
            "0.1,0.2",
            "m3\" is not an instrumented point of the structure; mode_shapes.points lists m2, m4",
        ),
        ("phi3_m2,phi3_m4", "0.1,0.2", "the structure has 2 modes"),
        ("phi1_m2,phi1_m4", "0.1,", "the shape of mode 1 has 1 of 2 components"),
        ("phi1_m2,phi1_m4", "0.1,x", "\"x\" is not a number"),
        ("phi1_m2,phi1_m4,phi1_m2", "0.1,0.2,0.3", "appears twice"),
    ];
    for (columns, cells, expected) in cases {
        let message = with_shapes(&format!("measured_at,f1_hz,f2_hz,{columns}\n{row},{cells}\n")).unwrap_err();
        assert!(message.contains(expected), "{columns}: {message}");
    }
    // Without instrumented points such a column is unknown.
    let table = format!("measured_at,f1_hz,f2_hz,phi1_m2\n{row},0.1\n");
    assert!(read(table.as_bytes(), 2, &[], &options()).unwrap_err()[0].message.contains("unknown column"));
}
