//! Tests of replays: which samples observers receive and when, and which answers clients receive.

use crate::commands::check;
use crate::recording::{
    frames, new_file, read, read_whole, start_recorder, start_replay, stop, take, truths,
    write_recording,
};
use emberwatch_protocol::backend::Backend;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::{Reply, Request};
use emberwatch_protocol::message::{FrameHeader, Status};
use emberwatch_protocol::observer::{Observer, Sample};
use emberwatch_protocol::{Client, Connection};
use rustix::process::Signal;
use tests::harness::{
    PATIENCE, Paths, SERVER, SMALL, Server, fly, frames_until, new_instance, run, takeover,
};
use tests::wire::observe_header;

#[test]
fn a_replay_gives_observers_byte_for_byte_what_the_server_gave_them() {
    let server = Server::start(&format!("{SMALL} --worlds 2 --publish-truth"));
    let (_folder, file) = new_file();
    let recorder = start_recorder(&server.instance, &file, "--truth");
    let observer = Observer::frames(&server.instance).expect("observe");
    let mut client = server.acquire(1..2);
    let (mut paths, mut seen) = (Paths::new(3), Vec::new());
    for step in 1..=40 {
        fly(&mut client, paths.next(6));
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

    let instance = new_instance();
    let reader = Observer::truth(&instance).expect("read the truth");
    let observer = Observer::frames(&instance).expect("observe");
    let replay = start_replay(&instance, &file, "--speed max");
    assert_eq!(take(&observer, recorded.len()), recorded);
    assert_eq!(take(&reader, hidden.len()), hidden);
    replay.ends(0);
    assert_eq!(observer.try_receive().expect("receive"), None);
    assert_eq!(reader.try_receive().expect("receive"), None);
}

#[test]
fn a_replay_answers_for_its_server_and_lets_nobody_act() {
    let (_folder, file) = new_file();
    write_recording(&file, 3, 100);
    let instance = new_instance();
    let replay = start_replay(&instance, &file, "--loop");
    replay.wait_for_words("waiting for an observer");
    let connect = || Connection::open(&instance, "tests", PATIENCE).expect("connect");
    let mut connection = connect();
    let info = connection.info();
    assert_eq!((info.height, info.n_moves, info.pid), (2, 1, replay.pid()));
    let observer = Observer::frames(&instance).expect("observe");
    // After the last sample, `--loop` restarts with the first sample.
    let steps = take(&observer, 7)
        .into_iter()
        .map(|it| it.header.result.step);
    assert_eq!(steps.collect::<Vec<_>>(), [0, 1, 2, 0, 1, 2, 0]);
    match Client::acquire(connect(), &takeover(0..1)).err() {
        Some(ConnectionError::Refused {
            status, message, ..
        }) => {
            assert_eq!(status, Status::NotPermitted);
            assert!(message.contains("replays a recording"), "{message}");
        }
        other => panic!("expected a refusal, got {other:?}"),
    }
    match connection.step(observe_header(0..1), &[], PATIENCE) {
        Err(ConnectionError::Refused { status, .. }) => assert_eq!(status, Status::NotPermitted),
        other => panic!("expected a refusal, got {other:?}"),
    }
    // Each round begins with the server's record, which precedes the frames.
    let shows_world = || match connection.control(&Request::Status {}, PATIENCE) {
        Ok(Reply::Status(status)) => {
            assert_eq!(status.pid, replay.pid());
            assert_eq!((status.n_refused, status.n_observers), (2, 1));
            status.worlds.len() == 1
        }
        other => panic!("expected a status, got {other:?}"),
    };
    replay.until(shows_world);
    let words = format!("already running, as pid {}", replay.pid());
    check(SERVER, &format!("--instance {}", instance.name()), &words);
    run(SERVER, &format!("stop --instance {}", instance.name())).check(0);
    replay.ends(0);
}

#[test]
fn a_replay_keeps_the_recorded_time_times_its_speed() {
    let (_folder, file) = new_file();
    let samples = write_recording(&file, 4, 3_600_000);
    for (flags, n_left_out) in [("--speed max", 0), ("--speed 1e9", 0), ("--from 10800", 3)] {
        let instance = new_instance();
        let observer = Observer::frames(&instance).expect("observe");
        let replay = start_replay(&instance, &file, flags);
        assert_eq!(take(&observer, 4 - n_left_out), samples[n_left_out..]);
        drop(observer);
        replay.ends(0);
    }
    let instance = new_instance();
    let observer = Observer::frames(&instance).expect("observe");
    let replay = start_replay(&instance, &file, "--speed 10");
    assert_eq!(take(&observer, 1), samples[..1]);
    // The replay answers requests while it waits for the second sample, which is due in six minutes.
    run(SERVER, &format!("stop --instance {}", instance.name())).check(0);
    replay.ends(0);
    assert_eq!(observer.try_receive().expect("receive"), None);
}

#[test]
fn a_long_replay_at_full_speed_reaches_an_observer_that_reads() {
    let (_folder, file) = new_file();
    let samples = write_recording(&file, 5_000, 1_000);
    let instance = new_instance();
    let observer = Observer::frames(&instance).expect("observe");
    let replay = start_replay(&instance, &file, "--speed max");
    let got = frames_until(&observer, 0, 4_999);
    drop(observer);
    assert_eq!(got.last(), samples.last());
    assert!(got.is_sorted_by_key(|sample| sample.header.sequence));
    replay.ends(0);
    // Without an observer, the replay starts only with `--no-wait`.
    write_recording(&file, 2, 0);
    start_replay(&new_instance(), &file, "--no-wait").ends(0);
    let waiting = start_replay(&new_instance(), &file, "");
    waiting.wait_for_words("waiting for an observer");
    waiting.signal(Signal::INT);
    waiting.ends(0);
}
