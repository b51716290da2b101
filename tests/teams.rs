//! Tests of several robots in one world, flown by several clients. A client that dies, hangs, is replaced or gives up
//! affects only its own robots.

use emberwatch_protocol::Client;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::message::{Status, StepRequest, WorldResult};
use emberwatch_protocol::observer::Observer;
use rustix::process::Signal;
use std::ops::Range;
use std::time::Instant;
use tests::harness::{PATIENCE, Paths, Program, Server, frames_until, robots_of};
use tests::wire::{RawClient, Wire, step_body, step_header};

const N_MOVES: usize = 10;

const FLAGS: &str = "--height 9 --width 14 --moves 10 --burn-in 2000 --robots 4";

#[test]
fn a_path_that_is_given_up_is_never_flown() {
    let server = Server::start(&format!("{FLAGS} --lease-millis 86400000"));
    let [first, second] = [0..2, 2..4].map(|robots| {
        let wire = Wire::open(&server.instance);
        let lease = wire.acquire(robots.clone()).lease;
        let header = StepRequest {
            first_robot: robots.start,
            n_robots: 2,
            ..step_header(lease, N_MOVES as u32)
        };
        (wire, header)
    });
    let send = |(wire, header): &(Wire, StepRequest)| {
        let paths = [3; 2 * N_MOVES];
        wire.send_step(*header, &step_body(&[0], &paths))
            .expect("send")
    };
    let wait_for_paths = |n_paths| {
        let has_come = || server.status().worlds[0].n_paths == n_paths;
        server.program.until(has_come);
    };
    let given_up = send(&first);
    wait_for_paths(2);
    drop(given_up);
    wait_for_paths(0);
    // Closes the connection of a client that waits.
    let waiting = send(&second);
    wait_for_paths(2);
    drop((waiting, second));
    wait_for_paths(0);
    assert_eq!(server.step_of(0), 0, "nothing was flown");
}

/// A world in which this process flies robot 0 and agents fly the other robots.
struct Lab {
    server: Server,
    client: Client,
    paths: Paths,
}

impl Lab {
    fn new(flags: &str) -> Self {
        let server = Server::start(&format!("{FLAGS} --lease-millis 86400000 {flags}"));
        let client = server.acquire(0..1);
        Self {
            server,
            client,
            paths: Paths::new(0),
        }
    }

    fn start_agent(&self, robot: u32, flags: &str) -> Program {
        let flags = format!("--robots {robot} --policy random_walk {flags}");
        Program::agent(&self.server.instance, &flags)
    }

    /// Starts three agents and waits until all robots fly.
    fn start_agents(&mut self) -> [Program; 3] {
        let agents = [1, 2, 3].map(|robot| self.start_agent(robot, ""));
        self.until(&agents.each_ref(), all_fly);
        agents
    }

    /// Steps the world until `wanted` returns true for its result.
    fn until(&mut self, agents: &[&Program], mut wanted: impl FnMut(&WorldResult) -> bool) {
        let start = Instant::now();
        loop {
            let world = self.step();
            if wanted(&world) {
                return;
            }
            let said: String = agents.iter().map(|agent| agent.stderr()).collect();
            assert!(start.elapsed() < PATIENCE, "{world:?}: {said}");
        }
    }

    fn step(&mut self) -> WorldResult {
        let (start, path) = (Instant::now(), self.paths.next(N_MOVES));
        let is_over = || start.elapsed() > PATIENCE;
        match self.client.step_until(0..1, &[path], &is_over) {
            Ok(Some(_)) => {}
            // This process was not scheduled in time. It continues with the next step.
            Err(ConnectionError::Refused {
                status: Status::Late,
                ..
            }) => {}
            other => panic!("the world does not move: {other:?}"),
        }
        self.client.observe(0..1).expect("observe")[0].world
    }
}

/// Returns whether all robots flew in the last step.
fn all_fly(world: &WorldResult) -> bool {
    world.hovered | world.late == 0
}

#[test]
fn the_robot_of_a_killed_agent_hovers_and_a_takeover_changes_only_who_flies() {
    let mut lab = Lab::new("");
    let [one, two, three] = lab.start_agents();
    two.kill();
    lab.until(&[&one, &three], |world| world.hovered == 0b0100);
    for _ in 0..20 {
        let world = lab.step();
        let stayed = (world.hovered, world.late);
        assert_eq!(stayed, (0b0100, 0), "the others fly on");
    }
    let two = lab.start_agent(2, "");
    lab.until(&[&one, &two, &three], all_fly);
    let next = lab.start_agent(2, "--takeover");
    let start = Instant::now();
    while lab.server.status().worlds[0].holder_pids[2] != Some(next.pid()) {
        assert!(start.elapsed() < PATIENCE, "{}", next.stderr());
        let world = lab.step();
        assert!(all_fly(&world), "a robot was left alone: {world:?}");
    }
    for _ in 0..20 {
        let world = lab.step();
        assert!(all_fly(&world), "{world:?}");
    }
    let words = format!("lease lost to pid {}", next.pid());
    two.ends(3).check_says(&words);
}

#[test]
fn a_stopped_agent_is_late_and_flies_again_when_it_wakes() {
    let mut lab = Lab::new("--deadline-millis 200");
    let [one, two, mut three] = lab.start_agents();
    three.stop();
    for _ in 0..3 {
        lab.until(&[&three], |world| world.late & 0b1000 != 0);
        assert_eq!(lab.step().hovered, 0, "it holds its robot");
    }
    three.signal(Signal::CONT);
    lab.until(&[&one, &two, &three], all_fly);
    three.wait_for_words("late: the world advanced");
    assert!(!three.has_ended(), "{}", three.stderr());
}

/// Flies four robots in a world with many fires, with one agent for each range of robots in `parts`. The agents make
/// one plan for all. Returns the paths of each step.
fn flown_by(parts: &[Range<u32>]) -> Vec<Vec<Vec<u8>>> {
    const N_STEPS: usize = 40;
    let server = Server::start(
        "--model wildfire-small --height 16 --width 14 --moves 8 --burn-in 300 --robots 4",
    );
    // Holds all robots until the agents take them over, so that the world does not move before each robot has its
    // agent.
    let _holder = server.acquire(0..4);
    let frames = Observer::frames(&server.instance).expect("the channel");
    let start = |robots: &Range<u32>| {
        let robots = format!("--robots {}..{}", robots.start, robots.end);
        let flags =
            format!("--steps {N_STEPS} --policy known/beam/exploit --takeover --team joint");
        Program::agent(&server.instance, &format!("{robots} {flags}"))
    };
    let agents: Vec<_> = parts.iter().map(start).collect();
    agents.into_iter().for_each(|agent| drop(agent.ends(0)));
    let mut samples = frames_until(&frames, 0, N_STEPS as u64);
    samples.dedup_by_key(|sample| sample.header.result.step);
    let flown = samples.iter().filter(|it| it.header.result.step > 0);
    let paths = |sample| {
        let robots = robots_of(sample).into_iter();
        robots.map(|robot| robot.path.to_vec()).collect()
    };
    let paths = Vec::from_iter(flown.map(paths));
    assert_eq!(paths.len(), N_STEPS);
    paths
}

#[test]
fn agents_of_a_team_fly_one_plan_whoever_flies_what() {
    let all = 0..4;
    let together = flown_by(std::slice::from_ref(&all));
    assert_eq!(flown_by(&[0..1, 1..2, 2..3, 3..4]), together);
    assert_eq!(flown_by(&[0..1, 1..4]), together);
}
