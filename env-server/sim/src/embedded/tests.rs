use super::*;
use crate::config::ServerConfig;
use emberwatch_messages::control::{Request, WorldSeed};
use emberwatch_messages::message::Operation;

const LONG: Duration = Duration::from_secs(60);

fn embedded(n_worlds: u32, burn_in: u64) -> Embedded {
    let config = ServerConfig {
        worlds: n_worlds,
        height: 7,
        width: 5,
        moves: 4,
        burn_in,
        model: "wildfire-small".into(),
        ..ServerConfig::default()
    };
    Embedded::new(config.check().expect("settings")).expect("worlds")
}

fn ask(embedded: &mut Embedded, request: &Request) -> Result<Reply, ConnectionError> {
    let text = serde_json::to_vec(request).expect("JSON");
    let answer = embedded.control_text(&text, LONG)?;
    Ok(serde_json::from_slice(&answer).expect("a reply"))
}

fn acquire(embedded: &mut Embedded, n_robots: u32) -> u64 {
    let request = Request::Acquire {
        first_robot: 0,
        n_robots,
        takeover: false,
        ttl_millis: None,
    };
    match ask(embedded, &request) {
        Ok(Reply::Lease(lease)) => lease.lease,
        other => panic!("expected a lease, got {other:?}"),
    }
}

fn step(embedded: &mut Embedded, lease: u64, k: u64) -> Result<Vec<u8>, ConnectionError> {
    let request = StepRequest {
        operation: Operation::Step as u32,
        lease,
        n_robots: 1,
        n_moves: 4,
        ..StepRequest::default()
    };
    let mut body = k.to_ne_bytes().to_vec();
    body.extend([1, 3, 1, 3]);
    embedded
        .step_payload(request, &body)
        .map(|(_, payload)| payload)
}

#[test]
fn a_snapshot_has_the_same_future() {
    let mut embedded = embedded(2, 20);
    let lease = acquire(&mut embedded, 2);
    step(&mut embedded, lease, 0).expect("a step");
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("worlds").display().to_string();
    let (first_world, n_worlds) = (0, 1);
    let save = Request::Snapshot {
        first_world,
        n_worlds,
        path: path.clone(),
    };
    ask(&mut embedded, &save).expect("a file");
    let future = step(&mut embedded, lease, 1).expect("a step");
    let load = Request::Restore {
        lease,
        first_world,
        n_worlds,
        from: 0,
        path,
    };
    ask(&mut embedded, &load).expect("worlds");
    assert_eq!(step(&mut embedded, lease, 1).expect("a step"), future);
}

#[test]
fn refusals_are_those_of_a_server() {
    let mut embedded = embedded(1, 20);
    let lease = acquire(&mut embedded, 1);
    let status = |refused| match refused {
        Err(ConnectionError::Refused { status, .. }) => status,
        other => panic!("expected a refusal, got {other:?}"),
    };
    assert_eq!(status(step(&mut embedded, lease, 7)), Status::Early);
    assert_eq!(status(step(&mut embedded, lease + 1, 0)), Status::NoLease);
    let worlds = vec![WorldSeed {
        world: 3,
        seed: None,
    }];
    let reset = ask(&mut embedded, &Request::Reset { lease, worlds });
    assert_eq!(status(reset.map(|_| Vec::new())), Status::NoSuchWorld);
    ask(&mut embedded, &Request::Shutdown {}).expect("an end");
    let gone = step(&mut embedded, lease, 0);
    assert!(matches!(gone, Err(ConnectionError::ServerGone { .. })));
}

#[test]
fn a_wait_that_ended_early_leaves_the_worlds_to_the_next_one() {
    let mut embedded = embedded(1, 100_000);
    let lease = acquire(&mut embedded, 1);
    let reset = Request::Reset {
        lease,
        worlds: vec![WorldSeed {
            world: 0,
            seed: Some(5),
        }],
    };
    let text = serde_json::to_vec(&reset).expect("JSON");
    let ended = embedded.control_text(&text, Duration::ZERO);
    assert!(matches!(ended, Err(ConnectionError::Timeout { .. })));
    ask(&mut embedded, &Request::Renew { lease }).expect("a world");
    let worlds = embedded.episodes(0..1).expect("worlds");
    assert_eq!(worlds.expect("a world")[0].result().seed, 5);
}

#[test]
fn worlds_that_do_not_fit_in_memory_are_refused() {
    let config = ServerConfig {
        worlds: 1024,
        height: 4096,
        width: 4096,
        ..ServerConfig::default()
    };
    let refused = Embedded::new(config.check().expect("settings"));
    let refused = refused.map(|_| ()).expect_err("too much").to_string();
    let expected = "for 1024 worlds of 4096 x 4096 cells, got ";
    assert!(refused.starts_with("memory: expected "), "{refused}");
    assert!(refused.contains(expected), "{refused}");
}
