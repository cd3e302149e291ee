//! The steps of a diagnosis, reported while it runs.

/// The step that a diagnosis has reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// The simulation is fitted without further causes.
    Showing,
    /// A further cause is searched for.
    Searching {
        /// Number of the cause, from 1.
        cause: usize,
        /// Greatest number of causes.
        of: usize,
    },
    /// A cause is searched for again with the other causes in place.
    LookingAgain {
        /// Number of the cause, from 1.
        cause: usize,
        /// Causes found.
        of: usize,
    },
    /// All rows are tested for a lasting change in time.
    Comparing,
    /// The gain on the rows held out is measured.
    Measuring,
}

impl std::fmt::Display for Step {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Showing => f.write_str("fitting the simulation without further causes"),
            Self::Searching { cause, of } => write!(f, "searching for cause {cause} of at most {of}"),
            Self::LookingAgain { cause, of } => write!(f, "searching again for cause {cause} of {of}"),
            Self::Comparing => f.write_str("testing for a lasting change in time"),
            Self::Measuring => f.write_str("measuring the gain on the rows held out"),
        }
    }
}

/// Called at each step.
pub type Progress<'a> = dyn Fn(Step) + Sync + 'a;
