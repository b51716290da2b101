//! The settings of a server as C structs.

use crate::view::{Texts, View};
use emberwatch_messages::control::ServerInfo;
use std::ffi::c_char;
use std::ptr::null;

/// The settings of a server.
#[repr(C)]
pub struct Info {
    /// The server's process.
    pub pid: u32,
    /// Rows of the grid, H.
    pub height: u32,
    /// Columns of the grid, W.
    pub width: u32,
    /// Moves of a path.
    pub n_moves: u32,
    /// Worlds.
    pub n_worlds: u32,
    /// Robots of each world, R. Robot r of world w has the number w R + r.
    pub n_robots: u32,
    /// Values in frames are below this number, or 255 where nothing was observed.
    pub n_observations: u32,
    /// States of the model, S; 0 if the server hides it.
    pub n_states: u32,
    /// Names of the observations.
    pub observations: *const *const c_char,
    /// Names of the states; NULL if hidden.
    pub states: *const *const c_char,
    /// Reward of a cell in each state; NULL if hidden.
    pub rewards: *const f64,
    /// 1 for each cell closed to robots, H W bytes; NULL if there are none.
    pub no_fly: *const u8,
    /// The model as TOML; NULL if hidden, or if the worlds are recorded.
    pub model: *const c_char,
    /// Release of the server.
    pub build: *const c_char,
    /// The task that defines the worlds; NULL without one.
    pub task: *const c_char,
    /// Identifies the worlds, 16 hexadecimal digits; NULL from old servers.
    pub worlds_fingerprint: *const c_char,
    /// Length of an episode; 0: never truncated.
    pub max_steps: u64,
    /// Time that a world waits for late paths, milliseconds; 0: no deadline.
    pub deadline_millis: u64,
    /// Rows and columns that robots see beyond the cells of their path.
    pub radius: u32,
    /// Frames show 0: the path, 1: every cell, 2: the path, or every cell with EW_FULL_COVERAGE.
    pub coverage: u32,
    /// Hidden states are published.
    pub publish_truth: bool,
}

pub type InfoView = View<Info, (Texts, Option<Vec<f64>>, Option<Vec<u8>>)>;

pub fn view_of(info: &ServerInfo) -> InfoView {
    let airspace = info.airspace.as_ref();
    let no_fly = airspace.and_then(|it| it.no_fly.as_ref());
    let no_fly = no_fly.map(|rows| rows.concat());
    let model = info.revealed_model();
    let rewards = model.as_ref().map(|it| it.reward().to_vec());
    let mut texts = Texts::default();
    let view = Info {
        pid: info.pid,
        height: info.height as u32,
        width: info.width as u32,
        n_moves: info.n_moves as u32,
        n_worlds: info.n_worlds,
        n_robots: info.n_robots,
        n_observations: info.n_observations as u32,
        n_states: rewards.as_ref().map_or(0, |it| it.len() as u32),
        observations: texts.add_all(&info.observations),
        states: model.map_or(null(), |it| texts.add_all(&it.state_names())),
        rewards: rewards.as_ref().map_or(null(), |it| it.as_ptr()),
        no_fly: no_fly.as_ref().map_or(null(), |it| it.as_ptr()),
        model: info.model.as_ref().map_or(null(), |it| texts.add(it)),
        build: texts.add(&info.build),
        task: info.task.as_ref().map_or(null(), |it| texts.add(it)),
        worlds_fingerprint: info
            .worlds_fingerprint
            .as_ref()
            .map_or(null(), |it| texts.add(it)),
        max_steps: info.max_steps,
        deadline_millis: info.deadline_millis,
        radius: airspace.map_or(0, |it| it.radius as u32),
        coverage: info.coverage as u32,
        publish_truth: info.publish_truth,
    };
    View::new(view, (texts, rewards, no_fly))
}
