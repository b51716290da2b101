//! A world whose robots are flown by a process each: these are killed, stopped, told to end and taken over at random
//! moments, while this process flies one more robot, which paces the world, and checks each step.

use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::planning::team::robot_seed;
use emberwatch_belief::planning::{
    CellValues, Objective, Planner, PlanningProblem, RandomWalk, Target,
};
use emberwatch_learning::config::AgentConfig;
use emberwatch_protocol::message::FrameHeader;
use emberwatch_protocol::observer::Sample;
use emberwatch_protocol::path::path_to_bytes;
use emberwatch_protocol::{Cell, Shape};
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rustix::process::Signal;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tests::harness::{PATIENCE, Program, Server, eventually, robots_of};
use tests::mirror::PacedWorld;
use tests::report::{say, spread};

const FLAGS: &str = "--height 64 --width 64 --moves 64 --burn-in 1000 --robots 5 --deadline-ms 100 \
                     --lease-millis 86400000";

/// Robots that agents fly; this process flies the one after them.
const N_AGENTS: usize = 4;

/// What happens to agents.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Event {
    Kill,
    Stop,
    Restart,
    TakeOver,
}

const EVENTS: [Event; 4] = [Event::Kill, Event::Stop, Event::Restart, Event::TakeOver];

/// What the last step was.
#[derive(Default)]
struct Last {
    step: AtomicU64,
    hovered: AtomicU64,
    late: AtomicU64,
}

/// A step: when it was seen here, and the robots that stayed.
struct Step {
    at: Instant,
    hovered: u64,
    late: u64,
}

/// Does each of the events so many times; every step on the way must be as its paths and masks make it, and every path
/// the one that its agent plans for this very step.
pub fn disturb(n_times: usize) {
    let server = Server::start(FLAGS);
    let (last, is_done) = (Last::default(), AtomicBool::new(false));
    let mut world = PacedWorld::new(&server, N_AGENTS as u32);
    let started = Instant::now();
    let (steps, events) = std::thread::scope(|scope| {
        let crowd = scope.spawn(|| {
            let end = Done(&is_done);
            let events = Crowd::new(&server, &last).disturb(n_times);
            drop(end);
            events
        });
        let steps = observe(&mut world, &last, &is_done);
        (steps, crowd.join().expect("the agents"))
    });
    let (n_steps, seconds) = (world.last.step, started.elapsed().as_secs_f64());
    assert_eq!(server.step_of(0), n_steps);
    say(&format!(
        "{} events in {seconds:.0} s, {n_times} of each of {EVENTS:?}; the same server process answers",
        events.len()
    ));
    let n_late = steps.iter().filter(|step| step.late != 0).count();
    say(&format!(
        "{n_steps} steps, each made once, all as their own paths make them, all paths planned for their step; \
         in {n_late} a robot was late"
    ));
    let pairs = steps.windows(2);
    let seconds = pairs.map(|pair| (pair[1].at - pair[0].at).as_secs_f64());
    say(&format!("from step to step: {}", spread(seconds.collect())));
    for (kind, words) in [(Event::Kill, "a kill"), (Event::Stop, "a stop")] {
        let delays = spread(delays(&steps, &events, kind));
        say(&format!(
            "from {words} to the first step without the agent: {delays}"
        ));
    }
}

/// Says so when the thread ends, also if it fails.
struct Done<'a>(&'a AtomicBool);

impl Drop for Done<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Seconds from each such event to the first step in which its robot stayed.
fn delays(steps: &[Step], events: &[(Event, usize, Instant)], kind: Event) -> Vec<f64> {
    let events = events.iter().filter(|(event, ..)| *event == kind);
    let delay = |(_, robot, at): &(Event, usize, Instant)| {
        let next = steps.partition_point(|step| step.at < *at);
        let stayed = |step: &&Step| (step.hovered | step.late) >> robot & 1 == 1;
        let step = steps[next..].iter().find(stayed).expect("it stayed");
        (step.at - *at).as_secs_f64()
    };
    events.map(delay).collect()
}

/// Flies and checks until it is done.
fn observe(world: &mut PacedWorld, last: &Last, is_done: &AtomicBool) -> Vec<Step> {
    let (paths, mut steps) = (PlannedPaths::new(), Vec::new());
    while !is_done.load(Ordering::Relaxed) {
        world.step(|sample| paths.check(sample));
        let result = world.last;
        steps.push(Step {
            at: Instant::now(),
            hovered: result.hovered,
            late: result.late,
        });
        last.hovered.store(result.hovered, Ordering::Relaxed);
        last.late.store(result.late, Ordering::Relaxed);
        last.step.store(result.step, Ordering::Release);
    }
    steps
}

