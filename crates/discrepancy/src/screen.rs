//! Score tests: an estimate of the gain in log-likelihood of each candidate, from derivatives at size 0 and without fitting it.
//!
//! e: residual of the present fit; D: derivative of the mean by the numbers ψ of a candidate, at size 0; N: derivative by the
//! numbers that are fitted already; w: weight of a row; V: covariance of its residual; ⟨a, b⟩ = Σ_j w_j aᵀ V_j⁻¹ b:
//!
//! ```text
//!  S = ⟨D, e⟩,   I = ⟨D, D⟩ − ⟨D, N⟩⟨N, N⟩⁻¹⟨N, D⟩,    estimated gain = ½ Sᵀ I⁻¹ S  nats,    first guess ψ = I⁻¹ S
//! ```
//!
//! Source: Rao (1948), Proc. Cambridge Phil. Soc. 44.

use nalgebra::{DMatrix, DVector, Dyn};
use rayon::prelude::*;

use super::data::{Data, Values};
use super::fit::Fit;
use super::grammar::{spread, Candidate};
use super::model::RowView;
use super::study::Study;
use structures::physics::effect::Target;
use structures::simulator::law::{lagged, Input, Law, LawKind};
use structures::stats;

/// Share of the information about a number that must remain after projecting out the numbers that are fitted already.
const IDENTIFIABLE: f64 = 1e-5;

/// Added to the unit diagonal of ⟨N, N⟩, which directions without information would make singular.
const RIDGE: f64 = 1e-10;

/// The result of the score test of one candidate under one law.
#[derive(Debug, Clone)]
pub struct Promise {
    /// Index of the candidate.
    pub candidate: usize,
    /// The law.
    pub law: LawKind,
    /// Whether the law has a level.
    pub with_level: bool,
    /// Estimated gain in log-likelihood, nats.
    pub nats: f64,
    /// Number of linear numbers that are identifiable.
    pub numbers: usize,
    /// First guess of all numbers of the law, in its order.
    pub psi: Vec<f64>,
    /// Time of a step, days.
    pub step_days: f64,
}

impl Promise {
    /// The estimated gain less half of ln n for each number of the law, nats; n: number of rows.
    ///
    /// Source: Schwarz (1978), Annals of Statistics 6.
    pub fn less_its_numbers(&self, rows: usize) -> f64 {
        self.nats - 0.5 * self.psi.len() as f64 * (rows as f64).ln()
    }
}

/// Residuals and derivatives of a fit, whitened row by row with V = L Lᵀ.
pub struct Whitened {
    /// √w L⁻¹ e of each row, `[present]`.
    pub residual: Vec<DVector<f64>>,
    /// √w L⁻¹ N of each row, `[present, N]`.
    pub nuisance: Vec<DMatrix<f64>>,
    /// Inverse of ⟨N, N⟩ plus the prior information, `[N, N]`.
    inverse: DMatrix<f64>,
    /// L⁻¹, the outputs present and √w of each row.
    factors: Vec<(DMatrix<f64>, Vec<usize>, f64)>,
}

/// Products of one direction T in the space of outputs with residual and derivatives, for each row: w TᵀV⁻¹e, `[rows]`;
/// w TᵀV⁻¹T, `[rows]`; w TᵀV⁻¹N, `[rows, N]`.
pub struct Sums {
    along: DVector<f64>,
    square: DVector<f64>,
    /// `[rows, N]`
    nuisance: DMatrix<f64>,
}

/// The same products for the unit direction of each of the first outputs.
pub struct OutputSums {
    /// `[rows, outputs]`
    along: DMatrix<f64>,
    /// `[rows, outputs·outputs]`
    square: DMatrix<f64>,
    /// `[rows, N·outputs]`
    nuisance: DMatrix<f64>,
}

/// The result of a score test.
pub struct Score {
    /// Estimated gain in log-likelihood, nats; twice the gain has a χ² distribution with [`Self::numbers`] degrees of freedom
    /// by chance.
    pub nats: f64,
    /// First guess of the numbers; 0 in directions that are not identifiable.
    pub psi: Vec<f64>,
    /// Number of identifiable directions.
    pub numbers: usize,
}

