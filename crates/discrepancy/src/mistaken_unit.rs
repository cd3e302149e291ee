//! Units that were mistaken: frequencies that are not in Hz, and masses and stiffnesses of a structure file that are not in kg and N/m. No
//! cause in the structure explains frequencies that are off by such a factor.

use super::effect::FittedEffect;
use super::model::RowView;
use super::study::{part_of, Study};
use structures::measurement::mistaken_unit::MISTAKEN_UNITS;
use structures::stats;

/// What the numbers of a structure file may be, and the factor that the squares of all frequencies of the simulation then lack.
const OF_FILES: [(&str, f64); 6] = [
    ("the masses of the structure file are read as weights in N: give masses in kg", 9.806_65),
    ("the masses of the structure file are read as weights in lbf and its lengths as inches: give kg and m", 386.089),
    ("the stiffnesses of the structure file are read as kN/m or N/mm, or its masses as g: give N/m and kg", 1e3),
    ("the stiffnesses of the structure file are read as MN/m or kN/mm: give N/m", 1e6),
    ("the stiffnesses of the structure file are read as lbf/in: give N/m", 175.126_8),
    ("the masses of the structure file are read as t: give kg", 1e-3),
];

/// Number of rows that are compared.
const ROWS: usize = 50;

/// A unit is suspected if the mean of ln f of some mode is off by more than the first as it is given, and that of no mode by more than the
/// second in the other unit.
const OFF: f64 = 0.5;
const FITS: f64 = 0.1;

/// The unit in which the frequencies fit, as a clause, where they are far off in the units that should be given; `None` if they are not, or
/// fit in no unit.
pub(super) fn suspected(study: &Study<'_>, rows: &[usize], known: &[FittedEffect]) -> Option<String> {
    let part = part_of(rows, ROWS);
    if off(study, &part, known)? <= OFF {
        return None;
    }
    let fits = |in_hz: &dyn Fn(f64) -> f64| {
        let mut data = study.data.clone();
        for value in data.log_frequencies.iter_mut().flatten() {
            *value = in_hz(value.exp()).ln();
        }
        off(&Study::new(study.simulator, &data), &part, known).is_some_and(|off| off < FITS)
    };
    if let Some(unit) = MISTAKEN_UNITS.iter().find(|unit| fits(&unit.in_hz)) {
        return Some(format!("they are read as {} instead of Hz: give Hz", unit.name));
    }
    study.simulator.structure()?;
    OF_FILES.iter().find(|(_, factor)| fits(&|hz| hz / factor.sqrt())).map(|(clause, _)| (*clause).to_owned())
}

/// Largest mean residual of ln f over the modes, in size, of the fit with the `known` effects; `None` without a fit or any frequency.
fn off(study: &Study<'_>, rows: &[usize], known: &[FittedEffect]) -> Option<f64> {
    let views = study.view(rows, &study.fit(rows, known, None)?)?;
    let mean = |mode: usize| {
        let residual =
            |view: &RowView| view.present.iter().position(|output| *output == mode).map(|place| view.residual[place]);
        let all: Vec<f64> = views.iter().filter_map(residual).collect();
        (!all.is_empty()).then(|| stats::mean(&all).abs())
    };
    (0..study.simulator.modes()).filter_map(mean).reduce(f64::max)
}
