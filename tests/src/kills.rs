//! Programs that are killed at any moment of their start or end: the next ones find nothing in their way.

use crate::harness::{Program, SERVER, Server, new_instance, run, status};
use crate::meter::all_under;
use emberwatch_protocol::channels::{Instance, SHARED_MEMORY};
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
pub const FLAGS: &str = "--burn-in 0 --height 8 --width 8 --moves 4";

/// How many are killed in one of the loops.
#[derive(Clone, Copy)]
pub struct Kills {
    /// Servers, 1 to 60 ms after they were started.
    pub starts: usize,
    /// Servers, 0 to 20 ms after they were told to stop.
    pub ends: usize,
    /// Clients and observers of a running server, 1 to 30 ms after they were started.
    pub connects: usize,
    /// Whether some of these are Python's, which needs what `scripts/test` makes.
    pub with_python: bool,
}

/// What such loops left: all instances are of processes that have ended.
#[derive(Default)]
pub struct Left {
    pub instances: Vec<Instance>,
    pub killed: HashSet<u32>,
}

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
    let began = Instant::now();
    let running = Server::start(FLAGS);
    // As long as starts take here, else none would be killed in the middle of one.
    let longest = (began.elapsed().as_micros() as u64).max(60_000);
    let folder = TempDir::new().expect("a folder");
    let mut killed = HashSet::new();
    let (mut starts, mut ends, mut connects) = (kills.starts, kills.ends, kills.connects);
    while starts + ends + connects > 0 {
        let chosen = rng.random_range(0..starts + ends + connects);
        let instance = &instances[rng.random_range(0..instances.len())];
        if chosen < starts {
            starts -= 1;
            let server = Server::start_without_waiting(instance, FLAGS);
            killed.insert(kill_after(server.program, &mut rng, 1..longest));
        } else if chosen < starts + ends {
            ends -= 1;
            let server = Server::start_without_waiting(instance, FLAGS);
            server.program.wait_for_words("serving");
            server.program.signal(Signal::TERM);
            killed.insert(kill_after(server.program, &mut rng, 0..20_000));
        } else {
            connects -= 1;
            let n_kinds = if kills.with_python { 4 } else { 3 };
            let kind = rng.random_range(0..n_kinds);
            let program = connect(&running.instance, &folder, kind);
            killed.insert(kill_after(program, &mut rng, 1..longest / 2));
        }
    }
    assert!(status(&running.instance).is_ok(), "the others' server");
    Left { instances, killed }
}

/// A client, an observer, one that acts, or a Python client that has been loaded.
fn connect(instance: &Instance, folder: &TempDir, kind: u32) -> Program {
    let name = instance.name();
    let file = folder.path().join("recording").display().to_string();
    match kind {
        0 => Program::start(SERVER, &format!("status --instance {name}")),
        1 => {
            let flags = format!("record --force --instance {name} --out {file}");
            Program::start(SERVER, &flags)
        }
        2 => Program::agent(instance, "--takeover --policy coverage"),
        _ => {
            let script = format!(
                "import emberwatch, sys, time; sys.stderr.write('connecting'); sys.stderr.flush(); \
                 client = emberwatch.connect({name:?}); time.sleep(60)"
            );
            let program = Program::start_python(&script);
            program.wait_for_words("connecting");
            program
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

/// How long it takes a program to learn that nobody serves an instance; a program, as that could take without end.
pub fn look_up_nobody() -> Duration {
    let (start, instance) = (Instant::now(), new_instance());
    let flags = format!("status --instance {}", instance.name());
    run(SERVER, &flags).check_says("no server on");
    start.elapsed()
}

/// The channels' files that are left: by the ids in their names, and of services of the instances.
pub fn files_of(left: &Left) -> Vec<PathBuf> {
    let names: Vec<String> = left
        .instances
        .iter()
        .map(|instance| format!("emberwatch/v2/{}/", instance.name()))
        .collect();
    let is_theirs = |path: &PathBuf| {
        if path.extension() == Some("service".as_ref()) {
            let text = std::fs::read_to_string(path).unwrap_or_default();
            return text.is_empty() || names.iter().any(|name| text.contains(name));
        }
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let ids = name
            .split(['_', '.'])
            .filter_map(|word| word.parse::<u128>().ok());
        let mut began = ids.map(|id| (id >> 64) as u32);
        began.any(|pid| left.killed.contains(&pid))
    };
    let mut all = all_under(SHARED_MEMORY.as_ref());
    all.retain(is_theirs);
    all
}
