//! A browser's request for a picture, and the picture that answers it. Does no I/O.
//!
//! A picture is a `u32` length, JSON of this length in bytes (a `Header`), and the arrays that the JSON lists. The JSON
//! is padded with spaces and each array with zeros, so that all arrays begin at multiples of eight bytes. Numbers are
//! little-endian.

use crate::album::Strip;
use crate::entry::Entry;
use crate::last_seen::LastSeen;
use crate::scene::{Info, Lost, Player, Scene};
use emberwatch_protocol::control::ServerStatus;
use emberwatch_protocol::frame::UNOBSERVED;
use emberwatch_protocol::{Airspace, Grid};
use serde::{Deserialize, Serialize};
use std::time::{Duration, Instant};

/// Minimum and maximum number of points of a time series.
const BINS: (usize, usize) = (16, 2000);

/// Marks a point of the time series without an objective.
const NO_OBJECTIVE: u8 = 255;

/// Maximum number of distinct objectives. Any further objective is shown as the last of these.
const MAX_OBJECTIVES: usize = 255;

/// Maximum age difference for which a step with a belief is shown instead of a newer step without a belief.
const BELIEF_LAG: Duration = Duration::from_millis(200);

/// Time without a new belief after which an agent counts as silent.
const SILENCE: Duration = Duration::from_secs(2);

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ask {
    pub world: u32,
    /// Serial number of a step; `None` for the newest.
    pub at: Option<u64>,
    pub bins: usize,
    /// A recording's new speed, in the unit of [`Player::speed`].
    #[serde(default)]
    pub speed: Option<f64>,
    #[serde(default)]
    pub playing: Option<bool>,
}

#[derive(Debug, Serialize)]
struct Header<'a> {
    instance: &'a str,
    source: &'static str,
    state: &'static str,
    note: Option<&'a str>,
    info: Option<&'a Info>,
    status: Option<&'a ServerStatus>,
    world: u32,
    kept: Option<Range>,
    shown: Option<Shown>,
    agent: Option<AgentFacts<'a>>,
    lost: Lost,
    player: Option<&'a Player>,
    objectives: Vec<&'a str>,
    series: Option<Series>,
    arrays: Vec<Listing>,
}

#[derive(Debug, Serialize)]
struct Range {
    first: u64,
    last: u64,
}

#[derive(Debug, Serialize)]
struct Shown {
    serial: u64,
    height: usize,
    width: usize,
    seen_since: u64,
    /// Text, because JavaScript represents only integers up to 53 bits exactly.
    seed: String,
    episode: u64,
    step: u64,
    reward: f64,
    n_visited: u32,
    n_hits: u32,
    n_target_cells: u32,
    robots: Vec<ShownRobot>,
    terminated: bool,
    truncated: bool,
    log_loss: Option<f64>,
    brier: Option<f64>,
}

#[derive(Debug, Serialize)]
struct ShownRobot {
    /// `flew`, `hovered`, `late`, or `new` after a reset.
    state: &'static str,
    cell: [u32; 2],
    /// Row and column of each cell, beginning with the start.
    path: Vec<[usize; 2]>,
    share: f64,
}

#[derive(Debug, Serialize)]
struct AgentFacts<'a> {
    pid: u32,
    /// The first robot that the agent flies, numbered within the world.
    first_robot: u32,
    n_robots: u32,
    policy: &'a str,
    belief_from: &'a str,
    objective: &'a str,
    plan_millis: f64,
    states: &'a [String],
    /// The step that the belief is about: the shown step or an earlier one.
    step: u64,
    is_live: bool,
}

#[derive(Debug, Serialize)]
struct Series {
    first: u64,
    last: u64,
    bins: usize,
    first_step: u64,
    last_step: u64,
}

#[derive(Debug, Serialize)]
struct Listing {
    name: &'static str,
    #[serde(rename = "type")]
    kind: &'static str,
    length: usize,
}

#[derive(Default)]
struct Arrays {
    listings: Vec<Listing>,
    bytes: Vec<u8>,
}

