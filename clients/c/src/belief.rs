//! Beliefs: published for displays, and left for a robot's next agent.

use crate::error::{Error, ErrorInfo, Outcome, guard, invalid};
use crate::handle::{array, duration, of, text};
use crate::lease::LeaseHandle;
use crate::server::{Core, Server};
use crate::view::{Texts, View, keep};
use emberwatch_messages::agent_belief::{Intent as WireIntent, MAX_STATES};
use emberwatch_messages::left_belief::{self, LeftBelief};
use emberwatch_messages::message::{AgentHeader, Status, worlds_of};
use emberwatch_model::grid::Probabilities;
use emberwatch_protocol::agent_belief::BeliefPublisher;
use std::collections::HashMap;
use std::ffi::c_char;
use std::sync::PoisonError;
use std::time::{Duration, Instant};

/// Minimum time between two beliefs about the same robot: displays need no higher rate, and each costs a copy.
const INTERVAL: Duration = Duration::from_millis(20);

/// What a display shows about the agent behind a belief. Pointers may be NULL.
#[repr(C)]
pub struct Intent {
    /// Name of the policy.
    pub policy: *const c_char,
    /// What computed the belief.
    pub belief_from: *const c_char,
    /// What the last path was planned for.
    pub objective: *const c_char,
    /// Names of the belief's states, as many as the belief has; NULL: the model's.
    pub states: *const *const c_char,
    /// Time taken to plan the path.
    pub plan_millis: f64,
}

/// A belief that another agent left.
#[repr(C)]
pub struct Left {
    /// What the bytes are.
    pub kind: *const c_char,
    /// The bytes.
    pub bytes: *const u8,
    /// Their number.
    pub n_bytes: usize,
    /// Seed of the episode.
    pub seed: u64,
    /// The episode.
    pub episode: u64,
    /// The step k that the belief is about.
    pub step: u64,
}

pub type LeftView = View<Left, (Texts, LeftBelief)>;

/// The beliefs that the leases of one server publish.
pub struct Publisher {
    channel: BeliefPublisher,
    /// When a belief about each first robot was last published.
    shown: HashMap<u32, Instant>,
}

impl Publisher {
    fn is_due(&self, robot: u32) -> bool {
        let shown = self.shown.get(&robot);
        self.channel.is_watched() && shown.is_none_or(|shown| shown.elapsed() >= INTERVAL)
    }
}

impl Drop for Publisher {
    /// Gives readers time to receive the last belief.
    fn drop(&mut self) {
        if !self.shown.is_empty() && self.channel.is_watched() {
            std::thread::sleep(INTERVAL);
        }
    }
}

/// Converts what C says about a belief of `n_states` states.
fn intent_of(core: &Core, n_states: usize, given: Option<&Intent>) -> Outcome<WireIntent> {
    let words = |of: fn(&Intent) -> *const c_char| match given.map(of) {
        Some(given) if !given.is_null() => text("intent", given).map(String::from),
        _ => Ok(String::new()),
    };
    let states = match given.map(|it| it.states).filter(|it| !it.is_null()) {
        Some(names) => array("states", names, n_states)?
            .iter()
            .map(|&name| text("states", name).map(String::from))
            .collect::<Outcome<Vec<_>>>()?,
        None => core.state_names(n_states),
    };
    Ok(WireIntent {
        policy: words(|it| it.policy)?,
        belief_from: words(|it| it.belief_from)?,
        objective: words(|it| it.objective)?,
        states,
        plan_millis: given.map_or(0.0, |it| it.plan_millis),
    })
}

