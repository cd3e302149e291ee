//! A batch as JSON, as a post and as a message of a broker: any bytes give measurements or problems, never a panic. The JSON that
//! the service writes of an accepted batch is accepted again, with the same digest.
#![no_main]

use std::sync::OnceLock;

use libfuzzer_sys::fuzz_target;
use modalwatch::baseline::library::find_structure;
use modalwatch::measurement::body::RawBatch;
use modalwatch::measurement::check::{check_idempotency_key, check_measurements, check_source};
use modalwatch::measurement::MeasurementBatch;
use modalwatch::quantity::Timestamp;
use modalwatch::simulator::Simulator;

fn simulator() -> &'static Simulator {
    static SIMULATOR: OnceLock<Simulator> = OnceLock::new();
    SIMULATOR.get_or_init(|| find_structure("three-dof").unwrap())
}

fn checked(raw: RawBatch) -> Option<MeasurementBatch> {
    let s = simulator();
    let source = raw.source.unwrap_or_else(|| "default".to_owned());
    check_source(&source).ok()?;
    if let Some(key) = &raw.idempotency_key {
        check_idempotency_key(key).ok()?;
    }
    let expectation = s.expectation(Timestamp::from_micros(1_800_000_000_000_000).unwrap(), 5_000);
    let measurements = match check_measurements(raw.measurements, &expectation) {
        Ok(measurements) => measurements,
        Err(problems) => {
            assert!(!problems.is_empty() && problems.len() <= 21);
            return None;
        }
    };
    let (structure, idempotency_key) = (s.id().clone(), raw.idempotency_key);
    Some(MeasurementBatch { structure, source, idempotency_key, posted_by: None, measurements })
}

fuzz_target!(|bytes: &[u8]| {
    let _ = RawBatch::of_message(bytes).map(checked);
    let Ok(raw) = RawBatch::of_post(bytes, None) else { return };
    let Some(batch) = checked(raw) else { return };
    let (from, to) = batch.time_span();
    assert!(from <= to);
    let measurements = serde_json::to_string(&batch.measurements).unwrap();
    let source = serde_json::to_string(&batch.source).unwrap();
    let written = format!("{{\"source\":{source},\"measurements\":{measurements}}}");
    let again = RawBatch::of_post(written.as_bytes(), None).ok().and_then(checked);
    let again = again.unwrap_or_else(|| panic!("an accepted batch is not accepted again: {written}"));
    assert_eq!(again.content_digest(), batch.content_digest(), "{written}");
});
