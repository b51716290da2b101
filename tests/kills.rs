//! Tests of programs that are killed at any moment while they start or end. Leftovers must not block later programs.

use emberwatch_protocol::channels::{Instance, SHARED_MEMORY};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rustix::process::Signal;
use std::collections::HashSet;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tests::harness::{
    Folder, Program, SERVER, Server, eventually, new_instance, run, service_files, status,
};
use tests::meter::all_under;

/// A small server that is ready immediately.
const FLAGS: &str = "--burn-in 0 --height 8 --width 8 --moves 4";

/// Starts programs and kills them. Returns all their instances and process ids, after all these processes have ended.
fn kill_in_a_loop(seed: u64, n_kills: usize) -> (Vec<Instance>, HashSet<u32>) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let instances: Vec<Instance> = (0..10).map(|_| new_instance()).collect();
    let began = Instant::now();
    let running = Server::start(FLAGS);
    // Kills are spread over at least the time that a server takes to start on this machine, so that some hit its start.
    let longest = (began.elapsed().as_micros() as u64).max(60_000);
    let folder = Folder::default();
    let mut killed = HashSet::new();
    for _ in 0..n_kills {
        let instance = &instances[rng.random_range(0..instances.len())];
        let (program, moment) = match rng.random_range(0..6) {
            0 => {
                let server = Server::start_without_waiting(instance, FLAGS);
                server.program.wait_for_words("serving");
                server.program.signal(Signal::TERM);
                (server.program, 0..20_000)
            }
            1 => {
                let kind = rng.random_range(0..3);
                (connect(&running.instance, &folder, kind), 1..longest / 2)
            }
            _ => {
                let server = Server::start_without_waiting(instance, FLAGS);
                (server.program, 1..longest)
            }
        };
        killed.insert(kill_after(program, &mut rng, moment));
    }
    assert!(status(&running.instance).is_ok(), "the others' server");
    (instances, killed)
}

/// Starts a client, an observer or an agent.
fn connect(instance: &Instance, folder: &Folder, kind: u32) -> Program {
    let name = instance.name();
    match kind {
        0 => Program::start(SERVER, &format!("status --instance {name}")),
        1 => {
            let file = folder.word("recording");
            let flags = format!("record --force --instance {name} --out {file}");
            Program::start(SERVER, &flags)
        }
        _ => Program::agent(instance, "--takeover --policy coverage"),
    }
}

/// Kills a program after a random number of microseconds. Returns its process id.
fn kill_after(program: Program, rng: &mut ChaCha8Rng, micros: Range<u64>) -> u32 {
    let pid = program.pid();
    std::thread::sleep(Duration::from_micros(rng.random_range(micros)));
    program.kill();
    pid
}

/// Returns whether the name of a channel's file contains the id of one of these processes.
fn is_of(path: &Path, pids: &HashSet<u32>) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let mut words = name.split(['_', '.']);
    words.any(|word| {
        let id = word.parse::<u128>();
        id.is_ok_and(|id| pids.contains(&((id >> 64) as u32)))
    })
}

fn kill(n_loops: u64, n_kills: usize) {
    let (mut instances, mut killed) = (Vec::new(), HashSet::new());
    std::thread::scope(|scope| {
        let start = |seed| scope.spawn(move || kill_in_a_loop(seed, n_kills));
        let loops: Vec<_> = (0..n_loops).map(start).collect();
        for (names, pids) in loops.into_iter().map(|one| one.join().expect("a loop")) {
            instances.extend(names);
            killed.extend(pids);
        }
    });
    // Runs this command as a separate program, because it could hang.
    let flags = format!("status --instance {}", new_instance().name());
    run(SERVER, &flags).check_says("no server on");
    for instance in &instances {
        Server::start_on(instance, FLAGS).program.finish();
    }
    emberwatch_protocol::cleanup::remove_leftovers().expect("a turn");
    let mut left = all_under(SHARED_MEMORY.as_ref());
    left.retain(|path| is_of(path, &killed));
    left.extend(instances.iter().flat_map(service_files));
    // A process that is killed while it creates a service leaves an empty file, which does not contain the instance's
    // name. The file of a living process is empty only for a moment.
    let mut empty = all_under(SHARED_MEMORY.as_ref());
    let is_empty = |path: &PathBuf| {
        path.extension() == Some("service".as_ref())
            && path.metadata().is_ok_and(|it| it.len() == 0)
    };
    eventually(Duration::from_secs(10), || {
        empty.retain(is_empty);
        empty.is_empty()
    });
    left.extend(empty);
    assert_eq!(left, Vec::<PathBuf>::new());
}

#[test]
fn killed_programs_leave_nothing_in_the_way() {
    kill(3, 30);
}

#[test]
#[ignore = "takes minutes"]
fn a_thousand_killed_programs_leave_nothing_in_the_way() {
    kill(5, 200);
}

#[test]
fn an_idle_server_reads_no_files_of_others() {
    let server = Server::start(FLAGS);
    let n_bytes = || {
        let usage = format!("/proc/{}/io", server.program.pid());
        let usage = std::fs::read_to_string(usage).expect("what it read");
        let line = usage.lines().find_map(|line| line.strip_prefix("rchar: "));
        line.expect("a line").parse::<u64>().expect("a number")
    };
    let before = n_bytes();
    let reads = eventually(Duration::from_secs(1), || n_bytes() >= before + 1000);
    assert!(!reads, "{} bytes", n_bytes() - before);
}
