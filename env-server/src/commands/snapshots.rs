//! `snapshot`, `restore` and `fork`: save, replace and copy worlds.

use anyhow::{Result, bail};
use clap::Args;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::client::Claim;
use emberwatch_protocol::control::{Reply, Request, WorldInfo};
use emberwatch_protocol::{Client, Connection};
use emberwatch_sim::snapshot::read;
use std::path::PathBuf;
use std::time::Duration;

/// How long to wait for the server. This is long, because files may be large and worlds may be in their burn-in.
const TIMEOUT: Duration = Duration::from_secs(120);

/// Writes worlds to a file. This needs no lease.
#[derive(Args)]
pub struct SnapshotCommand {
    /// The file to write
    file: PathBuf,
    /// The server's instance name
    #[arg(long, default_value = "default")]
    instance: String,
    /// The first world to write
    #[arg(long, default_value_t = 0)]
    first_world: u32,
    /// Number of worlds to write [default: the first world and all later ones]
    #[arg(long)]
    worlds: Option<u32>,
}

/// Replaces worlds of a server with worlds from a file.
#[derive(Args)]
pub struct RestoreCommand {
    /// The file to read
    file: PathBuf,
    /// The server's instance name
    #[arg(long, default_value = "default")]
    instance: String,
    /// The first world to replace
    #[arg(long, default_value_t = 0)]
    first_world: u32,
    /// The first of the file's worlds to read
    #[arg(long, default_value_t = 0)]
    from: u32,
    /// Number of worlds to read [default: the first one and all later ones in the file]
    #[arg(long)]
    worlds: Option<u32>,
    /// Take over robots that other clients hold
    #[arg(long)]
    takeover: bool,
}

/// Replaces a world with a copy of another world.
#[derive(Args)]
pub struct ForkCommand {
    /// The world to copy
    from: u32,
    /// The world to replace
    to: u32,
    /// The server's instance name
    #[arg(long, default_value = "default")]
    instance: String,
    /// Take over robots of the replaced world that other clients hold
    #[arg(long)]
    takeover: bool,
}

impl SnapshotCommand {
    pub fn run(&self) -> Result<()> {
        let mut server = connect(&self.instance)?;
        let rest = server.info().n_worlds.saturating_sub(self.first_world);
        let request = Request::Snapshot {
            first_world: self.first_world,
            n_worlds: self.worlds.unwrap_or(rest),
            path: absolute(&self.file)?,
        };
        match server.control(&request, TIMEOUT)? {
            Reply::Snapshot {
                path,
                n_bytes,
                worlds,
            } => {
                let n_worlds = worlds.len();
                tracing::info!(path, n_worlds, n_bytes, "written");
                Ok(())
            }
            other => bail!("expected a snapshot, got {other:?}"),
        }
    }
}

impl RestoreCommand {
    pub fn run(&self) -> Result<()> {
        // Reads the file first, so that a wrong file is refused before any robot is taken over.
        let in_file = read(&self.file)?.worlds.len() as u32;
        let Some(rest) = in_file.checked_sub(self.from).filter(|rest| *rest > 0) else {
            bail!(
                "--from: expected a world below {in_file}, the number in the file, got {}",
                self.from
            );
        };
        let (first_world, n_worlds) = (self.first_world, self.worlds.unwrap_or(rest));
        let path = absolute(&self.file)?;
        replace(
            connect(&self.instance)?,
            first_world..first_world.saturating_add(n_worlds),
            self.takeover,
            |lease| Request::Restore {
                lease,
                first_world,
                n_worlds,
                from: self.from,
                path,
            },
        )
    }
}

impl ForkCommand {
    pub fn run(&self) -> Result<()> {
        let (from, to) = (self.from, self.to);
        replace(
            connect(&self.instance)?,
            to..to.saturating_add(1),
            self.takeover,
            |lease| Request::Fork { lease, from, to },
        )
    }
}

/// Acquires a temporary lease on all robots of the worlds and sends a request that replaces these worlds.
fn replace(
    server: Connection,
    worlds: std::ops::Range<u32>,
    takeover: bool,
    request: impl FnOnce(u64) -> Request,
) -> Result<()> {
    let team = server.info().n_robots;
    let claim = Claim {
        robots: worlds.start.saturating_mul(team)..worlds.end.saturating_mul(team),
        takeover,
        time_to_live: Some(TIMEOUT),
    };
    let mut client = Client::acquire(server, &claim)?;
    let request = request(client.lease());
    let replaced = client.backend().control(&request, TIMEOUT);
    client.release()?;
    let Reply::Restored { worlds } = replaced? else {
        bail!("expected a reply to the replacement of worlds, got another one");
    };
    for WorldInfo {
        world,
        step,
        seed,
        episode,
        ..
    } in worlds
    {
        tracing::info!(world, step, seed, episode, "replaced");
    }
    Ok(())
}

fn connect(instance: &str) -> Result<Connection> {
    Ok(Connection::open(
        &Instance::new(instance)?,
        "emberwatch-server",
        TIMEOUT,
    )?)
}

/// Makes a path absolute, because the server may run in another folder.
fn absolute(path: &PathBuf) -> Result<String> {
    let absolute = std::path::absolute(path)?;
    match absolute.to_str() {
        Some(path) => Ok(path.into()),
        None => bail!("expected a file name in UTF-8, got {}", path.display()),
    }
}
