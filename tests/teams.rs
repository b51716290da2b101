//! Tests of several robots in one world, flown by several clients. The same paths give the same answers, byte for byte,
//! however the robots are divided among clients. A client that dies, hangs, is replaced or is refused does not affect
//! the paths and observations of other clients.

use crate::commands::check;
use crate::recording::{frames, new_file, read_whole, start_recorder, stop};
use crate::trainings::on;
use emberwatch_protocol::control::{Reply, Request};
use emberwatch_protocol::message::{FLAG_TEAM_FRAMES, Status, StepReply, StepRequest, WorldResult};
use emberwatch_protocol::observer::Observer;
use emberwatch_protocol::path::path_to_bytes;
use emberwatch_protocol::payload::split_step_payload;
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rustix::process::Signal;
use std::ops::Range;
use std::time::Instant;
use tests::harness::{
    AGENT, AgentObservation, PATIENCE, Paths, Program, Server, eventually, frames_until, robots_of,
};
use tests::mirror::{Mirror, PacedWorld};
use tests::wire::{
    Pending, RawClient, Wire, answer, observe_header, recall_header, step_body, step_header,
};

/// Number of robots in the world.
const TEAM: u32 = 4;

const N_MOVES: usize = 10;

const FLAGS: &str = "--height 9 --width 14 --moves 10 --burn-in 2000 --robots 4";

const N_STEPS: u64 = 12;

/// A client with a lease on some robots.
struct Flyer {
    wire: Wire,
    lease: u64,
    robots: Range<u32>,
}

type Sent = Pending<StepRequest, StepReply>;

impl Flyer {
    fn new(server: &Server, robots: Range<u32>) -> Self {
        let wire = Wire::open(&server.instance);
        let lease = wire.acquire(robots.clone()).lease;
        Self {
            wire,
            lease,
            robots,
        }
    }

    fn header(&self) -> StepRequest {
        StepRequest {
            first_robot: self.robots.start,
            n_robots: self.robots.len() as u32,
            ..step_header(self.lease, N_MOVES as u32)
        }
    }

    /// Sends the robots' paths for a step.
    fn send(&self, k: u64) -> Sent {
        let robots = self.robots.clone();
        let paths: Vec<u8> = robots.flat_map(|robot| path(k, robot)).collect();
        let sent = self.wire.send_step(self.header(), &step_body(&[k], &paths));
        sent.expect("send a step")
    }

    /// Waits for the answer to a step.
    fn shown(&self, sent: &Sent) -> Vec<AgentObservation> {
        let (reply, payload) = answer(sent, PATIENCE).expect("an answer to a step");
        assert_eq!(reply.status, Status::Ok as u32, "{reply:?}");
        let parts = split_step_payload(&reply, &payload).expect("a whole payload");
        let frames = parts.frames.chunks_exact(9 * 14);
        let robots = parts.robots.iter().zip(frames);
        let shown = robots.map(|(robot, frame)| (parts.worlds[0], *robot, frame.to_vec()));
        shown.collect()
    }

    /// Waits until the server has received the paths of `n_paths` robots for the world's next step.
    fn wait_for_paths(&self, n_paths: u32) {
        let has_come = || match self.wire.ask(&Request::Status {}) {
            Reply::Status(status) => status.worlds[0].n_paths == n_paths,
            other => panic!("expected a status, got {other:?}"),
        };
        assert!(eventually(PATIENCE, has_come), "not {n_paths} paths");
    }
}

/// Returns the path of a robot in a step.
fn path(k: u64, robot: u32) -> Vec<u8> {
    path_to_bytes(&Paths::new(k * u64::from(TEAM) + u64::from(robot)).next(N_MOVES))
}

/// Flies four robots, with one client for each range of robots in `shares`, and returns the observations. The clients
/// send their paths in another order in each step.
fn send_paths(server: &Server, shares: &[Range<u32>]) -> Vec<Vec<AgentObservation>> {
    let flyer = |robots: &Range<u32>| Flyer::new(server, robots.clone());
    let flyers: Vec<_> = shares.iter().map(flyer).collect();
    let step = |k: u64| {
        let mut sent: Vec<Option<Sent>> = flyers.iter().map(|_| None).collect();
        let mut n_paths = 0;
        let mut order: Vec<usize> = (0..flyers.len()).collect();
        order.shuffle(&mut ChaCha8Rng::seed_from_u64(k));
        for index in order {
            sent[index] = Some(flyers[index].send(k));
            n_paths += flyers[index].robots.len() as u32;
            if n_paths < TEAM {
                flyers[index].wait_for_paths(n_paths);
            }
        }
        let answers = flyers.iter().zip(&sent);
        let shown = answers.flat_map(|(flyer, sent)| flyer.shown(sent.as_ref().expect("sent")));
        shown.collect()
    };
    (0..N_STEPS).map(step).collect()
}

