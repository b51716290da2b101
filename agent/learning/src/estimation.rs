//! Estimators that need networks, and the first belief of the others.

pub mod autoencoder;
pub mod first_belief;
pub mod follower;
pub mod neural;

pub use autoencoder::AutoencoderEstimator;
pub use follower::Follower;
pub use neural::NeuralEstimator;
