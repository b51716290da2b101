//! Fuzz targets for the requests that the server reads. Each input goes to a new simulator.

use super::messages::{split_header, survives};
use emberwatch_protocol::control::{CoverageRule, Reply, Request, WorldStatus, parse};
use emberwatch_protocol::message::{Operation, Status, StepReply, StepRequest, VERSION};
use emberwatch_protocol::payload::split_step_payload;
use emberwatch_protocol::settings::WorldSettings;
use emberwatch_sim::config::ServerConfig;
use emberwatch_sim::simulator::{ClientId, Outcome, ServerStats, Simulator, Stepped};
use emberwatch_sim::snapshot::{SnapshotWorld, encode};
use rayon::ThreadPoolBuilder;
use std::time::Instant;

const N_MOVES: usize = 4;
const N_ROBOTS: u32 = 2;

/// The worlds of the attackers come first. The last world is the victim's.
const N_WORLDS: u32 = 3;
const HOME: usize = 2;

/// Number of robots that the attackers hold, from robot 0 on.
const N_THEIRS: u32 = HOME as u32 * N_ROBOTS;

const VICTIM: ClientId = ClientId { node: 1, pid: 1 };

/// The attacking clients. The first one holds the attackers' robots.
const ATTACKERS: [ClientId; 2] = [ClientId { node: 2, pid: 2 }, ClientId { node: 3, pid: 3 }];

const VICTIMS_LEASE: u64 = 11;
const ATTACKERS_LEASE: u64 = 12;

/// The placeholder for the attacker's lease in a control request.
const LEASE: &str = "LEASE";

/// Handles a step request, which consists of a header of 56 bytes and a payload.
pub fn step(bytes: &[u8]) -> bool {
    let Some((request, body)) = split_header::<StepRequest>(bytes) else {
        return false;
    };
    let (mut simulator, now) = begin();
    let (before, mut payload) = (worlds(&simulator), Vec::new());
    let stepped = simulator.step(now, ATTACKERS[0], &request, body, &mut payload);
    let after = worlds(&simulator);
    let Stepped::Reply(reply) = stepped else {
        panic!("a step waits, although all other robots of its world have no holder");
    };
    assert_eq!(reply.sequence, request.sequence);
    let status = check_answer(&reply, &payload);
    if status != Status::Ok || request.operation != Operation::Step as u32 {
        assert!(before == after, "{status:?} changed a world");
        return status == Status::Ok;
    }
    let robots = request.first_robot as usize..(request.first_robot + reply.n_robots) as usize;
    assert!(robots.end <= N_THEIRS as usize, "the victim's robot");
    assert_eq!(request.lease, ATTACKERS_LEASE, "a step without a lease");
    let stepped = simulator.worlds_of(&robots);
    for (world, (before, after)) in before.iter().zip(&after).enumerate() {
        let is_changed = before != after;
        assert_eq!(is_changed, stepped.contains(&world), "world {world}");
    }
    true
}

/// Handles a control request. Bits of the first byte select the client and the version.
pub fn control(bytes: &[u8]) -> bool {
    let Some((&first, text)) = bytes.split_first() else {
        return false;
    };
    let client = ATTACKERS[usize::from(first & 1)];
    let version = VERSION + u32::from(first >> 3 & 1);
    let text = replaced(text, &ATTACKERS_LEASE.to_string());
    let request = parse::<Request>(&text);
    if let Ok(request) = &request {
        assert_eq!(survives::<Request>(&text).as_ref(), Some(request));
    }
    let (mut simulator, now) = begin();
    let (before, known) = (worlds(&simulator), status(&mut simulator, now));
    match ask(&mut simulator, now, client, version, &text) {
        Outcome::Pending(..) | Outcome::File(..) => true,
        Outcome::Answer(reply) => {
            let text = serde_json::to_vec(&reply).expect("replies serialise");
            assert_eq!(survives::<Reply>(&text), Some(reply.clone()));
            let is_refused = reply.status() != Status::Ok;
            if is_refused {
                assert!(worlds(&simulator) == before, "{reply:?} changed a world");
                assert_eq!(status(&mut simulator, now), known, "{reply:?}");
            }
            !is_refused
        }
        Outcome::Changed(changed, reply) => {
            assert!(changed.end <= HOME, "a fork into the victim's world");
            assert_eq!(reply.status(), Status::Ok);
            true
        }
        Outcome::Shutdown => {
            assert_eq!(request, Ok(Request::Shutdown {}));
            true
        }
    }
}

