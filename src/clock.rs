//! The system clock. Only the service reads it: the crates below it are given the times that they need.

use crate::quantity::Timestamp;

/// The present time, in whole microseconds.
pub fn now() -> Timestamp {
    let of = |micros| Timestamp::from_micros(micros).expect("the clock is within the calendar");
    fault_point!("clock", |micros: Option<String>| of(micros
        .and_then(|text| text.parse().ok())
        .expect("the test gives microseconds")));
    of(jiff::Timestamp::now().as_microsecond())
}
