//! The commands as a person or a script runs them: exit status, sentences about mistakes, rehearsals, and what is shown of a structure.

mod check;
mod demo;
mod design;
mod mistakes;
mod new;
mod simulate;
mod without_model;
mod words;
mod world;
