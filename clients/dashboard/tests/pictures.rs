//! Tests of the pictures that browsers receive, built from published samples.

use emberwatch_dashboard::album::{Album, MAX_ENTRIES};
use emberwatch_dashboard::entry::States;
use emberwatch_dashboard::picture::{Ask, picture};
use emberwatch_dashboard::scene::Scene;
use emberwatch_protocol::Probabilities;
use emberwatch_protocol::agent_belief::{AgentBelief, Intent};
use emberwatch_protocol::message::{
    AgentHeader, FrameHeader, RobotResult, TruthHeader, WorldResult,
};
use emberwatch_protocol::observer::Sample;
use serde_json::Value;
use std::time::{Duration, Instant};

/// Returns a frame of a 2 x 3 world: the robot flew right along the upper row and saw `values`.
fn frame(step: u64, values: [u8; 6]) -> Sample<FrameHeader> {
    let robot = RobotResult {
        col: 2,
        n_moves: 2,
        reward: 0.25,
        ..RobotResult::default()
    };
    frame_of(step, &[(robot, values)])
}

/// Returns a frame of several robots, which all fly right.
fn frame_of(step: u64, robots: &[(RobotResult, [u8; 6])]) -> Sample<FrameHeader> {
    let header = FrameHeader {
        n_robots: robots.len() as u32,
        height: 2,
        width: 3,
        result: WorldResult {
            step,
            seed: u64::MAX,
            reward: step as f64,
            ..WorldResult::default()
        },
        ..FrameHeader::default()
    };
    let results = robots
        .iter()
        .flat_map(|(robot, _)| bytemuck::bytes_of(robot));
    let values = robots.iter().flat_map(|(_, values)| values);
    let n_moves: u32 = robots.iter().map(|(robot, _)| robot.n_moves).sum();
    let mut payload: Vec<u8> = results.chain(values).copied().collect();
    payload.resize(payload.len() + n_moves as usize, 3);
    Sample { header, payload }
}

fn truth(step: u64, states: [u8; 6]) -> Sample<TruthHeader> {
    let header = TruthHeader {
        step,
        seed: u64::MAX,
        height: 2,
        width: 3,
        ..TruthHeader::default()
    };
    let payload = states.to_vec();
    Sample { header, payload }
}

/// Returns a belief that is certain of state 1 in the left column, and uniform elsewhere.
fn agent_belief(step: u64) -> AgentBelief {
    let p = |(state, _, col): (usize, usize, usize)| match (col, state) {
        (0, 1) => 1.0,
        (0, _) => 0.0,
        _ => 0.5,
    };
    AgentBelief {
        header: AgentHeader {
            step,
            seed: u64::MAX,
            ..AgentHeader::default()
        },
        belief: Probabilities::from_shape_fn((2, 2, 3), p),
        intent: Intent {
            objective: "fire".into(),
            states: vec!["calm".into(), "fire".into()],
            ..Intent::default()
        },
    }
}

fn states() -> States {
    States {
        names: vec!["calm".into(), "fire".into()],
        target: 1,
    }
}

fn ask(at: Option<u64>) -> Ask {
    Ask {
        world: 0,
        at,
        bins: 16,
        speed: None,
        playing: None,
    }
}

/// Returns the JSON of a picture, and its arrays as bytes.
fn read(album: Album, at: Option<u64>) -> (Value, impl Fn(&str) -> Vec<u8>) {
    let mut scene = Scene::new("test");
    scene.album = album;
    let bytes = picture(&scene, &ask(at), Instant::now());
    let n = u32::from_le_bytes(bytes[..4].try_into().expect("four bytes")) as usize;
    let header: Value = serde_json::from_slice(&bytes[4..4 + n]).expect("JSON");
    assert_eq!((4 + n) % 8, 0);
    let listings = header["arrays"].as_array().expect("a list").clone();
    let arrays = move |name: &str| {
        let mut offset = 4 + n;
        for listing in &listings {
            let size = if listing["type"] == "f32" { 4 } else { 1 };
            let length = size * listing["length"].as_u64().expect("a length") as usize;
            if listing["name"] == name {
                return bytes[offset..offset + length].to_vec();
            }
            offset += length.next_multiple_of(8);
        }
        panic!("no {name} in {listings:?}");
    };
    (header, arrays)
}

