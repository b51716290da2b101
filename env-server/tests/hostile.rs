//! A million requests of random numbers and bytes, without processes: no panic, refusals change
//! nothing, and a world that nobody else may touch goes its way bit for bit.

use env_server::config::{Checked, ServerConfig};
use env_server::lease::ClientId;
use env_server::simulator::{Awaited, Outcome, ResetOrder, Simulator, Surroundings};
use protocol::control::Reply;
use protocol::message::{Operation, RESULT_BYTES, Status, StepReply, StepRequest, VERSION};
use rand::RngExt;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rayon::ThreadPoolBuilder;
use std::time::{Duration, Instant};

/// Cells of the grid.
const N_CELLS: usize = 2 * 3;

/// Moves of a path.
const N_MOVES: usize = 4;

/// Worlds; the last is the victim's.
const N_WORLDS: u32 = 4;

/// The one client whose world must not notice anything.
const VICTIM: ClientId = ClientId { node: 1, pid: 1 };

/// One of the others.
const ATTACKER: ClientId = ClientId { node: 2, pid: 2 };

/// Numbers that are wrong in most places and right in some.
const NUMBERS: [u32; 9] = [0, 1, 2, 3, 4, 5, 1024, u32::MAX - 1, u32::MAX];

/// Control requests, with L for a lease, W for a world and B for anything.
const TEMPLATES: [&str; 7] = [
    r#"{"op":"hello","protocol":1,"client":"B"}"#,
    r#"{"op":"acquire","first_world":W,"n_worlds":W,"ttl_millis":W}"#,
    r#"{"op":"acquire","first_world":W,"n_worlds":1}"#,
    r#"{"op":"renew","lease":L}"#,
    r#"{"op":"release","lease":L}"#,
    r#"{"op":"reset","lease":L,"worlds":[{"world":W,"seed":W},{"world":W}]}"#,
    r#"{"op":"status"}"#,
];

fn simulator() -> Simulator {
    let config = ServerConfig {
        worlds: N_WORLDS,
        height: 2,
        width: 3,
        moves: N_MOVES,
        burn_in: 0,
        max_steps: 2_000,
        ..ServerConfig::default()
    };
    let checked: Checked = config.check().expect("valid settings");
    let threads = ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .expect("a thread");
    let mut token = 10;
    let next_token = Box::new(move || {
        token += 1;
        token
    });
    let (mut simulator, orders) = Simulator::new(checked, threads, next_token).expect("valid");
    carry_out(&mut simulator, orders);
    simulator
}

fn carry_out(simulator: &mut Simulator, orders: Vec<ResetOrder>) {
    for order in orders {
        let (world, episode) = order.carry_out(simulator.rules());
        simulator.finish_reset(world, episode);
    }
}

/// The simulator, its clock, and the requests that wait.
struct Siege {
    simulator: Simulator,
    rng: ChaCha8Rng,
    now: Instant,
    orders: Vec<ResetOrder>,
    awaited: Vec<(ClientId, Awaited)>,
    payload: Vec<u8>,
    n_refused: u64,
    /// Who got a lease on each world last, and which.
    holders: [(ClientId, u64); N_WORLDS as usize],
}

impl Siege {
    fn attacker(&mut self) -> ClientId {
        let pid = self.rng.random_range(2..4);
        ClientId {
            node: pid.into(),
            pid,
        }
    }

    fn number(&mut self, right: u32) -> u32 {
        match self.rng.random_range(0..12) {
            0 => *NUMBERS.choose(&mut self.rng).expect("numbers"),
            1 => self.rng.random(),
            _ => right,
        }
    }

    fn lease(&mut self) -> u64 {
        let (_, token) = *self.holders.choose(&mut self.rng).expect("holders");
        *[token, token, token, 0, u64::MAX]
            .choose(&mut self.rng)
            .expect("leases")
    }

    fn bytes(&mut self, most: usize) -> Vec<u8> {
        let mut bytes = vec![0; self.rng.random_range(0..most)];
        self.rng.fill_bytes(&mut bytes);
        bytes
    }

    fn step(&mut self) {
        let first_world = self.rng.random_range(0..N_WORLDS - 1);
        let (client, lease) = match self.rng.random() {
            true => self.holders[first_world as usize],
            false => (self.attacker(), self.lease()),
        };
        let request = StepRequest {
            version: self.number(VERSION),
            operation: self.number(1),
            lease,
            sequence: self.rng.random(),
            first_world: self.number(first_world),
            n_worlds: self.number(1),
            n_moves: self.number(N_MOVES as u32),
            flags: self.number(0),
            ..StepRequest::default()
        };
        let paths = match self.rng.random_range(0..8) {
            0 => self.bytes(40),
            _ => vec![self.rng.random_range(0..4); N_MOVES],
        };
        let before = self.simulator.n_steps();
        let reply = self
            .simulator
            .step(self.now, client, &request, &paths, &mut self.payload);
        let is_refused = self.check(&request, &reply);
        assert!(!is_refused || self.simulator.n_steps() == before);
        self.n_refused += u64::from(is_refused);
    }

    fn check(&self, request: &StepRequest, reply: &StepReply) -> bool {
        let status = Status::try_from(reply.status).expect("a known status");
        let n_worlds = reply.n_worlds as usize;
        assert_eq!(reply.sequence, request.sequence);
        assert_eq!(self.payload.len(), n_worlds * (RESULT_BYTES + N_CELLS));
        assert_eq!(status == Status::Ok, n_worlds > 0);
        status != Status::Ok
    }

