//! What a seed draws: batches, and what several clients do with them while faults strike.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::OnceLock;

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::faults::Mode;
use crate::baseline::library::find_structure;
use crate::measurement::{MeasurementBatch, ModalMeasurement};
use crate::quantity::{Hertz, StructureId, Timestamp};
use crate::simulator::Simulator;

/// Measurements of a batch: two batches are enough for a reference.
const MEASUREMENTS: usize = 6;

/// Healthy batches at the beginning, of which references are made. All other batches were measured later, so that each of them is
/// compared with the newest reference in the end, whenever it arrived.
pub(super) const HEALTHY: usize = 4;

const BEGIN_US: i64 = 1_767_225_600_000_000;
const HOUR_US: i64 = 3_600_000_000;

pub(super) fn structure() -> StructureId {
    StructureId::parse("three-dof").unwrap()
}

/// What the measurements of a batch show.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Kind {
    Healthy,
    /// The first spring has lost a third of its stiffness.
    Damaged,
    /// Its stated noise is larger than any that a model was trained for, so that its assessment fails.
    Unusable,
    /// Other values at the times of the batch at the same place, which only one of the two can have.
    Other,
}

/// A batch, by its place in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Content {
    pub place: usize,
    pub kind: Kind,
}

impl Content {
    /// Time of its first measurement, µs.
    pub fn from_us(place: usize) -> i64 {
        BEGIN_US + place as i64 * HOUR_US
    }

    /// The place of a batch whose first measurement has this time.
    pub fn place_of(from: Timestamp) -> usize {
        ((from.micros() - BEGIN_US) / HOUR_US) as usize
    }

    /// Whether its first measurement repeats the last one of the batch before it, if that shows the same: a gateway that hangs for a moment.
    pub fn repeats(self) -> bool {
        self.place % 3 == 2 && matches!(self.kind, Kind::Healthy | Kind::Damaged)
    }

    /// Its idempotency key, where it has one of its own.
    pub fn key(self) -> String {
        format!("{:?}-{}", self.kind, self.place)
    }

    pub fn measurements(self) -> Vec<ModalMeasurement> {
        static SIMULATOR: OnceLock<Simulator> = OnceLock::new();
        let simulator = SIMULATOR.get_or_init(|| find_structure("three-dof").unwrap());
        let stiffness = if self.kind == Kind::Damaged { 4.0 * 0.67 } else { 4.0 };
        let one = |i: usize| {
            let row = MEASUREMENTS * self.place + i + if self.kind == Kind::Other { 1_000 } else { 0 };
            let row = row - usize::from(i == 0 && self.repeats());
            let wave = |phase: usize| 1.0 + 0.02 * ((row * 7 + phase * 3) as f64).sin();
            let exact = simulator.frequencies_hz(&[stiffness * wave(0), 5.0 * wave(1), 6.0 * wave(2)]).unwrap();
            let noise = |f: &f64| Hertz::new(f * 0.9).ok();
            ModalMeasurement {
                measured_at: Timestamp::from_micros(Self::from_us(self.place) + i as i64 * 60_000_000).unwrap(),
                std_hz: (self.kind == Kind::Unusable).then(|| exact.iter().map(|f| noise(f).map(Hertz::get)).collect()),
                frequencies_hz: exact.into_iter().map(|f| Hertz::new(f).ok()).collect(),
                mode_shapes: None,
                covariates: BTreeMap::new(),
                settings: BTreeMap::new(),
            }
        };
        (0..MEASUREMENTS).map(one).collect()
    }

    pub fn batch(self, key: Option<String>) -> MeasurementBatch {
        let measurements = self.measurements();
        MeasurementBatch {
            structure: structure(),
            source: "logger".to_owned(),
            idempotency_key: key,
            posted_by: None,
            measurements,
        }
    }
}

/// What a client does.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Action {
    /// Posts a batch, perhaps again, with its own key, with that of another batch, or without one.
    Post { content: Content, key: Option<Content> },
    /// Declares the first batches as undamaged.
    Declare { batches: usize },
    /// Extends the reference to the first batches.
    Extend { batches: usize },
    /// Puts one of two trained models into use, and renews the reference if told so.
    Reload { model: usize, renew: bool },
    /// Acknowledges the open alarms.
    Acknowledge,
    /// Deletes the batches before a place.
    Retain { before: usize },
}

/// A client in a round: it lets others go before it, and repeats what failed.
#[derive(Debug, Clone)]
pub(super) struct Client {
    pub yields: u32,
    pub tries: u32,
    pub action: Action,
}

/// Clients that act at the same time, and what happens to them.
#[derive(Debug, Clone)]
pub(super) struct Round {
    pub clients: Vec<Client>,
    pub faults: Mode,
    /// The process is killed at this call of the store, or at the end of the round if there are fewer.
    pub kill: Option<u32>,
    pub disk_full: bool,
    /// Seconds since the round before; the clock stands still during a round and may be set back.
    pub seconds: i64,
    /// The next round begins only when nothing runs in the background any more.
    pub quiet: bool,
}