/// What an agent that walks randomly flies from each step on.
struct PlannedPaths {
    config: AgentConfig,
    values: CellValues,
}

impl PlannedPaths {
    fn new() -> Self {
        let shape = Shape::new(64, 64).expect("a grid");
        let any = Objective::new(Target::Coverage);
        Self {
            config: AgentConfig::default(),
            values: any.values(&Belief::uniform(3, shape)),
        }
    }

    fn check(&self, sample: &Sample<FrameHeader>) {
        let world = sample.header.result;
        let robots = robots_of(sample).into_iter().enumerate();
        for (robot, sample) in robots.take(N_AGENTS).filter(|(_, it)| !it.path.is_empty()) {
            let problem = PlanningProblem {
                start: Cell { row: 0, col: 0 },
                n_moves: 64,
                values: &self.values,
                seed: robot_seed(self.config.planner_seed(world.seed), robot),
                step: world.step - 1,
            };
            let planned = path_to_bytes(&RandomWalk.plan(&problem).moves);
            assert!(
                sample.path == planned,
                "robot {robot} flew a path of another step"
            );
        }
    }
}

/// The agents and what happens to them.
struct Crowd<'a> {
    server: &'a Server,
    last: &'a Last,
    agents: Vec<Program>,
    rng: ChaCha8Rng,
    events: Vec<(Event, usize, Instant)>,
}

impl<'a> Crowd<'a> {
    fn new(server: &'a Server, last: &'a Last) -> Self {
        let agents = (0..N_AGENTS).map(|robot| start(server, robot, ""));
        let crowd = Self {
            server,
            last,
            agents: agents.collect(),
            rng: ChaCha8Rng::seed_from_u64(0),
            events: Vec::new(),
        };
        (0..N_AGENTS).for_each(|robot| crowd.wait_until_it_flies(robot));
        crowd
    }

    fn disturb(mut self, n_times: usize) -> Vec<(Event, usize, Instant)> {
        let mut events = EVENTS.repeat(n_times);
        events.shuffle(&mut self.rng);
        for event in events {
            let robot = self.rng.random_range(0..N_AGENTS);
            std::thread::sleep(Duration::from_micros(self.rng.random_range(0..5_000)));
            self.events.push((event, robot, Instant::now()));
            match event {
                Event::Kill => self.kill(robot),
                Event::Stop => self.stop(robot),
                Event::Restart => self.restart(robot),
                Event::TakeOver => self.take_over(robot),
            }
            self.wait_until_it_flies(robot);
        }
        self.events
    }

    fn kill(&mut self, robot: usize) {
        self.agents[robot].signal(Signal::KILL);
        self.wait(robot, "hover", |last| last.hovered.load(Ordering::Relaxed));
        self.agents[robot] = start(self.server, robot, "");
    }

    fn stop(&mut self, robot: usize) {
        self.agents[robot].signal(Signal::STOP);
        self.wait(robot, "be late", |last| last.late.load(Ordering::Relaxed));
        std::thread::sleep(Duration::from_millis(self.rng.random_range(0..150)));
        self.agents[robot].signal(Signal::CONT);
    }

    fn restart(&mut self, robot: usize) {
        self.agents.remove(robot).finish();
        self.agents.insert(robot, start(self.server, robot, ""));
    }

    fn take_over(&mut self, robot: usize) {
        let next = start(self.server, robot, "--takeover");
        std::mem::replace(&mut self.agents[robot], next).ends(3);
    }

    fn wait(&self, robot: usize, what: &str, mask: impl Fn(&Last) -> u64) {
        let is_so = eventually(PATIENCE, || mask(self.last) >> robot & 1 == 1);
        assert!(
            is_so,
            "robot {robot} should {what}: {}",
            self.agents[robot].stderr()
        );
    }

    fn wait_until_it_flies(&self, robot: usize) {
        let pid = Some(self.agents[robot].pid());
        self.agents[robot].until(|| self.server.status().worlds[0].holder_pids[robot] == pid);
        let at = self.last.step.load(Ordering::Acquire);
        let flies = |last: &Last| {
            let step = last.step.load(Ordering::Acquire);
            let stayed = last.hovered.load(Ordering::Relaxed) | last.late.load(Ordering::Relaxed);
            if step > at + 1 { !stayed } else { 0 }
        };
        self.wait(robot, "fly", flies);
    }
}

fn start(server: &Server, robot: usize, flags: &str) -> Program {
    let flags = format!("--robot {robot} --policy random_walk {flags}");
    Program::agent(&server.instance, &flags)
}