/// Builds the picture that a browser requested. An agent whose last belief is not recent at `now` counts as silent.
pub fn picture(scene: &Scene, ask: &Ask, now: Instant) -> Vec<u8> {
    let strip = scene.album.strip(ask.world);
    let chosen = strip.and_then(|strip| match ask.at {
        Some(serial) => strip.nearest(serial),
        None => newest(strip),
    });
    let believed = chosen.and_then(|(serial, _)| strip?.believed(serial));
    let mut arrays = Arrays::default();
    let (mut objectives, mut series, mut since) = (Vec::new(), None, 0);
    if let (Some(strip), Some((serial, entry))) = (strip, chosen) {
        since = arrays.add_grids(strip, serial, entry);
        arrays.add_land(scene.info.as_ref(), entry);
        arrays.add_belief(believed);
        (objectives, series) = arrays.add_series(strip, ask.bins.clamp(BINS.0, BINS.1));
    }
    let is_live = |entry: &Entry| now.duration_since(entry.at) < SILENCE;
    let header = Header {
        instance: &scene.instance,
        source: scene.player.as_ref().map_or("live", |_| "recording"),
        state: if scene.is_serving {
            "serving"
        } else {
            "waiting"
        },
        note: scene.note.as_deref().or(scene.trouble.as_deref()),
        info: scene.info.as_ref(),
        status: scene.status.as_ref(),
        world: ask.world,
        kept: strip
            .and_then(Strip::kept)
            .map(|(first, last)| Range { first, last }),
        shown: chosen.map(|(serial, entry)| {
            Shown::of(serial, entry, since, &airspace(scene.info.as_ref(), entry))
        }),
        agent: believed.and_then(|entry| AgentFacts::of(entry, is_live(entry))),
        lost: scene.lost,
        player: scene.player.as_ref(),
        objectives,
        series,
        arrays: arrays.listings,
    };
    [framed(&header), arrays.bytes].concat()
}

/// Returns the newest step with a belief if it is at most [`BELIEF_LAG`] older than the newest step. Otherwise, returns
/// the newest step.
fn newest(strip: &Strip) -> Option<(u64, &Entry)> {
    let (_, last) = strip.kept()?;
    let newest = strip.nearest(last)?;
    let is_recent = |entry: &&Entry| newest.1.at.duration_since(entry.at) < BELIEF_LAG;
    let mut recent = (0..).zip(strip.back_from(last).take_while(is_recent));
    let believed = recent.find(|(_, entry)| entry.belief.is_some());
    Some(believed.map_or(newest, |(back, entry)| (last - back, entry)))
}

fn framed(header: &Header<'_>) -> Vec<u8> {
    let mut text = serde_json::to_vec(header).expect("invariant: a header serialises");
    text.resize((text.len() + 4).next_multiple_of(8) - 4, b' ');
    let mut bytes = (text.len() as u32).to_le_bytes().to_vec();
    bytes.extend(text);
    bytes
}

impl Arrays {
    fn add(&mut self, name: &'static str, kind: &'static str, length: usize, bytes: &[u8]) {
        self.listings.push(Listing { name, kind, length });
        self.bytes.extend(bytes);
        self.bytes.resize(self.bytes.len().next_multiple_of(8), 0);
    }

    fn add_bytes(&mut self, name: &'static str, bytes: &[u8]) {
        self.add(name, "u8", bytes.len(), bytes);
    }

    fn add_floats(&mut self, name: &'static str, numbers: &[f32]) {
        let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
        self.add(name, "f32", numbers.len(), &bytes);
    }

    /// Adds the grids of states and observations. Returns the first step that `seen` covers.
    fn add_grids(&mut self, strip: &Strip, serial: u64, entry: &Entry) -> u64 {
        if let Some(truth) = &entry.truth {
            self.add_bytes("truth", truth);
        }
        let mut frame = vec![UNOBSERVED; entry.shape.n_cells()];
        for &(cell, value) in &entry.seen {
            frame[cell as usize] = value;
        }
        self.add_bytes("frame", &frame);
        let last = LastSeen::of(strip, serial, entry);
        self.add_bytes("seen", &last.seen);
        self.add_bytes("age", &last.age);
        last.since
    }

    /// Adds the model's maps, one after another, and that of no-fly cells, unless the entry's grid differs from the
    /// server's.
    fn add_land(&mut self, info: Option<&Info>, entry: &Entry) {
        let airspace = info.and_then(|info| info.airspace.as_ref());
        let no_fly = airspace.and_then(|airspace| airspace.no_fly());
        let no_fly = no_fly.map(|map| map.mapv(u8::from));
        let fits = |map: &&Grid<u8>| map.dim() == entry.shape.dim();
        let maps = info.into_iter().flat_map(|info| &info.levels).filter(fits);
        for (name, maps) in [
            ("maps", maps.collect()),
            ("no_fly", Vec::from_iter(no_fly.as_ref().filter(fits))),
        ] {
            if !maps.is_empty() {
                self.add_bytes(
                    name,
                    &maps.into_iter().flatten().copied().collect::<Vec<_>>(),
                );
            }
        }
    }

    fn add_belief(&mut self, believed: Option<&Entry>) {
        if let Some(belief) = believed.and_then(|entry| entry.belief.as_ref()) {
            self.add_bytes("belief", &belief.levels);
            self.add_bytes("entropy", &belief.entropy);
        }
    }

