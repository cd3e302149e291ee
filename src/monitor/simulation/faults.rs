//! Which calls of the store fail, and at which one the process is killed.

use std::sync::{Arc, Mutex};

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use tokio::sync::Notify;

use crate::fault::Faults;

/// Points that fail.
const POINTS: [&str; 8] = [
    "store::begin",
    "store::task",
    "store::measurement",
    "store::commit",
    "store::committed",
    "store::query",
    "store::read",
    "baseline::load",
];

/// How the points fail during a round.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mode {
    None,
    /// One call of one point.
    Once {
        point: &'static str,
        call: u32,
    },
    /// All calls of all points, from one on.
    Streak {
        call: u32,
        length: u32,
    },
    /// Each call with a probability in per mille.
    Rate {
        per_mille: u32,
        seed: u64,
    },
    /// All calls of one point.
    Stuck {
        point: &'static str,
    },
}

impl Mode {
    pub fn draw(rng: &mut ChaCha8Rng) -> Self {
        let point = POINTS[rng.random_range(0..POINTS.len() - 1)];
        match rng.random_range(0..10) {
            0..4 => Self::None,
            4..6 => Self::Once { point, call: rng.random_range(0..12) },
            6 => Self::Streak { call: rng.random_range(0..30), length: rng.random_range(2..12) },
            7 | 8 => Self::Rate { per_mille: rng.random_range(20..400), seed: rng.random() },
            _ => Self::Stuck { point },
        }
    }
}

/// The state of a round.
struct State {
    mode: Mode,
    kill: Option<u32>,
    /// Calls of all points, and of each.
    calls: u32,
    of_point: [u32; POINTS.len()],
    rng: ChaCha8Rng,
    dead: bool,
    killed: Arc<Notify>,
    struck: u64,
}

impl State {
    fn new(mode: Mode, kill: Option<u32>, struck: u64) -> Self {
        let seed = if let Mode::Rate { seed, .. } = mode { seed } else { 0 };
        let rng = ChaCha8Rng::seed_from_u64(seed);
        Self { mode, kill, calls: 0, of_point: [0; POINTS.len()], rng, dead: false, killed: Arc::default(), struck }
    }
}

/// Decides which calls fail.
#[derive(Clone)]
pub(super) struct Plan {
    state: Arc<Mutex<State>>,
}

impl Plan {
    /// Puts a plan without faults into force, on the thread that holds `faults`. The seed decides with which error reads fail.
    pub fn follow(faults: &Faults, seed: u64) -> Self {
        for point in POINTS {
            faults.set(point, ["return", "return(busy)", "return(interrupted)"][(seed % 3) as usize]);
        }
        faults.set("monitor::pause", "return");
        let plan = Self { state: Arc::new(Mutex::new(State::new(Mode::None, None, 0))) };
        let own = plan.clone();
        faults.follow(move |point| own.strikes(point));
        plan
    }

    /// Begins a round.
    pub fn set(&self, mode: Mode, kill: Option<u32>) {
        let mut state = self.state.lock().unwrap();
        *state = State::new(mode, kill, state.struck);
    }

    /// Completes when the process is killed.
    pub async fn killed(&self) {
        let killed = Arc::clone(&self.state.lock().unwrap().killed);
        killed.notified().await;
    }

    /// Number of calls that have failed.
    pub fn struck(&self) -> u64 {
        self.state.lock().unwrap().struck
    }

    fn strikes(&self, point: &str) -> bool {
        let Some(number) = POINTS.iter().position(|known| *known == point) else { return true };
        let mut state = self.state.lock().unwrap();
        let (call, of_point) = (state.calls, state.of_point[number]);
        state.calls += 1;
        state.of_point[number] += 1;
        if !state.dead && state.kill.is_some_and(|kill| call >= kill) {
            state.dead = true;
            state.killed.notify_one();
        }
        // Nothing is written any more by a process that is dead.
        let strikes = state.dead
            || match state.mode {
                Mode::None => false,
                Mode::Once { point: only, call: at } => only == point && of_point == at,
                Mode::Streak { call: from, length } => (from..from + length).contains(&call),
                Mode::Rate { per_mille, .. } => state.rng.random_range(0..1_000) < per_mille,
                Mode::Stuck { point: only } => only == point,
            };
        state.struck += u64::from(strikes);
        strikes
    }
}
