use super::*;
use crate::simulator::tests::lab::settings;
use emberwatch_messages::client::{Claim, Client, Observation};
use emberwatch_messages::control::{Request, WorldInfo, WorldSeed};
use emberwatch_model::path::Move;
use emberwatch_model::{Coverage, UNOBSERVED};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::fmt::Debug;

const LONG: Duration = Duration::from_secs(60);

/// Creates small worlds with these settings, and a client that holds a robot in each.
fn client(given: Value) -> Client<Embedded> {
    let mut all = json!({"height": 7, "width": 5, "moves": 4, "burn_in": 20});
    all["model"] = "wildfire-small".into();
    let given = given.as_object().expect("a dictionary").clone();
    all.as_object_mut().expect("a dictionary").extend(given);
    let checked = settings(all);
    let n_worlds = checked.config.worlds;
    let worlds = Embedded::new(checked).expect("worlds");
    Client::acquire(worlds, &Claim::new(0..n_worlds)).expect("a lease")
}

fn step(client: &mut Client<Embedded>) -> Result<Vec<Observation>, ConnectionError> {
    let path = vec![Move::Down, Move::Right, Move::Down, Move::Right];
    let paths = vec![path; client.robots().len()];
    client.step(client.robots(), &paths)
}

fn ask(client: &mut Client<Embedded>, request: Value) {
    let request: Request = serde_json::from_value(request).expect("a request");
    client.backend().control(&request, LONG).expect("done");
}

fn reset(world: u32, seed: u64) -> [WorldSeed; 1] {
    let seed = Some(seed);
    [WorldSeed { world, seed }]
}

fn status<T: Debug>(refused: Result<T, ConnectionError>) -> Status {
    match refused {
        Err(ConnectionError::Refused { status, .. }) => status,
        other => panic!("expected a refusal, got {other:?}"),
    }
}

#[test]
fn a_client_flies_resets_and_recalls() {
    let mut client = client(json!({"worlds": 2}));
    let first = step(&mut client).expect("a step");
    let second = step(&mut client).expect("a step");
    assert_eq!(second.len(), 2);
    for (robot, seen) in second.iter().enumerate() {
        assert_eq!((seen.world.step, seen.robot.n_moves), (2, 4));
        assert_eq!(seen.robot.start(), first[robot].robot.cell());
    }
    assert_eq!(client.observe(0..2).expect("worlds"), second);
    assert_eq!(client.recall(0..2, 1).expect("kept"), first);
    assert_eq!(status(client.recall(0..2, 3)), Status::NotKept);
    client.reset(&reset(1, 5)).expect("a world");
    let seen = step(&mut client).expect("a step");
    assert_eq!([0, 1].map(|robot: usize| seen[robot].world.step), [3, 1]);
    client.renew().expect("a lease");
    client.release().expect("a lease");
}

#[test]
fn a_world_does_not_depend_on_worlds_next_to_it_or_on_threads() {
    let start = |worlds, threads, seed| {
        client(json!({
            "worlds": worlds, "threads": threads, "seed": seed, "coverage": "full",
            "height": 72, "width": 72, "burn_in": 3,
        }))
    };
    // A batch so large that both threads step it.
    let mut together = start(8, 2, 0);
    let all: Vec<_> = (0..5)
        .map(|_| step(&mut together).expect("a step"))
        .collect();
    assert_ne!(all[4][0].frame, all[4][1].frame);
    for world in 0..8 {
        let mut alone = start(1, 1, world as u64);
        for seen in &all {
            assert_eq!(step(&mut alone).expect("a step")[0], seen[world]);
        }
    }
}

#[test]
fn a_reset_begins_an_episode_with_an_empty_frame_and_a_seed() {
    let mut client = client(json!({"worlds": 3}));
    step(&mut client).expect("a step");
    let seeds = [(2, 0), (0, u64::MAX)];
    let begun = client.reset(&seeds.map(|(world, seed)| reset(world, seed)[0]));
    let expected = seeds.map(|(world, seed)| WorldInfo {
        world,
        step: 0,
        seed,
        episode: 1,
        robots: vec![[0, 0]],
    });
    assert_eq!(begun.expect("worlds"), expected, "in the order of requests");
    let seen = client.observe(0..1).expect("a world").remove(0);
    assert_eq!(seen.frame.as_bytes(), [UNOBSERVED; 35]);
    assert_eq!(seen.robot.coverage, Coverage::Empty as u32);
    assert_eq!((seen.world.reward, seen.world.n_visited), (0.0, 0));
    // Without a given seed, each reset chooses a new one.
    let (world, seed) = (0, None);
    let mut next = || client.reset(&[WorldSeed { world, seed }]).expect("a world")[0].seed;
    let seeds = BTreeSet::from_iter((0..4).map(|_| next()));
    assert_eq!(seeds.len(), 4, "{seeds:?}");
    assert!(
        seeds.iter().all(|seed| (1..1 << 53).contains(seed)),
        "{seeds:?}"
    );
}

