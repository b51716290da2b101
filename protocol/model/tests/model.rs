//! The model's mathematics against its formulas and the authors' worlds. All seeds are fixed: a test passes always or
//! never.

mod airspace;
mod dynamics;
mod models;
mod refusals;
mod statistics;
mod transition;
