//! The model's mathematics, compared with its formulas and with the authors' worlds. All seeds are fixed, so a test
//! always passes or always fails.

mod airspace;
mod dynamics;
mod models;
mod refusals;
mod statistics;
mod transition;
