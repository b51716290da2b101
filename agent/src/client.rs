//! Worlds on a server or in this process: connections, hidden states for scoring, and beliefs for observers.

pub(crate) mod errors;
pub(crate) mod info;
pub mod truth;
pub(crate) mod view;
pub mod worlds;
