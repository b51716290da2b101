//! [`Mirror`] is a copy of a server's world in this process, which repeats the published steps to check them.
//! [`PacedWorld`] is a world on a server that waits after each step until the step is checked.

use crate::harness::{PATIENCE, Paths, Server, frames_until, robots_of};
use emberwatch_protocol::client::Claim;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::ServerInfo;
use emberwatch_protocol::message::{FrameHeader, RobotResult, Status, WorldResult};
use emberwatch_protocol::observer::{Observer, Sample};
use emberwatch_protocol::path::{path_from_bytes, path_to_bytes};
use emberwatch_protocol::settings::WorldSettings;
use emberwatch_protocol::{Client, Coverage, Move};
use emberwatch_sim::config::ServerConfig;
use emberwatch_sim::results::{robot_result, world_result};
use emberwatch_sim::snapshot::WorldSpec;
use emberwatch_sim::world::{Episode, Flown, Robot, Rules};
use std::time::{Duration, Instant};

/// Duration of a lease that does not expire during a test.
const LONG: Duration = Duration::from_secs(3600);

/// The expected state of world 0 of a server.
pub struct Mirror {
    rules: Rules,
    episode: Episode,
}

impl Mirror {
    /// Creates the world at k = 0 of the first episode. The server's settings that `info` does not contain must have
    /// their default values.
    pub fn of(info: &ServerInfo) -> Self {
        let config = ServerConfig {
            world: WorldSettings {
                height: info.height,
                width: info.width,
                moves: info.n_moves,
                robots: info.n_robots,
                burn_in: info.burn_in,
                ..WorldSettings::default()
            },
            ..ServerConfig::default()
        };
        let seed = config.seed;
        let checked = config.check().expect("valid settings");
        let rules = WorldSpec::of(&checked).expect("a valid model").rules;
        let episode = Episode::new(&rules, seed);
        Self { rules, episode }
    }

    /// Repeats a published step with the paths and masks in its sample. Returns false if the sample shows the same step
    /// as the previous one.
    ///
    /// # Panics
    /// If a step is missing, or the sample differs from the result of its paths.
    pub fn follow(&mut self, sample: &Sample<FrameHeader>) -> bool {
        let (world, k) = (sample.header.result, self.episode.outcome().step);
        let robots = robots_of(sample);
        let is_new = world.step != k;
        if is_new {
            assert_eq!(world.step, k + 1, "a step was lost, or made twice");
            let path = |bytes| path_from_bytes(bytes).expect("a path");
            let flown = robots.iter().map(|robot| (path(robot.path), robot.result));
            step_again(&mut self.episode, &self.rules, &world, flown);
        }
        assert_eq!(world_result(self.episode.outcome()), world);
        for (index, (robot, shown)) in self.episode.robots().iter().zip(&robots).enumerate() {
            assert_eq!(
                robot_result(robot.outcome()),
                shown.result,
                "robot {index}, step {k}"
            );
            let expected = (shown.frame, shown.path.to_vec());
            assert_eq!(seen(robot), expected, "robot {index}, step {k}");
        }
        is_new
    }
}

/// Repeats a step, given its result and the robots' paths. The paths of robots that hovered or were late are empty.
fn step_again(
    episode: &mut Episode,
    rules: &Rules,
    told: &WorldResult,
    robots: impl ExactSizeIterator<Item = (Vec<Move>, RobotResult)>,
) {
    let all = (1 << robots.len()) - 1;
    let mut moves = vec![Move::Up; rules.n_robots * rules.n_moves];
    let (mut ready, mut full) = (0, 0);
    for (index, (path, result)) in robots.enumerate() {
        moves[index * rules.n_moves..][..path.len()].copy_from_slice(&path);
        ready |= u64::from(!path.is_empty()) << index;
        full |= u64::from(result.coverage == Coverage::Full as u32) << index;
    }
    let (hovered, late) = (told.hovered, told.late);
    // Each robot either flew, hovered or was late.
    assert_eq!(ready ^ hovered ^ late, all);
    assert_eq!(hovered & late, 0);
    let flown = Flown {
        moves: &moves,
        ready,
        full,
        hovered,
        late,
    };
    episode.step(rules, &flown);
}

fn seen(robot: &Robot) -> (&[u8], Vec<u8>) {
    (robot.frame().as_bytes(), path_to_bytes(robot.path()))
}

/// World 0 of a server. This process flies one robot. It checks each step before it sends the next path, so that it
/// misses no step.
pub struct PacedWorld {
    pub client: Client,
    pub last: WorldResult,
    observer: Observer<FrameHeader>,
    mirror: Mirror,
    paths: Paths,
}

impl PacedWorld {
    /// Acquires a free robot in a world at k = 0.
    pub fn new(server: &Server, robot: u32) -> Self {
        let observer = Observer::frames(&server.instance).expect("observe");
        frames_until(&observer, 0, 0);
        let claim = Claim {
            time_to_live: Some(LONG),
            ..Claim::new(robot..robot + 1)
        };
        Self {
            client: Client::acquire(server.connect(), &claim).expect("acquire"),
            last: WorldResult::default(),
            observer,
            mirror: Mirror::of(&server.info()),
            paths: Paths::new(0),
        }
    }

    /// Flies a path, then checks all steps that have been published since the last call and passes each to `tell`.
    pub fn step(&mut self, mut tell: impl FnMut(&Sample<FrameHeader>)) {
        let path = self.paths.next(self.client.info().n_moves);
        let (start, robots) = (Instant::now(), self.client.robots());
        let is_over = || start.elapsed() > PATIENCE;
        let flown = self.client.step_until(robots.clone(), &[path], &is_over);
        match flown {
            Ok(Some(_)) => {}
            // The path was late, because this process was not scheduled in time. It continues with the next step.
            Err(ConnectionError::Refused {
                status: Status::Late,
                ..
            }) => {}
            other => panic!("the world does not move: {other:?}"),
        }
        let now = self.client.observe(robots).expect("observe")[0].world;
        for sample in frames_until(&self.observer, 0, now.step) {
            if self.mirror.follow(&sample) {
                self.last = sample.header.result;
                tell(&sample);
            }
        }
    }
}