/// Creates the simulator, in which the victim and the first attacker hold their robots.
fn begin() -> (Simulator, Instant) {
    let config = ServerConfig {
        worlds: N_WORLDS,
        coverage: CoverageRule::Client,
        world: WorldSettings {
            robots: N_ROBOTS,
            height: 2,
            width: 3,
            moves: N_MOVES,
            burn_in: 0,
            ..WorldSettings::default()
        },
        ..ServerConfig::default()
    };
    let threads = ThreadPoolBuilder::new().num_threads(1).build();
    let mut tokens = VICTIMS_LEASE..;
    let next_token = Box::new(move || tokens.next().expect("numbers"));
    let checked = config.check().expect("valid settings");
    let simulator = Simulator::new(checked, threads.expect("a thread"), next_token);
    let (mut simulator, jobs) = simulator.expect("valid settings");
    for job in jobs {
        let (world, episode) = job.run(&simulator.spec().rules);
        simulator.put(world, episode);
    }
    let now = Instant::now();
    for (client, first_robot, n_robots) in
        [(VICTIM, N_THEIRS, N_ROBOTS), (ATTACKERS[0], 0, N_THEIRS)]
    {
        let robots = format!(r#""first_robot":{first_robot},"n_robots":{n_robots}"#);
        let text = format!(r#"{{"op":"acquire",{robots}}}"#);
        let outcome = ask(&mut simulator, now, client, VERSION, text.as_bytes());
        assert!(
            matches!(outcome, Outcome::Pending(..)),
            "the robots are free"
        );
    }
    (simulator, now)
}

fn ask(
    simulator: &mut Simulator,
    now: Instant,
    client: ClientId,
    version: u32,
    text: &[u8],
) -> Outcome {
    simulator.control(now, client, version, text, &ServerStats::default())
}

/// Returns the public status of the worlds, with the holders of their robots.
fn status(simulator: &mut Simulator, now: Instant) -> Vec<WorldStatus> {
    match ask(simulator, now, VICTIM, VERSION, br#"{"op":"status"}"#) {
        Outcome::Answer(Reply::Status(status)) => status.worlds,
        _ => panic!("everybody may ask for the status"),
    }
}

/// Returns the snapshot of each world.
fn worlds(simulator: &Simulator) -> Vec<Vec<u8>> {
    let saved = |world| {
        let episode = simulator.episode(world).expect("ready");
        encode(&simulator.spec().settings, &[SnapshotWorld::Ready(episode)]).expect("small")
    };
    simulator.worlds().map(saved).collect()
}

/// Checks that an answer is complete and that a refusal is empty.
fn check_answer(reply: &StepReply, payload: &[u8]) -> Status {
    assert_eq!(reply.version, VERSION);
    let parts = split_step_payload(reply, payload).expect("as long as its header says");
    let status = Status::try_from(reply.status).expect("a known status");
    assert_eq!(parts.worlds.is_empty(), status != Status::Ok, "{status:?}");
    status
}

/// Replaces the placeholder in a text with the lease.
fn replaced(text: &[u8], lease: &str) -> Vec<u8> {
    let mut words = text.windows(LEASE.len());
    let Some(at) = words.position(|word| word == LEASE.as_bytes()) else {
        return text.to_vec();
    };
    [&text[..at], lease.as_bytes(), &text[at + LEASE.len()..]].concat()
}
