//! Snapshots that are whole, damaged and forged.

use super::error::SnapshotError;
use super::format::{HEADER_BYTES, MAGIC, NewEpisode, SnapshotWorld, VERSION, decode, encode};
use super::settings::{Settings, WorldSpec};
use crate::config::ServerConfig;
use crate::world::{Episode, Flown, Rules, SavedWorld};
use emberwatch_messages::control::CoverageRule;
use emberwatch_model::Move;
use emberwatch_model::task::Start;

const NEW: NewEpisode = NewEpisode {
    seed: 7,
    episode: 3,
};

fn spec() -> WorldSpec {
    let config = ServerConfig {
        height: 3,
        width: 5,
        moves: 2,
        robots: 2,
        burn_in: 300,
        history: 4,
        ..ServerConfig::default()
    };
    let checked = config.check().expect("valid settings");
    WorldSpec::of(&checked).expect("a valid model")
}

fn episodes(rules: &Rules) -> Vec<Episode> {
    let mut episodes = vec![Episode::new(rules, 1), Episode::new(rules, 2)];
    for _ in 0..6 {
        step(rules, &mut episodes[1], 0);
    }
    step(rules, &mut episodes[1], 0b01);
    episodes
}

/// Both robots fly; those of `full` observe every cell.
fn step(rules: &Rules, episode: &mut Episode, full: u64) {
    let flown = Flown {
        moves: &[Move::Right, Move::Down, Move::Left, Move::Up],
        ready: 0b11,
        full,
        hovered: 0,
        late: 0,
    };
    episode.step(rules, &flown);
}

fn bytes(settings: &Settings, episodes: &[Episode]) -> Vec<u8> {
    let mut worlds: Vec<_> = episodes.iter().map(SnapshotWorld::Ready).collect();
    worlds.push(SnapshotWorld::New(NEW));
    encode(settings, &worlds).expect("small")
}

#[test]
fn what_is_read_is_what_was_written() {
    let spec = spec();
    let written = bytes(&spec.settings, &episodes(&spec.rules));
    let snapshot = decode(&written).expect("a snapshot");
    let mut restored = snapshot.restore(&spec).expect("a fit");
    let last = restored.pop().expect("three worlds");
    assert!(matches!(last, SnapshotWorld::New(NEW)));
    let episodes: Vec<Episode> = restored
        .into_iter()
        .map(|world| match world {
            SnapshotWorld::Ready(episode) => *episode,
            SnapshotWorld::New(_) => panic!("expected a world at a step"),
        })
        .collect();
    assert_eq!(bytes(&spec.settings, &episodes), written);
}

/// As a hostile author would write it: any body, with a header that fits.
fn sealed(body: &[u8]) -> Vec<u8> {
    let mut bytes = MAGIC.to_vec();
    bytes.extend(VERSION.to_ne_bytes());
    bytes.extend(crc32fast::hash(body).to_ne_bytes());
    bytes.extend((body.len() as u64).to_ne_bytes());
    bytes.extend(body);
    bytes
}

#[test]
fn a_changed_body_is_refused_or_a_possible_world() {
    let spec = spec();
    let whole = bytes(&spec.settings, &episodes(&spec.rules));
    let body = &whole[HEADER_BYTES..];
    let mut n_restored = 0;
    for at in 0..body.len() {
        for byte in [0, 1, 3, 127, 255] {
            let mut changed = body.to_vec();
            changed[at] = byte;
            let snapshot = decode(&sealed(&changed));
            let restored = snapshot.and_then(|snapshot| snapshot.restore(&spec));
            for world in restored.into_iter().flatten() {
                if let SnapshotWorld::Ready(mut episode) = world {
                    n_restored += 1;
                    step(&spec.rules, &mut episode, 0);
                    episode.reset(&spec.rules, 5);
                }
            }
        }
    }
    assert!(n_restored > 1000, "{n_restored}: nearly all were refused");
    // A length that no memory holds.
    let mut claims = body.to_vec();
    claims[..8].copy_from_slice(&u64::MAX.to_ne_bytes());
    let refusal = decode(&sealed(&claims)).expect_err("a false length");
    assert!(refusal.to_string().starts_with("malformed: "), "{refusal}");
}

#[test]
fn every_cut_and_every_flipped_bit_is_noticed() {
    let spec = spec();
    let bytes = bytes(&spec.settings, &episodes(&spec.rules));
    for length in 0..bytes.len() {
        assert!(decode(&bytes[..length]).is_err(), "cut to {length}");
    }
    for bit in 0..8 * bytes.len() {
        let mut damaged = bytes.clone();
        damaged[bit / 8] ^= 1 << (bit % 8);
        assert!(decode(&damaged).is_err(), "bit {bit}");
    }
    let mut longer = bytes.clone();
    longer.push(0);
    let refusal = decode(&longer).expect_err("one byte too many");
    let (expected, got) = (bytes.len() - HEADER_BYTES, longer.len() - HEADER_BYTES);
    let problem = format!("damaged: expected {expected} bytes, got {got}");
    assert_eq!(refusal, SnapshotError::Damaged(problem));
}

