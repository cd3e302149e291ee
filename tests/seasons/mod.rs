//! Charts of the process behind an undamaged reference on frequencies measured at real bridges, over their seasons.
//!
//! The data are not part of the repository; without them the tests are counted as skipped.

mod consoli;
mod contained;
mod estimates;
mod hidden_part;
mod many_worlds;
mod parts;
mod rhythms;
mod sciri;
mod thermometer;
mod watch;
mod worlds;
mod z24;
mod z24_descriptions;
