//! Tables of finite-element runs and their checks.

use nalgebra::DMatrix;

/// Finite-element runs: their parameters and the natural frequencies that they gave.
#[derive(Debug, Clone, PartialEq)]
pub struct Runs {
    /// Parameters, one row per run, `[n, d]`, parameter units.
    pub parameters: DMatrix<f64>,
    /// Natural frequencies, one row per run, `[n, m]`, Hz, ascending within a row.
    pub frequencies_hz: DMatrix<f64>,
}

/// Why an emulator cannot be fitted to a table of runs. Runs, parameters and modes are counted from 1.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FitError {
    /// There is no parameter column or no frequency column.
    #[error("the table has {parameters} parameters and {modes} frequencies: it needs at least one of each")]
    Empty {
        /// Parameter columns.
        parameters: usize,
        /// Frequency columns.
        modes: usize,
    },
    /// Parameters and frequencies have different numbers of runs.
    #[error("there are parameters of {parameters} runs, but frequencies of {frequencies}: both need the same runs")]
    Lengths {
        /// Rows of the parameters.
        parameters: usize,
        /// Rows of the frequencies.
        frequencies: usize,
    },
    /// There are fewer than two runs for each term of a linear function.
    #[error("{runs} runs are too few for {parameters} parameters: at least {needed} are needed")]
    TooFewRuns {
        /// Runs in the table.
        runs: usize,
        /// Parameter columns.
        parameters: usize,
        /// Runs needed: 2(d + 1).
        needed: usize,
    },
    /// A parameter is infinite or not a number.
    #[error("run {run}, parameter {parameter}: {value} is not a finite number")]
    ParameterNotFinite {
        /// The run.
        run: usize,
        /// The parameter column.
        parameter: usize,
        /// The value.
        value: f64,
    },
    /// A parameter has the same value in all runs.
    #[error("parameter {parameter} is {value} in every run: remove its column, or vary it")]
    Constant {
        /// The parameter column.
        parameter: usize,
        /// Its only value.
        value: f64,
    },
    /// A frequency is not a positive, finite number.
    #[error("run {run}, mode {mode}: the frequency {hz} Hz must be positive and finite")]
    NotPositive {
        /// The run.
        run: usize,
        /// The mode.
        mode: usize,
        /// The frequency, Hz.
        hz: f64,
    },
    /// A frequency is below that of the mode before it.
    #[error("run {run}: mode {mode} has {hz} Hz, the mode before it {before_hz} Hz: frequencies must ascend")]
    NotAscending {
        /// The run.
        run: usize,
        /// The mode.
        mode: usize,
        /// Its frequency, Hz.
        hz: f64,
        /// The frequency of the mode before it, Hz.
        before_hz: f64,
    },
}

impl Runs {
    /// Checks that an emulator can be fitted.
    ///
    /// # Errors
    /// [`FitError`] for the first mistake found.
    pub(super) fn check(&self) -> Result<(), FitError> {
        let ((runs, parameters), modes) = (self.parameters.shape(), self.frequencies_hz.ncols());
        if parameters == 0 || modes == 0 {
            return Err(FitError::Empty { parameters, modes });
        }
        if self.frequencies_hz.nrows() != runs {
            return Err(FitError::Lengths { parameters: runs, frequencies: self.frequencies_hz.nrows() });
        }
        let needed = 2 * (parameters + 1);
        if runs < needed {
            return Err(FitError::TooFewRuns { runs, parameters, needed });
        }
        for run in 0..runs {
            self.check_run(run)?;
        }
        for (parameter, column) in self.parameters.column_iter().enumerate() {
            // A width that overflows would scale all values to zero.
            let width = column.max() - column.min();
            if width <= 0.0 || !width.is_finite() {
                return Err(FitError::Constant { parameter: parameter + 1, value: column[0] });
            }
        }
        Ok(())
    }

    fn check_run(&self, run: usize) -> Result<(), FitError> {
        if let Some((parameter, &value)) = self.parameters.row(run).iter().enumerate().find(|(_, v)| !v.is_finite()) {
            return Err(FitError::ParameterNotFinite { run: run + 1, parameter: parameter + 1, value });
        }
        let mut before_hz = 0.0;
        for (mode, &hz) in self.frequencies_hz.row(run).iter().enumerate() {
            if !(hz.is_finite() && hz > 0.0) {
                return Err(FitError::NotPositive { run: run + 1, mode: mode + 1, hz });
            }
            // Equal frequencies are allowed: a symmetric structure has repeated eigenvalues.
            if hz < before_hz {
                return Err(FitError::NotAscending { run: run + 1, mode: mode + 1, hz, before_hz });
            }
            before_hz = hz;
        }
        Ok(())
    }
}