/// A change to the world of an otherwise good file.
fn misfit(change: impl FnOnce(&mut SavedWorld), words: &str) {
    let spec = spec();
    let bytes = bytes(&spec.settings, &episodes(&spec.rules));
    let mut snapshot = decode(&bytes).expect("a snapshot");
    let SnapshotWorld::Ready(world) = &mut snapshot.worlds[1] else {
        panic!("expected a world at a step");
    };
    change(world);
    let error = snapshot.restore(&spec).err();
    let error = error.expect("a misfit").to_string();
    assert!(error.starts_with("world 1 of the file"), "{error}");
    assert!(error.contains(words), "{words:?}: {error}");
}

#[test]
fn a_world_that_cannot_be_is_refused() {
    misfit(
        |world| world.states[3] = 3,
        "states: expected states below 3, got 3",
    );
    misfit(
        |world| world.first_states.truncate(14),
        "first states: expected 15, got 14",
    );
    misfit(
        |world| world.robots[0].frame[0] = 3,
        "expected an observation below 3 or 255",
    );
    misfit(|world| world.robots[1].path = vec![4, 0], "move");
    misfit(
        |world| world.robots[0].path = vec![0],
        "path: expected 0 or 2 moves, got 1",
    );
    misfit(
        |world| world.robots[0].outcome.cell.row = 3,
        "robot: expected a cell of 3 x 5, got (3, ",
    );
    misfit(
        |world| world.robots[1].outcome.start.col = 5,
        "start of the path",
    );
    misfit(
        |world| world.robots[1].outcome.n_moves = 0,
        "moves of the path: expected 2, got 0",
    );
    misfit(|world| _ = world.robots.pop(), "robots: expected 2, got 1");
    misfit(
        |world| world.outcome.late = 4,
        "robots that stayed: expected bits below 2, got 4",
    );
    misfit(
        |world| world.outcome.step = u64::MAX,
        "step: expected at most",
    );
    misfit(
        |world| world.outcome.reward = f64::NAN,
        "reward: expected a number",
    );
    misfit(
        |world| world.outcome.is_truncated = true,
        "ends: expected [0, 0], got [0, 1]",
    );
    misfit(
        |world| world.outcome.episode = u64::MAX,
        "episode: expected at most",
    );
    misfit(
        |world| world.history.clear(),
        "history: expected 1 to 8 steps, got 0",
    );
    misfit(
        |world| world.history[0].outcome.step = 9,
        "history: expected seed, episode and step [2, 0, 4], got [2, 0, 9]",
    );
    misfit(
        |world| world.history[1].robots[1].cells[0] = 15,
        "cells below 15, got 15",
    );
    misfit(
        |world| world.history[1].robots[0].values[0] = 3,
        "observations below 3, got 3",
    );
    misfit(|world| world.history[1].robots[0].values.push(0), "values");
}

#[test]
fn the_first_other_setting_is_named() {
    let ours = spec().settings;
    let mut theirs = ours.clone();
    theirs.others[4].1 = "9".into();
    let error = theirs.check(&ours).expect_err("another burn-in");
    let expected = "burn_in: expected 300 as this server's, got 9";
    assert_eq!(error.to_string(), expected);
    theirs.model = theirs.model.replace("0.1", "0.2");
    assert!(
        theirs
            .check(&ours)
            .expect_err("a model")
            .to_string()
            .starts_with("model: ")
    );
}

#[test]
fn a_fingerprint_differs_exactly_where_the_worlds_differ() {
    type Change = fn(&mut ServerConfig);
    let fingerprint = |change: Change| {
        let mut config = ServerConfig {
            model: "wildfire-small".into(),
            height: 8,
            width: 8,
            moves: 4,
            burn_in: 10,
            ..ServerConfig::default()
        };
        change(&mut config);
        let checked = config.check().expect("valid settings");
        Settings::of(&checked).worlds_fingerprint()
    };
    let usual = fingerprint(|_| ());
    assert_eq!(usual.len(), 16);
    let same: [Change; 5] = [
        |config| config.max_steps = 7,
        |config| config.worlds = 3,
        |config| config.seed = 9,
        |config| config.publish_truth = true,
        |config| config.coverage = CoverageRule::Client,
    ];
    for (index, change) in same.into_iter().enumerate() {
        assert_eq!(fingerprint(change), usual, "{index}");
    }
    let other: [Change; 9] = [
        |config| config.height = 9,
        |config| config.width = 9,
        |config| config.moves = 5,
        |config| config.robots = 2,
        |config| config.burn_in = 11,
        |config| config.start = Start::Random,
        |config| config.model = "wildfire".into(),
        |config| config.sensor_radius = 1,
        |config| config.coverage = CoverageRule::Full,
    ];
    let mut all: Vec<String> = other.into_iter().map(fingerprint).collect();
    all.push(usual);
    all.sort();
    all.dedup();
    assert_eq!(all.len(), 10, "{all:?}");
}
