//! The messages of decisions: an external learner decides the objective of the next path in each world, the agent
//! estimates, plans, describes its plans and steps. JSON text both ways, behind the headers of `control`.

use super::control::WorldSeed;
use super::message::Status;
use serde::{Deserialize, Serialize};

/// What a learner asks an agent.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "op", rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// Handshake: which agent is this, and which protocol version does it speak?
    Hello {
        /// The learner's protocol version.
        protocol: u32,
        /// The learner's name and version, for the agent's log.
        client: String,
    },
    /// Start new episodes with new beliefs in some worlds; answered when burn-in is done.
    Reset {
        /// The worlds and their seeds.
        worlds: Vec<WorldSeed>,
    },
    /// Fly the paths planned for objectives, correct the beliefs with the frames, plan again.
    Decide {
        /// One for each world: its position among [`AgentInfo::objectives`], or `None` to leave the world as it is.
        objectives: Vec<Option<u64>>,
    },
    /// What did the last decisions give? Changes nothing.
    // A variant with braces: serde refuses unknown keys of it, but not of a unit variant.
    Last {},
    /// Release the worlds and end the agent.
    Shutdown {},
}

/// What the agent answers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "reply", rename_all = "snake_case")]
pub enum Reply {
    /// To `hello`.
    Hello(Box<AgentInfo>),
    /// To `reset`, `decide` and `last`.
    Decisions {
        /// Every world of the agent, in order.
        worlds: Vec<Decision>,
    },
    /// To `shutdown`.
    Done,
    /// To anything that was refused.
    Error {
        /// Reason for programs.
        status: Status,
        /// See [`Status`].
        detail: u64,
        /// Reason for people.
        message: String,
    },
}

/// The handshake: everything a learner needs to know to decide.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AgentInfo {
    /// The agent's protocol version.
    pub protocol: u32,
    /// The agent's release.
    pub build: String,
    /// The agent's process.
    pub pid: u32,
    /// The PID namespace of this number, as Linux numbers it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pid_namespace: Option<u64>,
    /// The instance of its server.
    pub instance: String,
    /// The first world it acts on.
    pub first_world: u32,
    /// Number of worlds it acts on.
    pub n_worlds: u32,
    /// Grid height H.
    pub height: usize,
    /// Grid width W.
    pub width: usize,
    /// Moves in a path.
    pub n_moves: usize,
    /// Episode length; 0: never truncated.
    pub max_steps: u64,
    /// Names of the states.
    pub states: Vec<String>,
    /// Names of the objectives, which are whole plans.
    pub objectives: Vec<String>,
    /// What keeps the belief, such as `known_model`.
    pub estimator: String,
    /// Names of the numbers that describe the plan for an objective; see [`Decision::features`].
    pub features: Vec<String>,
}

/// A world and the agent's belief after its last decision or reset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Decision {
    /// Step index k; 0 after a reset.
    pub step: u64,
    /// Sum of rewards over the distinct visited cells.
    pub reward: f64,
    /// Cells of the whole grid in the state that pays most; for reports, not for learners.
    pub n_target_cells: u32,
    /// Distinct cells visited by the path.
    pub n_visited: u32,
    /// Distinct visited cells in the state that pays most.
    pub n_hits: u32,
    /// The robot's `[row, col]`.
    pub robot: [u32; 2],
    /// Whether the episode ended by itself.
    pub terminated: bool,
    /// Whether the episode reached the server's `max_steps`: reset before the next decision.
    pub truncated: bool,
    /// Seed of the episode; with the model it gives the hidden state away: not for learners.
    pub seed: u64,
    /// Resets of this world since the server started.
    pub episode: u64,
    /// The objective decided for; `None` after a reset, and before this agent's first decision.
    pub objective: Option<u64>,
    /// What the next plans promise: 32-bit floats, little-endian, in base64; for each of [`AgentInfo::objectives`] the
    /// numbers that [`AgentInfo::features`] names.
    pub features: String,
}

impl Reply {
    /// A refusal with its standard sentence.
    pub fn refusal(status: Status, detail: u64) -> Self {
        Self::Error {
            status,
            detail,
            message: status.explain(detail),
        }
    }

    /// The status for the binary header.
    pub fn status(&self) -> Status {
        match self {
            Self::Error { status, .. } => *status,
            _ => Status::Ok,
        }
    }
}
