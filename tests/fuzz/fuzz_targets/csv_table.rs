//! A table of measurements: any bytes give measurements or problems with their line, never a panic. Accepted measurements are
//! written and read back unchanged.
#![no_main]

use std::sync::OnceLock;

use libfuzzer_sys::fuzz_target;
use modalwatch::measurement::check::{check_measurements, Expectation, Purpose};
use modalwatch::measurement::csv::{offered, read, CsvOptions, Times};
use modalwatch::measurement::csv_output::write;
use modalwatch::measurement::{Covariate, CovariateKind, ModalMeasurement};
use modalwatch::parameter::{DamageDirection, Parameter, ParameterSpace, PriorForm};
use modalwatch::quantity::Timestamp;

fn space() -> &'static ParameterSpace {
    static SPACE: OnceLock<ParameterSpace> = OnceLock::new();
    SPACE.get_or_init(|| {
        let (name, unit) = ("k1".to_owned(), "N/m".to_owned());
        ParameterSpace::new(vec![Parameter {
            name,
            unit,
            lower: 0.5,
            upper: 9.0,
            damage: DamageDirection::Decrease,
            form: PriorForm::Uniform,
        }])
    })
}

fn covariates() -> [Covariate; 2] {
    [Covariate::new("temperature_c", CovariateKind::Number), Covariate::new("Operator", CovariateKind::Category)]
}

fn checked(bytes: &[u8], times: Times) -> Option<Vec<ModalMeasurement>> {
    let covariates = covariates();
    let options = CsvOptions { times, ignore: vec!["lab".to_owned()], ..CsvOptions::default() };
    let raw = match read(bytes, 3, &covariates, &options) {
        Ok(raw) => raw,
        Err(problems) => {
            assert!(!problems.is_empty());
            return None;
        }
    };
    let expectation = Expectation {
        purpose: Purpose::Assessment,
        modes: 3,
        frequency_limits_hz: (0.001, 1_000.0),
        covariates: &covariates,
        instrumented: None,
        space: space(),
        now: Timestamp::from_micros(1_800_000_000_000_000).unwrap(),
        max_measurements: 5_000,
    };
    check_measurements(raw, &expectation).ok()
}

fuzz_target!(|bytes: &[u8]| {
    let points = vec!["m1".to_owned(), "m2".to_owned()];
    let options = CsvOptions { time_column: Some("Zeit".to_owned()), points, ..CsvOptions::default() };
    let _ = offered(bytes, &covariates(), &options, 5);
    let _ = read(bytes, 3, &covariates(), &options);
    let _ = checked(bytes, Times::RowNumber);
    let Some(taken) = checked(bytes, Times::Required) else { return };
    let table = write(&taken);
    let again = checked(table.as_bytes(), Times::Required);
    assert_eq!(again.as_ref(), Some(&taken), "{table}");
});