#[test]
fn a_picture_joins_frame_truth_and_belief_of_a_step() {
    let mut album = Album::default();
    let now = Instant::now();
    // Hidden states are held until their frame arrives.
    album.add_truth(&truth(1, [0; 6]));
    album.add_truth(&truth(2, [1, 1, 0, 1, 0, 0]));
    album.add_frame(&frame(1, [255, 0, 1, 255, 255, 255]), now);
    album.add_frame(&frame(2, [255, 1, 0, 255, 255, 255]), now);
    album.add_belief(&agent_belief(2), Some(&states()));
    let (header, array) = read(album, None);
    assert_eq!(header["shown"]["step"], 2);
    assert_eq!(header["shown"]["seed"], u64::MAX.to_string());
    assert_eq!(
        (&header["shown"]["height"], &header["shown"]["width"]),
        (&2.into(), &3.into())
    );
    let path = [[0, 0], [0, 1], [0, 2]];
    let robot = serde_json::json!({"state": "flew", "cell": [0, 2], "path": path, "share": 0.25});
    assert_eq!(header["shown"]["robots"], serde_json::json!([robot]));
    assert_eq!(array("frame"), [255, 1, 0, 255, 255, 255]);
    assert_eq!(array("truth"), [1, 1, 0, 1, 0, 0]);
    assert_eq!(
        array("belief"),
        [0, 128, 128, 0, 128, 128, 255, 128, 128, 255, 128, 128]
    );
    assert_eq!(array("entropy"), [0, 255, 255, 0, 255, 255]);
    // Four of the six cells add ln 2 to the loss, and two add nothing.
    let log_loss = header["shown"]["log_loss"].as_f64().expect("a number");
    assert!(
        (log_loss - 4.0 / 6.0 * 2f64.ln()).abs() < 1e-6,
        "{log_loss}"
    );
    assert!((header["shown"]["brier"].as_f64().expect("a number") - 1.0 / 6.0).abs() < 1e-6);
}

#[test]
fn a_picture_tells_what_each_robot_did_and_what_all_saw() {
    let mut album = Album::default();
    let flew = RobotResult {
        start_col: 1,
        col: 2,
        n_moves: 1,
        reward: 0.5,
        ..RobotResult::default()
    };
    let stayed = RobotResult {
        start_row: 1,
        row: 1,
        ..RobotResult::default()
    };
    let robots = [
        (stayed, [255; 6]),
        (flew, [255, 255, 1, 255, 255, 255]),
        (stayed, [255; 6]),
        (flew, [0, 255, 1, 255, 255, 255]),
    ];
    let mut sample = frame_of(4, &robots);
    (sample.header.result.hovered, sample.header.result.late) = (0b1, 0b100);
    album.add_frame(&frame_of(3, &[(stayed, [255; 6]); 4]), Instant::now());
    album.add_frame(&sample, Instant::now());
    album.add_frame(&sample, Instant::now()); // repeated
    let (header, array) = read(album, None);
    assert_eq!(
        header["shown"]["robots"],
        serde_json::json!([
            {"state": "hovered", "cell": [1, 0], "path": [[1, 0]], "share": 0.0},
            {"state": "flew", "cell": [0, 2], "path": [[0, 1], [0, 2]], "share": 0.5},
            {"state": "late", "cell": [1, 0], "path": [[1, 0]], "share": 0.0},
            {"state": "flew", "cell": [0, 2], "path": [[0, 1], [0, 2]], "share": 0.5},
        ])
    );
    assert_eq!(array("frame"), [0, 255, 1, 255, 255, 255]);
    assert_eq!(header["kept"], serde_json::json!({"first": 0, "last": 1}));
    // No robot flew in the first entry, so it has no reward.
    let rewards: Vec<f32> = array("series_reward")
        .chunks_exact(4)
        .map(|bytes| f32::from_le_bytes(bytes.try_into().expect("a float")))
        .filter(|reward| !reward.is_nan())
        .collect();
    assert_eq!(rewards, [4.0]);
}

#[test]
fn the_agent_with_the_first_robot_is_shown() {
    let told = |step: u64, robot: u32| {
        let mut belief = agent_belief(step);
        (belief.header.first_robot, belief.header.pid) = (robot, robot);
        belief
    };
    let (mut album, now) = (Album::default(), Instant::now());
    let shown = |album: &mut Album, step: u64, robots: [u32; 3], at: Instant| {
        album.add_frame(&frame(step, [255; 6]), at);
        for robot in robots {
            assert!(album.add_belief(&told(step, robot), None));
        }
        let strip = album.strip(0).expect("a world");
        let newest = strip.entries().last().expect("a step");
        newest.belief.as_ref().map(|belief| belief.pid)
    };
    assert_eq!(shown(&mut album, 1, [2, 1, 2], now), Some(1));
    assert_eq!(shown(&mut album, 2, [2, 3, 2], now), None);
    let later = now + Duration::from_secs(5);
    assert_eq!(shown(&mut album, 3, [2, 3, 3], later), Some(2));
}

