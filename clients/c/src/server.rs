//! Servers: running ones, and worlds in this process.

use crate::error::{Error, ErrorInfo, Outcome, guard, invalid};
use crate::fork::watch_forks;
use crate::handle::{duration, give, of, put, text};
use crate::info::{Info, InfoView, view_of};
use emberwatch_messages::backend::Backend;
use emberwatch_messages::control::ServerInfo;
use emberwatch_messages::errors::ErrorClass;
use emberwatch_messages::instance::Instance;
use emberwatch_protocol::Connection;
use emberwatch_protocol::agent_belief::BeliefPublisher;
use emberwatch_sim::embedded::Embedded;
use serde_json::{Map, Value};
use std::any::{Any, TypeId};
use std::collections::HashMap;
use std::ffi::{CString, c_char};
use std::ptr::{null, null_mut};
use std::sync::{Arc, Mutex, PoisonError};

/// A connection to a server, or worlds in this process. Threads may share it; requests run one after another.
pub struct Server {
    pub core: Arc<Core>,
    info: InfoView,
    /// The last reply of each type, to which C has pointers.
    kept: Mutex<HashMap<TypeId, Box<dyn Any + Send>>>,
}

/// What leases share with their server.
pub struct Core {
    pub info: ServerInfo,
    /// `None` for worlds in this process.
    pub instance: Option<Instance>,
    pub publisher: Mutex<Option<BeliefPublisher>>,
    worlds: Mutex<Box<dyn Backend + Send>>,
}

impl Core {
    pub fn with<R>(&self, request: impl FnOnce(&mut dyn Backend) -> R) -> R {
        let mut worlds = self.worlds.lock().unwrap_or_else(PoisonError::into_inner);
        request(&mut **worlds)
    }

    /// Returns names for the states of a belief: the model's, if it has as many and the server reveals them.
    pub fn state_names(&self, n_states: usize) -> Vec<String> {
        let names = self.info.revealed_model().map(|it| it.state_names());
        let names = names.filter(|names| names.len() == n_states);
        names.unwrap_or_else(|| (0..n_states).map(|it| format!("state {it}")).collect())
    }
}

impl Server {
    fn give(
        worlds: Box<dyn Backend + Send>,
        instance: Option<Instance>,
        to: *mut *mut Self,
    ) -> Outcome {
        let info = worlds.info().clone();
        let server = Self {
            info: view_of(&info),
            kept: Mutex::default(),
            core: Arc::new(Core {
                info,
                instance,
                publisher: Mutex::default(),
                worlds: Mutex::new(worlds),
            }),
        };
        give(server, to)
    }

    /// Keeps a reply until the next one of its type.
    pub fn keep<T: Send + 'static>(&self, reply: T) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.insert(TypeId::of::<T>(), Box::new(reply));
    }
}

/// Returns the version of the binary interface of this library. Compare it with EW_ABI once.
#[unsafe(no_mangle)]
pub extern "C" fn ew_abi() -> u32 {
    1
}

/// Returns the release of this library, such as "0.2.0".
#[unsafe(no_mangle)]
pub extern "C" fn ew_version() -> *const c_char {
    concat!(env!("CARGO_PKG_VERSION"), "\0").as_ptr().cast()
}

/// Attaches to the server of an instance ("default" if emberwatch-server got no name). `client` names this program in
/// the server's log. Waits up to `wait` seconds for a server that is still starting (0: fails at once with
/// EW_FAILURE_NO_SERVER), and up to `timeout` seconds for its answer.
#[unsafe(no_mangle)]
pub extern "C" fn ew_attach(
    instance: *const c_char,
    client: *const c_char,
    wait: f64,
    timeout: f64,
    out: *mut *mut Server,
    error: *mut ErrorInfo,
) -> i32 {
    guard(error, || {
        put(out, null_mut());
        let instance = Instance::new(text("instance", instance)?)?;
        let client = text("client", client)?;
        watch_forks();
        let limits = (duration("wait", wait)?, duration("timeout", timeout)?);
        let connection = Connection::open_within(&instance, client, limits, |_| true)?;
        Server::give(Box::new(connection), Some(instance), out)
    })
}

/// Starts worlds inside this process. `settings` is TOML with the keys of config/server.toml, one a line, such as
/// "worlds = 4\nseed = 7"; "" gives the defaults. Starts threads, whose number the setting `threads` limits.
#[unsafe(no_mangle)]
pub extern "C" fn ew_embed(
    settings: *const c_char,
    out: *mut *mut Server,
    error: *mut ErrorInfo,
) -> i32 {
    guard(error, || {
        put(out, null_mut());
        let given: Map<String, Value> = toml::from_str(text("settings", settings)?)
            .map_err(|error| Error::of_class(ErrorClass::Invalid, error))?;
        watch_forks();
        let worlds = Embedded::open(given);
        let worlds = worlds.map_err(|error| Error::of_class(error.class(), error))?;
        Server::give(Box::new(worlds), None, out)
    })
}

/// Returns the settings of the server: shapes, names, the model. They never change, and live as long as the handle.
/// NULL if `server` is no server of this process.
#[unsafe(no_mangle)]
pub extern "C" fn ew_info_of(server: *mut Server) -> *const Info {
    of(server).map_or(null(), |server| server.info.pointer())
}

/// Sends a control request as JSON (PROTOCOL.md section 6), for requests that have no function here: snapshot, shutdown,
/// and restore and fork, with the `lease` of an ew_answer, after which you call ew_observe. The reply lives until the
/// next ew_control of this server.
#[unsafe(no_mangle)]
pub extern "C" fn ew_control(
    server: *mut Server,
    request: *const c_char,
    timeout: f64,
    reply: *mut *const c_char,
    error: *mut ErrorInfo,
) -> i32 {
    guard(error, || {
        let (server, request) = (of(server)?, text("request", request)?.as_bytes());
        let limit = duration("timeout", timeout)?;
        let answer = CString::new(server.core.with(|it| it.control_text(request, limit))?);
        let answer = answer.map_err(|error| Error::of_class(ErrorClass::BadAnswer, error))?;
        put(reply, answer.as_ptr());
        server.keep(answer);
        Ok(())
    })
}

/// Returns the hidden states of a world in this process, H * W bytes, if the setting `publish_truth` is true. They live
/// until the next ew_states of this server. For evaluation and pictures, never for learners.
#[unsafe(no_mangle)]
pub extern "C" fn ew_states(
    server: *mut Server,
    world: u32,
    states: *mut *const u8,
    error: *mut ErrorInfo,
) -> i32 {
    guard(error, || {
        let server = of(server)?;
        let n_worlds = server.core.info.n_worlds;
        if world >= n_worlds {
            return Err(invalid("world", format!("0 to {}", n_worlds - 1), world));
        }
        let truths = server.core.with(|it| it.truths(world..world + 1))?;
        let found: Vec<u8> = truths.into_iter().flat_map(|(_, grid)| grid).collect();
        put(states, found.as_ptr());
        server.keep(found);
        Ok(())
    })
}
