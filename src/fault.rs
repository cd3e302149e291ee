//! Fault injection for unit tests: points in the code at which a test can make a write, a commit, a model file, a delivery
//! or the clock fail.
//!
//! `fault_point!("store::commit", |_| Err(…))` returns from the enclosing function when a test activates it by `fail::cfg`;
//! a test can also make it panic. The points are compiled into the library's unit tests only: the released program contains
//! none, and `cargo test` needs neither a feature nor a second build. Integration tests cause faults of the real program
//! from outside, by `kill`, `fiu`, `faketime` and full disks (`tests/faults`).

/// A named point that a test can make fail; see the module.
#[cfg(test)]
macro_rules! fault_point {
    ($name:literal, $answer:expr) => {
        fail::fail_point!($name, $crate::fault::is_armed(), $answer)
    };
}

/// Expands to nothing outside the unit tests.
#[cfg(not(test))]
macro_rules! fault_point {
    ($name:literal, $answer:expr) => {};
}

#[cfg(test)]
thread_local! {
    static ARMED: std::cell::Cell<bool> = const { std::cell::Cell::new(false) };
}

/// Whether the test on this thread has activated faults. Tests on other threads run at the same time and must not be
/// affected.
#[cfg(test)]
pub(crate) fn is_armed() -> bool {
    ARMED.get()
}

/// Guard that activates faults on this thread until it is dropped. Only one test at a time can hold it.
///
/// A test with tokio's default runtime runs all its tasks on its own thread, so that this suffices.
#[cfg(test)]
pub(crate) struct Faults {
    _scenario: fail::FailScenario<'static>,
    /// Makes the guard `!Send`.
    _here: std::marker::PhantomData<*const ()>,
}

#[cfg(test)]
#[expect(clippy::unused_self, reason = "only the holder of the guard may set faults")]
impl Faults {
    pub(crate) fn arm() -> Self {
        let scenario = fail::FailScenario::setup();
        ARMED.set(true);
        Self { _scenario: scenario, _here: std::marker::PhantomData }
    }

    /// Sets the actions of a point, in the syntax of `fail`: `2*off->1*return` makes the third call fail.
    pub(crate) fn set(&self, point: &str, actions: &str) {
        fail::cfg(point, actions).expect("the actions are well formed");
    }

    /// Removes the actions of a point.
    pub(crate) fn clear(&self, point: &str) {
        fail::remove(point);
    }
}

#[cfg(test)]
impl Drop for Faults {
    fn drop(&mut self) {
        ARMED.set(false);
    }
}