impl Whitened {
    /// Whitens the rows of a fit; `None` if a covariance is singular or the frequencies cannot be computed in some row.
    pub fn new(study: &Study<'_>, rows: &[usize], fit: &Fit, views: &[RowView]) -> Option<Self> {
        let slopes = study.nuisance(rows, fit)?;
        let mut factors = Vec::with_capacity(rows.len());
        let (mut residual, mut nuisance) = (Vec::new(), Vec::new());
        for (view, slopes) in views.iter().zip(&slopes) {
            let inverse = view.covariance.clone().cholesky()?.l().try_inverse()?;
            let root = view.weight.sqrt();
            residual.push(&inverse * &view.residual * root);
            let present = slopes.select_rows(&view.present);
            nuisance.push(&inverse * present * root);
            factors.push((inverse, view.present.clone(), root));
        }
        let size = nuisance.first().map_or(0, DMatrix::ncols);
        let mut square = DMatrix::zeros(size, size);
        for n in &nuisance {
            square += n.transpose() * n;
        }
        // With the prior information: an effect of the structure that is known exactly cannot compensate for a residual.
        let known = study.prior_information(fit);
        for i in 0..size {
            square[(i, i)] += known[i];
        }
        // Columns have different units and are scaled to a unit diagonal before the inversion.
        let scale: Vec<f64> =
            (0..size).map(|i| if square[(i, i)] > 0.0 { 1.0 / square[(i, i)].sqrt() } else { 1.0 }).collect();
        let shares = DMatrix::from_fn(size, size, |i, j| {
            square[(i, j)] * scale[i] * scale[j] + if i == j { RIDGE } else { 0.0 }
        });
        let inverse = if size == 0 { shares } else { shares.try_inverse()? };
        let inverse = DMatrix::from_fn(size, size, |i, j| inverse[(i, j)] * scale[i] * scale[j]);
        Some(Self { residual, nuisance, inverse, factors })
    }

    /// Products of the direction whose component is `direction(index of the row, output)`, in the unit of the output (ln f, or rad
    /// for a shape) per unit of the number.
    pub fn sums(&self, direction: impl Fn(usize, usize) -> f64) -> Sums {
        let rows = self.factors.len();
        let mut sums = Sums {
            along: DVector::zeros(rows),
            square: DVector::zeros(rows),
            nuisance: DMatrix::zeros(rows, self.inverse.nrows()),
        };
        let mut white = Vec::new();
        for (place, (inverse, present, root)) in self.factors.iter().enumerate() {
            white.clear();
            white.resize(present.len(), 0.0);
            for (column, mode) in inverse.column_iter().zip(present) {
                let value = direction(place, *mode) * root;
                for (white, factor) in white.iter_mut().zip(column.iter()) {
                    *white += factor * value;
                }
            }
            let along = |other: &[f64]| white.iter().zip(other).map(|(a, b)| a * b).sum::<f64>();
            sums.along[place] = along(self.residual[place].as_slice());
            sums.square[place] = along(&white);
            for (column, nuisance) in self.nuisance[place].column_iter().enumerate() {
                sums.nuisance[(place, column)] = along(nuisance.as_slice());
            }
        }
        sums
    }

    /// The score test of q numbers that act along one direction, each times a function of the row: `basis` is `[q][rows]`.
    pub fn score(&self, sums: &Sums, basis: &[&DVector<f64>]) -> Score {
        let q = basis.len();
        let mut score = DVector::zeros(q);
        let mut information = DMatrix::zeros(q, q);
        let mut cross = DMatrix::zeros(q, self.inverse.nrows());
        for a in 0..q {
            score[a] = basis[a].dot(&sums.along);
            cross.row_mut(a).tr_copy_from(&sums.nuisance.tr_mul(basis[a]));
            let weighed = basis[a].component_mul(&sums.square);
            for b in 0..=a {
                information[(a, b)] = basis[b].dot(&weighed);
                information[(b, a)] = information[(a, b)];
            }
        }
        self.solve(&score, &information, &cross)
    }

