//! Tests of recorders: what they record, and how recorders and recordings report missing samples.

use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::message::{FrameHeader, TruthHeader};
use emberwatch_protocol::observer::{Observer, Sample};
use emberwatch_protocol::recording::{Event, Reader, Record, RecordingError};
use rustix::process::Signal;
use std::fs::File;
use std::io::Read;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use tempfile::TempDir;
use tests::harness::{
    Ended, Paths, Program, SERVER, SMALL, Server, fly_on, frames_until, new_instance, send_paths,
};

/// Creates a temporary folder. Returns the folder, and the path of a file in it that does not exist yet.
fn new_file() -> (TempDir, PathBuf) {
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("test.recording");
    (folder, file)
}

/// Starts a recorder and waits until it observes.
fn start_recorder(instance: &Instance, file: &Path, flags: &str) -> Program {
    let (name, file) = (instance.name(), file.display());
    let recorder = Program::start(
        SERVER,
        &format!("record --instance {name} --out {file} {flags}"),
    );
    recorder.wait_for_words("recording");
    recorder
}

fn stop(recorder: Program) -> Ended {
    let ended = recorder.finish();
    ended.check_says("recorded");
    ended
}

/// Returns the intact records at the start of a file, and the error that follows them, if any.
fn read(file: &Path) -> (Vec<Record>, Option<RecordingError>) {
    let reader = Reader::new(File::open(file).expect("the file")).expect("a recording");
    let (mut records, mut errors) = (Vec::new(), Vec::new());
    for record in reader {
        record.map_or_else(|error| errors.push(error), |record| records.push(record));
    }
    (records, errors.pop())
}

fn read_whole(file: &Path) -> Vec<Record> {
    let (records, error) = read(file);
    assert!(error.is_none(), "{error:?}");
    records
}

fn frames(records: &[Record]) -> Vec<Sample<FrameHeader>> {
    let frame = |record: &Record| match &record.event {
        Event::Frame(sample) => Some(sample.clone()),
        _ => None,
    };
    records.iter().filter_map(frame).collect()
}

fn truths(records: &[Record]) -> Vec<Sample<TruthHeader>> {
    let truth = |record: &Record| match &record.event {
        Event::Truth(sample) => Some(sample.clone()),
        _ => None,
    };
    records.iter().filter_map(truth).collect()
}

/// Waits until a file contains the frame of a step of world 0.
fn wait_for_step(recorder: &Program, file: &Path, step: u64) {
    recorder.until(|| {
        let frames = frames(&read(file).0);
        frames.iter().any(|frame| frame.header.result.step == step)
    });
}

#[test]
fn a_recording_holds_byte_for_byte_what_observers_received() {
    let server = Server::start(&format!("{SMALL} --worlds 2 --publish-truth"));
    let (_folder, file) = new_file();
    let recorder = start_recorder(&server.instance, &file, "--truth");
    let observer = Observer::frames(&server.instance).expect("observe");
    let mut client = server.acquire(1..2);
    let (mut paths, mut seen) = (Paths::new(3), Vec::new());
    for step in 1..=40 {
        send_paths(&mut client, paths.next(6));
        seen.extend(frames_until(&observer, 1, step));
    }
    let last = seen.last().expect("frames").header.sequence;
    let is_last = |it: &Sample<FrameHeader>| it.header.sequence == last;
    recorder.until(|| frames(&read(&file).0).iter().any(is_last));
    let ended = stop(recorder);
    assert!(!ended.stderr.contains("WARN"), "{}", ended.stderr);
    ended.check_says("steps=40");
    let records = read_whole(&file);
    let recorded = frames(&records);
    let same = recorded.iter().position(|sample| *sample == seen[0]);
    assert_eq!(recorded[same.expect("the first")..], seen[..]);
    let hidden = truths(&records);
    assert!(hidden.iter().any(|sample| sample.header.step == 40));
}

#[test]
fn a_killed_recorder_leaves_whole_records() {
    let server = Server::start(SMALL);
    let (_folder, file) = new_file();
    let recorder = start_recorder(&server.instance, &file, "");
    let mut client = server.acquire(0..1);
    fly_on(&mut client, 0, 30);
    // The recorder writes the frame to the file within about a second, even if it is not stopped.
    wait_for_step(&recorder, &file, 30);
    recorder.kill();
    let (records, error) = read(&file);
    let length = file.metadata().expect("the file").len();
    match error {
        Some(RecordingError::Cut { offset, got, .. }) => assert_eq!(offset + got, length),
        other => panic!("expected a cut, got {other:?}"),
    }
    assert!(
        frames(&records)
            .iter()
            .any(|frame| frame.header.result.step == 30)
    );
}

