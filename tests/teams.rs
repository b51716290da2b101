//! Several robots in one world, flown by several clients: the same paths give the same bytes, and no client that dies,
//! hangs, is replaced or is not allowed changes what the others fly and see.

use crate::recording::{frames, new_file, read_whole, start_recorder, stop};
use emberwatch_protocol::control::{Reply, Request};
use emberwatch_protocol::message::{FLAG_TEAM_FRAMES, Status, StepReply, StepRequest, WorldResult};
use emberwatch_protocol::observer::Observer;
use emberwatch_protocol::path::path_to_bytes;
use emberwatch_protocol::payload::split_step_payload;
use rustix::process::Signal;
use std::ops::Range;
use std::time::Instant;
use tests::harness::{
    PATIENCE, Paths, Program, Seen, Server, eventually, frames_until, robots_of, seed,
};
use tests::mirror::{Mirror, PacedWorld};
use tests::wire::{
    Pending, RawClient, Wire, acquire_request, answer, observe_header, recall_header, step_body,
    step_header,
};

/// Robots of the world.
const TEAM: u32 = 4;

const N_MOVES: usize = 10;

const FLAGS: &str = "--height 9 --width 14 --moves 10 --burn-in 2000 --robots 4";

/// Steps: one for each order in which four clients can come.
const N_STEPS: u64 = 24;

/// A client of some robots.
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

    /// Sends its robots' paths for a step.
    fn send(&self, k: u64) -> Sent {
        let robots = self.robots.clone();
        let paths: Vec<u8> = robots.flat_map(|robot| path(k, robot)).collect();
        let sent = self.wire.send_step(self.header(), &step_body(&[k], &paths));
        sent.expect("send a step")
    }

    /// Waits for the answer to a step.
    fn shown(&self, sent: &Sent) -> Vec<Seen> {
        let (reply, payload) = answer(sent, PATIENCE).expect("an answer to a step");
        assert_eq!(reply.status, Status::Ok as u32, "{reply:?}");
        let parts = split_step_payload(&reply, &payload).expect("a whole payload");
        let frames = parts.frames.chunks_exact(9 * 14);
        let robots = parts.robots.iter().zip(frames);
        let shown = robots.map(|(robot, frame)| (parts.worlds[0], *robot, frame.to_vec()));
        shown.collect()
    }

    /// Waits for the refusal of a step.
    fn refusal(&self, sent: &Sent) -> (Status, u64) {
        let (reply, _) = answer(sent, PATIENCE).expect("an answer to a step");
        let status = Status::try_from(reply.status).expect("a known status");
        (status, reply.detail)
    }

    /// Waits until so many robots of the world have a path for its next step.
    fn wait_for_paths(&self, n_paths: u32) {
        let has_come = || match self.wire.ask(&Request::Status {}) {
            Reply::Status(status) => status.worlds[0].n_paths == n_paths,
            other => panic!("expected a status, got {other:?}"),
        };
        assert!(eventually(PATIENCE, has_come), "not {n_paths} paths");
    }
}

/// The path of a robot in a step.
fn path(k: u64, robot: u32) -> Vec<u8> {
    path_to_bytes(&Paths::new(k * u64::from(TEAM) + u64::from(robot)).next(N_MOVES))
}

