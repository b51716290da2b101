//! Tests of the channels `frames` and `truth`: what they contain, and who receives it. The server must never wait for
//! observers.

use emberwatch_protocol::channels::FRAME_BUFFER;
use emberwatch_protocol::message::{FrameHeader, VERSION};
use emberwatch_protocol::observer::{Observer, Sample};
use emberwatch_protocol::{Coverage, UNOBSERVED};
use tests::harness::{
    PATIENCE, Paths, SMALL, Server, frames_until, new_instance, path_of, reset, robots_of, seen_by,
    seen_in, send_paths, service_files,
};

/// Number of cells of a world on a [`SMALL`] server.
const N_CELLS: usize = 35;

fn observe(server: &Server) -> Observer<FrameHeader> {
    Observer::frames(&server.instance).expect("observe frames")
}

fn assert_gapless(samples: &[Sample<FrameHeader>]) {
    let first = samples[0].header.sequence;
    let sequences = samples.iter().map(|sample| sample.header.sequence);
    assert!(sequences.eq(first..first + samples.len() as u64));
}

#[test]
fn a_reading_observer_gets_every_frame_with_its_path() {
    let server = Server::start(&format!("{SMALL} --worlds 2"));
    let mut client = server.acquire(1..2);
    let observer = observe(&server);
    let mut seen = frames_until(&observer, 1, 0);
    let mut paths = Paths::new(3);
    let mut start = (0, 0);
    for step in 1..=30 {
        let path = paths.next(6);
        let answer = send_paths(&mut client, path.clone());
        let new = frames_until(&observer, 1, step);
        let sample = new.last().expect("a frame");
        assert_eq!((seen_in(sample), path_of(sample)), (seen_by(&answer), path));
        let header = &sample.header;
        assert_eq!(
            (header.version, header.height, header.width),
            (VERSION, 5, 7)
        );
        assert_eq!((header.first_robot, header.n_robots), (1, 1));
        assert_eq!((answer.robot.start_row, answer.robot.start_col), start);
        start = (answer.robot.row, answer.robot.col);
        seen.extend(new);
    }
    // A reset is published as an empty frame without a path.
    reset(&mut client, 5);
    seen.extend(frames_until(&observer, 1, 0));
    assert_gapless(&seen);
    let sample = seen.last().expect("a frame");
    let world = sample.header.result;
    assert_eq!((world.seed, world.episode), (5, 1));
    let robot = &robots_of(sample)[0];
    assert_eq!(robot.result.coverage, Coverage::Empty as u32);
    assert_eq!(robot.frame, [UNOBSERVED; N_CELLS]);
    assert!(robot.path.is_empty());
}

#[test]
fn a_late_observer_gets_the_current_frame_of_every_world_at_once() {
    let server = Server::start(&format!("{SMALL} --worlds 3"));
    let paths = vec![Paths::new(0).next(6); 3];
    server.acquire(0..3).step(0..3, &paths).expect("step");
    // The second and third observer connect right after the previous one has left, so the server may see one observer
    // all the time.
    for _ in 0..3 {
        let observer = observe(&server);
        for world in 0..3 {
            frames_until(&observer, world, 1);
        }
    }
}

#[test]
fn a_stalled_observer_sees_a_gap_and_slows_nobody() {
    let server = Server::start(SMALL);
    let mut client = server.acquire(0..1);
    let (stalled, reading) = (observe(&server), observe(&server));
    frames_until(&stalled, 0, 0);
    frames_until(&reading, 0, 0);
    let mut read = Vec::new();
    for (step, path) in (1..).zip(Paths::new(4).take(6, 2 * FRAME_BUFFER)) {
        send_paths(&mut client, path);
        read.extend(frames_until(&reading, 0, step));
    }
    assert_gapless(&read);
    let late = frames_until(&stalled, 0, 2 * FRAME_BUFFER as u64);
    assert_gapless(&late);
    assert!(late.len() <= FRAME_BUFFER, "{} were kept", late.len());
    assert_eq!(late.last(), read.last(), "the newest are kept");
}

#[test]
fn hidden_states_come_only_on_request() {
    for publishes in [false, true] {
        let server = Server::start(&format!("{SMALL} --publish-truth {publishes}"));
        let truth = Observer::truth(&server.instance).expect("the truth channel");
        send_paths(&mut server.acquire(0..1), Paths::new(0).next(6));
        server.status();
        if !publishes {
            assert!(truth.try_receive().expect("receive").is_none());
            continue;
        }
        let next = || truth.receive(PATIENCE).expect("receive").expect("states");
        let Sample { header, payload } = std::iter::repeat_with(next)
            .find(|sample| sample.header.step == 1)
            .expect("endless");
        assert_eq!((header.world, payload.len()), (0, N_CELLS));
    }
}

#[test]
fn an_observer_whose_files_are_removed_says_so() {
    let instance = new_instance();
    let frames = Observer::frames(&instance).expect("observe");
    let agents = Observer::agents(&instance).expect("observe");
    for file in service_files(&instance) {
        std::fs::remove_file(file).expect("remove it");
    }
    let frames = frames.receive(PATIENCE).map(|sample| sample.is_some());
    let agents = agents.receive(PATIENCE).map(|sample| sample.is_some());
    for received in [frames, agents] {
        let words = received.expect_err("its files are gone").to_string();
        assert!(words.contains("was removed while it was in use"), "{words}");
    }
}
