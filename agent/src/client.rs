//! Communication with the server: connections, hidden states for scoring, and beliefs for observers.

pub(crate) mod errors;
pub(crate) mod info;
pub(crate) mod launch;
pub mod left_belief;
pub mod truth;
pub(crate) mod view;