    /// Products of the unit direction of each of the first `outputs` outputs.
    pub fn output_sums(&self, outputs: usize) -> OutputSums {
        let (rows, columns) = (self.factors.len(), self.inverse.nrows());
        let mut sums = OutputSums {
            along: DMatrix::zeros(rows, outputs),
            square: DMatrix::zeros(rows, outputs * outputs),
            nuisance: DMatrix::zeros(rows, outputs * columns),
        };
        for (place, (inverse, present, root)) in self.factors.iter().enumerate() {
            let along = inverse.tr_mul(&self.residual[place]) * *root;
            let square = inverse.tr_mul(inverse) * (root * root);
            let with = inverse.tr_mul(&self.nuisance[place]) * *root;
            for (i, a) in present.iter().enumerate().take_while(|(_, a)| **a < outputs) {
                sums.along[(place, *a)] = along[i];
                for (j, b) in present.iter().enumerate().take_while(|(_, b)| **b < outputs) {
                    sums.square[(place, b * outputs + a)] = square[(i, j)];
                }
                for column in 0..columns {
                    sums.nuisance[(place, column * outputs + a)] = with[(i, column)];
                }
            }
        }
        sums
    }

    /// The score test of an arbitrary response of each output to one function of the row, `[rows]`.
    pub fn free_score(&self, sums: &OutputSums, function: &DVector<f64>) -> Score {
        let outputs = sums.along.ncols();
        let score = sums.along.tr_mul(function);
        let information =
            sums.square.tr_mul(&function.component_mul(function)).reshape_generic(Dyn(outputs), Dyn(outputs));
        let columns = self.inverse.nrows();
        let cross = sums.nuisance.tr_mul(function).reshape_generic(Dyn(outputs), Dyn(columns));
        self.solve(&score, &information, &cross)
    }

    /// The test with score S `[q]`, information ⟨D, D⟩ `[q, q]` and ⟨D, N⟩ `[q, N]`.
    fn solve(&self, score: &DVector<f64>, information: &DMatrix<f64>, cross: &DMatrix<f64>) -> Score {
        let q = score.len();
        let left = information - cross * &self.inverse * cross.transpose();
        // Scaled by ⟨D, D⟩, so that the eigenvalues are shares of the information that remain.
        let scale: Vec<f64> = (0..q).map(|a| information[(a, a)].max(f64::MIN_POSITIVE).sqrt()).collect();
        let shares = DMatrix::from_fn(q, q, |a, b| left[(a, b)] / (scale[a] * scale[b]));
        let eigen = shares.symmetric_eigen();
        let (mut nats, mut numbers) = (0.0, 0);
        let mut psi = DVector::zeros(q);
        let scaled = DVector::from_fn(q, |a, _| score[a] / scale[a]);
        for (index, value) in eigen.eigenvalues.iter().enumerate() {
            if *value > IDENTIFIABLE {
                let vector = eigen.eigenvectors.column(index);
                let along = vector.dot(&scaled);
                nats += 0.5 * along * along / value;
                psi += vector * (along / value);
                numbers += 1;
            }
        }
        Score { nats, psi: psi.iter().zip(&scale).map(|(p, s)| p / s).collect(), numbers }
    }
}

