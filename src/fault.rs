//! Places where a test makes something go wrong: a write, a commit, a model file, a delivery, the clock.
//!
//! `fault_point!("store::commit", |_| Err(…))` returns from the function around it when a test asks for it by `fail::cfg`; a
//! `panic` there works as well. The points are compiled into the library's own tests only: the program that is shipped holds
//! none, and `cargo test` needs no feature and no second build for them. Faults of the real program are made from outside, by
//! `kill`, `fiu`, `faketime` and full disks (`tests/faults`).

/// A place that can be told to fail, by name; see the module.
#[cfg(test)]
macro_rules! fault_point {
    ($name:literal, $answer:expr) => {
        fail::fail_point!($name, $crate::fault::is_armed(), $answer)
    };
}

/// Nothing, outside the tests of the library.
#[cfg(not(test))]
macro_rules! fault_point {
    ($name:literal, $answer:expr) => {};
}

#[cfg(test)]
thread_local! {
    static ARMED: std::cell::Cell<bool> = const { std::cell::Cell::new(false) };
}

/// Whether this thread's test wants faults: the others run at the same time and must not have them.
#[cfg(test)]
pub(crate) fn is_armed() -> bool {
    ARMED.get()
}

/// Faults for what runs on this thread, until it is dropped; one test at a time has them.
///
/// A test with tokio's default runtime runs all its tasks on its own thread, so nothing more is needed.
#[cfg(test)]
pub(crate) struct Faults {
    _scenario: fail::FailScenario<'static>,
    /// Stays on its thread.
    _here: std::marker::PhantomData<*const ()>,
}

#[cfg(test)]
#[expect(clippy::unused_self, reason = "whoever sets a fault must hold them")]
impl Faults {
    pub(crate) fn arm() -> Self {
        let scenario = fail::FailScenario::setup();
        ARMED.set(true);
        Self { _scenario: scenario, _here: std::marker::PhantomData }
    }

    /// Sets what happens at a point, in the words of `fail`: `2*off->1*return` fails the third call.
    pub(crate) fn set(&self, point: &str, actions: &str) {
        fail::cfg(point, actions).expect("the actions are well formed");
    }

    /// Sets a point back.
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