#[test]
fn a_recorder_comes_before_the_server_and_stays_for_the_next() {
    let instance = new_instance();
    let (_folder, file) = new_file();
    let recorder = start_recorder(&instance, &file, "--truth");
    recorder.wait_for_words("no server yet");
    let mut expected = Vec::new();
    for (seed, flags) in [(11, SMALL), (12, "--task small")] {
        let server = Server::start_on(&instance, &format!("{flags} --seed {seed} --publish-truth"));
        expected.push(server.info());
        fly_on(&mut server.acquire(0..1), seed, 3);
        recorder.until(|| {
            let last = frames(&read(&file).0).pop();
            last.is_some_and(|last| (last.header.result.seed, last.header.result.step) == (seed, 3))
        });
        server.kill();
    }
    stop(recorder).check_says("servers=2");
    let mut seed = 10;
    let mut servers = Vec::new();
    for record in read_whole(&file) {
        match record.event {
            Event::Server(info) => {
                seed += 1;
                servers.push(*info);
            }
            Event::Frame(sample) => assert_eq!(sample.header.result.seed, seed),
            Event::Truth(sample) => assert_eq!(sample.header.seed, seed),
        }
    }
    assert_eq!(servers, expected);
}

#[test]
fn a_recorder_stopped_twice_keeps_what_was_published_and_says_what_it_missed() {
    let server = Server::start(SMALL);
    let (_folder, file) = new_file();
    let recorder = start_recorder(&server.instance, &file, "");
    let mut client = server.acquire(0..1);
    fly_on(&mut client, 0, 1);
    wait_for_step(&recorder, &file, 1);
    recorder.stop();
    fly_on(&mut client, 1, 400);
    server.info(); // answered only after the last step was published
    recorder.signal(Signal::TERM);
    recorder.signal(Signal::INT); // `timeout` also signals both a process and its group
    recorder.signal(Signal::CONT);
    recorder.ends(0).check_says("samples were lost");
    let records = read_whole(&file);
    let frames = frames(&records);
    let (first, last) = (&frames[0].header, &frames[frames.len() - 1].header);
    assert_eq!(last.result.step, 401);
    let n_lost = last.sequence + 1 - first.sequence - frames.len() as u64;
    let said: u64 = records.iter().map(|record| u64::from(record.n_lost)).sum();
    assert!(n_lost > 0 && said == n_lost, "{said} of {n_lost}");
}

#[test]
fn a_recorder_ends_after_its_steps_with_its_worlds_alone() {
    let server = Server::start(&format!("{SMALL} --worlds 3 --publish-truth"));
    let (_folder, file) = new_file();
    std::fs::write(&file, "something else").expect("write");
    let flags = "--steps 4 --worlds 0,2 --truth --force";
    let recorder = start_recorder(&server.instance, &file, flags);
    let (mut client, mut paths) = (server.acquire(0..3), Paths::new(0));
    for _ in 0..2 {
        client.step(0..3, &paths.take(6, 3)).expect("step");
    }
    recorder.ends(0).check_says("steps=4");
    let records = read_whole(&file);
    assert!(records.iter().all(|record| record.n_lost == 0));
    assert!(frames(&records).iter().all(|frame| frame.header.world != 1));
    let shown = truths(&records).into_iter();
    let shown = shown.map(|truth| (truth.header.world, truth.header.step));
    let shown: Vec<_> = shown.collect();
    assert!(
        shown.contains(&(0, 2)) && shown.contains(&(2, 2)),
        "{shown:?}"
    );
}

#[test]
fn nobody_else_reads_a_recording() {
    let server = Server::start(&format!("{SMALL} --publish-truth"));
    let (folder, file) = new_file();
    let path = |name: &str| folder.path().join(name);
    std::fs::write(&file, "open to everybody").expect("write");
    let mut old = File::open(&file).expect("somebody has it open");
    let everybody = std::fs::Permissions::from_mode(0o666);
    std::fs::set_permissions(&file, everybody).expect("a mode");
    for (target, link) in [(&file, "link"), (&path("target"), "dangling")] {
        std::os::unix::fs::symlink(target, path(link)).expect("a link");
    }
    for path in [&file, &path("link"), &path("new"), &path("dangling")] {
        stop(start_recorder(&server.instance, path, "--truth --force"));
        let mode = path.metadata().expect("the file").permissions().mode();
        assert_eq!(mode & 0o777, 0o600, "{}", path.display());
    }
    let mut seen = String::new();
    old.read_to_string(&mut seen).expect("read");
    assert_eq!(seen, "open to everybody");
}
