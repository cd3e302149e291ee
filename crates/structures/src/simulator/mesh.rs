//! The error of a beam's finite elements.

use super::check;
use super::simulate::Simulator;
use crate::quantity::significant;

/// Share of the noise of one measurement above which the error of the finite elements is told. The mean of many measurements is more exact than
/// one by their root, and a diagnosis sees what is off in the mean.
const TOLD: f64 = 0.2;

/// Part of the error that elements of half the length leave: it falls with the fourth power of the length.
const LEFT: f64 = 1.0 / 16.0;

impl Simulator {
    /// What a person should know about the finite elements of a beam, as a clause; `None` if their error is small beside the noise, and for
    /// another simulation.
    ///
    /// ```text
    ///  error of mode i ≈ (f_i(h) − f_i(h/2))/(1 − 1/16)      h: length of the elements
    /// ```
    pub fn mesh_warning(&self) -> Option<String> {
        let mut finer = self.definition().clone();
        if finer.beams.is_empty() {
            return None;
        }
        finer.effects.clear();
        finer.beams.iter_mut().for_each(|beam| beam.elements *= 2);
        let finer_hz = check::check(&finer).ok()?.nominal_frequencies_hz;
        let own = self.nominal_frequencies_hz();
        let error = |(mode, (f, finer)): (usize, (&f64, &f64))| {
            let (share, noise) = ((f - finer) / (1.0 - LEFT) / f, self.std_hz(mode, *f) / f);
            (share > TOLD * noise && noise > 0.0).then_some((mode, share, noise))
        };
        let worst =
            own.iter().zip(&finer_hz).enumerate().filter_map(error).max_by(|a, b| (a.1 / a.2).total_cmp(&(b.1 / b.2)));
        worst.map(|(mode, share, noise)| {
            format!(
                "the finite elements raise the frequency of mode {} by {} %, and the noise of one measurement is {} %: give the spans more \
                 elements, or a diagnosis finds this error",
                mode + 1,
                significant(100.0 * share),
                significant(100.0 * noise)
            )
        })
    }
}
