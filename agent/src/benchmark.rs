//! Policies on the same worlds, scored against the hidden states.

pub mod arena;
pub mod compare;
pub mod evaluate;
pub mod report;
pub mod team;
