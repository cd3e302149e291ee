//! An instrument that is off by one factor in all frequencies, alone or together with a loss of a part, and losses without it.

use modalwatch::measurement::ModalMeasurement;
use modalwatch::process::lasting::QuantityChange;
use modalwatch::quantity::Hertz;
use modalwatch::stats;
use rand::Rng as _;
use rayon::prelude::*;

use super::coverage::Structure;
use super::manners::{alarms, assessed, one, Manner, COMPLETE};

/// Batches before the exchange of the instrument and after it.
const BEFORE: usize = 5;
const AFTER: usize = 25;

/// First batch after the reference.
const FIRST: usize = 1_000;

/// What is said of a change of all frequencies.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
enum Factor {
    #[default]
    NotNamed,
    Candidate,
    /// Certain, with an interval that holds the factor or does not.
    Certain {
        holds: bool,
    },
}

/// What is said of a world with its last batch.
#[derive(Default)]
struct Outcome {
    factor: Factor,
    /// Parts that lost nothing and are certain, and whether the part that lost is certain or a candidate.
    accused: usize,
    found: bool,
    /// `None` without an alarm.
    said: Option<String>,
}

impl Outcome {
    fn is_certain(&self) -> bool {
        matches!(self.factor, Factor::Certain { .. })
    }
}

/// A factor of all frequencies, in per cent, and whether a part loses 5 to 12 % on the same day.
fn outcome(seed: u64, percent: f64, with_loss: bool) -> Outcome {
    let mut stream = stats::stream(seed, "test: exchanged instruments");
    let id = ["three-dof", "ruler-frame-4dof"][stream.random_range(0..2)];
    let structure = Structure::new(id, seed);
    let sizes: [&[usize]; 4] = [&[5], &[20], &[50], &[1, 20, 3]];
    let manner = Manner { sizes: sizes[stream.random_range(0..sizes.len())], ..COMPLETE };
    let mut damaged = structure.healthy.clone();
    let lost = stream.random_range(0..damaged.len());
    if with_loss {
        damaged[lost].0 *= 1.0 - stream.random_range(0.05..0.12);
    }
    let all: Vec<Vec<ModalMeasurement>> = (0..BEFORE + AFTER)
        .map(|t| {
            let now = if t < BEFORE { &structure.healthy } else { &damaged };
            let mut batch = one(&structure.baseline, manner, now, FIRST + t, seed);
            if t >= BEFORE {
                for f in batch.iter_mut().flat_map(|m| &mut m.frequencies_hz).flatten() {
                    *f = Hertz::new(f.get() * (1.0 + percent / 100.0)).unwrap();
                }
            }
            batch
        })
        .collect();
    let assessments = assessed(&structure.baseline, &structure.undamaged, &all, seed);
    let found = alarms(&structure.baseline, &structure.undamaged, &assessments);
    let Some(last) = found.last().unwrap() else { return Outcome::default() };
    let name = &structure.baseline.space().as_slice()[lost].name;
    let of_all = |own: &&QuantityChange| own.is_of_all_frequencies();
    let holds = |own: &QuantityChange| {
        let [low, high] = own.interval.map(|end| own.percent(end));
        (low..=high).contains(&percent)
    };
    let is_lost = |own: &QuantityChange| with_loss && own.name.split(['+', ':']).any(|part| part == name);
    let parts = || last.changes.iter().filter(|own| !own.is_of_all_frequencies());
    let certain = last.changes.iter().find(of_all).map(|own| Factor::Certain { holds: holds(own) });
    let candidate = last.candidates.iter().find(of_all).map(|_| Factor::Candidate);
    Outcome {
        factor: certain.or(candidate).unwrap_or_default(),
        accused: parts().filter(|own| own.towards_damage && !is_lost(own)).count(),
        found: parts().chain(&last.candidates).any(is_lost),
        said: Some(format!("{seed} {id} {:?}: {}", manner.sizes, last.sentence())),
    }
}

/// Outcomes of worlds with a factor between −1.2 and −0.1 %, or 0.
fn outcomes(worlds: u64, off: bool, with_loss: bool) -> Vec<Outcome> {
    let percent =
        |seed: u64| if off { -0.1 * 12.0_f64.powf(stats::stream(seed, "test: factor").random()) } else { 0.0 };
    let found: Vec<Outcome> = (0..worlds).into_par_iter().map(|seed| outcome(seed, percent(seed), with_loss)).collect();
    let count = |of: fn(&Outcome) -> bool| found.iter().filter(|own| of(own)).count();
    println!(
        "instrument off {off}, loss {with_loss}: {} of {worlds} alarmed; factor certain in {}, a candidate in {}, its interval holds in {}; \
         parts that lost nothing named in {}, that which lost named or a candidate in {}",
        count(|own| own.said.is_some()),
        count(Outcome::is_certain),
        count(|own| own.factor == Factor::Candidate),
        count(|own| own.factor == Factor::Certain { holds: true }),
        count(|own| own.accused > 0),
        count(|own| own.found)
    );
    for (seed, own) in found.iter().enumerate() {
        if own.accused > 0 || own.is_certain() != off || with_loss && !own.found {
            println!("  {:.2} %: {}", percent(seed as u64), own.said.as_deref().unwrap_or("no alarm"));
        }
    }
    found
}

#[test]
fn an_instrument_that_is_off_is_told_from_a_loss() {
    let off = outcomes(10, true, false);
    assert!(off.iter().all(|own| own.accused == 0 && (own.said.is_none() || own.factor != Factor::NotNamed)));
    assert!(off.iter().filter(|own| own.is_certain()).count() >= 8);
    let lost = outcomes(10, false, true);
    assert!(lost.iter().all(|own| own.accused == 0 && own.found && !own.is_certain()));
}

#[test]
#[ignore = "a study of minutes"]
fn instruments_in_many_worlds() {
    for (off, with_loss) in [(true, false), (false, true), (true, true)] {
        outcomes(60, off, with_loss);
    }
}