/// Publishes a belief about a world after its last answer, for dashboards: n_states * H * W probabilities, state by
/// state. The robots of the world from `first_robot` on fly by it. The call does nothing without readers, within 20 ms
/// of the last belief about `first_robot`, and for worlds in this process. `intent` may be NULL.
#[unsafe(no_mangle)]
pub extern "C" fn ew_publish_belief(
    lease: *mut LeaseHandle,
    first_robot: u32,
    n_robots: u32,
    belief: *const f32,
    n_states: u32,
    intent: *const Intent,
    error: *mut ErrorInfo,
) -> i32 {
    guard(error, || {
        let lease = of(lease)?;
        let (world, result) = lease.last_result(first_robot)?;
        let (core, end) = (&lease.core, first_robot.saturating_add(n_robots));
        let info = &core.info;
        if n_robots == 0 || worlds_of(first_robot, n_robots, info.n_robots) != (world..world + 1) {
            let expected = format!("robots of one world, {} a world", info.n_robots);
            return Err(invalid("robots", expected, format!("{first_robot}..{end}")));
        }
        if !(1..=MAX_STATES).contains(&n_states) {
            return Err(invalid("n_states", format!("1 to {MAX_STATES}"), n_states));
        }
        let dim = (n_states as usize, info.height, info.width);
        let numbers = array("belief", belief, dim.0 * dim.1 * dim.2)?;
        let Some(instance) = &core.instance else {
            return Ok(());
        };
        let mut publisher = core
            .publisher
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        if publisher.is_none() {
            let n_bytes = size_of_val(numbers) + 1024; // The intent is a few hundred bytes of text.
            *publisher = Some(Publisher {
                channel: BeliefPublisher::open(instance, n_bytes)?,
                shown: HashMap::new(),
            });
        }
        let Some(publisher) = publisher.as_mut().filter(|it| it.is_due(first_robot)) else {
            return Ok(());
        };
        // SAFETY: the caller passes null or a pointer to an `ew_intent`.
        let intent = intent_of(core, dim.0, unsafe { intent.as_ref() })?;
        let about = AgentHeader {
            world,
            episode: result.episode,
            step: result.step,
            seed: result.seed,
            first_robot,
            n_robots,
            ..AgentHeader::default()
        };
        let belief = Probabilities::from_shape_vec(dim, numbers.to_vec());
        let belief = belief.expect("invariant: as many numbers as cells");
        publisher.channel.show(about, &belief, &intent)?;
        publisher.shown.insert(first_robot, Instant::now());
        Ok(())
    })
}

/// Leaves bytes with the server, such as a belief, for the next agent that flies this robot from its present step.
/// `kind` describes them in at most 256 bytes.
#[unsafe(no_mangle)]
pub extern "C" fn ew_leave_belief(
    lease: *mut LeaseHandle,
    robot: u32,
    kind: *const c_char,
    bytes: *const u8,
    n_bytes: usize,
    timeout: f64,
    error: *mut ErrorInfo,
) -> i32 {
    guard(error, || {
        let lease = of(lease)?;
        let (_, at) = lease.last_result(robot)?;
        let (kind, bytes) = (text("kind", kind)?, array("bytes", bytes, n_bytes)?);
        let (place, limit) = ((lease.number(), robot), duration(timeout));
        Ok(lease
            .core
            .with(|backend| left_belief::leave(backend, place, &at, kind, bytes, limit))?)
    })
}

/// Returns the belief that the last agent of a robot left for the world's present step; EW_STATUS_NOT_KEPT if there is
/// none. It lives until the next ew_left_belief of this server.
#[unsafe(no_mangle)]
pub extern "C" fn ew_left_belief(
    server: *mut Server,
    robot: u32,
    timeout: f64,
    out: *mut *const Left,
    error: *mut ErrorInfo,
) -> i32 {
    guard(error, || {
        let server = of(server)?;
        let limit = duration(timeout);
        let left = server
            .core
            .with(|backend| left_belief::load(backend, robot, None, limit))?;
        let Some(left) = left else {
            return Err(Error::new(Status::NotKept as i32, "no belief was left"));
        };
        let mut texts = Texts::default();
        let kind = texts.add(&left.info.kind);
        let view = View::new((texts, left), |(_, left)| Left {
            kind,
            bytes: left.bytes.as_ptr(),
            n_bytes: left.bytes.len(),
            seed: left.info.seed,
            episode: left.info.episode,
            step: left.info.step,
        });
        keep(&mut server.kept().left, view, out);
        Ok(())
    })
}