impl Round {
    /// Whether nothing in it may fail.
    pub fn is_clean(&self) -> bool {
        self.faults == Mode::None && self.kill.is_none() && !self.disk_full
    }
}

/// What a seed draws.
pub(super) struct Drawn {
    /// What the batch at each place shows.
    pub kinds: Vec<Kind>,
    pub rounds: Vec<Round>,
    /// Whether the process is started again after the last round, or goes on by itself.
    pub restarts_at_the_end: bool,
}

impl fmt::Display for Drawn {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "batches: {:?}", self.kinds)?;
        for (number, Round { clients, faults, kill, disk_full, seconds, quiet }) in self.rounds.iter().enumerate() {
            writeln!(
                f,
                "round {number}: {seconds} s later, {faults:?}, kill {kill:?}, disk full {disk_full}, quiet {quiet}"
            )?;
            for Client { yields, tries, action } in clients {
                writeln!(f, "    {action:?}, behind {yields}, {tries} tries")?;
            }
        }
        write!(f, "restarted at the end: {}", self.restarts_at_the_end)
    }
}

/// Draws a history. The same seed draws the same one.
pub(super) fn draw(seed: u64) -> Drawn {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let kinds = kinds(&mut rng);
    let mut actions = posts(&mut rng, &kinds);
    // Models are read from files, which takes longer than all the rest.
    if rng.random_bool(0.1) {
        for _ in 0..rng.random_range(1..=2) {
            let reload = Action::Reload { model: rng.random_range(0..2), renew: rng.random_bool(0.7) };
            actions.insert(rng.random_range(0..=actions.len()), reload);
        }
    }
    if rng.random_bool(0.1) {
        let retain = Action::Retain { before: rng.random_range(0..=kinds.len()) };
        actions.insert(rng.random_range(0..=actions.len()), retain);
    }
    let (mut rounds, mut actions) = (Vec::new(), actions.into_iter().peekable());
    let mut disk_full = false;
    while actions.peek().is_some() {
        let together = rng.random_range(1..=3);
        let client = |action: Action| Client { yields: rng.random_range(0..8), tries: rng.random_range(1..=4), action };
        let clients = actions.by_ref().take(together).map(client).collect();
        disk_full = if disk_full { rng.random_bool(0.5) } else { rng.random_bool(0.05) };
        rounds.push(Round {
            clients,
            faults: Mode::draw(&mut rng),
            kill: rng.random_bool(0.12).then(|| rng.random_range(0..40)),
            disk_full,
            seconds: if rng.random_bool(0.1) { -rng.random_range(0..100_000) } else { rng.random_range(0..5_000) },
            quiet: rng.random_bool(0.3),
        });
    }
    Drawn { kinds, rounds, restarts_at_the_end: rng.random_bool(0.5) }
}

fn kinds(rng: &mut ChaCha8Rng) -> Vec<Kind> {
    let mut kinds = vec![Kind::Healthy; HEALTHY];
    let later = rng.random_range(3..=7);
    let (begin, length) = (rng.random_range(0..later), rng.random_range(0..=4));
    kinds.extend((0..later).map(|i| if (begin..begin + length).contains(&i) { Kind::Damaged } else { Kind::Healthy }));
    if rng.random_bool(0.2) {
        let place = rng.random_range(HEALTHY..kinds.len());
        kinds[place] = Kind::Unusable;
    }
    kinds
}

/// The posts of all batches, about in the order of time, with repetitions, references and acknowledgements among them.
fn posts(rng: &mut ChaCha8Rng, kinds: &[Kind]) -> Vec<Action> {
    let mut order: Vec<(usize, usize)> =
        (0..kinds.len()).map(|place| (place + rng.random_range(0..4), place)).collect();
    order.sort_unstable();
    let (mut posted, mut actions) = (Vec::new(), Vec::new());
    for (_, place) in order {
        let content = Content { place, kind: kinds[place] };
        posted.push(content);
        actions.push(Action::Post { content, key: rng.random_bool(0.5).then_some(content) });
        while rng.random_bool(0.35) {
            let one = posted[rng.random_range(0..posted.len())];
            let other = posted[rng.random_range(0..posted.len())];
            actions.push(match rng.random_range(0..20) {
                0..8 => Action::Post { content: one, key: rng.random_bool(0.5).then_some(one) },
                8 => Action::Post { content: one, key: Some(other) },
                9 => Action::Post { content: Content { kind: Kind::Other, ..one }, key: None },
                10..14 => Action::Declare { batches: rng.random_range(2..=HEALTHY) },
                14..17 => Action::Extend { batches: rng.random_range(3..=HEALTHY) },
                _ => Action::Acknowledge,
            });
        }
    }
    // Nearly every history has a reference.
    for from in [HEALTHY, actions.len() / 2, actions.len() / 2 + 2] {
        let declare = Action::Declare { batches: rng.random_range(2..=HEALTHY) };
        actions.insert(rng.random_range(from..=actions.len()), declare);
    }
    actions
}
