//! The state of a server's worlds.

use crate::error::{ErrorInfo, guard};
use crate::handle::{duration, of, put};
use crate::server::Server;
use emberwatch_messages::control::{Reply, Request, WorldStatus};
use emberwatch_messages::errors::unexpected;

/// The state of one world.
#[repr(C)]
pub struct WorldReport {
    /// The step k.
    pub step: u64,
    /// Seed of the episode.
    pub seed: u64,
    /// Resets since the server started.
    pub episode: u64,
    /// Robots that a client holds.
    pub n_held: u32,
    /// Robots that have a path for the next step.
    pub n_paths: u32,
    /// The world is being reset.
    pub resetting: bool,
}

impl From<&WorldStatus> for WorldReport {
    fn from(world: &WorldStatus) -> Self {
        Self {
            step: world.info.step,
            seed: world.info.seed,
            episode: world.info.episode,
            n_held: world.holder_pids.iter().flatten().count() as u32,
            n_paths: world.n_paths,
            resetting: world.resetting,
        }
    }
}

/// Asks for the state of all worlds, as many as `n_worlds` of ew_info. It lives until the next ew_status_of of this
/// server. The request `status` of ew_control also tells clients, holders and speed.
#[unsafe(no_mangle)]
pub extern "C" fn ew_status_of(
    server: *mut Server,
    timeout: f64,
    worlds: *mut *const WorldReport,
    error: *mut ErrorInfo,
) -> i32 {
    guard(error, || {
        let (server, limit) = (of(server)?, duration("timeout", timeout)?);
        let request = Request::Status {};
        let reply = server.core.with(|it| it.control(&request, limit))?;
        let Reply::Status(status) = reply else {
            return Err(unexpected("status", &reply).into());
        };
        let reports: Vec<WorldReport> = status.worlds.iter().map(WorldReport::from).collect();
        put(worlds, reports.as_ptr());
        server.keep(reports);
        Ok(())
    })
}
