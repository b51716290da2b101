//! Fuzz targets for the messages that clients and observers read.

use bytemuck::Pod;
use emberwatch_protocol::agent_belief::AgentBelief;
use emberwatch_protocol::control::{Reply, parse};
use emberwatch_protocol::message::{AgentHeader, FrameHeader, Status, StepReply};
use emberwatch_protocol::observer::Sample;
use emberwatch_protocol::path::{path_from_bytes, path_to_bytes};
use emberwatch_protocol::payload::{RobotSample, split_frame_payload, split_step_payload};
use emberwatch_protocol::{Coverage, Frame, Shape, UNOBSERVED};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::fmt::Debug;

/// Number of observations of the model.
const N_OBSERVATIONS: usize = 3;

/// Splits bytes into a header and the rest. Returns `None` if there are too few bytes.
pub fn split_header<H: Pod>(bytes: &[u8]) -> Option<(H, &[u8])> {
    let (header, payload) = bytes.split_at_checked(size_of::<H>())?;
    Some((bytemuck::pod_read_unaligned(header), payload))
}

/// Checks that the parts of an answer to a step request add up to the whole payload, and that its frames contain valid
/// observations.
pub fn step_answer(bytes: &[u8]) -> bool {
    let Some((reply, payload)) = split_header::<StepReply>(bytes) else {
        return false;
    };
    if let Ok(status) = Status::try_from(reply.status) {
        assert_eq!(status as u32, reply.status);
        assert!(!status.explain(reply.detail).is_empty());
    }
    let Ok(parts) = split_step_payload(&reply, payload) else {
        return false;
    };
    let counts = (parts.worlds.len(), parts.robots.len());
    assert_eq!(counts, (reply.n_worlds as usize, reply.n_robots as usize));
    let results = [
        bytemuck::cast_slice(&parts.worlds),
        bytemuck::cast_slice(&parts.robots),
    ];
    assert_eq!([&results.concat(), parts.frames].concat(), payload);
    for robot in &parts.robots {
        if let Ok(coverage) = Coverage::try_from(robot.coverage) {
            assert_eq!(coverage as u32, robot.coverage);
        }
    }
    let Ok(shape) = Shape::new(reply.height as usize, reply.width as usize) else {
        return false;
    };
    let frames = parts.frames.chunks_exact(shape.n_cells());
    !parts.worlds.is_empty() && frames.map(|frame| is_frame(shape, frame)).min() == Some(true)
}

/// Checks that each robot in a sample of `frames` has a valid frame and path, and starts on the grid.
pub fn frame(bytes: &[u8]) -> bool {
    let Some((header, payload)) = split_header::<FrameHeader>(bytes) else {
        return false;
    };
    let Ok(robots) = split_frame_payload(&header, payload) else {
        return false;
    };
    let shape =
        Shape::new(header.height as usize, header.width as usize).expect("its frames were split");
    let is_good = |robot: &RobotSample<'_>| {
        let is_on_grid = shape.contains(robot.result.start());
        is_frame(shape, robot.frame) && is_on_grid && is_path(robot.path)
    };
    robots.iter().filter(|robot| is_good(robot)).count() == header.n_robots as usize
}

fn is_frame(shape: Shape, values: &[u8]) -> bool {
    let valid = |&value: &u8| value == UNOBSERVED || usize::from(value) < N_OBSERVATIONS;
    let decoded = Frame::from_bytes(shape, N_OBSERVATIONS, values);
    assert_eq!(decoded.is_ok(), values.iter().all(valid));
    decoded.is_ok_and(|frame| {
        assert_eq!(frame.as_bytes(), values);
        true
    })
}

fn is_path(bytes: &[u8]) -> bool {
    path_from_bytes(bytes).is_ok_and(|path| {
        assert_eq!(path_to_bytes(&path), bytes);
        true
    })
}

/// Checks that the belief and the plan in a sample of `agent` have the lengths that the header states.
pub fn outlook(bytes: &[u8]) -> bool {
    let Some((header, payload)) = split_header::<AgentHeader>(bytes) else {
        return false;
    };
    let payload = payload.to_vec();
    let Ok(outlook) = AgentBelief::try_from(&Sample { header, payload }) else {
        return false;
    };
    let dimensions = [header.n_states, header.height, header.width].map(|n| n as usize);
    assert_eq!(outlook.belief.shape(), dimensions);
    let is_probability = |p: &f32| (0.0..=1.0).contains(p);
    assert!(outlook.belief.iter().all(is_probability));
    true
}

/// Checks a reply on `control`.
pub fn control_reply(bytes: &[u8]) -> bool {
    let reply = survives::<Reply>(bytes);
    if let Some(Reply::Hello(info)) = &reply
        && let Ok(shape) = info.shape()
        && shape.n_cells() < 1 << 16
    {
        let _ = info.airspace();
    }
    reply.is_some_and(|reply| reply.status() == Status::Ok)
}

/// Parses a value, writes it and checks that it is unchanged when parsed again.
pub fn survives<T: Serialize + DeserializeOwned + PartialEq + Debug>(bytes: &[u8]) -> Option<T> {
    let value = parse::<T>(bytes).ok()?;
    let text = serde_json::to_vec(&value).expect("what was parsed is written");
    assert_eq!(parse::<T>(&text).as_ref(), Ok(&value));
    Some(value)
}
