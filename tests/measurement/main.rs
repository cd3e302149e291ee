//! Tables of measurements: whatever comes, no panic; what is written is read back.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

use std::collections::BTreeMap;

use modalwatch::measurement::check::{check_measurements, Expectation};
use modalwatch::measurement::csv::{read, write, CsvOptions, Times};
use modalwatch::measurement::{Covariate, CovariateKind, CovariateValue, ModalMeasurement};
use modalwatch::parameter::{DamageDirection, Parameter, ParameterSpace};
use modalwatch::quantity::{Hertz, Timestamp};
use proptest::prelude::*;

fn covariates() -> Vec<Covariate> {
    vec![
        Covariate { name: "temperature_c".to_owned(), kind: CovariateKind::Number },
        Covariate { name: "Operator".to_owned(), kind: CovariateKind::Category },
    ]
}

fn space() -> ParameterSpace {
    let parameter = Parameter {
        name: "k1".to_owned(),
        unit: "N/m".to_owned(),
        lower: 0.5,
        upper: 9.0,
        damage: DamageDirection::Decrease,
    };
    ParameterSpace::new(vec![parameter])
}

fn options() -> CsvOptions {
    CsvOptions { times: Times::Required, ignore: Vec::new(), time_column: None }
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
            modes: 3,
            frequency_limits_hz: (0.01, 100.0),
            covariates: &covariates,
            space: &space,
            now: Timestamp::now(),
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
