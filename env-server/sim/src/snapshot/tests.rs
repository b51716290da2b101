//! Tests of intact, damaged and forged snapshots.

use super::format::{HEADER_BYTES, NewEpisode, SnapshotWorld, decode, encode};
use super::settings::{Settings, WorldSpec};
use crate::simulator::tests::lab::settings;
use crate::world::{Episode, Flown, Rules, SavedWorld};
use emberwatch_model::{Airspace, Cell, Grid, Move};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::sync::Arc;

const NEW: NewEpisode = NewEpisode {
    seed: 7,
    episode: 3,
};

fn spec() -> WorldSpec {
    let given =
        json!({"history": 4, "height": 3, "width": 5, "moves": 2, "robots": 2, "burn_in": 300});
    WorldSpec::of(&settings(given)).expect("a valid model")
}

fn episodes(rules: &Rules) -> Vec<Episode> {
    let mut episodes = vec![Episode::new(rules, 1), Episode::new(rules, 2)];
    for _ in 0..6 {
        step(rules, &mut episodes[1], 0);
    }
    step(rules, &mut episodes[1], 0b01);
    episodes
}

/// Flies both robots. Robots in `full` observe every cell.
fn step(rules: &Rules, episode: &mut Episode, full: u64) {
    let flown = Flown {
        moves: &[Move::Right, Move::Down, Move::Left, Move::Up],
        ready: 0b11,
        full,
        ..Flown::default()
    };
    episode.step(rules, &flown);
}

fn bytes(settings: &Settings, episodes: &[Episode]) -> Vec<u8> {
    let mut worlds: Vec<_> = episodes.iter().map(SnapshotWorld::Ready).collect();
    worlds.push(SnapshotWorld::New(NEW));
    encode(settings, &worlds).expect("small")
}

#[test]
fn a_snapshot_is_read_as_it_was_written() {
    let spec = spec();
    let written = bytes(&spec.settings, &episodes(&spec.rules));
    let snapshot = decode(&written).expect("a snapshot");
    let mut restored = snapshot.restore(&spec).expect("a fit");
    let last = restored.pop().expect("three worlds");
    assert!(matches!(last, SnapshotWorld::New(NEW)));
    let episode = |world: SnapshotWorld<Box<Episode>>| match world {
        SnapshotWorld::Ready(episode) => *episode,
        SnapshotWorld::New(_) => panic!("expected a world at a step"),
    };
    let episodes: Vec<Episode> = restored.into_iter().map(episode).collect();
    assert_eq!(bytes(&spec.settings, &episodes), written);
}

#[test]
fn every_truncation_and_every_changed_byte_is_detected() {
    let spec = spec();
    let mut bytes = bytes(&spec.settings, &episodes(&spec.rules));
    for at in 0..bytes.len() {
        assert!(decode(&bytes[..at]).is_err(), "cut to {at}");
        bytes[at] ^= 1 << (at % 8);
        assert!(decode(&bytes).is_err(), "byte {at}");
        bytes[at] ^= 1 << (at % 8);
    }
    let (header, body) = bytes.split_at(HEADER_BYTES);
    let refusal = |header: &[u8], body: &[u8]| {
        let refused = decode(&[header, body].concat());
        refused.expect_err("no snapshot").to_string()
    };
    // A hostile author can write any body with a matching header.
    let sealed = |body: &[u8]| {
        let mut header = header.to_vec();
        header[12..16].copy_from_slice(&crc32fast::hash(body).to_ne_bytes());
        header[16..].copy_from_slice(&(body.len() as u64).to_ne_bytes());
        refusal(&header, body)
    };
    let longer = [body, &[0]].concat();
    let (expected, got) = (body.len(), longer.len());
    let words = format!("damaged: expected {expected} bytes, got {got}");
    assert_eq!(refusal(header, &longer), words);
    let words = "malformed: 1 bytes after the last world";
    assert_eq!(sealed(&longer), words);
    // The first length in the body exceeds any memory.
    let claims = [&u64::MAX.to_ne_bytes(), &body[8..]].concat();
    let said = sealed(&claims);
    assert!(said.starts_with("malformed: "), "{said}");
}

/// A hostile author can write any byte with a matching header.
#[test]
fn a_world_with_any_byte_changed_is_refused_or_flies_and_ends() {
    let spec = spec();
    let whole = bytes(&spec.settings, &episodes(&spec.rules));
    let mut n_restored = 0;
    for at in HEADER_BYTES..whole.len() {
        for value in [0, 1, 0x7f, 0xff] {
            let mut bytes = whole.clone();
            bytes[at] = value;
            let checksum = crc32fast::hash(&bytes[HEADER_BYTES..]);
            bytes[12..16].copy_from_slice(&checksum.to_ne_bytes());
            let restored = decode(&bytes).and_then(|it| it.restore(&spec));
            for world in restored.into_iter().flatten() {
                let SnapshotWorld::Ready(mut episode) = world else {
                    continue;
                };
                n_restored += 1;
                if !episode.is_over() {
                    step(&spec.rules, &mut episode, 0);
                }
                let k = episode.outcome().step;
                assert!(episode.recall(k).is_ok() && episode.recall(k + 1).is_err());
            }
        }
    }
    assert!(n_restored > 1000, "{n_restored} worlds prove little");
}

