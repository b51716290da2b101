//! What a robot's world shows.

use crate::message::{RobotResult, WorldResult};
use emberwatch_model::frame::Frame;

/// What a robot's world shows after a step, or when the robot is acquired.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// The world at its step k.
    pub world: WorldResult,
    /// The robot: where it is, and what the step gave it.
    pub robot: RobotResult,
    /// What the robot saw, or all robots of its world where a client asks for that; shape `[H, W]`.
    pub frame: Frame,
}