#[test]
fn an_episode_is_over_at_max_steps_until_it_is_reset() {
    let mut client = client(json!({"worlds": 2, "max_steps": 2}));
    for is_truncated in [0, 1] {
        let seen = step(&mut client).expect("a step");
        assert!(seen.iter().all(|it| it.world.truncated == is_truncated));
        assert!(seen.iter().all(|it| it.world.terminated == 0));
    }
    assert_eq!(status(step(&mut client)), Status::EpisodeOver);
    client.reset(&reset(0, 5)).expect("a world");
    assert_eq!(status(step(&mut client)), Status::EpisodeOver);
    assert_eq!(client.observe(0..1).expect("a world")[0].world.step, 0);
    client.step(0..1, &[vec![Move::Up; 4]]).expect("a step");
}

#[test]
fn a_restored_snapshot_continues_in_the_same_way() {
    let mut client = client(json!({"worlds": 2}));
    step(&mut client).expect("a step");
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("worlds").display().to_string();
    let mut of_file = json!({"op": "snapshot", "first_world": 0, "n_worlds": 2, "path": path});
    ask(&mut client, of_file.clone());
    let present = client.observe(0..2).expect("worlds");
    let past = client.recall(0..2, 0).expect("kept");
    let future = step(&mut client).expect("a step");
    (of_file["op"], of_file["lease"]) = ("restore".into(), client.lease().into());
    ask(&mut client, of_file);
    assert_eq!(client.observe(0..2).expect("worlds"), present);
    assert_eq!(client.recall(0..2, 0).expect("kept"), past);
    assert_eq!(step(&mut client).expect("a step"), future);
}

#[test]
fn requests_are_refused_as_a_server_refuses_them() {
    let mut client = client(json!({"worlds": 2}));
    let lease = client.lease();
    assert_eq!(status(client.reset(&reset(3, 1))), Status::NoSuchWorld);
    // The sum of the lengths is right.
    let uneven = client.step(0..2, &[3, 5].map(|length| vec![Move::Up; length]));
    assert_eq!(status(uneven), Status::WrongPathLength);
    let few = client.step(0..2, &[vec![Move::Up; 4]]);
    assert_eq!(status(few), Status::WrongLength);
    ask(&mut client, json!({"op": "release", "lease": lease}));
    assert_eq!(status(step(&mut client)), Status::LeaseLost);
    ask(&mut client, json!({"op": "shutdown"}));
    let gone = step(&mut client);
    assert!(matches!(gone, Err(ConnectionError::ServerGone { .. })));
}

#[test]
fn an_interrupted_wait_leaves_its_worlds_to_the_next_call() {
    let mut client = client(json!({"burn_in": 100_000}));
    let reset = Request::Reset {
        lease: client.lease(),
        worlds: reset(0, 5).into(),
    };
    let ended = client.backend().control(&reset, Duration::ZERO);
    assert!(matches!(ended, Err(ConnectionError::Timeout { .. })));
    client.renew().expect("a world");
    let worlds = client.backend().episodes(0..1).expect("worlds");
    assert_eq!(worlds.expect("a world")[0].outcome().seed, 5);
}

#[test]
fn worlds_that_do_not_fit_in_memory_are_refused() {
    let refused = Embedded::new(settings(
        json!({"worlds": 1024, "height": 4096, "width": 4096}),
    ));
    let refused = refused.map(|_| ()).expect_err("too much").to_string();
    let expected = "for 1024 worlds of 4096 x 4096 cells, got ";
    assert!(refused.starts_with("memory: expected "), "{refused}");
    assert!(refused.contains(expected), "{refused}");
}
