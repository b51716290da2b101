//! What holds for planners and teams on random problems, and for filters and summaries.

mod airspace;
mod fields;
mod planners;
mod team;
