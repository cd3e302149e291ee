//! The real program on a free port with its own SQLite file.

mod bad_input;
mod batches;
mod helpers;
mod history;
mod operations;
mod restart;
mod ruler_frame;
