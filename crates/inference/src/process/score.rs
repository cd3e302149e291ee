//! How well a change since an onset explains the innovations after it.
//!
//! A change δ of the parameters that lasts from batch τ on adds G_s,τ δ to the innovation of each later batch s, where G follows from
//! the filter, which takes part of the change for weather. For each onset, the innovations since then give a score and its variance:
//!
//! ```text
//!  ν_s ~ N(G_s δ, S_s),    G_s = 1 − H M_s,    M_τ = 0,    M_s+1 = F (M_s + K_s G_s)
//!  b = Σ_s G_sᵀ S_s⁻¹ ν_s,    I = Σ_s G_sᵀ S_s⁻¹ G_s
//!  one parameter: z_k = ∓b_k/√I_kk,        several: z² = max over losses δ of 2 bᵀδ − δᵀIδ,        misfit: z² = b_vᵀ I_vv⁻¹ b_v
//! ```
//!
//! Source: A. S. Willsky, H. L. Jones (1976), IEEE Trans. Automatic Control 21, 108–112.

use nalgebra::{DMatrix, DVector};

use super::direction::ChangeDirection;
use super::filter::Innovation;

/// Sweeps of the search for the most likely losses, and the relative change at which it ends.
const SWEEPS: usize = 100;
const SETTLED: f64 = 1e-6;

/// Courses of a change in time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Courses {
    /// A step at the onset.
    Step,
    /// A step at the onset, and a growth in proportion to the time since then; with its end, in steps of the process after the first changed
    /// innovation, if it has ended.
    StepAndGrowth(Option<f64>),
}

/// Score b and information I of a change since an onset. With c courses, a change has c·d coefficients: the d steps, then the d growths in a
/// step of the process.
#[derive(Debug, Clone, PartialEq)]
pub struct Score {
    /// b, `[c·d]`.
    pub score: DVector<f64>,
    /// I, `[c·d, c·d]`.
    pub information: DMatrix<f64>,
    /// M: what the states have taken of the change, `[q + d, c·d]`.
    pub taken: DMatrix<f64>,
    /// H M at the newest innovation: the part of the change that its prediction contains, `[d, c·d]`.
    pub predicted: DMatrix<f64>,
    /// Time from the first changed innovation to the newest, in steps of the process; `None` before the first.
    pub elapsed: Option<f64>,
    /// Time from the first changed innovation to the end of the growth, in steps; `None` while it goes on.
    pub growth_ends: Option<f64>,
}

impl Score {
    /// Before the first changed innovation, with `states` = q + d states and `quantities` = d.
    pub fn new(states: usize, quantities: usize, courses: Courses) -> Self {
        let (of_each, growth_ends) = match courses {
            Courses::Step => (1, None),
            Courses::StepAndGrowth(end) => (2, end),
        };
        let columns = quantities * of_each;
        Self {
            score: DVector::zeros(columns),
            information: DMatrix::zeros(columns, columns),
            taken: DMatrix::zeros(states, columns),
            predicted: DMatrix::zeros(quantities, columns),
            elapsed: None,
            growth_ends,
        }
    }

    /// Time for which the change has grown, in steps; `None` before the first innovation.
    pub fn grown(&self) -> Option<f64> {
        self.elapsed.map(|elapsed| self.growth_ends.map_or(elapsed, |end| end.min(elapsed)))
    }

    /// Adds the next innovation. `contributions`: H, `[d, q + d]`.
    pub fn add(&mut self, innovation: &Innovation, contributions: &DMatrix<f64>) {
        for (mut row, decay) in self.taken.row_iter_mut().zip(innovation.decay.iter()) {
            row *= *decay;
        }
        let elapsed = self.elapsed.map_or(0.0, |elapsed| elapsed + innovation.steps);
        self.elapsed = Some(elapsed);
        let grown = self.grown().unwrap_or(0.0);
        let d = contributions.nrows();
        self.predicted = contributions * &self.taken;
        let of_course = |k: usize, column: usize| match (column % d == k, column < d) {
            (false, _) => 0.0,
            (true, true) => 1.0,
            (true, false) => grown,
        };
        let left = DMatrix::from_fn(d, self.score.len(), of_course) - &self.predicted;
        let signature = left.select_rows(&innovation.informed);
        let weighted = signature.transpose() * &innovation.precision;
        self.score += &weighted * &innovation.difference;
        self.information += &weighted * &signature;
        self.taken += &innovation.gain * &signature;
    }

