//! Tests that a world depends only on model, seed and k, and not on other worlds, threads, clients or observers.

use emberwatch_protocol::client::{Claim, Observation};
use emberwatch_protocol::observer::Observer;
use emberwatch_protocol::{Client, Move};
use std::ops::Range;
use tests::harness::{PATIENCE, Paths, Server, reset, send_paths};

/// Number of seeds, with one world each.
const N_SEEDS: u32 = 8;

/// Number of steps flown on each world.
const N_STEPS: usize = 12;

/// A grid so small that a single thread steps a batch of worlds.
const SMALL: &str = "--height 9 --width 14 --burn-in 200";

/// A grid so large that several threads step a batch of 8 worlds.
const LARGE: &str = "--height 128 --width 128 --burn-in 3";

/// The observations of a world at each step.
type Trajectory = Vec<Observation>;

fn start(flags: &str) -> Server {
    Server::start(&format!("--moves 10 {flags}"))
}

fn paths(seed: u32) -> Vec<Vec<Move>> {
    Paths::new(seed.into()).take(10, N_STEPS)
}

fn without_episode(mut observation: Observation) -> Observation {
    observation.world.episode = 0;
    observation
}

/// Simulates the worlds one after the other, on a server with one world, one thread, one client and no observers.
fn reference(size: &str) -> Vec<Trajectory> {
    let server = start(&format!("{size} --worlds 1 --threads 1"));
    let mut client = server.acquire(0..1);
    let mut trajectory = |seed| {
        reset(&mut client, u64::from(seed));
        let flights = paths(seed).into_iter();
        flights
            .map(|path| without_episode(send_paths(&mut client, path)))
            .collect()
    };
    (0..N_SEEDS).map(&mut trajectory).collect()
}

/// Steps all worlds in one request.
fn batches(client: &mut Client, steps: Range<usize>, trajectories: &mut [Trajectory]) {
    let all: Vec<_> = (0..N_SEEDS).map(paths).collect();
    for step in steps {
        let batch: Vec<_> = all.iter().map(|paths| paths[step].clone()).collect();
        let answer = client.step(0..N_SEEDS, &batch).expect("step");
        for (trajectory, observation) in trajectories.iter_mut().zip(answer) {
            trajectory.push(without_episode(observation));
        }
    }
}

#[test]
fn worlds_do_not_depend_on_worlds_beside_them_observers_or_threads() {
    for (size, flags, n_observers) in [
        (SMALL, "--threads 2 --publish-truth", 3),
        (LARGE, "--threads 1", 0),
        (LARGE, "--threads 2", 3),
    ] {
        let server = start(&format!("{size} --worlds {N_SEEDS} {flags}"));
        let observe = |_| Observer::frames(&server.instance).expect("observe");
        let observers: Vec<_> = (0..n_observers).map(observe).collect();
        let mut trajectories = vec![Vec::new(); N_SEEDS as usize];
        batches(
            &mut server.acquire(0..N_SEEDS),
            0..N_STEPS,
            &mut trajectories,
        );
        assert!(
            trajectories[0] != trajectories[1],
            "worlds with different seeds differ"
        );
        assert!(trajectories == reference(size), "{size} {flags}");
        for observer in observers {
            assert!(observer.receive(PATIENCE).expect("receive").is_some());
        }
    }
}

#[test]
fn worlds_do_not_notice_who_acts_on_them_or_where_robots_fly() {
    let server = start(&format!("{SMALL} --worlds {N_SEEDS}"));
    let mut trajectories = vec![Vec::new(); N_SEEDS as usize];
    let mut first = server.acquire(0..N_SEEDS);
    batches(&mut first, 0..4, &mut trajectories);
    first.release().expect("release");
    let mut second = server.acquire(0..N_SEEDS);
    let claimed = Client::acquire(server.connect(), &Claim::new(0..1));
    assert!(claimed.is_err(), "a refused claim in between");
    batches(&mut second, 4..8, &mut trajectories);
    let mut third = server.take_over(0..N_SEEDS);
    let stale = second.step(0..1, &paths(99)[..1]);
    assert!(stale.is_err(), "a lost lease steps nothing");
    batches(&mut third, 8..N_STEPS, &mut trajectories);
    assert!(trajectories == reference(SMALL));
    // Full frames contain a noisy observation of every state.
    let flags = format!("{SMALL} --coverage full");
    let servers = [start(&flags), start(&format!("{flags} --start random"))];
    let mut clients = servers.each_ref().map(|server| server.acquire(0..1));
    let [one, other] = &mut clients;
    for (mine, theirs) in paths(1).into_iter().zip(paths(2)) {
        let (mine, theirs) = (send_paths(one, mine), send_paths(other, theirs));
        assert_eq!(mine.frame, theirs.frame);
        assert_eq!(mine.world.n_target_cells, theirs.world.n_target_cells);
    }
}
