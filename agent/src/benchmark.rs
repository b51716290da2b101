//! Policies on the same worlds, scored against the hidden states.

pub mod arena;
mod brier;
pub mod compare;
pub mod evaluate;
pub mod merit;
pub mod report;
pub mod team;
