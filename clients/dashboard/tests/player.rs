//! Tests that a damaged recording is played up to the damage, and that recordings of earlier releases are played.

use crate::server_info;
use emberwatch_dashboard::player::play;
use emberwatch_dashboard::scene::{Scene, Stage};
use emberwatch_protocol::message::{FrameHeader, RobotResult, VERSION};
use emberwatch_protocol::observer::Sample;
use emberwatch_protocol::recording::{Event, Record, Writer};
use serde_json::json;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Returns a recording of three steps of a 2 x 3 world. The last step is damaged.
fn damaged() -> Vec<u8> {
    let info = server_info(json!({}));
    let frame = |step| {
        let mut header = FrameHeader {
            version: VERSION,
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
        writer
            .write(&Record {
                nanos: 0,
                n_lost: 0,
                event,
            })
            .expect("write");
    }
    writer.finish().expect("finish");
    bytes[start_of_last + 30] ^= 1;
    bytes
}

/// Plays a recording as fast as possible. Returns the scene at the end.
fn played(file: &Path) -> Scene {
    let stage = Arc::new(Stage::new(Scene::new("test")));
    let stop = Arc::new(AtomicBool::new(false));
    let thread = play(file, &stage, &stop).expect("a recording");
    stage.change(|scene| scene.player.as_mut().expect("a player").speed = 0.0);
    let deadline = Instant::now() + Duration::from_secs(25);
    let has_ended = || {
        let scene = stage.look();
        scene.player.as_ref().is_some_and(|player| player.ended)
    };
    while !has_ended() {
        assert!(Instant::now() < deadline, "it does not end");
        std::thread::sleep(Duration::from_millis(1));
    }
    let scene = std::mem::replace(&mut *stage.look(), Scene::new("taken"));
    stop.store(true, Ordering::Relaxed);
    thread.join().expect("the player");
    scene
}

fn n_steps(scene: &Scene) -> Option<usize> {
    scene.album.strip(0).map(|strip| strip.entries().len())
}

#[test]
fn a_damaged_recording_is_played_up_to_the_damage() {
    let file = format!("dashboard-damaged-{}.recording", std::process::id());
    let file = std::env::temp_dir().join(file);
    std::fs::write(&file, damaged()).expect("write");
    let scene = played(&file);
    std::fs::remove_file(&file).expect("clean up");
    assert_eq!(n_steps(&scene), Some(2));
    let error = scene.player.and_then(|player| player.error).expect("said");
    assert!(error.contains("is damaged at byte"), "{error}");
    assert!(error.contains("good before it: 2 steps"), "{error}");
}

#[test]
fn a_recording_of_release_0_2_is_played() {
    let file = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../tests/data/version-2.recording"
    );
    let scene = played(file.as_ref());
    assert_eq!(
        scene
            .player
            .as_ref()
            .and_then(|player| player.error.clone()),
        None
    );
    assert_eq!(n_steps(&scene), Some(9));
    let info = serde_json::to_value(&scene.info).expect("JSON");
    assert_eq!(info["states"], json!(["normal", "latent", "fire"]));
    assert_eq!(info["radius"], 1);
}
