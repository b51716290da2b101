//! Time of a decision from a learner outside to the agent, through the server and back:
//! `cargo bench -p tests --bench decide`; arguments after `--` go to the agent.
//!
//! Prints median and tail over the decisions of one episode on the default grid.

use iceoryx2::node::Node;
use iceoryx2::port::client::Client;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::AllocationStrategy;
use protocol::channels::{Channel, ChannelError, Instance, Ipc, Services, create_node};
use protocol::control::WorldSeed;
use protocol::decisions::{Reply, Request};
use protocol::message::{ControlReply, ControlRequest, VERSION};
use protocol::wait::{Waiter, descriptor, drain, sleep_until_readable};
use std::process::{Child, Command};
use std::time::{Duration, Instant};

const TIMEOUT: Duration = Duration::from_secs(60);
const N_DECISIONS: usize = 1000;

/// A child process that is killed when it goes out of scope.
struct Running(Child);

impl Running {
    fn start(name: &str, arguments: &[&str]) -> Self {
        let program = std::env::current_exe().expect("this program has a path");
        let directory = program
            .ancestors()
            .nth(2)
            .expect("target/release/deps/decide");
        let child = Command::new(directory.join(name))
            .args(arguments)
            .env("RUST_LOG", "warn")
            .spawn();
        Self(child.unwrap_or_else(|error| panic!("start {name}: {error}")))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A learner that waits as PROTOCOL.md says.
struct Learner {
    port: Client<Ipc, [u8], ControlRequest, [u8], ControlReply>,
    agent: Notifier<Ipc>,
    listener: Listener<Ipc>,
    waiter: Waiter,
    _node: Node<Ipc>,
}

impl Learner {
    fn open(instance: &Instance) -> Result<Self, ChannelError> {
        let node = create_node()?;
        let services = Services {
            node: &node,
            instance,
        };
        let service = services.open_decisions(0)?;
        let port = service.client_builder().initial_max_slice_len(4096);
        let port = port.allocation_strategy(AllocationStrategy::PowerOfTwo);
        let agent = services.wake(Channel::WakeAgent(0))?;
        Ok(Self {
            port: port.create().expect("a client"),
            agent: agent.notifier_builder().create().expect("a notifier"),
            listener: services.listener(Channel::WakeClient)?,
            waiter: Waiter::default(),
            _node: node,
        })
    }

    fn ask(&self, request: &Request) -> Reply {
        let text = serde_json::to_vec(request).expect("requests serialise");
        let id = self.listener.id().value();
        let mut loan = self.port.loan_slice_uninit(text.len()).expect("a loan");
        *loan.user_header_mut() = ControlRequest {
            version: VERSION,
            listener_low: id as u64,
            listener_high: (id >> 64) as u64,
            ..ControlRequest::default()
        };
        let pending = loan.write_from_slice(&text).send().expect("send");
        self.agent.notify().expect("wake the agent");
        let poll = || {
            let response = pending.receive().expect("receive");
            Ok(response.map(|response| response.payload().to_vec()))
        };
        let block = |limit| {
            if !drain(&self.listener)? {
                sleep_until_readable(&[descriptor(&self.listener)], limit).expect("sleep");
            }
            Ok::<_, ChannelError>(())
        };
        let answer = self.waiter.wait(TIMEOUT, poll, block).expect("wait");
        serde_json::from_slice(&answer.expect("an answer in time")).expect("a reply")
    }

    /// Microseconds of one decision.
    fn decide(&self, objective: u64) -> f64 {
        let start = Instant::now();
        let objectives = vec![Some(objective)];
        let reply = self.ask(&Request::Decide { objectives });
        let micros = start.elapsed().as_secs_f64() * 1e6;
        assert!(matches!(reply, Reply::Decisions { .. }), "{reply:?}");
        micros
    }
}

fn main() {
    let name = format!("bench-decide-{}", std::process::id());
    let _server = Running::start("emberwatch-server", &["--instance", &name]);
    let instance = Instance::new(&name).expect("a plain name");
    eventually(|| protocol::Connection::open(&instance, "decide", TIMEOUT).ok());
    // cargo adds `--bench` on its own.
    let more = std::env::args()
        .skip(1)
        .filter(|argument| argument != "--bench");
    let more: Vec<String> = more.collect();
    let mut arguments = vec!["serve-decisions", "--instance", &name];
    arguments.extend(more.iter().map(String::as_str));
    let _agent = Running::start("emberwatch-agent", &arguments);
    let learner = eventually(|| Learner::open(&instance).ok());
    let (world, seed) = (0, Some(1));
    let worlds = vec![WorldSeed { world, seed }];
    learner.ask(&Request::Reset { worlds });
    (0..N_DECISIONS / 10).for_each(|_| _ = learner.decide(2));
    for (objective, what) in [(2, "a state"), (3, "entropy")] {
        let mut times: Vec<f64> = (0..N_DECISIONS)
            .map(|_| learner.decide(objective))
            .collect();
        times.sort_unstable_by(f64::total_cmp);
        let quantile = |q: f64| times[(N_DECISIONS as f64 * q) as usize];
        say(&format!(
            "a decision for {what:<8} p50 {:7.1} p99 {:7.1} us",
            quantile(0.5),
            quantile(0.99)
        ));
    }
}

fn eventually<T>(mut attempt: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + TIMEOUT;
    loop {
        if let Some(done) = attempt() {
            return done;
        }
        assert!(Instant::now() < deadline, "nothing after {TIMEOUT:?}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[expect(clippy::print_stdout, reason = "a benchmark's output")]
fn say(line: &str) {
    println!("{line}");
}
