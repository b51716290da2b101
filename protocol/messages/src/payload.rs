//! The payloads of steps and frames: converts bytes to results, frames and paths, and back.

use super::capacity::MAX_ROBOTS;
use super::control::ServerInfo;
use super::message::{
    FLAG_TEAM_FRAMES, FrameHeader, RobotResult, StepReply, TruthHeader, WorldResult,
};
use super::sample::Sample;
use bytemuck::AnyBitPattern;
use emberwatch_model::frame::UNOBSERVED;
use emberwatch_model::grid::{Grid, Shape};
use emberwatch_model::path::MAX_MOVES;

/// Size of one [`WorldResult`] in a payload in bytes.
pub const WORLD_BYTES: usize = size_of::<WorldResult>();

/// Size of one [`RobotResult`] in a payload in bytes.
pub const ROBOT_BYTES: usize = size_of::<RobotResult>();

#[derive(Debug, Clone, PartialEq)]
pub struct StepParts<'a> {
    pub worlds: Vec<WorldResult>,
    pub robots: Vec<RobotResult>,
    /// Frames of `height * width` bytes: one per robot, or one per world with [`FLAG_TEAM_FRAMES`].
    pub frames: &'a [u8],
}

/// The payload of a sample on `frames`: the robots of a world, in order.
pub type FrameParts<'a> = Vec<RobotSample<'a>>;

/// The part of a sample on `frames` that is about one robot.
#[derive(Debug, Clone, PartialEq)]
pub struct RobotSample<'a> {
    pub result: RobotResult,
    /// The robot's frame, `height * width` bytes.
    pub frame: &'a [u8],
    /// The path that the robot flew, one byte per move; empty if it did not fly.
    pub path: &'a [u8],
}

impl StepParts<'_> {
    /// Checks that only existing robots are marked as having stayed, that paths are complete, and that frames contain
    /// only valid observations.
    ///
    /// # Errors
    /// Describes the first wrong value.
    pub fn check(&self, info: &ServerInfo) -> Result<(), String> {
        let n_robots = info.n_robots.clamp(1, MAX_ROBOTS as u32) as usize;
        let stayed = self.worlds.iter().map(|world| world.hovered | world.late);
        let stayed = stayed.max().unwrap_or_default();
        if stayed > u64::MAX >> (MAX_ROBOTS - n_robots) {
            return Err(format!(
                "robots that stayed: expected bits below {n_robots}, got {stayed:#x}"
            ));
        }
        let mut paths = self.robots.iter().map(|robot| robot.n_moves as usize);
        if let Some(got) = paths.find(|&n_moves| n_moves != 0 && n_moves != info.n_moves) {
            let expected = info.n_moves;
            return Err(format!("n_moves: expected 0 or {expected}, got {got}"));
        }
        // With 255 mapped to 0 and observation o to o + 1, one vectorised maximum checks all values.
        let values = self.frames.iter().map(|value| value.wrapping_add(1));
        let highest = values.fold(0, u8::max);
        if usize::from(highest) > info.n_observations {
            let (n, got) = (info.n_observations, highest - 1);
            return Err(format!(
                "frame: expected observations below {n} or {UNOBSERVED}, got {got}"
            ));
        }
        Ok(())
    }
}

/// Splits the payload of a step answer.
///
/// # Errors
/// Returns the expected number of bytes if the payload's length differs from it.
pub fn split_step_payload<'a>(
    reply: &StepReply,
    payload: &'a [u8],
) -> Result<StepParts<'a>, usize> {
    let (n_worlds, n_robots) = (reply.n_worlds as usize, reply.n_robots as usize);
    let n_frames = match reply.flags & FLAG_TEAM_FRAMES {
        0 => n_robots,
        _ => n_worlds,
    };
    let n_cells = (reply.height as usize).saturating_mul(reply.width as usize);
    let expected = (n_worlds * WORLD_BYTES + n_robots * ROBOT_BYTES)
        .saturating_add(n_cells.saturating_mul(n_frames));
    if payload.len() != expected {
        return Err(expected);
    }
    let (worlds, rest) = payload.split_at(n_worlds * WORLD_BYTES);
    let (robots, frames) = rest.split_at(n_robots * ROBOT_BYTES);
    Ok(StepParts {
        worlds: read_all(worlds),
        robots: read_all(robots),
        frames,
    })
}

/// Splits the payload of a sample on `frames`.
///
/// # Errors
/// If the payload does not fit the header. The error contains the expected value.
pub fn split_frame_payload<'a>(
    header: &FrameHeader,
    payload: &'a [u8],
) -> Result<FrameParts<'a>, String> {
    let shape = Shape::new(header.height as usize, header.width as usize);
    let n_cells = shape.map_err(|error| error.to_string())?.n_cells();
    let n_robots = header.n_robots as usize;
    if !(1..=MAX_ROBOTS).contains(&n_robots) {
        return Err(format!(
            "robots: expected 1 to {MAX_ROBOTS}, got {n_robots}"
        ));
    }
    let stayed = header.result.hovered | header.result.late;
    if stayed > u64::MAX >> (MAX_ROBOTS - n_robots) {
        return Err(format!(
            "robots that stayed: expected bits below {n_robots}, got {stayed:#x}"
        ));
    }
    let wrong_length = |expected: usize| {
        let got = payload.len();
        format!("payload bytes: expected {expected}, got {got}")
    };
    let fixed = n_robots * (ROBOT_BYTES + n_cells);
    let (results, rest) = payload
        .split_at_checked(n_robots * ROBOT_BYTES)
        .filter(|_| payload.len() >= fixed)
        .ok_or_else(|| wrong_length(fixed))?;
    let (frames, mut paths) = rest.split_at(n_robots * n_cells);
    let results: Vec<RobotResult> = read_all(results);
    let n_moves: usize = results.iter().map(|result| result.n_moves as usize).sum();
    if paths.len() != n_moves {
        return Err(wrong_length(fixed.saturating_add(n_moves)));
    }
    let robots = results.into_iter().zip(frames.chunks_exact(n_cells));
    robots
        .map(|(result, frame)| {
            let (path, others) = paths.split_at(result.n_moves as usize);
            paths = others;
            if path.len() > MAX_MOVES {
                let got = path.len();
                return Err(format!(
                    "path: expected at most {MAX_MOVES} moves, got {got}"
                ));
            }
            Ok(RobotSample {
                result,
                frame,
                path,
            })
        })
        .collect()
}

/// Returns the hidden states in a sample on `truth`.
///
/// # Errors
/// If the payload does not fit the header. The error contains the expected value.
pub fn truth_states(sample: &Sample<TruthHeader>) -> Result<Grid<u8>, String> {
    let header = &sample.header;
    let shape = Shape::new(header.height as usize, header.width as usize);
    let shape = shape.map_err(|error| error.to_string())?;
    let (expected, got) = (shape.n_cells(), sample.payload.len());
    let states = Grid::from_shape_vec(shape.dim(), sample.payload.clone());
    states.map_err(|_| format!("payload bytes: expected {expected}, got {got}"))
}

/// Appends the payload of a `Step` request: the steps, then the paths. Without paths, this is the payload of a
/// `Recall`.
pub fn write_step_body(steps: &[u64], paths: &[u8], body: &mut Vec<u8>) {
    body.extend_from_slice(bytemuck::cast_slice(steps));
    body.extend_from_slice(paths);
}

fn read_all<T: AnyBitPattern>(bytes: &[u8]) -> Vec<T> {
    let each = bytes.chunks_exact(size_of::<T>());
    each.map(bytemuck::pod_read_unaligned).collect()
}
