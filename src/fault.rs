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
        fail::fail_point!($name, $crate::fault::strikes($name), $answer)
    };
}

/// Expands to nothing outside the unit tests.
#[cfg(not(test))]
macro_rules! fault_point {
    ($name:literal, $answer:expr) => {};
}

/// Decides at each call of a point whether the fault that is set for it strikes.
#[cfg(test)]
type Plan = std::sync::Arc<std::sync::Mutex<dyn FnMut(&'static str) -> bool + Send>>;

/// The faults of a thread.
#[cfg(test)]
#[derive(Clone, Default)]
struct Armed {
    armed: bool,
    /// Without a plan, every fault strikes that is set.
    plan: Option<Plan>,
}

#[cfg(test)]
thread_local! {
    static ARMED: std::cell::RefCell<Armed> = std::cell::RefCell::default();
}

/// Whether the test on this thread has activated faults, and its plan lets this one strike. Tests on other threads run at the same time
/// and must not be affected.
#[cfg(test)]
pub(crate) fn strikes(point: &'static str) -> bool {
    let Armed { armed, plan } = ARMED.with_borrow(Clone::clone);
    armed && plan.is_none_or(|plan| plan.lock().unwrap_or_else(std::sync::PoisonError::into_inner)(point))
}

/// Work for another thread, for which the faults of the present thread hold there as well.
#[cfg(test)]
pub(crate) fn carried<T>(work: impl FnOnce() -> T) -> impl FnOnce() -> T {
    /// Gives the thread its own faults back, also after a panic.
    struct Lent(Armed);
    impl Drop for Lent {
        fn drop(&mut self) {
            ARMED.set(std::mem::take(&mut self.0));
        }
    }
    let here = ARMED.with_borrow(Clone::clone);
    move || {
        let _lent = Lent(ARMED.replace(here));
        work()
    }
}

/// The work itself outside the unit tests.
#[cfg(not(test))]
pub(crate) fn carried<F>(work: F) -> F {
    work
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
        ARMED.set(Armed { armed: true, plan: None });
        Self { _scenario: scenario, _here: std::marker::PhantomData }
    }

    /// Sets the actions of a point, in the syntax of `fail`: `2*off->1*return` makes the third call fail.
    pub(crate) fn set(&self, point: &str, actions: &str) {
        fail::cfg(point, actions).expect("the actions are well formed");
    }

    /// Calls a function at a point, behind which the code goes on.
    pub(crate) fn call(&self, point: &str, function: impl Fn() + Send + Sync + 'static) {
        fail::cfg_callback(point, function).expect("a function is well formed");
    }

    /// Lets a plan decide at each call whether the fault that is set for a point strikes.
    pub(crate) fn follow(&self, plan: impl FnMut(&'static str) -> bool + Send + 'static) {
        ARMED.with_borrow_mut(|armed| armed.plan = Some(std::sync::Arc::new(std::sync::Mutex::new(plan))));
    }

    /// Removes the actions of a point.
    pub(crate) fn clear(&self, point: &str) {
        fail::remove(point);
    }
}

#[cfg(test)]
impl Drop for Faults {
    fn drop(&mut self) {
        ARMED.set(Armed::default());
    }
}
