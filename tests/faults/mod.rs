//! Faults from outside: the real program under kills, full and failing disks, jumping clocks, damaged files, hostile clients.
//!
//! `tests/README.md` lists every case with its test. A test whose tool is missing (`fiu-run`, `faketime`, the right to mount) is
//! recorded as skipped, by `tests/zz_skipped/needs.rs`.

mod clients;
mod clock;
mod damage;
mod disk;
mod input;
mod io;
mod kit;
mod models;
mod soak;
mod stop;
