//! Beliefs: published for displays, and left for a robot's next agent.

use crate::error::{Error, ErrorInfo, Outcome, guard, invalid};
use crate::handle::{array, duration, of, put, text};
use crate::lease::LeaseHandle;
use crate::server::{Core, Server};
use crate::view::{Texts, View};
use emberwatch_messages::agent_belief::{Intent as WireIntent, MAX_STATES};
use emberwatch_messages::left_belief;
use emberwatch_messages::message::{AgentHeader, Status, worlds_of};
use emberwatch_model::grid::Probabilities;
use emberwatch_protocol::agent_belief::BeliefPublisher;
use std::ffi::c_char;
use std::sync::PoisonError;

/// What a display shows about the agent behind a belief. Pointers may be NULL.
#[repr(C)]
#[derive(Default)]
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

fn intent_of(core: &Core, n_states: usize, given: &Intent) -> Outcome<WireIntent> {
    let words = |given: *const c_char| {
        if given.is_null() {
            return Ok(String::new());
        }
        let words = text("intent", given)?;
        if words.len() > 256 {
            return Err(invalid("intent", "texts of at most 256 bytes", words.len()));
        }
        Ok(words.to_owned())
    };
    if !given.plan_millis.is_finite() || given.plan_millis < 0.0 {
        return Err(invalid("plan_millis", "at least 0", given.plan_millis));
    }
    let states = if given.states.is_null() {
        core.state_names(n_states)
    } else {
        let names = array("states", given.states, n_states)?;
        names
            .iter()
            .map(|&name| words(name))
            .collect::<Outcome<_>>()?
    };
    Ok(WireIntent {
        policy: words(given.policy)?,
        belief_from: words(given.belief_from)?,
        objective: words(given.objective)?,
        states,
        plan_millis: given.plan_millis,
    })
}

/// Publishes a belief about a world after its last answer, for dashboards: n_states * H * W probabilities, state by
/// state. The robots of the world from `first_robot` on fly by it. The call does nothing without readers, and for
/// worlds in this process. `intent` may be NULL.
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
        if let Some(got) = numbers.iter().find(|p| !(0.0..=1.0).contains(*p)) {
            return Err(invalid("belief", "probabilities", got));
        }
        let Some(instance) = &core.instance else {
            return Ok(());
        };
        let publisher = core.publisher.lock();
        let mut publisher = publisher.unwrap_or_else(PoisonError::into_inner);
        let publisher = match &mut *publisher {
            Some(publisher) => publisher,
            // The intent is a few hundred bytes of text.
            none => {
                let n_bytes = size_of_val(numbers) + 1024;
                none.insert(BeliefPublisher::open(instance, n_bytes)?)
            }
        };
        if !publisher.is_watched() {
            return Ok(());
        }
        // SAFETY: the caller passes null or a pointer to an `ew_intent`.
        let intent = unsafe { intent.as_ref() };
        let intent = intent_of(core, dim.0, intent.unwrap_or(&Intent::default()))?;
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
        publisher.show(about, &belief, &intent)?;
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
        let (place, limit) = ((lease.number(), robot), duration("timeout", timeout)?);
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
        let limit = duration("timeout", timeout)?;
        let left = server
            .core
            .with(|backend| left_belief::load(backend, robot, None, limit))?;
        let Some(left) = left else {
            return Err(Error::new(Status::NotKept as i32, "no belief was left"));
        };
        let mut texts = Texts::default();
        let view = Left {
            kind: texts.add(&left.info.kind),
            bytes: left.bytes.as_ptr(),
            n_bytes: left.bytes.len(),
            seed: left.info.seed,
            episode: left.info.episode,
            step: left.info.step,
        };
        let view = Box::new(View::new(view, (texts, left)));
        put(out, view.pointer());
        server.keep(view);
        Ok(())
    })
}
