//! A robot's observation of its world.

use crate::message::{RobotResult, WorldResult};
use emberwatch_model::frame::Frame;

/// A robot's observation of its world after a step, or when the robot is acquired.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    pub world: WorldResult,
    /// The robot's cell, and its result of the step.
    pub robot: RobotResult,
    /// What the robot saw, or with shared frames what all robots of its world saw; shape `[H, W]`.
    pub frame: Frame,
}