/// The score tests of every candidate under each of its laws. Candidates that are not identifiable in addition to the numbers
/// of the fit are omitted, as are oscillators and orders of modes, which have no derivative at size 0, constant deviations in no single part, for
/// which that derivative is far from the effect of a usual size, and a deviation everywhere. `None` if the frequencies cannot be computed.
pub fn promises(
    study: &Study<'_>,
    rows: &[usize],
    whitened: &Whitened,
    fit: &Fit,
    candidates: &[Candidate],
) -> Option<Vec<Promise>> {
    let screened = |candidate: &Candidate| match candidate.target {
        Target::Oscillator(_) | Target::ModeOrder(_) | Target::Everywhere(_) => false,
        Target::Deviation(_) => candidate.covariate.is_some(),
        _ => !candidate.target.is_switch(),
    };
    let mut targets: Vec<&Target> = Vec::new();
    for candidate in candidates {
        if screened(candidate) && !targets.contains(&&candidate.target) {
            targets.push(&candidate.target);
        }
    }
    let owned: Vec<Target> = targets.iter().map(|t| (*t).clone()).collect();
    let directions = study.directions(rows, fit, &owned)?;
    // The functions of the rows are the same for every target.
    let mut inputs: Vec<(Option<&str>, Option<&str>)> = Vec::new();
    for candidate in candidates {
        let input = candidate.input();
        if !inputs.contains(&input) {
            inputs.push(input);
        }
    }
    let bases_of = |input: &(Option<&str>, Option<&str>)| {
        // A switched target follows fewer laws than the others.
        let candidate = candidates.iter().find(|c| c.input() == *input && !c.target.is_switch());
        candidate.map_or_else(Vec::new, |candidate| bases(candidate, study.data, rows))
    };
    let bases: Vec<Vec<Basis>> = inputs.par_iter().map(bases_of).collect();
    let ones = DVector::from_element(rows.len(), 1.0);
    let mut columns = Vec::with_capacity(targets.len());
    let mut next = 0;
    for target in &targets {
        columns.push(next);
        next += target.sizes();
    }
    let of_target = |(place, target): (usize, &&Target)| {
        let column = columns[place];
        if let Target::ModeGain { mode, .. } = target {
            let candidate = candidates.iter().position(|c| c.target == **target);
            let beyond = DVector::from_iterator(rows.len(), directions.iter().map(|d| d[(*mode, column)]));
            let basis =
                Basis { values: vec![beyond, ones.clone()], ..Basis::new(LawKind::Constant, Vec::new(), Vec::new()) };
            let sums = whitened.sums(|_, other| f64::from(u8::from(other == *mode)));
            return candidate.map_or_else(Vec::new, |index| best_of_each_law(whitened, &sums, index, &[basis], None));
        }
        let sums = whitened.sums(|place, mode| {
            let set = f64::from(u8::from(study.is_set(rows[place], target)));
            directions[place][(mode, column)] * set
        });
        let level_identifiable = whitened.score(&sums, &[&ones]).numbers == 1;
        let mut found = Vec::new();
        for (index, candidate) in candidates.iter().enumerate().filter(|(_, c)| c.target == **target && screened(c)) {
            let input = candidate.input();
            let place = inputs.iter().position(|i| *i == input).expect("the inputs of all candidates are listed");
            let level = level_identifiable.then_some(&ones);
            found.extend(best_of_each_law(whitened, &sums, index, &bases[place], level));
        }
        found
    };
    let found: Vec<Vec<Promise>> = targets.par_iter().enumerate().map(of_target).collect();
    Some(found.into_iter().flatten().collect())
}

/// The best test of each law of one candidate; `level`: ones, if a constant along the direction is identifiable.
fn best_of_each_law(
    whitened: &Whitened,
    sums: &Sums,
    candidate: usize,
    bases: &[Basis],
    level: Option<&DVector<f64>>,
) -> Vec<Promise> {
    let mut best: Vec<Promise> = Vec::new();
    for Basis { law, values, further, step_days } in bases {
        let level = level.filter(|_| law.has_level());
        let with_level = level.is_some();
        let basis: Vec<&DVector<f64>> = level.into_iter().chain(values).collect();
        let score = whitened.score(sums, &basis);
        // A law of which only the level is identifiable adds nothing to a constant effect.
        if score.numbers == 0 || (score.numbers == 1 && with_level) {
            continue;
        }
        let psi = score.psi.iter().chain(further).copied().collect();
        let promise = Promise {
            candidate,
            law: *law,
            with_level,
            nats: score.nats,
            numbers: score.numbers,
            psi,
            step_days: *step_days,
        };
        match best.iter_mut().find(|p| p.law == *law) {
            Some(known) if known.nats >= promise.nats => {}
            Some(known) => *known = promise,
            None => best.push(promise),
        }
    }
    best
}

/// Functions of the row that a law consists of for small sizes, at fixed values of its nonlinear numbers.
struct Basis {
    law: LawKind,
    /// Values at each row, `[q][rows]`.
    values: Vec<DVector<f64>>,
    /// The nonlinear numbers of the law.
    further: Vec<f64>,
    /// Time of a step, days.
    step_days: f64,
}

