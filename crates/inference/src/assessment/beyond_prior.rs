//! Batches of a structure that has left its prior: a part has lost more than the prior allows.
//!
//! The prior is drawn for the healthy structure, and the flow is trained inside it. Where no point of the prior reproduces a batch, or only
//! one at its bounds or one at which several parameters have changed, the parameters are sought beyond: downwards to a fiftieth of their
//! healthy values, upwards to five times, each in the direction that counts as damage. One or two parameters are free and the others are as in the reference, because most parts of a
//! structure that is damaged are not:
//!
//! ```text
//!  score(A) = min_m  Σ_n r_nᵀ (J S Jᵀ + R)_n⁻¹ r_n + Σ_{k ∉ A} (m_k − θ_k)²/σ_k² + 12 Σ_{k ∈ A} (m_k − θ_k)²/w_k² + 8 |A|
//! ```
//!
//! θ_k, σ_k: mean and standard deviation of the parameter at all times of the reference; w_k: width of the widened prior; 8: twice the
//! logarithm of the odds against the change of a part, 50 to 1. The set of the least score is taken unless the best point within the prior
//! is better, with the parameters that differ there from the reference counted in the same way. The population about that point follows from
//! the linearised simulation, see [`LinearBatch`].

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;
use statrs::distribution::{ChiSquared, ContinuousCDF as _};

use super::batch_mean::{is_computed, BatchMean, Healthy, Problem};
use super::narrow::linearised;
use super::population::MOST_DEGREES;
use super::wrong_values::Compared;
use crate::baseline::observation::Observation;
use crate::baseline::Baseline;
use crate::hierarchy::{LinearBatch, LinearMeasurements, Populations, Spread};
use crate::posterior::PosteriorSamples;
use crate::trust::{fit, Finding, FindingCode, FindingEffect};
use structures::parameter::{DamageDirection, Parameter, ParameterSpace, PriorForm};
use structures::quantity::with_prefix;
use structures::simulator::Simulator;
use structures::stats;

/// Least and largest value of a parameter beyond the prior, as a share of its healthy value.
const LEAST: f64 = 0.02;
const LARGEST: f64 = 5.0;

/// Shares of the healthy value at which searches start.
const FALLEN: [f64; 4] = [0.7, 0.4, 0.15, 0.05];
const RISEN: [f64; 2] = [1.5, 3.0];

/// Twice the logarithm of the odds against the change of a part.
const COST: f64 = 8.0;

/// Number of changed parameters from which a point within the prior is compared with fewer ones beyond it.
const SEVERAL: usize = 2;

/// Error of a frequency of the simulation far from the healthy structure, as a share of its change.
const ERROR_OF_CHANGE: f64 = 0.02;

/// Parameters of the sets of two: those that explain the batch best alone.
const IN_PAIRS: usize = 6;

/// Most measurements that a search compares.
const SEARCHED: usize = 8;

/// Standard deviation of the prior of the other parameters, as a multiple of that at all times of the reference, once it is known which have
/// changed. Far from the prior, the frequencies may hardly tell two parameters apart, and follow them along a curve.
const OTHERS: f64 = 2.0;

/// Precision of the prior of a free parameter in the box: that of a uniform distribution over it.
const FREE: f64 = 12.0;

/// A parameter lies beyond its prior if so many standard deviations of single measurements about their mean do.
const DEVIATIONS: f64 = 2.0;

/// A point within the prior is the better one only if its score is less by this, because both are found by searches.
const SAME: f64 = 0.5;

/// Probability with which measurements that the simulation explains have a smaller misfit, and how much larger it may be because a
/// simulation is not exact and a damaged structure may scatter more than a healthy one.
const FITS: f64 = 0.999;
const LARGEST_MISFIT: f64 = 2.0;

/// A score that exceeds the least by less than this belongs to an explanation that cannot be excluded.
const AS_GOOD: f64 = 6.0;

/// The parameters of a batch beyond the prior.
pub(super) struct Beyond {
    pub posterior: PosteriorSamples,
    pub populations: Populations,
    pub mean: BatchMean,
    pub fit: fit::Fit,
    /// Names of the parameters that lie beyond their prior.
    pub names: Vec<String>,
    pub finding: Finding,
}

/// A set of parameters that may have changed, with the point that explains the batch best.
struct Explanation {
    columns: Vec<usize>,
    at: DVector<f64>,
    score: f64,
}

