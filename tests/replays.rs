//! Replays: what observers get of a recording, when, and what clients are told.

use crate::commands::{SERVER, check};
use crate::harness::{
    PATIENCE, Paths, SMALL, Server, eventually, fly, frames_until, new_instance, run, takeover,
};
use crate::recording::{
    frames, new_file, read, read_whole, start_recorder, start_replay, stop, take, truths,
    write_recording,
};
use protocol::connection::ConnectionError;
use protocol::control::{Reply, Request};
use protocol::message::{FrameHeader, Operation, Status, StepRequest};
use protocol::observer::{Observer, Sample};
use protocol::{Client, Connection};
use rustix::process::Signal;

#[test]
fn a_replay_gives_observers_byte_for_byte_what_the_server_gave_them() {
    let server = Server::start(&format!("{SMALL} --worlds 2 --publish-truth"));
    let (_folder, file) = new_file();
    let recorder = start_recorder(&server.instance, &file, &["--truth"]);
    let observer = Observer::frames(&server.instance).expect("observe");
    let mut client = server.acquire(1..2);
    let (mut paths, mut seen) = (Paths::new(3), Vec::new());
    for step in 1..=40 {
        fly(&mut client, paths.next(6));
        seen.extend(frames_until(&observer, 1, step));
    }
    let last = seen.last().expect("frames").header.sequence;
    let has_all = || {
        frames(&read(&file).0)
            .iter()
            .any(|it| it.header.sequence == last)
    };
    assert!(eventually(PATIENCE, has_all));
    let ended = stop(recorder);
    assert!(!ended.stderr.contains("WARN"), "{}", ended.stderr);
    assert!(ended.stderr.contains("steps=40"), "{}", ended.stderr);

    let records = read_whole(&file);
    let recorded = frames(&records);
    let same = recorded.iter().position(|sample| *sample == seen[0]);
    assert_eq!(recorded[same.expect("the first")..], seen[..]);
    let hidden = truths(&records);
    assert!(hidden.iter().any(|sample| sample.header.step == 40));

    let instance = new_instance();
    let reader = Observer::truth(&instance).expect("read the truth");
    let observer = Observer::frames(&instance).expect("observe");
    let replay = start_replay(&instance, &file, &["--speed", "max"]);
    assert_eq!(take(&observer, recorded.len()), recorded);
    assert_eq!(take(&reader, hidden.len()), hidden);
    let ended = replay.wait(PATIENCE);
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    assert_eq!(observer.try_receive().expect("receive"), None);
    assert_eq!(reader.try_receive().expect("receive"), None);
}

#[test]
fn a_replay_answers_for_its_server_and_lets_nobody_act() {
    let (_folder, file) = new_file();
    write_recording(&file, 3, 100);
    let instance = new_instance();
    let replay = start_replay(&instance, &file, &["--loop"]);
    replay.wait_for_words("waiting for an observer", PATIENCE);
    let connect = || Connection::open(&instance, "tests", PATIENCE).expect("connect");
    let mut connection = connect();
    let info = connection.info();
    assert_eq!((info.height, info.n_moves, info.pid), (2, 1, replay.pid()));
    let observer = Observer::frames(&instance).expect("observe");
    // Round and round: after the last comes the first.
    let steps = take(&observer, 7)
        .into_iter()
        .map(|it| it.header.result.step);
    assert_eq!(steps.collect::<Vec<_>>(), [0, 1, 2, 0, 1, 2, 0]);
    match Client::acquire(connect(), &takeover(0..1)).err() {
        Some(ConnectionError::Refused {
            status, message, ..
        }) => {
            assert_eq!(status, Status::NotPermitted);
            assert!(message.contains("a recording is replayed"), "{message}");
        }
        other => panic!("expected a refusal, got {other:?}"),
    }
    let observe = StepRequest {
        operation: Operation::Observe as u32,
        n_robots: 1,
        ..StepRequest::default()
    };
    let refused = connection.step(observe, &[], PATIENCE);
    assert!(
        matches!(
            refused,
            Err(ConnectionError::Refused {
                status: Status::NotPermitted,
                ..
            })
        ),
        "{refused:?}"
    );
    // A round begins with the server, whose world follows.
    let shows_world = || match connection.control(&Request::Status {}, PATIENCE) {
        Ok(Reply::Status(status)) => {
            assert_eq!(status.pid, replay.pid());
            assert_eq!((status.n_refused, status.n_observers), (2, 1));
            status.worlds.len() == 1
        }
        other => panic!("expected a status, got {other:?}"),
    };
    assert!(eventually(PATIENCE, shows_world));
    let words = format!("already running, as pid {}", replay.pid());
    check(
        SERVER,
        &format!("--instance {}", instance.name()),
        &[&words],
    );
    let stop = run(SERVER, &["stop", "--instance", instance.name()], PATIENCE);
    assert_eq!(stop.code, Some(0), "{}", stop.stderr);
    assert_eq!(replay.wait(PATIENCE).code, Some(0));
}

#[test]
fn a_replay_keeps_the_recorded_time_times_its_speed() {
    let (_folder, file) = new_file();
    let samples = write_recording(&file, 4, 3_600_000);
    for (flags, n_left_out) in [
        (["--speed", "max"], 0),
        (["--speed", "1e9"], 0),
        (["--from", "10800"], 3),
    ] {
        let instance = new_instance();
        let observer = Observer::frames(&instance).expect("observe");
        let replay = start_replay(&instance, &file, &flags);
        assert_eq!(take(&observer, 4 - n_left_out), samples[n_left_out..]);
        drop(observer);
        assert_eq!(replay.wait(PATIENCE).code, Some(0), "{flags:?}");
    }
    let instance = new_instance();
    let observer = Observer::frames(&instance).expect("observe");
    let replay = start_replay(&instance, &file, &["--speed", "10"]);
    assert_eq!(take(&observer, 1), samples[..1]);
    // It answers while it waits for the second, which comes in six minutes.
    let stop = run(SERVER, &["stop", "--instance", instance.name()], PATIENCE);
    assert_eq!(stop.code, Some(0), "{}", stop.stderr);
    assert_eq!(replay.wait(PATIENCE).code, Some(0));
    assert_eq!(observer.try_receive().expect("receive"), None);
}

#[test]
fn a_long_replay_at_full_speed_reaches_an_observer_that_reads() {
    let (_folder, file) = new_file();
    let samples = write_recording(&file, 5_000, 1_000);
    let is_increasing =
        |pair: &[Sample<FrameHeader>]| pair[0].header.sequence < pair[1].header.sequence;
    let instance = new_instance();
    let observer = Observer::frames(&instance).expect("observe");
    let replay = start_replay(&instance, &file, &["--speed", "max"]);
    // How many of them: `scripts/bench` tells.
    let got = frames_until(&observer, 0, 4_999);
    drop(observer);
    assert_eq!(got.last(), samples.last());
    assert!(got.windows(2).all(is_increasing));
    assert_eq!(replay.wait(PATIENCE).code, Some(0));
}

#[test]
fn a_replay_begins_without_an_observer_only_when_told() {
    let (_folder, file) = new_file();
    write_recording(&file, 2, 0);
    let at_once = start_replay(&new_instance(), &file, &["--no-wait"]);
    assert_eq!(at_once.wait(PATIENCE).code, Some(0));
    let waiting = start_replay(&new_instance(), &file, &[]);
    waiting.wait_for_words("waiting for an observer", PATIENCE);
    waiting.signal(Signal::INT);
    assert_eq!(waiting.wait(PATIENCE).code, Some(0));
}