/// The steps of four robots, flown by clients that each hold some; in step k the clients send in the k-th order.
fn fly(server: &Server, shares: &[Range<u32>]) -> Vec<Vec<Seen>> {
    let flyers = shares.iter();
    let flyers: Vec<_> = flyers
        .map(|robots| Flyer::new(server, robots.clone()))
        .collect();
    let step = |k: u64| {
        let mut sent: Vec<Option<Sent>> = flyers.iter().map(|_| None).collect();
        let mut n_paths = 0;
        for index in order(k as usize, flyers.len()) {
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

/// The `number`-th order of so many.
fn order(mut number: usize, n: usize) -> Vec<usize> {
    let mut left: Vec<usize> = (0..n).collect();
    let mut order = Vec::new();
    for n_left in (1..=n).rev() {
        order.push(left.remove(number % n_left));
        number /= n_left;
    }
    order
}

#[test]
fn bytes_do_not_depend_on_sender_or_order_of_paths() {
    let together = Server::start(&format!("{FLAGS} --threads 1"));
    let all = 0..4;
    let expected = fly(&together, std::slice::from_ref(&all));
    let has_shared = |step: &Vec<Seen>| {
        let own: u32 = step.iter().map(|(_, robot, _)| robot.n_visited).sum();
        own > step[0].0.n_visited
    };
    assert!(expected.iter().any(has_shared), "no cell was visited twice");
    let apart = Server::start(&format!("{FLAGS} --threads 2"));
    let (_folder, file) = new_file();
    let recorder = start_recorder(&apart.instance, &file, "");
    assert!(fly(&apart, &[0..1, 1..2, 2..3, 3..4]) == expected);
    apart.info(); // told after the last step was published
    stop(recorder);
    let in_parts = Server::start(FLAGS);
    assert!(fly(&in_parts, &[0..3, 3..4]) == expected);

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

/// Large enough that worlds are stepped by several threads.
const LARGE: &str = "--height 128 --width 128 --moves 10 --burn-in 3 --robots 2 --worlds 8";

#[test]
fn many_worlds_at_once_are_as_each_alone_with_one_thread_and_two() {
    let [together, alone] = [2, 1].map(|n| Server::start(&format!("{LARGE} --threads {n}")));
    let (mut all, mut each) = (together.acquire(0..16), alone.acquire(0..16));
    for k in 0..4 {
        let paths = Paths::new(k).take(N_MOVES, 16);
        let seen = all.step(0..16, &paths).expect("step");
        for world in (0..8).rev() {
            let robots = 2 * world..2 * world + 2;
            let own = robots.start as usize..robots.end as usize;
            let shown = each.step(robots, &paths[own.clone()]).expect("step");
            assert!(shown == seen[own], "world {world}");
        }
    }
}

#[test]
fn a_team_frame_holds_what_all_saw_and_is_open_to_all() {
    let server = Server::start(FLAGS);
    let flyers = [0..1, 1..4].map(|robots| Flyer::new(&server, robots));
    let sent = flyers.each_ref().map(|flyer| flyer.send(0));
    let own = flyers.iter().zip(&sent);
    let own: Vec<Seen> = own.flat_map(|(flyer, sent)| flyer.shown(sent)).collect();
    drop(sent);
    let union = |cell: usize| own.iter().map(|(.., frame)| frame[cell]).min();
    let union: Vec<u8> = (0..9 * 14).filter_map(union).collect();
    let stranger = Wire::open(&server.instance);
    for (mut header, body) in [
        (observe_header(2..3), Vec::new()),
        (recall_header(2..3), step_body(&[1], &[])),
    ] {
        header.flags = FLAG_TEAM_FRAMES;
        let (reply, payload) = stranger.step(header, &body);
        let parts = split_step_payload(&reply, &payload).expect("a whole payload");
        assert_eq!(parts.worlds[..], [own[2].0]);
        assert_eq!(parts.robots[..], [own[2].1]);
        assert_eq!(parts.frames, union, "{header:?}");
    }
}

#[test]
fn a_path_that_is_withdrawn_is_never_flown() {
    let server = Server::start(&format!("{FLAGS} --lease-millis 86400000"));
    let [first, second] = [0..2, 2..4].map(|robots| Flyer::new(&server, robots));
    // Its client gives it up, and sends it again.
    let given_up = first.send(0);
    second.wait_for_paths(2);
    drop(given_up);
    second.wait_for_paths(0);
    // Its client releases its robots, which hover from then on.
    let waiting = first.send(0);
    second.wait_for_paths(2);
    let lease = first.lease;
    assert_eq!(first.wire.ask(&Request::Release { lease }), Reply::Done);
    assert_eq!(first.refusal(&waiting), (Status::LeaseLost, 0));
    drop(waiting);
    let sent = second.send(0);
    let world = second.shown(&sent)[0].0;
    assert_eq!((world.step, world.hovered, world.late), (1, 3, 0));
    drop(sent);
    // One of its robots is taken over: the path of the other is withdrawn with it.
    let first = Flyer::new(&server, 0..2);
    let waiting = first.send(1);
    second.wait_for_paths(2);
    let thief = server.take_over(1..2);
    let us = u64::from(std::process::id());
    assert_eq!(first.refusal(&waiting), (Status::LeaseLost, us));
    second.wait_for_paths(0);
    // The connection of who waits is closed.
    drop((waiting, thief));
    let waiting = second.send(1);
    first.wait_for_paths(2);
    drop((waiting, second));
    first.wait_for_paths(0);
    assert_eq!(server.step_of(0), 1, "nothing was flown");
}

#[test]
fn a_late_path_is_refused_and_not_flown_in_a_later_step() {
    let server = Server::start(&format!("{FLAGS} --lease-millis 86400000 --deadline-ms 50"));
    let observer = Observer::frames(&server.instance).expect("observe");
    let mut mirror = Mirror::of(&server.info());
    let flyers = [0..1, 1..4].map(|robots| Flyer::new(&server, robots));
    let [quick, slow] = &flyers;
    let (world, robot, _) = quick.shown(&quick.send(0)).remove(0);
    assert_eq!((world.step, world.late, robot.n_moves), (1, 0b1110, 10));
    assert_eq!(slow.refusal(&slow.send(0)), (Status::Late, 1));
    assert_eq!(slow.refusal(&slow.send(2)), (Status::Early, 1));
    // The next step has the paths that were meant for it, whichever come in time.
    let sent = flyers.each_ref().map(|flyer| flyer.send(1));
    let mut answers = flyers.iter().zip(&sent);
    assert!(answers.any(|(flyer, sent)| flyer.refusal(sent).0 == Status::Ok));
    for step in frames_until(&observer, 0, 2) {
        mirror.follow(&step);
        for (robot, sample) in (0..).zip(robots_of(&step)) {
            let k = step.header.result.step.saturating_sub(1);
            assert!(sample.path.is_empty() || sample.path == path(k, robot));
        }
    }
}

#[test]
fn who_holds_no_robot_can_neither_fly_nor_read_ahead_nor_block() {
    let server = Server::start(&format!("{FLAGS} --lease-millis 86400000"));
    let flyers = [0..1, 1..4].map(|robots| Flyer::new(&server, robots));
    let frames = Observer::frames(&server.instance).expect("the channel");
    let stranger = Wire::open(&server.instance);
    let observe = || stranger.step(observe_header(0..TEAM), &[]).1;
    for k in 0..5 {
        let before = observe();
        let first = flyers[0].send(k);
        flyers[1].wait_for_paths(1);
        assert!(observe() == before, "a path that waits is shown");
        for (robot, lease) in [(0, flyers[0].lease), (1, flyers[1].lease), (1, 0)] {
            let header = StepRequest {
                first_robot: robot,
                ..step_header(lease, N_MOVES as u32)
            };
            let body = step_body(&[k], &[3; N_MOVES]);
            let refused = stranger.status_of(header, &body);
            assert_eq!(refused, (Status::NoLease, robot.into()));
        }
        let ahead = stranger.status_of(recall_header(0..TEAM), &step_body(&[k + 1], &[]));
        assert_eq!(ahead, (Status::NotKept, k));
        let reset = |lease| Request::Reset {
            lease,
            worlds: vec![seed(0, None)],
        };
        let acquired = stranger.ask(&acquire_request(3..4));
        assert_eq!(acquired.status(), Status::Busy);
        let stolen = stranger.ask(&reset(flyers[0].lease));
        assert_eq!(stolen.status(), Status::NoLease);
        // Not even who holds some of its robots may reset the world.
        let own = flyers[1].wire.ask(&reset(flyers[1].lease));
        assert_eq!(own.status(), Status::Busy);
        assert!(observe() == before);
        flyers[1].wait_for_paths(1);
        let second = flyers[1].send(k);
        let shown = [flyers[0].shown(&first), flyers[1].shown(&second)].concat();
        let mut worlds = shown.iter().map(|(world, ..)| world);
        assert!(worlds.all(|world| (world.step, world.hovered) == (k + 1, 0)));
    }
    // What was refused is not published either: each step once, after the present state for a new observer.
    let mut steps = Vec::new();
    while steps.last() != Some(&5) {
        let sample = frames.receive(PATIENCE).expect("the channel");
        steps.push(sample.expect("a sample").header.result.step);
    }
    assert!(
        steps.is_sorted_by(|before, after| before < after),
        "{steps:?}"
    );
}

/// A world of agents, and of robot 0, which this process flies.
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
        let flags = format!("--robot {robot} --policy random_walk {flags}");
        Program::agent(&self.server.instance, &flags)
    }

    /// Three agents, once all robots fly.
    fn start_agents(&mut self) -> [Program; 3] {
        let agents = [1, 2, 3].map(|robot| self.start_agent(robot, ""));
        self.until(&agents.each_ref(), all_fly);
        agents
    }

    /// Steps until a result is as wanted; every step on the way must be as its own paths make it.
    fn until(&mut self, agents: &[&Program], wanted: impl Fn(&WorldResult) -> bool) {
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

/// No robot stays.
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
    // It has no world to wait for it: it asks by itself, and hears.
    three.ends(3).check_says("lease lost");
}

#[test]
fn a_stopped_agent_is_late_and_flies_again_when_it_wakes() {
    let mut lab = Lab::new("--lease-millis 86400000 --deadline-ms 200");
    let [one, two, mut three] = lab.start_agents();
    three.stop();
    for _ in 0..3 {
        lab.until(&[&three], |world| world.late & 0b1000 != 0);
        assert_eq!(lab.step().hovered, 0, "it holds its robot");
    }
    three.signal(Signal::CONT);
    lab.until(&[&one, &two, &three], all_fly);
    three.wait_for_words("late: the world went on");
    assert!(!three.has_ended(), "{}", three.stderr());
}

#[test]
fn one_agent_flies_a_team_and_others_share_its_frames() {
    let server = Server::start(FLAGS);
    let observer = Observer::frames(&server.instance).expect("observe");
    let mut mirror = Mirror::of(&server.info());
    let run = |flags: &str| Program::agent(&server.instance, &format!("--steps 10 {flags}"));
    run("--robots 0..4 --team").ends(0);
    let mates = [0, 1, 2, 3].map(|robot| run(&format!("--robot {robot} --share")));
    for mate in mates {
        mate.ends(0);
    }
    let steps = server.step_of(0);
    let n_new = frames_until(&observer, 0, steps)
        .iter()
        .filter(|sample| mirror.follow(sample))
        .count();
    assert_eq!(n_new as u64, steps);
    assert!(steps >= 20, "{steps}");
}