macro_rules! changes {
    ($world:ident: $($change:block $words:literal)*) => {
        &[$((|$world| $change, $words)),*]
    };
}

type Change = fn(&mut SavedWorld);

const MISFITS: &[(Change, &str)] = changes! { world:
    { world.states[3] = 3; } "states: expected states below 3, got 3"
    { world.first_states.truncate(14); } "first states: expected 15 cells, got 14"
    { world.robots[0].frame[0] = 3; } "expected an observation below 3 or 255"
    { world.robots[1].path = vec![4, 0]; } "move"
    { world.robots[0].path = vec![0]; } "path: expected 0 or 2 moves, got 1"
    { world.robots[0].outcome.cell.row = 3; } "robot: expected a cell of 3 x 5, got (3, "
    { world.robots[1].outcome.start.col = 5; } "start of the path: expected a cell of 3 x 5"
    { world.robots[0].outcome.cell = CLOSED; } "robot: expected a cell where robots may be, got (2, 0)"
    { world.robots[1].outcome.n_moves = 0; } "moves of the path: expected 2, got 0"
    { world.robots[0].outcome.reward = f64::NAN; } "reward: expected a finite number, got NaN"
    { world.robots[0].outcome.marginal = f64::INFINITY; } "reward: expected a finite number, got inf"
    { world.robots.pop(); } "robots: expected 2, got 1"
    { world.outcome.late = 4; } "robots that stayed: expected bits below 2, got 4"
    { world.outcome.step = u64::MAX; } "step: expected at most"
    { world.outcome.episode = u64::MAX; } "episode: expected at most"
    { world.outcome.reward = f64::NAN; } "reward: expected a finite number, got NaN"
    { world.outcome.is_truncated = true; } "terminated, truncated: expected [0, 0], got [0, 1]"
    { world.history.clear(); } "history: expected 1 to 8 steps, got 0"
    { world.history = vec![world.history[0].clone(); 9]; } "history: expected 1 to 8 steps, got 9"
    { world.history[0].outcome.step = 9; } "history: expected seed, episode and step [2, 0, 4], got [2, 0, 9]"
    { world.history[0].robots.pop(); } "history: robots: expected 2, got 1"
    { world.history[1].robots[1].cells[0] = 15; } "history: expected cells below 15, got 15"
    { world.history[1].robots[0].values[0] = 3; } "history: expected observations below 3, got 3"
    { world.history[1].robots[0].values.push(0); } "history: expected 1 values, got 2"
    { world.history[3].robots[0].values.pop(); } "history: expected 0 values, got 14"
};

const CLOSED: Cell = Cell { row: 2, col: 0 };

#[test]
fn an_impossible_world_is_refused() {
    let mut spec = spec();
    let bytes = bytes(&spec.settings, &episodes(&spec.rules));
    let closed = Grid::from_shape_fn((3, 5), |at| at == (CLOSED.row, CLOSED.col));
    let (shape, closed) = (spec.rules.shape, Some(Arc::new(closed)));
    spec.rules.airspace = Airspace::new(shape, closed, 0);
    let mut wrong = Vec::new();
    for (change, words) in MISFITS {
        let mut snapshot = decode(&bytes).expect("a snapshot");
        let SnapshotWorld::Ready(world) = &mut snapshot.worlds[1] else {
            panic!("expected a world at a step");
        };
        change(world);
        let said = match snapshot.restore(&spec) {
            Ok(_) => "restored".into(),
            Err(error) => error.to_string(),
        };
        if !said.starts_with("world 1 of the file: ") || !said.contains(words) {
            wrong.push((words, said));
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn a_fingerprint_differs_exactly_where_the_worlds_differ() {
    let fingerprint = |(name, value): (&str, Value)| {
        let mut given = json!({"model": "wildfire-small", "height": 8, "width": 8});
        given[name] = value;
        Settings::of(&settings(given)).worlds_fingerprint()
    };
    let usual = fingerprint(("height", json!(8)));
    assert_eq!(usual.len(), 16);
    for same in [
        ("max_steps", json!(7)),
        ("worlds", json!(3)),
        ("seed", json!(9)),
        ("publish_truth", json!(true)),
        ("coverage", json!("client")),
    ] {
        assert_eq!(fingerprint(same.clone()), usual, "{same:?}");
    }
    let other = [
        ("height", json!(9)),
        ("width", json!(9)),
        ("moves", json!(5)),
        ("robots", json!(2)),
        ("burn_in", json!(11)),
        ("start", json!("random")),
        ("model", json!("wildfire")),
        ("sensor_radius", json!(1)),
        ("coverage", json!("full")),
    ];
    let mut all: BTreeSet<String> = other.into_iter().map(fingerprint).collect();
    all.insert(usual);
    assert_eq!(all.len(), 10, "{all:?}");
}