impl Explanation {
    /// Whether all measurements show it: a wrong one beside right ones does not. `usual_misfit`: that of healthy batches.
    fn fits(&self, observations: &[Observation], usual_misfit: f64) -> bool {
        let frequencies: usize = observations.iter().map(Observation::modes_present).sum();
        let misfit = self.score - COST * self.columns.len() as f64;
        ChiSquared::new(frequencies as f64)
            .is_ok_and(|chi| misfit < LARGEST_MISFIT * usual_misfit.max(1.0) * chi.inverse_cdf(FITS))
    }
}

/// The parameters of a batch beyond the prior; `None` where the prior holds them, where no point beyond it fits, and where the simulation
/// is not exact and quick. `of_prior`: the fit within the prior; `draws`: posterior samples of each measurement.
pub(super) fn found(
    baseline: &Baseline,
    observations: &[Observation],
    compared: Compared<'_>,
    of_prior: &fit::Fit,
    draws: usize,
    seed: u64,
) -> Option<Beyond> {
    let (healthy, all_times) = (compared.healthy, compared.all_times?);
    if !is_computed(baseline, observations) || baseline.simulator().table().is_some() {
        return None;
    }
    let inside = Problem::new(baseline, observations, healthy)?;
    let fails =
        of_prior.rejected_beside(compared.usual_misfit) || !of_prior.outside.is_empty() || !of_prior.gross.is_empty();
    if !fails {
        let solved = inside.solved()?;
        let changed = changed(&inside, &solved.at, all_times);
        if changed < SEVERAL && !inside.is_near_bound(&solved, DEVIATIONS)? {
            return None;
        }
    }
    let observations = &far_from(baseline.simulator(), observations, &healthy.centre)?;
    let wide = baseline.simulator().with_space(widened(baseline.space(), &healthy.centre));
    let step = observations.len().div_ceil(SEARCHED);
    let searched: Vec<Observation> = observations.iter().step_by(step).cloned().collect();
    let inside = score_inside(&Problem::new(baseline, &searched, healthy)?, all_times)?;
    let mut all = explanations(&Problem::of(&wide, &searched, healthy)?, all_times);
    all.sort_by(|a, b| a.score.total_cmp(&b.score));
    let best =
        all.first().filter(|best| best.score < inside + SAME && best.fits(&searched, compared.usual_misfit[0]))?;
    let mut problem = Problem::of(&wide, observations, healthy)?;
    problem.prior = priors(&problem, &best.columns, all_times);
    let about = problem.solved_from(&best.at)?.at;
    for k in 0..about.len() {
        if best.columns.contains(&k) {
            problem.centre[k] = about[k];
        } else {
            problem.prior[k] /= OTHERS * OTHERS;
        }
    }
    let mean = problem.mean_linearised(&about)?;
    let beyond = |k: &usize| {
        let (parameter, std) = (&baseline.space().as_slice()[*k], healthy.scatter[(*k, *k)].sqrt());
        let (value, off) = (mean.mean[*k], DEVIATIONS * std);
        value - off < parameter.lower || value + off > parameter.upper
    };
    let columns: Vec<usize> = (0..mean.mean.len()).filter(beyond).collect();
    let start: Vec<f64> = wide.space().iter().zip(&about).map(|(p, at)| p.from_unit(*at)).collect();
    let starts = vec![start; observations.len()];
    let fit = fit::fit(&wide, observations, &starts).ok()?;
    if columns.is_empty() || fit.rejected_beside(compared.usual_misfit) {
        return None;
    }
    let alike = linearised(&problem, &about, &vec![0.0; wide.modes()])?;
    let posterior = posterior(&problem, &alike, &about, draws, seed)?;
    let linear = LinearBatch {
        alike: alike.into_iter().map(|(_, alike)| alike).collect(),
        prior_mean: &problem.centre - &about,
        prior_precision: problem.prior.clone(),
        about,
        spread: Spread::Usual { covariance: problem.scatter.clone(), degrees: MOST_DEGREES },
    };
    Some(Beyond {
        populations: linear.populations(wide.space(), seed)?,
        posterior,
        fit,
        names: columns.iter().map(|k| baseline.space().as_slice()[*k].name.clone()).collect(),
        finding: finding(baseline.space(), wide.space(), healthy, &mean, &columns, &all),
        mean,
    })
}

