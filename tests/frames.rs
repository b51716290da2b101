//! Observers: what `frames` and `truth` show, to whom, and that nobody waits for them.

use emberwatch_protocol::channels::{FRAME_BUFFER, channel_directory};
use emberwatch_protocol::message::{FrameHeader, VERSION};
use emberwatch_protocol::observer::{Observer, Sample};
use emberwatch_protocol::{Coverage, UNOBSERVED};
use tests::harness::{
    PATIENCE, Paths, SMALL, Server, eventually, fly, frames_until, new_instance, path_of, reset,
    robots_of, seen_by, seen_in,
};

/// Cells of a [`SMALL`] server.
const N_CELLS: usize = 35;

fn observe(server: &Server) -> Observer<FrameHeader> {
    Observer::frames(&server.instance).expect("observe frames")
}

fn assert_gapless(samples: &[Sample<FrameHeader>]) {
    for pair in samples.windows(2) {
        assert_eq!(pair[1].header.sequence, pair[0].header.sequence + 1);
    }
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
        let answer = fly(&mut client, path.clone());
        let new = frames_until(&observer, 1, step);
        let sample = new.last().expect("a frame");
        assert_eq!((seen_in(sample), path_of(sample)), (seen_by(&answer), path));
        let header = &sample.header;
        assert_eq!(header.version, VERSION);
        assert_eq!((header.height, header.width), (5, 7));
        assert_eq!((header.first_robot, header.n_robots), (1, 1));
        assert_eq!((answer.robot.start_row, answer.robot.start_col), start);
        start = (answer.robot.row, answer.robot.col);
        seen.extend(new);
    }
    assert_gapless(&seen);
}

#[test]
fn a_reset_is_published_as_an_empty_frame_without_a_path() {
    let server = Server::start(SMALL);
    let mut client = server.acquire(0..1);
    let observer = observe(&server);
    fly(&mut client, Paths::new(0).next(6));
    frames_until(&observer, 0, 1);
    reset(&mut client, 5);
    let new = frames_until(&observer, 0, 0);
    let sample = new.last().expect("a frame");
    let world = sample.header.result;
    assert_eq!((world.seed, world.episode), (5, 1));
    let [robot] = &robots_of(sample)[..] else {
        panic!("expected one robot");
    };
    assert_eq!(robot.result.coverage, Coverage::Empty as u32);
    assert_eq!(robot.frame, [UNOBSERVED; N_CELLS]);
    assert!(robot.path.is_empty());
}

#[test]
fn a_late_observer_gets_the_current_frame_of_every_world_at_once() {
    let server = Server::start(&format!("{SMALL} --worlds 3"));
    let mut client = server.acquire(0..3);
    client
        .step(0..3, &vec![Paths::new(0).next(6); 3])
        .expect("step");
    // The second and third come when another has just gone: the number of observers stays one.
    for _ in 0..3 {
        let observer = observe(&server);
        for world in 0..3 {
            frames_until(&observer, world, 1);
        }
    }
}

#[test]
fn an_observer_may_come_before_the_server_and_stay_for_the_next() {
    let instance = new_instance();
    let observer = Observer::frames(&instance).expect("observe frames");
    for seed in [11, 12] {
        let server = Server::start_on(&instance, &format!("{SMALL} --seed {seed}"));
        let frames = frames_until(&observer, 0, 0);
        let last = frames.last().expect("a frame").header;
        assert_eq!(last.result.seed, seed);
        fly(&mut server.acquire(0..1), Paths::new(0).next(6));
        frames_until(&observer, 0, 1);
        server.kill();
    }
}

#[test]
fn a_stalled_observer_sees_a_gap_and_slows_nobody() {
    let server = Server::start(SMALL);
    let mut client = server.acquire(0..1);
    let (stalled, reading) = (observe(&server), observe(&server));
    frames_until(&stalled, 0, 0);
    frames_until(&reading, 0, 0);
    let mut paths = Paths::new(4);
    let mut read = Vec::new();
    for step in 1..=200 {
        fly(&mut client, paths.next(6));
        read.extend(frames_until(&reading, 0, step));
    }
    assert_gapless(&read);
    let last = read.last().expect("frames").header.sequence;
    let late = frames_until(&stalled, 0, 200);
    assert!(late.len() <= FRAME_BUFFER, "{} were kept", late.len());
    let newest = late.last().expect("frames").header.sequence;
    assert_eq!(newest, last, "the newest are kept");
    assert!(late[0].header.sequence > last - FRAME_BUFFER as u64);
}