    /// Score and information of the step alone, `[d]` and `[d, d]`.
    pub fn of_step(&self) -> (DVector<f64>, DMatrix<f64>) {
        let d = self.predicted.nrows();
        (self.score.rows(0, d).into_owned(), self.information.view((0, 0), (d, d)).into_owned())
    }

    /// Evidence for a loss in each quantity alone and in several together, and for a change of the misfit.
    pub fn evidence(&self, directions: &[ChangeDirection]) -> (Vec<f64>, [f64; 2]) {
        let (score, information) = self.of_step();
        let d = directions.len();
        let r = directions.iter().filter(|own| **own == ChangeDirection::Either).count();
        let inverse = information.view((d - r, d - r), (r, r)).into_owned().cholesky().map(|own| own.inverse());
        let misfit = inverse.map_or(0.0, |inverse| of_misfit(score.as_slice(), &inverse));
        let (score, information) = (score.as_slice(), information.as_slice());
        let alone = directions.iter().enumerate().map(|(k, own)| of_one(score, information, k, own.sign())).collect();
        (alone, [of_several(score, information, directions, &mut vec![0.0; d]), misfit])
    }
}

/// The score of a change with the first of some successive innovations. `contributions`: H, `[d, q + d]`.
pub fn score(innovations: &[Innovation], contributions: &DMatrix<f64>, courses: Courses) -> Score {
    let (d, n) = contributions.shape();
    let mut found = Score::new(n, d, courses);
    for innovation in innovations {
        found.add(innovation, contributions);
    }
    found
}

/// z of a loss of quantity k alone; 0 if nothing informs it. `score`: b, `[d]`; `information`: I, `[d, d]`.
pub(super) fn of_one(score: &[f64], information: &[f64], k: usize, sign: f64) -> f64 {
    let own = information[k * score.len() + k];
    if own > 0.0 {
        sign * score[k] / own.sqrt()
    } else {
        0.0
    }
}

/// z of a change of the misfit, whose coordinates are the last quantities. `inverse`: of their information, `[r, r]`.
pub(super) fn of_misfit(score: &[f64], inverse: &DMatrix<f64>) -> f64 {
    let own = &score[score.len() - inverse.nrows()..];
    let square: f64 = inverse
        .column_iter()
        .zip(own)
        .map(|(column, b)| b * column.iter().zip(own).map(|(i, b)| i * b).sum::<f64>())
        .sum();
    square.max(0.0).sqrt()
}

/// z of losses of any quantities together. The most likely losses, in the direction of damage and not negative, and the most likely changes
/// of the misfit are written to `losses`, `[d]`. The misfit has no part in z.
///
/// The maximum over losses is found by coordinates: each in turn takes its best value, given the others.
pub(super) fn of_several(
    score: &[f64],
    information: &[f64],
    directions: &[ChangeDirection],
    losses: &mut [f64],
) -> f64 {
    let d = directions.len();
    losses.fill(0.0);
    for _ in 0..SWEEPS {
        let (mut moved, mut largest) = (0.0_f64, 0.0_f64);
        for k in 0..d {
            let own = information[k * d + k];
            let sign = directions[k].sign();
            if sign == 0.0 || own <= 0.0 {
                continue;
            }
            let row = &information[k * d..(k + 1) * d];
            let all: f64 = row.iter().zip(directions).zip(&*losses).map(|((i, own), loss)| i * own.sign() * loss).sum();
            let others = sign * all - own * losses[k];
            let unbounded = (sign * score[k] - others) / own;
            let best = if directions[k] == ChangeDirection::Either { unbounded } else { unbounded.max(0.0) };
            moved = moved.max((best - losses[k]).abs() * own.sqrt());
            largest = largest.max(best.abs() * own.sqrt());
            losses[k] = best;
        }
        if moved <= SETTLED * largest {
            break;
        }
    }
    // At the maximum, the gain 2 bᵀδ − δᵀIδ is bᵀδ.
    let damages = score.iter().zip(directions).zip(&*losses).filter(|((_, own), _)| own.is_damage());
    let gain: f64 = damages.map(|((b, own), loss)| b * own.sign() * loss).sum();
    gain.max(0.0).sqrt()
}