/// The prior, widened in the directions of damage, and uniform.
fn widened(space: &ParameterSpace, healthy: &[f64]) -> ParameterSpace {
    let one = |(parameter, healthy): (&Parameter, &f64)| {
        let (mut lower, mut upper) = (parameter.lower, parameter.upper);
        match parameter.damage {
            DamageDirection::Decrease if *healthy > 0.0 => lower = lower.min(LEAST * healthy),
            DamageDirection::Increase if *healthy > 0.0 => upper = upper.max(LARGEST * healthy),
            _ => {}
        }
        Parameter { lower, upper, form: PriorForm::Uniform, ..parameter.clone() }
    };
    ParameterSpace::new(space.iter().zip(healthy).map(one).collect())
}

/// Precisions of parameters that are as in the reference, `[d]`.
fn unchanged(problem: &Problem<'_>, all_times: &[f64]) -> DVector<f64> {
    let width = |k: usize| problem.space.as_slice()[k].upper - problem.space.as_slice()[k].lower;
    DVector::from_fn(all_times.len(), |k, _| (width(k) / all_times[k].max(f64::MIN_POSITIVE)).powi(2))
}

/// Precisions of parameters of which some may have changed, `[d]`.
fn priors(problem: &Problem<'_>, changed: &[usize], all_times: &[f64]) -> DVector<f64> {
    let unchanged = unchanged(problem, all_times);
    DVector::from_fn(unchanged.len(), |k, _| if changed.contains(&k) { FREE } else { unchanged[k] })
}

/// Number of parameters that have changed at a point within the prior.
fn changed(problem: &Problem<'_>, at: &DVector<f64>, all_times: &[f64]) -> usize {
    let (unchanged, off) = (unchanged(problem, all_times), at - &problem.centre);
    (0..off.len()).filter(|k| unchanged[*k] * off[*k].powi(2) > COST + FREE * off[*k].powi(2)).count()
}

/// The observations with the error of a simulation that is far from the healthy structure: its frequencies are off by a share of their
/// change. `None` where the simulation fails.
fn far_from(simulator: &Simulator, observations: &[Observation], healthy: &[f64]) -> Option<Vec<Observation>> {
    let usual_hz = simulator.frequencies_hz(healthy).ok()?;
    let one = |observation: &Observation| {
        let mut observation = observation.clone();
        for ((hz, multiple), usual_hz) in
            observation.frequencies_hz.iter().zip(&mut observation.noise_multiple).zip(&usual_hz)
        {
            let Some(hz) = hz else { continue };
            let error_hz = ERROR_OF_CHANGE * (hz - usual_hz);
            *multiple = multiple.hypot(error_hz / simulator.noise().std_hz(*hz));
        }
        observation
    };
    Some(observations.iter().map(one).collect())
}

/// The score of the best point within the prior, with the cheapest set of parameters that may have changed.
fn score_inside(problem: &Problem<'_>, all_times: &[f64]) -> Option<f64> {
    let solved = problem.solved()?;
    let off = &solved.at - &problem.centre;
    let unchanged = unchanged(problem, all_times);
    let of_one = |k: usize| (unchanged[k] * off[k].powi(2)).min(COST + FREE * off[k].powi(2));
    let of_parameters: f64 = (0..off.len()).map(of_one).sum();
    Some(problem.misfit(&solved) + of_parameters)
}

/// What one or two changed parameters explain.
fn explanations(problem: &Problem<'_>, all_times: &[f64]) -> Vec<Explanation> {
    let space = problem.space.as_slice();
    let explain = |columns: &[usize]| {
        let mut own = problem.clone();
        own.prior = priors(problem, columns, all_times);
        let starts = starts(problem, columns);
        let solved = starts.iter().filter_map(|start| own.solved_from(start));
        let best = solved.min_by(|a, b| a.deviance().total_cmp(&b.deviance()))?;
        let score = best.deviance() + COST * columns.len() as f64;
        Some(Explanation { columns: columns.to_vec(), at: best.at, score })
    };
    let directed = (0..space.len()).filter(|k| space[*k].damage != DamageDirection::None);
    let mut all: Vec<Explanation> = directed.filter_map(|k| explain(&[k])).collect();
    all.sort_by(|a, b| a.score.total_cmp(&b.score));
    let few: Vec<usize> = all.iter().take(IN_PAIRS).map(|one| one.columns[0]).collect();
    let pairs = (0..few.len()).flat_map(|i| (0..i).map(move |j| (i, j)));
    let pairs: Vec<Explanation> = pairs.filter_map(|(i, j)| explain(&[few[i], few[j]])).collect();
    all.extend(pairs);
    all
}

