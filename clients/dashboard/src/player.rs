//! Plays a recording onto the stage, at a speed that browsers choose.

use crate::scene::{Info, Lost, Player, Scene, Stage};
use anyhow::{Context, Result};
use emberwatch_protocol::recording::{Event, Reader, Record, RecordingError};
use std::fs::File;
use std::io::BufReader;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

const TICK: Duration = Duration::from_millis(20);

pub fn play(path: &Path, stage: &Arc<Stage>, stop: &Arc<AtomicBool>) -> Result<JoinHandle<()>> {
    let mut reader = Some(open(path)?);
    let player = Player {
        file: path.display().to_string(),
        seconds: 0.0,
        speed: 1.0,
        playing: true,
        ended: false,
        error: None,
    };
    stage.change(|scene| {
        scene.is_serving = true;
        scene.player = Some(player);
    });
    let (path, stage, stop) = (path.to_owned(), stage.clone(), stop.clone());
    let thread = std::thread::Builder::new().name("player".into());
    let thread = thread.spawn(move || {
        while !stop.load(Ordering::Relaxed) {
            let reader = reader.take().map_or_else(|| open(&path), Ok);
            let played = reader.and_then(|reader| {
                let played = Playing::new(&stage, &stop).play(reader);
                played.with_context(|| in_file(&path))
            });
            change_player(&stage, |player| {
                player.ended = true;
                player.playing = false;
                player.error = played.err().map(|error| format!("{error:#}"));
            });
            while !stop.load(Ordering::Relaxed) && !is_playing(&stage) {
                std::thread::sleep(TICK);
            }
            stage.change(begin_again);
        }
    });
    thread.context("start a thread")
}

fn open(path: &Path) -> Result<Reader<BufReader<File>>> {
    let open = || Reader::new(BufReader::new(File::open(path)?));
    open().with_context(|| in_file(path))
}

fn in_file(path: &Path) -> String {
    format!("recording {}", path.display())
}

fn begin_again(scene: &mut Scene) {
    scene.album.clear();
    scene.lost = Lost::default();
    if let Some(player) = &mut scene.player {
        (player.ended, player.error, player.seconds) = (false, None, 0.0);
    }
}

fn is_playing(stage: &Stage) -> bool {
    let scene = stage.look();
    scene.player.as_ref().is_some_and(|player| player.playing)
}

fn change_player(stage: &Stage, act: impl FnOnce(&mut Player)) {
    stage.change(|scene| scene.player.as_mut().map(act));
}

struct Playing<'a> {
    stage: &'a Stage,
    stop: &'a AtomicBool,
    /// Position in the recording: the recorded time that has been played.
    clock: Duration,
    looked: Instant,
}

impl<'a> Playing<'a> {
    fn new(stage: &'a Stage, stop: &'a AtomicBool) -> Self {
        Self {
            stage,
            stop,
            clock: Duration::ZERO,
            looked: Instant::now(),
        }
    }

    fn play(mut self, reader: Reader<BufReader<File>>) -> Result<(), RecordingError> {
        for record in reader {
            let record = record?;
            if !self.wait_for(Duration::from_nanos(record.nanos)) {
                break;
            }
            self.stage.change(|scene| show(scene, &record));
        }
        Ok(())
    }

    fn wait_for(&mut self, moment: Duration) -> bool {
        loop {
            let Some((speed, playing)) = self.orders() else {
                return false;
            };
            let now = Instant::now();
            let passed = now.duration_since(self.looked);
            self.looked = now;
            if playing && speed > 0.0 {
                self.clock += passed.mul_f64(speed);
            } else if playing {
                self.clock = self.clock.max(moment);
            }
            if playing && self.clock >= moment {
                return true;
            }
            let missing = moment.saturating_sub(self.clock);
            std::thread::sleep(if playing {
                TICK.min(missing.div_f64(speed.max(1e-3)))
            } else {
                TICK
            });
        }
    }

    fn orders(&self) -> Option<(f64, bool)> {
        if self.stop.load(Ordering::Relaxed) {
            return None;
        }
        let scene = self.stage.look();
        let player = scene.player.as_ref()?;
        Some((player.speed, player.playing))
    }
}

fn show(scene: &mut Scene, record: &Record) {
    let lost = u64::from(record.n_lost);
    match &record.event {
        Event::Server(info) => scene.info = Some(Info::new(info)),
        Event::Frame(frame) => {
            scene.lost.frames += lost;
            scene.album.add_frame(frame, Instant::now());
        }
        Event::Truth(truth) => {
            scene.lost.truth += lost;
            scene.album.add_truth(truth);
        }
    }
    if let Some(player) = &mut scene.player {
        player.seconds = record.nanos as f64 / 1e9;
    }
}
