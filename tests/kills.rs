//! Programs that are killed at any moment of their start or end: the next ones find nothing in their way.

use crate::harness::{PATIENCE, Program, Server, new_instance, status};
use protocol::Connection;
use protocol::channels::{ChannelError, Instance, SHARED_MEMORY};
use protocol::connection::ConnectionError;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rustix::process::Signal;
use std::collections::HashSet;
use std::ops::Range;
use std::path::PathBuf;
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// A small server that is ready at once.
pub const FLAGS: [&str; 8] = [
    "--burn-in",
    "0",
    "--height",
    "8",
    "--width",
    "8",
    "--moves",
    "4",
];

/// How many are killed in one of the loops.
#[derive(Clone, Copy)]
pub struct Kills {
    /// Servers, 1 to 60 ms after they were started.
    pub starts: usize,
    /// Servers, 0 to 20 ms after they were told to stop.
    pub ends: usize,
    /// Clients and observers of a running server, 1 to 30 ms after they were started.
    pub connects: usize,
}

/// What such loops left.
#[derive(Default)]
pub struct Left {
    /// Instances that were used.
    pub instances: Vec<Instance>,
    /// Processes that were killed.
    pub killed: HashSet<u32>,
}

/// Kills in loops at once.
pub fn kill_in_loops(n_loops: u64, kills: Kills) -> Left {
    let mut left = Left::default();
    std::thread::scope(|scope| {
        let loops: Vec<_> = (0..n_loops)
            .map(|seed| scope.spawn(move || kill_in_loop(seed, kills)))
            .collect();
        for one in loops {
            let one = one.join().expect("a loop");
            left.instances.extend(one.instances);
            left.killed.extend(one.killed);
        }
    });
    left
}

fn kill_in_loop(seed: u64, kills: Kills) -> Left {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let instances: Vec<Instance> = (0..10).map(|_| new_instance()).collect();
    let running = Server::start_with(&new_instance(), &FLAGS);
    let folder = TempDir::new().expect("a folder");
    let mut killed = HashSet::new();
    let (mut starts, mut ends, mut connects) = (kills.starts, kills.ends, kills.connects);
    while starts + ends + connects > 0 {
        let chosen = rng.random_range(0..starts + ends + connects);
        let instance = &instances[rng.random_range(0..instances.len())];
        if chosen < starts {
            starts -= 1;
            let server = Server::start_without_waiting(instance, &FLAGS);
            killed.insert(kill_after(server.program, &mut rng, 1..60_000));
        } else if chosen < starts + ends {
            ends -= 1;
            let server = Server::start_without_waiting(instance, &FLAGS);
            server.program.wait_for_words("serving", PATIENCE);
            server.program.signal(Signal::TERM);
            killed.insert(kill_after(server.program, &mut rng, 0..20_000));
        } else {
            connects -= 1;
            let program = connect(&running.instance, &folder, rng.random_range(0..3));
            killed.insert(kill_after(program, &mut rng, 1..30_000));
        }
    }
    assert!(status(&running.instance).is_ok(), "the others' server");
    Left { instances, killed }
}

/// A client, an observer, or one that acts.
fn connect(instance: &Instance, folder: &TempDir, kind: u32) -> Program {
    let name = instance.name();
    let file = folder.path().join("recording").display().to_string();
    match kind {
        0 => Program::start("emberwatch-server", &["status", "--instance", name]),
        1 => {
            let flags = ["record", "--force", "--instance", name, "--out", &file];
            Program::start("emberwatch-server", &flags)
        }
        _ => {
            let flags = [
                "run",
                "--takeover",
                "--policy",
                "coverage",
                "--instance",
                name,
            ];
            Program::start("emberwatch-agent", &flags)
        }
    }
}

/// Kills a program some microseconds from now; returns its process id.
fn kill_after(program: Program, rng: &mut ChaCha8Rng, micros: Range<u64>) -> u32 {
    let pid = program.pid();
    std::thread::sleep(Duration::from_micros(rng.random_range(micros)));
    program.kill();
    pid
}

/// How long it takes to learn that nobody serves an instance.
pub fn look_up_nobody() -> Duration {
    let start = Instant::now();
    let found = Connection::open(&new_instance(), "tests", PATIENCE).map(drop);
    let is_absent = matches!(
        found,
        Err(ConnectionError::Channel(ChannelError::NoServer { .. }))
    );
    assert!(is_absent, "{found:?}");
    start.elapsed()
}

/// The channels' files that processes began, by the ids in their names.
pub fn files_of(pids: &HashSet<u32>) -> Vec<PathBuf> {
    let is_theirs = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let ids = name
            .split(['_', '.'])
            .filter_map(|word| word.parse::<u128>().ok());
        let mut began = ids.map(|id| (id >> 64) as u32);
        began.any(|pid| pids.contains(&pid))
    };
    let mut all = vec![PathBuf::from(SHARED_MEMORY)];
    let mut next = 0;
    while let Some(folder) = all.get(next).cloned() {
        let below = std::fs::read_dir(folder).into_iter().flatten().flatten();
        all.extend(below.map(|entry| entry.path()));
        next += 1;
    }
    all.retain(is_theirs);
    all
}

#[test]
fn programs_that_are_killed_at_any_moment_leave_nothing_in_the_way_of_others() {
    let kills = Kills {
        starts: 40,
        ends: 10,
        connects: 10,
    };
    let left = kill_in_loops(3, kills);
    look_up_nobody();
    for instance in &left.instances {
        let server = Server::start_with(instance, &FLAGS);
        server.program.signal(Signal::TERM);
        let ended = server.program.wait(PATIENCE);
        assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    }
    protocol::cleanup::remove_leftovers().expect("a turn");
    assert_eq!(files_of(&left.killed), Vec::<PathBuf>::new());
}