#[test]
fn what_was_seen_is_remembered_with_its_age_and_how_far_it_reaches() {
    const NO: u8 = 255;
    for (frames, seen, age, since) in [
        (
            vec![(1, [NO, 0, 1, NO, NO, NO]), (4, [NO, 1, NO, NO, NO, NO])],
            [NO, 1, 1, NO, NO, NO],
            [NO, 0, 3, NO, NO, NO],
            0, // since the beginning of the episode
        ),
        // An episode that begins anew, or an episode of another server, starts without observations.
        (
            vec![(5, [NO, 0, 1, NO, NO, NO]), (1, [NO; 6])],
            [NO; 6],
            [NO; 6],
            0,
        ),
        (
            [(5, [NO, NO, NO, 0, 0, 0])]
                .into_iter()
                .chain((1..=6).map(|k| (k, [NO, 1, NO, NO, NO, NO])))
                .collect(),
            [NO, 1, NO, NO, NO, NO],
            [NO, 0, NO, NO, NO, NO],
            0,
        ),
        (vec![(7, [NO; 6]), (8, [NO; 6])], [NO; 6], [NO; 6], 7),
    ] {
        let mut album = Album::default();
        for &(step, values) in &frames {
            album.add_frame(&frame(step, values), Instant::now());
        }
        let (header, array) = read(album, None);
        assert_eq!(
            (array("seen"), array("age")),
            (seen.to_vec(), age.to_vec()),
            "{frames:?}"
        );
        assert_eq!(header["shown"]["seen_since"], since, "{frames:?}");
    }
}

#[test]
fn the_last_few_thousand_steps_are_kept() {
    let mut album = Album::default();
    let n = MAX_ENTRIES as u64 + 10;
    for step in 1..=n {
        album.add_frame(&frame(step, [255; 6]), Instant::now());
    }
    album.add_frame(&frame(n, [255; 6]), Instant::now()); // repeated, as for a new observer
    let (header, array) = read(album, Some(3));
    assert_eq!(
        header["kept"],
        serde_json::json!({"first": 10, "last": n - 1})
    );
    assert_eq!(header["shown"]["serial"], 10);
    let first: [u8; 4] = array("series_reward")[..4].try_into().expect("a float");
    let mean = (11 + 10 + MAX_ENTRIES as u64 / 16) as f32 / 2.0;
    assert_eq!(f32::from_le_bytes(first), mean);
}

#[test]
fn a_step_with_a_belief_is_shown_rather_than_a_slightly_newer_one() {
    let mut album = Album::default();
    let now = Instant::now();
    assert!(
        !album.add_belief(&agent_belief(1), None),
        "without its frame"
    );
    album.add_frame(&frame(1, [255; 6]), now);
    assert!(album.add_belief(&agent_belief(1), None));
    album.add_frame(&frame(2, [255; 6]), now);
    let (header, _) = read(album, None);
    assert_eq!(header["shown"]["step"], 1);
    assert_eq!(header["shown"]["log_loss"], Value::Null);
    assert_eq!(header["agent"]["objective"], "fire");
}

#[test]
fn what_makes_no_sense_is_left_out() {
    let mut album = Album::default();
    let good = frame(1, [255; 6]);
    let change = |act: fn(&mut Sample<FrameHeader>)| {
        let mut sample = good.clone();
        act(&mut sample);
        sample
    };
    for bad in [
        change(|sample| sample.header.height = 0),
        change(|sample| sample.header.height = u32::MAX),
        change(|sample| sample.header.n_robots = 2),
        change(|sample| sample.header.result.late = 2),
        change(|sample| sample.payload[24] = 2), // the row where it started
        change(|sample| sample.payload[44] = 3), // moves
        change(|sample| sample.payload[55] = 4), // the last move
        change(|sample| sample.payload.truncate(3)),
    ] {
        album.add_frame(&bad, Instant::now());
    }
    assert!(album.strip(0).is_none());
    album.add_truth(&truth(2, [0; 6])); // its frame never arrives
    album.add_belief(&agent_belief(1), None);
    album.add_frame(&good, Instant::now());
    let mut short = truth(1, [0; 6]);
    short.payload.pop();
    album.add_truth(&short);
    let (header, _) = read(album, Some(u64::MAX));
    assert_eq!(header["shown"]["serial"], 0);
    let names = header["arrays"].to_string();
    assert!(
        !names.contains("truth") && !names.contains("belief"),
        "{names}"
    );
}

#[test]
fn a_step_without_a_belief_has_the_one_before_of_its_episode() {
    let facts = |serial: u64| {
        let (mut album, now) = (Album::default(), Instant::now());
        for step in 1..=4 {
            album.add_frame(&frame(step, [255; 6]), now);
            if step == 2 {
                album.add_belief(&agent_belief(step), Some(&states()));
            }
        }
        let mut next_episode = frame(1, [255; 6]);
        next_episode.header.result.episode = 1;
        album.add_frame(&next_episode, now);
        let (header, array) = read(album, Some(serial));
        let about = header["agent"]["step"].as_u64();
        if about.is_some() {
            assert_eq!(array("belief")[..3], [0, 128, 128]);
        }
        (header["shown"]["step"].as_u64(), about)
    };
    let expected = [None, Some(2), Some(2), Some(2)];
    for (serial, about) in (0..).zip(expected) {
        assert_eq!(facts(serial), (Some(serial + 1), about));
    }
    assert_eq!(facts(4), (Some(1), None), "of another episode");
}