impl Basis {
    fn new(law: LawKind, values: Vec<Vec<f64>>, further: Vec<f64>) -> Self {
        Self { law, values: values.into_iter().map(DVector::from_vec).collect(), further, step_days: 0.0 }
    }
}

/// The bases of all laws of a candidate, at several values of their nonlinear numbers.
fn bases(candidate: &Candidate, data: &Data, rows: &[usize]) -> Vec<Basis> {
    let Some(column) = candidate.covariate.as_deref().and_then(|name| data.column(name)) else {
        return vec![Basis::new(LawKind::Constant, vec![vec![1.0; rows.len()]], Vec::new())];
    };
    let values = match &column.values {
        Values::Categories(..) => {
            let effect_levels = candidate.levels(data, rows);
            let Values::Categories(names, indices) = &column.values else { unreachable!("matched above") };
            let of = |level: &String| {
                let is = |row: &usize| f64::from(u8::from(indices[*row].is_some_and(|i| names[i] == *level)));
                rows.iter().map(is).collect::<Vec<f64>>()
            };
            return vec![Basis::new(LawKind::Category, effect_levels.iter().map(of).collect(), Vec::new())];
        }
        Values::Numbers(values) => values,
    };
    let numbers = column.numbers(rows);
    let (mean, std) = (stats::mean(&numbers), spread(column, rows));
    let at = |function: &dyn Fn(f64) -> f64| -> Vec<f64> {
        rows.iter().map(|row| if values[*row].is_finite() { function(values[*row]) } else { 0.0 }).collect()
    };
    let mut all = Vec::new();
    for law in candidate.laws(data) {
        match law {
            LawKind::Linear => all.push(Basis::new(law, vec![at(&|c| c - mean)], Vec::new())),
            LawKind::Quadratic => {
                all.push(Basis::new(law, vec![at(&|c| c - mean), at(&|c| (c - mean).powi(2))], Vec::new()));
            }
            LawKind::Bilinear => {
                for level in [0.1, 0.2, 0.35, 0.5, 0.7] {
                    let knee = stats::quantile(&numbers, level);
                    let basis = vec![at(&|c| (c - knee).min(0.0)), at(&|c| (c - knee).max(0.0))];
                    all.push(Basis::new(law, basis, vec![knee]));
                }
            }
            LawKind::Exponential => {
                for rate in [-1.0 / std, -0.4 / std, 0.4 / std, 1.0 / std] {
                    let basis = vec![at(&|c| (rate * (c - mean)).exp_m1() / rate)];
                    all.push(Basis::new(law, basis, vec![rate]));
                }
            }
            LawKind::Step => {
                for share in 1..20 {
                    let days = stats::quantile(&numbers, f64::from(share) / 20.0);
                    let after = at(&|c| f64::from(u8::from(c >= days)));
                    all.push(Basis { step_days: days, ..Basis::new(law, vec![after], Vec::new()) });
                }
            }
            LawKind::Lagged => {
                let span = data.times_days.last().copied().unwrap_or(0.0).max(1e-6);
                for divisor in [400.0, 150.0, 60.0, 30.0, 15.0, 7.0] {
                    let lag = span / divisor;
                    let followed = lagged(&data.times_days, values, lag);
                    let basis = vec![rows.iter().map(|row| followed[*row].0 - mean).collect()];
                    all.push(Basis::new(law, basis, vec![lag]));
                }
            }
            LawKind::Product => {
                let pairs = data.inputs(&Law::of_product(&column.name), None);
                let values = |part: fn(f64, f64) -> f64| -> Vec<f64> {
                    let of = |row: &usize| if let Input::Pair(u, v) = pairs[*row] { part(u, v) } else { 0.0 };
                    rows.iter().map(of).collect()
                };
                all.push(Basis::new(law, vec![values(|u, _| u), values(|_, v| v), values(|u, v| u * v)], Vec::new()));
            }
            LawKind::Cycle => {
                let cycle = column.origin.cycle();
                let waves = cycle.map(|cycle| cycle.waves(rows.iter().map(|row| values[*row])).to_vec());
                all.push(Basis::new(law, waves.unwrap_or_default(), Vec::new()));
            }
            LawKind::Constant | LawKind::Category => {}
        }
    }
    all
}