    /// Adds time series over all kept steps, divided into `n_bins` bins. Each bin contains means over its steps, and
    /// its last objective. Returns the names of the objectives, and the range of the bins.
    fn add_series<'a>(
        &mut self,
        strip: &'a Strip,
        n_bins: usize,
    ) -> (Vec<&'a str>, Option<Series>) {
        let n_entries = strip.entries().len();
        let mut objectives: Vec<&str> = Vec::new();
        let mut means = [(); 3].map(|()| vec![(0f64, 0u32); n_bins]);
        let mut chosen = vec![NO_OBJECTIVE; n_bins];
        for (index, entry) in strip.entries().enumerate() {
            let bin = index * n_bins / n_entries;
            let belief = entry.belief.as_ref();
            let log_loss = belief.and_then(|belief| Some(belief.score?.log_loss));
            let values = [
                entry.is_step().then_some(entry.result.reward),
                Some(entry.result.n_target_cells.into()),
                log_loss,
            ];
            for (mean, value) in means.iter_mut().zip(values) {
                if let Some(value) = value {
                    mean[bin] = (mean[bin].0 + value, mean[bin].1 + 1);
                }
            }
            if let Some(belief) = belief {
                chosen[bin] = number_of(&belief.intent.objective, &mut objectives);
            }
        }
        let names = ["series_reward", "series_target", "series_log_loss"];
        for (name, mean) in names.into_iter().zip(means) {
            let means = mean.iter().map(|(sum, n)| (sum / f64::from(*n)) as f32);
            self.add_floats(name, &means.collect::<Vec<_>>());
        }
        self.add_bytes("series_objective", &chosen);
        (objectives, Series::of(strip, n_bins))
    }
}

fn number_of<'a>(objective: &'a str, objectives: &mut Vec<&'a str>) -> u8 {
    let known = objectives.iter().position(|known| *known == objective);
    let number = known.unwrap_or_else(|| {
        if objectives.len() < MAX_OBJECTIVES {
            objectives.push(objective);
        }
        objectives.len() - 1
    });
    number as u8
}

fn airspace(info: Option<&Info>, entry: &Entry) -> Airspace {
    let known = info.and_then(|info| info.airspace.clone());
    let known = known.filter(|airspace| airspace.shape() == entry.shape);
    known.unwrap_or_else(|| Airspace::open(entry.shape))
}

impl Shown {
    fn of(serial: u64, entry: &Entry, seen_since: u64, airspace: &Airspace) -> Self {
        let result = &entry.result;
        let score = entry.belief.as_ref().and_then(|belief| belief.score);
        Self {
            serial,
            height: entry.shape.height(),
            width: entry.shape.width(),
            seen_since,
            seed: result.seed.to_string(),
            episode: result.episode,
            step: result.step,
            reward: result.reward,
            n_visited: result.n_visited,
            n_hits: result.n_hits,
            n_target_cells: result.n_target_cells,
            robots: (0..entry.robots.len())
                .map(|index| ShownRobot::of(entry, index, airspace))
                .collect(),
            terminated: result.terminated != 0,
            truncated: result.truncated != 0,
            log_loss: score.map(|score| score.log_loss),
            brier: score.map(|score| score.brier),
        }
    }
}

impl ShownRobot {
    fn of(entry: &Entry, index: usize, airspace: &Airspace) -> Self {
        let robot = &entry.robots[index];
        let is_among = |robots: u64| robots >> index & 1 == 1;
        let path = robot.path(airspace).into_iter();
        Self {
            state: if is_among(entry.result.hovered) {
                "hovered"
            } else if is_among(entry.result.late) {
                "late"
            } else if robot.moves.is_empty() {
                "new"
            } else {
                "flew"
            },
            cell: [robot.result.row, robot.result.col],
            path: path.map(|cell| [cell.row, cell.col]).collect(),
            share: robot.result.reward,
        }
    }
}

impl<'a> AgentFacts<'a> {
    fn of(entry: &'a Entry, is_live: bool) -> Option<Self> {
        let belief = entry.belief.as_ref()?;
        let intent = &belief.intent;
        Some(Self {
            pid: belief.pid,
            first_robot: belief.first_robot % entry.robots.len() as u32,
            n_robots: belief.n_robots,
            policy: &intent.policy,
            belief_from: &intent.belief_from,
            objective: &intent.objective,
            plan_millis: intent.plan_millis,
            states: &intent.states,
            step: entry.result.step,
            is_live,
        })
    }
}

impl Series {
    fn of(strip: &Strip, bins: usize) -> Option<Self> {
        let (first, last) = strip.kept()?;
        let step = |serial| strip.nearest(serial).map(|(_, entry)| entry.result.step);
        Some(Self {
            first,
            last,
            bins,
            first_step: step(first)?,
            last_step: step(last)?,
        })
    }
}