#[test]
fn bytes_do_not_depend_on_sender_or_order_of_paths() {
    let together = Server::start(&format!("{FLAGS} --threads 1"));
    let all = 0..4;
    let expected = send_paths(&together, std::slice::from_ref(&all));
    let has_shared = |step: &Vec<AgentObservation>| {
        let own: u32 = step.iter().map(|(_, robot, _)| robot.n_visited).sum();
        own > step[0].0.n_visited
    };
    assert!(expected.iter().any(has_shared), "no cell was visited twice");
    // A team frame combines the observations of all robots, and any client may request it.
    let last = expected.last().expect("steps");
    let union = |cell: usize| last.iter().map(|(.., frame)| frame[cell]).min();
    let union: Vec<u8> = (0..9 * 14).filter_map(union).collect();
    let stranger = Wire::open(&together.instance);
    for (mut header, body) in [
        (observe_header(2..3), Vec::new()),
        (recall_header(2..3), step_body(&[N_STEPS], &[])),
    ] {
        header.flags = FLAG_TEAM_FRAMES;
        let (reply, payload) = stranger.step(header, &body);
        let parts = split_step_payload(&reply, &payload).expect("a whole payload");
        let (world, robot, _) = &last[2];
        assert_eq!(
            (&parts.worlds[..], &parts.robots[..]),
            (&[*world][..], &[*robot][..])
        );
        assert_eq!(parts.frames, union, "{header:?}");
    }
    let apart = Server::start(&format!("{FLAGS} --threads 2"));
    let (_folder, file) = new_file();
    let recorder = start_recorder(&apart.instance, &file, "");
    assert!(send_paths(&apart, &[0..1, 1..2, 2..3, 3..4]) == expected);
    apart.info(); // answered only after the last step was published
    stop(recorder);
    let in_parts = Server::start(FLAGS);
    assert!(send_paths(&in_parts, &[0..3, 3..4]) == expected);

    let mut mirror = Mirror::of(&apart.info());
    let steps = frames(&read_whole(&file));
    let new: Vec<_> = steps.iter().filter(|step| mirror.follow(step)).collect();
    assert_eq!(new.len(), expected.len());
    for (k, (step, expected)) in new.into_iter().zip(&expected).enumerate() {
        let robots = robots_of(step).into_iter().zip(expected);
        for (robot, (sample, (world, result, frame))) in (0..).zip(robots) {
            assert_eq!((step.header.result, sample.result), (*world, *result));
            assert_eq!(sample.frame, frame);
            assert_eq!(sample.path, path(k as u64, robot));
        }
    }
}

#[test]
fn a_path_that_is_given_up_is_never_flown() {
    let server = Server::start(&format!("{FLAGS} --lease-millis 86400000"));
    let [first, second] = [0..2, 2..4].map(|robots| Flyer::new(&server, robots));
    let stranger = Wire::open(&server.instance);
    let observe = || stranger.step(observe_header(0..TEAM), &[]).1;
    let before = observe();
    let given_up = first.send(0);
    second.wait_for_paths(2);
    assert_eq!(observe(), before, "a path that waits is not shown");
    drop(given_up);
    second.wait_for_paths(0);
    // Closes the connection of a client that waits.
    let waiting = second.send(0);
    first.wait_for_paths(2);
    drop((waiting, second));
    first.wait_for_paths(0);
    assert_eq!(server.step_of(0), 0, "nothing was flown");
}

/// A world in which this process flies robot 0 and agents fly the other robots.
struct Lab {
    server: Server,
    world: PacedWorld,
}

