//! Property tests of planners and teams on random problems.

mod airspace;
mod fields;
mod planners;
mod team;