#[test]
fn hidden_states_are_published_only_on_request() {
    for (flag, is_published) in [("", false), ("--publish-truth", true)] {
        let server = Server::start(&format!("{SMALL} {flag}"));
        let observer = Observer::truth(&server.instance).expect("the truth channel");
        let mut client = server.acquire(0..1);
        fly(&mut client, Paths::new(0).next(6));
        server.status();
        let mut last = None;
        let limit = PATIENCE * u32::from(is_published);
        let arrived = eventually(limit, || {
            last = observer.try_receive().expect("receive").or(last.take());
            last.as_ref().is_some_and(|sample| sample.header.step == 1)
        });
        assert_eq!((arrived, last.is_some()), (is_published, is_published));
        let Some(Sample { header, payload }) = last else {
            continue;
        };
        assert_eq!((header.world, header.seed), (0, 0));
        assert_eq!((header.height, header.width), (5, 7));
        assert_eq!(payload.len(), N_CELLS);
        assert!(payload.iter().all(|&state| state < 3));
    }
}

#[test]
fn what_is_told_of_a_world_agrees_with_its_hidden_states() {
    let flags = "--height 9 --width 6 --moves 8 --burn-in 3000 --coverage full --publish-truth";
    let server = Server::start(flags);
    let truth = Observer::truth(&server.instance).expect("the truth channel");
    let mut client = server.acquire(0..1);
    let (mut paths, mut n_right, mut n_cells) = (Paths::new(1), 0, 0);
    for step in 1..=50 {
        let told = fly(&mut client, paths.next(8));
        let mut states = Vec::new();
        assert!(eventually(PATIENCE, || {
            let sample = truth.try_receive().expect("receive");
            let found = sample.filter(|sample| sample.header.step == step);
            found.map(|sample| states = sample.payload).is_some()
        }));
        let burning = states.iter().filter(|&&state| state == 2).count();
        let (world, robot) = (told.world, told.robot);
        assert_eq!(world.n_target_cells as usize, burning);
        assert!(robot.n_hits <= robot.n_visited && robot.n_visited <= 8);
        assert_eq!(world.n_hits, robot.n_hits);
        assert_eq!(world.n_visited, robot.n_visited);
        assert_eq!(world.reward, f64::from(robot.n_hits));
        assert_eq!((robot.reward, robot.marginal), (world.reward, world.reward));
        let seen = states.iter().zip(told.frame.as_bytes());
        // A normal or burning cell looks like itself with .98.
        let sharp = seen.filter(|(state, _)| **state != 1);
        let (right, all) = sharp.fold((0, 0), |(right, all), (state, seen)| {
            (right + usize::from(state == seen), all + 1)
        });
        (n_right, n_cells) = (n_right + right, n_cells + all);
    }
    // Binomial: .98 +- 6 standard errors of at most sqrt(.98 * .02 / n).
    let share = n_right as f64 / n_cells as f64;
    let bound = 6.0 * (0.98 * 0.02 / n_cells as f64).sqrt();
    assert!((share - 0.98).abs() < bound, "{share} of {n_cells}");
}

#[test]
fn an_observer_whose_files_are_removed_says_so() {
    let instance = new_instance();
    let frames = Observer::frames(&instance).expect("observe");
    let agents = Observer::agents(&instance).expect("observe");
    let services = std::fs::read_dir(channel_directory().join("services")).expect("services");
    for entry in services.flatten() {
        let text = std::fs::read_to_string(entry.path()).unwrap_or_default();
        if text.contains(&format!("emberwatch/v2/{}/", instance.name())) {
            std::fs::remove_file(entry.path()).expect("remove it");
        }
    }
    let frames = frames.receive(PATIENCE).map(|sample| sample.is_some());
    let agents = agents.receive(PATIENCE).map(|sample| sample.is_some());
    for received in [frames, agents] {
        let words = received.expect_err("its files are gone").to_string();
        assert!(words.contains("was removed while it was in use"), "{words}");
    }
}