impl Lab {
    fn new(flags: &str) -> Self {
        let server = Server::start(&format!("{FLAGS} {flags}"));
        let world = PacedWorld::new(&server, 0);
        Self { server, world }
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

    /// Steps the world until `wanted` returns true for its result. Checks that every step has the result that its paths
    /// imply.
    fn until(&mut self, agents: &[&Program], mut wanted: impl FnMut(&WorldResult) -> bool) {
        let start = Instant::now();
        while !wanted(&self.step()) {
            let said: String = agents.iter().map(|agent| agent.stderr()).collect();
            assert!(start.elapsed() < PATIENCE, "{:?}: {said}", self.world.last);
        }
    }

    fn step(&mut self) -> WorldResult {
        self.world.step(|_| ());
        self.world.last
    }
}

/// Returns whether all robots flew in the last step.
fn all_fly(world: &WorldResult) -> bool {
    world.hovered | world.late == 0
}

#[test]
fn the_robot_of_a_killed_agent_hovers_until_the_next_one_flies_it() {
    let mut lab = Lab::new("--lease-millis 86400000");
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
}

#[test]
fn a_takeover_changes_who_flies_a_robot_and_nothing_else() {
    let mut lab = Lab::new("--lease-millis 86400000");
    let [one, two, three] = lab.start_agents();
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
    drop((one, three));
}

#[test]
fn a_stopped_agent_delays_its_world_until_its_lease_ends() {
    let mut lab = Lab::new("--lease-millis 1500");
    let [_one, _two, three] = lab.start_agents();
    three.stop();
    lab.until(&[&three], |world| world.hovered & 0b1000 != 0);
    let holder = lab.server.status().worlds[0].holder_pids[3];
    assert_eq!(holder, None);
    three.signal(Signal::CONT);
    // The world does not wait for this robot, so its agent notices that it has lost the lease only at its next request.
    three.ends(3).check_says("lease lost");
}

#[test]
fn a_stopped_agent_is_late_and_flies_again_when_it_wakes() {
    let mut lab = Lab::new("--lease-millis 86400000 --deadline-millis 200");
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

#[test]
#[ignore = "takes minutes"]
fn agents_disturbed_at_random_change_nothing_for_the_others() {
    let mut lab = Lab::new("--lease-millis 86400000 --deadline-millis 100");
    let mut agents = lab.start_agents();
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    for _ in 0..50 {
        let robot: u32 = rng.random_range(1..TEAM);
        let agent = &mut agents[robot as usize - 1];
        let is = move |mask: u64| mask >> robot & 1 == 1;
        match rng.random_range(0..4) {
            0 => {
                agent.signal(Signal::KILL);
                lab.until(&[&*agent], |world| is(world.hovered));
                *agent = lab.start_agent(robot, "");
            }
            1 => {
                agent.signal(Signal::STOP);
                lab.until(&[&*agent], |world| is(world.late));
                agent.signal(Signal::CONT);
            }
            2 => {
                let mut former = std::mem::replace(agent, lab.start_agent(robot, "--takeover"));
                former.signal(Signal::TERM);
                lab.until(&[&*agent], |_| former.has_ended());
            }
            _ => {
                let next = lab.start_agent(robot, "--takeover");
                lab.until(&[&next], |_| agent.has_ended());
                std::mem::replace(agent, next).ends(3);
            }
        }
        lab.until(&[&*agent], |world| !is(world.hovered | world.late));
    }
}

/// Flies four robots in a world with many fires, with one agent for each range of robots in `parts`. `team` is a value
/// of `--team`. Returns the paths and the reward.
fn flown_by(parts: &[Range<u32>], team: &str) -> (Vec<Vec<Vec<u8>>>, f64) {
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
            format!("--steps {N_STEPS} --policy known/beam/exploit --takeover --team {team}");
        Program::agent(&server.instance, &format!("{robots} {flags}"))
    };
    let agents: Vec<_> = parts.iter().map(start).collect();
    agents.into_iter().for_each(|agent| drop(agent.ends(0)));
    let (mut paths, mut reward) = (Vec::new(), 0.0);
    for sample in frames_until(&frames, 0, N_STEPS as u64) {
        if sample.header.result.step > paths.len() as u64 {
            let robots = robots_of(&sample).into_iter();
            paths.push(robots.map(|robot| robot.path.to_vec()).collect());
            reward += sample.header.result.reward;
        }
    }
    assert_eq!(paths.len(), N_STEPS);
    (paths, reward)
}

#[test]
fn agents_of_a_team_fly_one_plan_whoever_flies_what() {
    let single = [0..1, 1..2, 2..3, 3..4];
    let all = 0..4;
    let together = flown_by(std::slice::from_ref(&all), "joint");
    assert_eq!(flown_by(&single, "joint"), together);
    assert_eq!(flown_by(&[0..1, 1..4], "joint"), together);
    // Agents that plan independently often fly over the same cells.
    let (paths, alone) = flown_by(&single, "alone");
    assert!(together.1 > 1.2 * alone, "{} and {alone}", together.1);
    let (shared, _) = flown_by(&single, "shared");
    assert_ne!(
        shared, paths,
        "shared frames change the beliefs, and so the paths"
    );
    let server = Server::start(&format!("{FLAGS} --publish-truth"));
    let check = |flags: &str, words: &str| check(AGENT, &format!("{flags} {}", on(&server)), words);
    let robots = "expected a part of the world's robots 0..4, got";
    check("run --robots 4", &format!("{robots} 4..5"));
    check("run --robots 2..6 --team joint", &format!("{robots} 2..6"));
}