/// The points at which a search begins: all combinations of changes of these parameters.
fn starts(problem: &Problem<'_>, columns: &[usize]) -> Vec<DVector<f64>> {
    let mut starts = vec![problem.centre.clone()];
    for k in columns {
        let parameter = &problem.space.as_slice()[*k];
        let healthy = parameter.from_unit(problem.centre[*k]);
        let shares: &[f64] = if parameter.damage == DamageDirection::Increase { &RISEN } else { &FALLEN };
        let moved = |start: &DVector<f64>| {
            let moved = shares.iter().map(|share| {
                let mut start = start.clone();
                start[*k] = parameter.to_unit(share * healthy);
                start
            });
            moved.collect::<Vec<_>>()
        };
        starts = starts.iter().flat_map(moved).collect();
    }
    starts
}

/// Posterior samples of each measurement under the widened prior, in normal approximation, `[measurements × draws, d]`.
fn posterior(
    problem: &Problem<'_>,
    alike: &[(Vec<usize>, LinearMeasurements)],
    about: &DVector<f64>,
    draws: usize,
    seed: u64,
) -> Option<PosteriorSamples> {
    let (d, count) = (about.len(), alike.iter().map(|(places, _)| places.len()).sum::<usize>());
    let mut stream = stats::stream(seed, "posterior beyond the prior");
    let mut theta = DMatrix::zeros(count * draws, d);
    let of_prior = problem.prior.component_mul(&(&problem.centre - about));
    for (places, LinearMeasurements { information, gradients }) in alike {
        let factor = (information + DMatrix::from_diagonal(&problem.prior)).cholesky()?;
        let mut gradients = gradients.clone();
        gradients.column_iter_mut().for_each(|mut gradient| gradient += &of_prior);
        let means = factor.solve(&gradients);
        for (column, place) in places.iter().enumerate() {
            for draw in 0..draws {
                let normal = DVector::from_fn(d, |_, _| stream.sample(StandardNormal));
                let off = factor.l_dirty().tr_solve_lower_triangular(&normal)?;
                for (k, parameter) in problem.space.iter().enumerate() {
                    let unit = (about[k] + means[(k, column)] + off[k]).clamp(0.0, 1.0);
                    theta[(place * draws + draw, k)] = parameter.from_unit(unit);
                }
            }
        }
    }
    Some(PosteriorSamples::new(theta, draws))
}

/// What is said of a batch beyond the prior. `all`: the explanations, the best first.
fn finding(
    prior: &ParameterSpace,
    wide: &ParameterSpace,
    healthy: &Healthy,
    mean: &BatchMean,
    columns: &[usize],
    all: &[Explanation],
) -> Finding {
    let name = |k: &usize| structures::parameter::in_words(&prior.as_slice()[*k].name);
    let percent =
        |k: usize, value: f64| format!("{:+.1} %", 100.0 * (value / healthy.centre[k] - 1.0)).replace('-', "−");
    let one = |k: &usize| {
        let (parameter, value) = (&prior.as_slice()[*k], mean.mean[*k]);
        let is_below = value < 0.5 * (parameter.lower + parameter.upper);
        let bound = if is_below { parameter.lower } else { parameter.upper };
        let side = match (is_below, parameter.lower <= value && value <= parameter.upper) {
            (_, true) => "at the end of",
            (true, false) => "below",
            (false, false) => "above",
        };
        format!(
            "{} lies {side} its prior, which ends at {}: {}, {} from the healthy structure",
            name(k),
            with_prefix(bound, &parameter.unit),
            with_prefix(value, &parameter.unit),
            percent(*k, value)
        )
    };
    let mut message = columns.iter().map(one).collect::<Vec<_>>().join("; ");
    message.push_str(
        ". The simulation was solved beyond the prior, with the other parameters near those of the reference",
    );
    let best = &all[0];
    let other = all
        .iter()
        .skip(1)
        .find(|other| other.score < best.score + AS_GOOD && !best.columns.iter().all(|k| other.columns.contains(k)));
    if let Some(other) = other {
        let value = |k: &usize| wide.as_slice()[*k].from_unit(other.at[*k]);
        let parts: Vec<String> =
            other.columns.iter().map(|k| format!("{} {}", name(k), percent(*k, value(k)))).collect();
        message = format!("{message}; {} explains the frequencies as well", parts.join(" with "));
    }
    Finding::new(FindingCode::OutsidePrior, FindingEffect::Note, message)
}
