//! Tests that a damaged recording is played up to the damage, and that recordings of earlier releases are played.

use emberwatch_dashboard::player::play;
use emberwatch_dashboard::scene::{Scene, Stage};
use serde_json::json;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

const RECORDING: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../../tests/data/version-2.recording"
);

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
    let mut bytes = std::fs::read(RECORDING).expect("a recording");
    let end = bytes.len();
    bytes[end / 2] ^= 1;
    std::fs::write(&file, bytes).expect("write");
    let scene = played(&file);
    std::fs::remove_file(&file).expect("clean up");
    let n_good = n_steps(&scene).expect("steps");
    assert!((1..9).contains(&n_good), "{n_good}");
    let error = scene.player.and_then(|player| player.error).expect("said");
    assert!(error.contains("is damaged at byte"), "{error}");
    let words = format!("good before it: {} steps", n_good - 1);
    assert!(error.contains(&words), "{n_good}: {error}");
}

#[test]
fn a_recording_of_release_0_2_is_played() {
    let scene = played(RECORDING.as_ref());
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