    fn control(&mut self) {
        let (text, client, version) = (self.text(), self.attacker(), self.number(VERSION));
        let surroundings = Surroundings::default();
        let outcome = self
            .simulator
            .control(self.now, client, version, &text, &surroundings);
        match outcome {
            Outcome::Later(orders, awaited) => {
                self.orders.extend(orders);
                self.awaited.push((client, awaited));
            }
            Outcome::Answer(Reply::Error { .. }) => self.n_refused += 1,
            Outcome::Answer(_) | Outcome::Changed(..) => {}
            Outcome::Shutdown | Outcome::File(..) => panic!("nobody asked for that"),
        }
    }

    fn text(&mut self) -> Vec<u8> {
        if self.rng.random_ratio(1, 8) {
            return self.bytes(60);
        }
        let template = *TEMPLATES.choose(&mut self.rng).expect("templates");
        let mut text = Vec::new();
        for byte in template.bytes() {
            match byte {
                b'L' => text.extend(self.lease().to_string().bytes()),
                b'W' => {
                    let world = self.rng.random_range(0..N_WORLDS);
                    text.extend(self.number(world).to_string().bytes());
                }
                b'B' => text.extend(self.bytes(9)),
                other => text.push(other),
            }
        }
        if self.rng.random_ratio(1, 8) {
            let at = self.rng.random_range(0..text.len());
            text[at] = self.rng.random();
        }
        text
    }

    /// What the loop of a server does between requests, sooner or later.
    fn look_around(&mut self) {
        self.now += Duration::from_millis(self.rng.random_range(0..30));
        match self.rng.random_range(0..20) {
            0..10 => carry_out(&mut self.simulator, std::mem::take(&mut self.orders)),
            10..12 => drop(self.simulator.expire(self.now)),
            12 => drop(self.simulator.end_of_process(self.rng.random_range(2..4))),
            _ => {}
        }
        for (client, awaited) in std::mem::take(&mut self.awaited) {
            match self.simulator.answer_awaited(self.now, &awaited) {
                Some(Reply::Lease(lease)) => {
                    for world in &lease.worlds {
                        self.holders[world.world as usize] = (client, lease.lease);
                    }
                }
                Some(_) => {}
                None if self.rng.random_ratio(1, 4) => {
                    self.simulator.forget_awaited(self.now, &awaited);
                }
                None => self.awaited.push((client, awaited)),
            }
        }
    }
}

/// The victim's steps on a simulator, given its lease; `reset` when its episode is over.
struct Victim {
    lease: u64,
    paths: ChaCha8Rng,
}

impl Victim {
    fn move_in(simulator: &mut Simulator, now: Instant) -> Self {
        let text = br#"{"op":"acquire","first_world":3,"n_worlds":1,"ttl_millis":86400000}"#;
        let lease = match ask(simulator, now, text) {
            Some(Reply::Lease(lease)) => lease.lease,
            other => panic!("expected a lease, got {other:?}"),
        };
        let paths = ChaCha8Rng::seed_from_u64(0);
        Self { lease, paths }
    }

    fn step(&mut self, simulator: &mut Simulator, now: Instant) -> Vec<u8> {
        if simulator
            .episode(3)
            .is_some_and(env_server::episode::Episode::is_over)
        {
            let reset = r#"{"op":"reset","lease":L,"worlds":[{"world":3}]}"#;
            let text = reset.replace('L', &self.lease.to_string());
            assert!(matches!(
                ask(simulator, now, text.as_bytes()),
                Some(Reply::Reset { .. })
            ));
        }
        let request = StepRequest {
            version: VERSION,
            operation: Operation::Step as u32,
            lease: self.lease,
            first_world: 3,
            n_worlds: 1,
            n_moves: N_MOVES as u32,
            ..StepRequest::default()
        };
        let path: Vec<u8> = (0..N_MOVES)
            .map(|_| self.paths.random_range(0..4))
            .collect();
        let mut payload = Vec::new();
        let reply = simulator.step(now, VICTIM, &request, &path, &mut payload);
        assert_eq!(Status::try_from(reply.status), Ok(Status::Ok));
        payload
    }
}

/// The victim asks, and its resets are done at once.
fn ask(simulator: &mut Simulator, now: Instant, text: &[u8]) -> Option<Reply> {
    match simulator.control(now, VICTIM, VERSION, text, &Surroundings::default()) {
        Outcome::Later(orders, awaited) => {
            carry_out(simulator, orders);
            simulator.answer_awaited(now, &awaited)
        }
        Outcome::Answer(reply) | Outcome::Changed(_, reply) => Some(reply),
        Outcome::Shutdown | Outcome::File(..) => None,
    }
}

#[test]
fn a_million_random_requests_change_nothing_for_others() {
    let now = Instant::now();
    let (mut disturbed, mut quiet) = (simulator(), simulator());
    let mut victim = Victim::move_in(&mut disturbed, now);
    let mut twin = Victim::move_in(&mut quiet, now);
    let mut siege = Siege {
        simulator: disturbed,
        rng: ChaCha8Rng::seed_from_u64(7),
        now,
        orders: Vec::new(),
        awaited: Vec::new(),
        payload: Vec::new(),
        n_refused: 0,
        // The victim's token is the first that is tried, by others.
        holders: [(ATTACKER, victim.lease); N_WORLDS as usize],
    };
    for round in 0..1_000_000u32 {
        match round % 8 {
            0..5 => siege.step(),
            5..7 => siege.control(),
            _ => siege.look_around(),
        }
        if round % 100 == 0 {
            let seen = victim.step(&mut siege.simulator, siege.now);
            assert_eq!(seen, twin.step(&mut quiet, now), "round {round}");
        }
    }
    let n_accepted = siege.simulator.n_steps() - 10_000;
    assert!(
        n_accepted > 20_000,
        "{n_accepted} steps of attackers: they never got in"
    );
    assert!(
        siege.n_refused > 200_000,
        "{} refused: too tame",
        siege.n_refused
    );
}
