//! A recording that is damaged is played up to the damage, and says so.

use emberwatch_dashboard::player::play;
use emberwatch_dashboard::scene::{Scene, Stage};
use emberwatch_protocol::control::{CoverageRule, ServerInfo};
use emberwatch_protocol::message::{FrameHeader, RobotResult};
use emberwatch_protocol::observer::Sample;
use emberwatch_protocol::recording::{Event, Record, Writer};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Three steps of a 2 x 3 world, the last of them damaged.
fn damaged() -> Vec<u8> {
    let info = ServerInfo {
        protocol: 2,
        build: "0.1.0".into(),
        pid: 1,
        pid_namespace: None,
        height: 2,
        width: 3,
        n_moves: 1,
        n_worlds: 1,
        n_robots: 1,
        n_observations: 3,
        observations: vec!["normal".into(), "latent".into(), "fire".into()],
        model: None,
        task: None,
        worlds_fingerprint: None,
        airspace: None,
        zones: None,
        recorded_world: None,
        burn_in: 0,
        max_steps: 0,
        max_clients: 16,
        coverage: CoverageRule::Path,
        publish_truth: false,
        lease_millis: 30_000,
        deadline_millis: 0,
    };
    let frame = |step| {
        let mut header = FrameHeader {
            version: 2,
            n_robots: 1,
            height: 2,
            width: 3,
            ..FrameHeader::default()
        };
        header.result.step = step;
        let robot = RobotResult {
            n_moves: 1,
            ..RobotResult::default()
        };
        let mut payload = bytemuck::bytes_of(&robot).to_vec();
        payload.extend([255, 0, 255, 255, 1, 255, 3]);
        Event::Frame(Sample { header, payload })
    };
    let mut bytes = Vec::new();
    let mut writer = Writer::new(&mut bytes).expect("begin");
    let mut start_of_last = 0;
    for event in [Event::Server(Box::new(info)), frame(1), frame(2), frame(3)] {
        start_of_last = writer.n_bytes() as usize;
        let (nanos, n_lost) = (0, 0);
        let record = Record {
            nanos,
            n_lost,
            event,
        };
        writer.write(&record).expect("write");
    }
    writer.finish().expect("finish");
    bytes[start_of_last + 30] ^= 1;
    bytes
}

#[test]
fn a_damaged_recording_is_played_up_to_the_damage() {
    let file = format!("dashboard-damaged-{}.recording", std::process::id());
    let file = std::env::temp_dir().join(file);
    std::fs::write(&file, damaged()).expect("write");
    let stage = Arc::new(Stage::new(Scene::new("test")));
    let stop = Arc::new(AtomicBool::new(false));
    let thread = play(&file, &stage, &stop).expect("a recording");
    let deadline = Instant::now() + Duration::from_secs(25);
    let has_ended = || {
        let scene = stage.look();
        scene.player.as_ref().is_some_and(|player| player.ended)
    };
    while !has_ended() {
        assert!(Instant::now() < deadline, "it does not end");
        std::thread::sleep(Duration::from_millis(1));
    }
    let error = stage
        .look()
        .player
        .as_ref()
        .and_then(|player| player.error.clone());
    let error = error.expect("said");
    assert!(error.contains("is damaged at byte"), "{error}");
    assert!(error.contains("good before it: 2 steps"), "{error}");
    let n_shown = stage
        .look()
        .album
        .strip(0)
        .map(|strip| strip.entries().len());
    assert_eq!(n_shown, Some(2));
    stop.store(true, Ordering::Relaxed);
    thread.join().expect("the player");
    std::fs::remove_file(&file).expect("clean up");
}
