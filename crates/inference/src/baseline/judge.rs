//! The rule that makes an outcome of the measured calibration, and its sentences.
//!
//! n simulations in each of C cells, P parameters. A share p̂ that should be p has the binomial error e(p) = √(p(1 − p)/n). Each of
//! four kinds of test has a family-wise level of 1 % over all cells and parameters (Bonferroni):
//!
//! ```text
//!  coverage   |p̂ − p| > z e(p) for p = 0.5 or 0.9,          z = Φ⁻¹(1 − 0.01/(2·2·C·P))
//!  tails      p̂ > 0.05 + z e(0.05), on either side of the 90 % interval
//!  ranks      χ² test of uniform ranks: p-value < 0.01/(C·P)
//!  TARP       χ² test of uniform TARP ranks: p-value < 0.01/C
//! ```
//!
//! *Too narrow*: a share too low, a tail too heavy; ranks that are not uniform, unless they are too wide; TARP ranks that are not
//! uniform and lie far from the middle.
//! *Too wide*: a share too high; ranks that are not uniform where no share and no tail is on the narrow side by more than 2 e(p);
//! TARP ranks that are not uniform and lie near the middle.
//!
//! A cell with any of these is measured again on other simulations, and that result counts. The outcome is `overconfident` if
//! something is too narrow, otherwise `cautious` if something is too wide, otherwise `passed`.

use super::manifest::{Cell, CellParameter};
use super::situations::cell_words;
use structures::stats::normal_quantile;

/// Significance level of each kind of test over all cells and parameters together.
const LEVEL: f64 = 0.01;

/// Binomial errors by which a share may be on the narrow side where ranks that are not uniform count as too wide.
const DOUBT: f64 = 2.0;

/// What is wrong in one cell, in words.
#[derive(Debug, Default)]
pub(super) struct Judgement {
    /// Where the posterior is too narrow.
    pub(super) narrow: Vec<String>,
    /// Where it is too wide.
    pub(super) wide: Vec<String>,
}

impl Judgement {
    pub(super) fn is_clean(&self) -> bool {
        self.narrow.is_empty() && self.wide.is_empty()
    }
}

/// Judges one of `cells`, each of which was measured on `simulations`.
pub(super) fn judge(cells: &[Cell], index: usize, simulations: usize) -> Judgement {
    let cell = &cells[index];
    let tests = cells.iter().map(|cell| cell.parameters.len()).sum::<usize>().max(1) as f64;
    let rule = Rule { tests, simulations: simulations as f64 };
    let words = cell_words(cell);
    let mut judgement = Judgement::default();
    for p in &cell.parameters {
        rule.parameter(p, &words, &mut judgement);
    }
    let p_value = cell.tarp_p_value;
    // This form of the condition also fails on NaN.
    let uniform = p_value * cells.len() as f64 >= LEVEL;
    if !uniform {
        let (list, how) = if cell.tarp_spread.is_some_and(|spread| spread < 1.0) && judgement.narrow.is_empty() {
            (&mut judgement.wide, "wide: regions that should hold a given share of the true values hold more")
        } else {
            (
                &mut judgement.narrow,
                "narrow or misplaced: regions that should hold a given share of the true values do not",
            )
        };
        list.push(format!(
            "The uncertainty of all parameters together is too {how} when {words} ({})",
            chance(p_value)
        ));
    }
    judgement
}

struct Rule {
    /// Cells × parameters.
    tests: f64,
    simulations: f64,
}

impl Rule {
    /// Binomial standard error of a share `p`.
    fn error(&self, p: f64) -> f64 {
        (p * (1.0 - p) / self.simulations).sqrt()
    }

    fn parameter(&self, p: &CellParameter, words: &str, judgement: &mut Judgement) {
        let z = -normal_quantile(0.5 * LEVEL / (2.0 * self.tests));
        let before = judgement.narrow.len() + judgement.wide.len();
        let name = &p.name;
        for (nominal, found) in [(0.9, p.coverage_90), (0.5, p.coverage_50)] {
            let deviation = (found - nominal) / self.error(nominal);
            // These forms of the conditions make NaN too narrow.
            let (enough, few) = (deviation >= -z, deviation <= z);
            let (list, how) = match (enough, few) {
                (true, true) => continue,
                (true, false) => (&mut judgement.wide, "wide"),
                (false, _) => (&mut judgement.narrow, "narrow"),
            };
            list.push(format!(
                "The intervals of {name} are too {how} when {words}: {:.0} % of the true values lie inside the {:.0} % intervals",
                100.0 * found,
                100.0 * nominal
            ));
        }
        let tails = p.outside_90.unwrap_or([0.05; 2]);
        for (share, [too, side]) in tails.into_iter().zip([["high", "below"], ["low", "above"]]) {
            if share > 0.05 + z * self.error(0.05) {
                judgement.narrow.push(format!(
                    "The intervals of {name} lie too {too} when {words}: {:.1} % of the true values lie {side} the 90 % intervals, and 5 % \
                     should",
                    100.0 * share
                ));
            }
        }
        let uniform = p.rank_p_value * self.tests >= LEVEL;
        if uniform || judgement.narrow.len() + judgement.wide.len() > before {
            return;
        }
        let doubtful = p.coverage_90 < 0.9 - DOUBT * self.error(0.9)
            || p.coverage_50 < 0.5 - DOUBT * self.error(0.5)
            || tails.iter().any(|share| *share > 0.05 + DOUBT * self.error(0.05))
            || p.rank_p_value.is_nan();
        let (list, how) = if doubtful {
            (&mut judgement.narrow, "misplaced: the true values do not lie among the samples as they should")
        } else {
            (&mut judgement.wide, "slightly too wide: the true values lie too often in the middle of the samples")
        };
        list.push(format!("The samples of {name} are {how} when {words} ({})", chance(p.rank_p_value)));
    }
}

/// A p-value in words.
fn chance(p_value: f64) -> String {
    if p_value > 0.0 {
        format!("by chance alone this would be found once in {:.0} trials", 1.0 / p_value)
    } else {
        "chance alone does not explain this".to_owned()
    }
}
