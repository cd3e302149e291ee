//! Which rows are searched and on which the gain is measured, after a lasting change was found.

use super::found::LastingChange;
use crate::data::Data;

/// Smallest number of rows that must remain for the search if others are held out; with fewer, none are held out, and the gain is
/// measured by cross-validation.
pub const FEWEST_BESIDE_HOLDOUT: usize = 30;

/// Smallest number of rows held out before a change on which the gain is measured: two batches of ten.
const FEWEST_HELD: usize = 20;

/// Number of successive blocks from which those held out are chosen.
const BLOCKS: usize = 20;

/// Least and greatest number of blocks held out.
const HELD_BLOCKS: (usize, usize) = (3, 10);

/// Share of the rows that is held out where the request does not state one.
const SHARE: f64 = 0.25;

/// How the rows were chosen on which the gain is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Held {
    /// As the request says.
    AsAsked,
    /// Those of the request that lie before the change.
    BeforeTheChange,
    /// This many blocks in time from before the change.
    Blocks(usize),
    /// All rows before the change by cross-validation.
    LeftOut,
    /// None: too few rows lie before the change.
    Nothing,
}

/// The use of the rows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Split {
    /// Rows that are searched for causes.
    pub training: Vec<usize>,
    /// Rows on which the gain is measured.
    pub holdout: Vec<usize>,
    /// Rows that are used for neither.
    pub set_aside: Vec<usize>,
    /// How `holdout` was chosen.
    pub held: Held,
}

impl Split {
    /// The rows as the request says.
    pub fn as_asked(training: Vec<usize>, holdout: Vec<usize>) -> Self {
        Self { training, holdout, set_aside: Vec::new(), held: Held::AsAsked }
    }

    /// The rows that may be used although a change was found: those before it. `explained`: whether a change in time is among the
    /// causes found, so that the rows searched may contain it.
    pub fn before(&self, change: &LastingChange, explained: bool, data: &Data) -> Self {
        let first = change.first_possible_row;
        let is_before = |row: &usize| *row < first && !data.further[*row];
        let within = self.training.iter().any(|row| !is_before(row) && !data.further[*row]);
        if within && explained {
            return self.clone();
        }
        let before: Vec<usize> = (0..data.rows()).filter(is_before).collect();
        if before.len() < FEWEST_BESIDE_HOLDOUT {
            let set_aside = self.holdout.iter().copied().filter(|row| !is_before(row)).collect();
            return Self { training: self.training.clone(), holdout: Vec::new(), set_aside, held: Held::Nothing };
        }
        let kept = |rows: &[usize]| rows.iter().copied().filter(is_before).collect::<Vec<usize>>();
        let (mut training, mut holdout) = (kept(&self.training), kept(&self.holdout));
        let held = if self.holdout.is_empty() {
            Held::LeftOut
        } else if holdout.len() >= FEWEST_HELD && training.len() >= FEWEST_BESIDE_HOLDOUT {
            Held::BeforeTheChange
        } else {
            let asked = self.holdout.len() as f64 / (self.holdout.len() + self.training.len()) as f64;
            let share = if asked < 0.5 { asked } else { SHARE };
            let (searched, held, blocks) = in_blocks(&before, share);
            (training, holdout) = (searched, held);
            if training.len() >= FEWEST_BESIDE_HOLDOUT && holdout.len() >= FEWEST_HELD {
                Held::Blocks(blocks)
            } else {
                (training, holdout) = (before.clone(), Vec::new());
                Held::LeftOut
            }
        };
        // What was measured to decide between causes is searched unless it was measured after the change.
        training.extend((0..first).filter(|row| data.further[*row]));
        training.sort_unstable();
        let used = |row: &usize| training.binary_search(row).is_ok() || holdout.binary_search(row).is_ok();
        let set_aside = (0..data.rows()).filter(|row| !used(row)).collect();
        Self { training, holdout, set_aside, held }
    }

    /// What is done with the rows since a change, as a sentence.
    pub fn in_words(&self, change: &LastingChange, explained: bool) -> String {
        let since = change.rows_since;
        let not_used = format!(
            "The {} measurements since then, or possibly since then, are used neither to find causes nor to measure the gain",
            self.set_aside.len()
        );
        let text = match self.held {
            Held::AsAsked if explained => format!(
                "A change in time is among the causes below, which were searched in these measurements too; {since} of them lie after \
                 the change"
            ),
            Held::AsAsked => format!("{since} measurements lie after it"),
            Held::BeforeTheChange => {
                format!("{not_used}, which is measured on the {} held out before them", self.holdout.len())
            }
            Held::Blocks(blocks) => format!(
                "{not_used}, which is measured on {} measurements from before, in {blocks} blocks in time that were held out instead",
                self.holdout.len()
            ),
            Held::LeftOut => {
                format!("{not_used}, which is measured by cross-validation over the {} from before", self.training.len())
            }
            Held::Nothing => format!(
                "Only {} measurements lie before it, too few to search them alone: the causes below may be a part of this change, \
                 and their gain is not measured",
                change.rows_before
            ),
        };
        text + "."
    }
}

/// Rows that stay, rows held out, and the number of blocks of the latter, which lie evenly in time.
fn in_blocks(rows: &[usize], share: f64) -> (Vec<usize>, Vec<usize>, usize) {
    let count = ((share * BLOCKS as f64).round() as usize).clamp(HELD_BLOCKS.0, HELD_BLOCKS.1);
    let chosen: Vec<usize> = (0..count).map(|i| (2 * i + 1) * BLOCKS / (2 * count)).collect();
    let held = |place: usize| chosen.contains(&(place * BLOCKS / rows.len()));
    let (mut kept, mut out) = (Vec::new(), Vec::new());
    for (place, row) in rows.iter().enumerate() {
        if held(place) { &mut out } else { &mut kept }.push(*row);
    }
    (kept, out, count)
}
