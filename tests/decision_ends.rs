//! How agents that serve decisions begin, keep their world and end; and learners that are killed.

use emberwatch_agent::acting::decider::{Assignment, Decider};
use emberwatch_agent::acting::mission::prepare;
use emberwatch_agent::client::errors;
use emberwatch_agent::config::AgentConfig;
use emberwatch_agent::learning::learned::Learned;
use emberwatch_agent::policy::EstimatorKind;
use emberwatch_protocol::Client;
use emberwatch_protocol::channels::{ChannelError, Instance};
use emberwatch_protocol::client::Claim;
use emberwatch_protocol::decisions::{Reply, Request};
use emberwatch_protocol::message::Status;
use rustix::process::Signal;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use tests::harness::{PATIENCE, Program, SMALL, Server, eventually, new_instance, takeover};
use tests::learner::{
    Learner, decide, refusal, reply_to, start_agent, start_at, start_with_learner,
};
use tests::wire::control_header;

/// Names the instance to the child of a test.
const CHILD: &str = "EMBERWATCH_TEST_CHILD";

#[test]
fn a_second_agent_is_refused_whatever_it_asks_for() {
    let server = Server::start(SMALL);
    let (agent, learner) = start_with_learner(&server.instance, "");
    let words = format!("served already, by pid {}", agent.pid());
    for flags in ["", "--takeover"] {
        let second = start_agent(&server.instance, flags).ends(1);
        second.check_says(&words);
    }
    learner.decide(2);
    agent.kill();
    let (_agent, next) = start_with_learner(&server.instance, "");
    assert_eq!(next.last().step, 1, "where the first was killed");
    assert_eq!(next.decide(2).step, 2);
}

#[test]
fn an_agent_renews_its_lease_when_a_third_of_it_has_passed_without_use() {
    let lease = Duration::from_secs(3600);
    let server = Server::start(&format!("{SMALL} --lease-millis {}", lease.as_millis()));
    let (mut decider, begun) = (attach(&server), Instant::now());
    decider.keep_alive(begun + lease / 3).expect("renewed");
    let due = begun + 2 * (lease / 3);
    let almost = due - Duration::from_millis(1);
    assert!(!decider.until_renewal(almost).is_zero());
    assert!(decider.until_renewal(due).is_zero());
    let _thief = server.take_over(0..1);
    decider.keep_alive(almost).expect("nothing is asked");
    let lost = decider.keep_alive(due).expect_err("the lease is lost");
    let status = errors::refusal(&lost).map(|(status, ..)| status);
    assert_eq!(status, Some(Status::LeaseLost), "{lost:?}");
}

/// What decides for world 0 in an agent, without what serves it.
fn attach(server: &Server) -> Decider {
    let task = Assignment {
        instance: server.instance.clone(),
        worlds: 0..1,
        takeover: false,
        estimator: EstimatorKind::KNOWN,
        config: AgentConfig::default(),
        learned: Learned::default(),
    };
    let (info, model) = prepare(&task.instance, &task.worlds, None, true).expect("a server");
    let shape = info.shape().expect("a grid");
    let prior = task.config.prior(info.burn_in).belief(&model, shape, 0);
    Decider::attach(&task, model, prior.expect("a belief")).expect("attach")
}

#[test]
fn an_agent_that_waits_for_a_server_ends_with_the_process_it_watches() {
    let mut watched = Command::new("sleep").arg("600").spawn().expect("sleep");
    let flags = format!("--wait 600 --exit-with {}", watched.id());
    let agent = start_agent(&new_instance(), &flags);
    agent.wait_for_words("waiting for it");
    watched.kill().expect("kill it");
    watched.wait().expect("its end");
    agent.ends(0);
}

#[test]
fn an_agent_that_is_told_to_end_releases_its_world_first() {
    let server = Server::start(SMALL);
    let (agent, learner) = start_with_learner(&server.instance, "");
    assert_eq!(learner.ask(&Request::Shutdown {}), Reply::Done);
    assert_eq!(server.holder(), None);
    drop(learner);
    agent.ends(0);
    for signal in [Signal::TERM, Signal::INT] {
        let (agent, _learner) = start_with_learner(&server.instance, "");
        agent.signal(signal);
        agent.ends(0);
        assert_eq!(server.holder(), None);
    }
    let error = Learner::try_open(&server.instance).err();
    assert!(
        matches!(error, Some(ChannelError::NoAgent { world: 0, .. })),
        "{error:?}"
    );
}

#[test]
fn an_agent_ends_with_the_process_that_it_was_started_for() {
    let server = Server::start(SMALL);
    let keeper = Command::new("sleep").arg("60").spawn();
    let mut keeper = keeper.expect("start a keeper");
    let (agent, _learner) =
        start_with_learner(&server.instance, &format!("--exit-with {}", keeper.id()));
    keeper.kill().expect("kill the keeper");
    keeper.wait().expect("wait for the keeper");
    agent.ends(0);
    assert_eq!(server.holder(), None);
}

#[test]
fn an_agent_whose_server_is_killed_says_so_and_ends() {
    for decides in [false, true] {
        let server = Server::start(SMALL);
        let (agent, learner) = start_with_learner(&server.instance, "");
        learner.reset(3);
        if decides {
            server.program.signal(Signal::STOP);
            let header = control_header(1);
            let pending = learner.send(header, br#"{"op":"decide","objectives":[2]}"#);
            server.kill();
            let (status, _, message) = refusal(reply_to(&pending, header));
            assert_eq!(status, Status::AgentEnds);
            assert!(
                message.starts_with("the agent ends: the server"),
                "{message}"
            );
        } else {
            server.kill();
        }
        drop(learner);
        agent.ends(1).check_says("is gone");
    }
}

#[test]
fn an_agent_whose_world_is_taken_says_so_and_ends_with_code_3() {
    let theft = Claim {
        time_to_live: Some(Duration::from_secs(3600)),
        ..takeover(0..1)
    };
    // One that is not asked notices when it renews its lease.
    for (decides, lease) in [(true, 86_400_000), (false, 3_000)] {
        let server = Server::start(&format!("{SMALL} --lease-millis {lease}"));
        let (agent, learner) = start_with_learner(&server.instance, "--takeover");
        let before = server.observe(0).0;
        let _thief = Client::acquire(server.connect(), &theft).expect("take over");
        if decides {
            let (status, detail, _) = learner.refused(&decide(&[Some(2)]));
            assert_eq!(status, Status::LeaseLost);
            assert_eq!(detail, u64::from(std::process::id()));
        }
        drop(learner);
        agent.ends(3).check_says("lease lost");
        assert_eq!(server.observe(0).0, before, "it stepped nothing");
    }
}

#[test]
fn a_world_goes_from_agent_to_agent_in_the_middle_of_an_episode() {
    let server = Server::start(SMALL);
    let first = Program::agent(&server.instance, "--policy random_walk");
    first.until(|| server.step_of(0) > 3);
    let refused = start_agent(&server.instance, "").ends(1);
    let words = format!("busy: held by pid {}", first.pid());
    refused.check_says(&words);
    let (_agent, learner) = start_with_learner(&server.instance, "--takeover");
    first.ends(3);
    let (result, ..) = server.observe(0);
    let last = learner.last();
    assert_eq!((last.step, last.reward), (result.step, result.reward));
    assert_eq!(last.objective, None);
    assert_eq!(learner.decide(3).step, result.step + 1);
}

#[test]
fn each_world_goes_on_from_what_is_known_about_it() {
    let flags = "--height 16 --width 16 --moves 12 --burn-in 3000 --seed 3 --worlds 4 --history 99";
    let (server, other) = (Server::start(flags), Server::start(flags));
    let (_undisturbed, expected) = start_at(&other.instance, 1, "--worlds 3");
    let objectives = [Some(2), Some(3), Some(0)];
    for known in ["", "the belief that was left", "the frames that were kept"] {
        let (agent, learner) = start_at(&server.instance, 1, "--worlds 3");
        let decisions = learner.decide_all(&objectives);
        assert_eq!(decisions, expected.decide_all(&objectives));
        let words = agent.stderr();
        assert!(
            known.is_empty() || words.matches(known).count() == 3,
            "{words}"
        );
        if known.is_empty() {
            assert_eq!(learner.ask(&Request::Shutdown {}), Reply::Done);
            drop(learner);
            agent.ends(0);
        } else {
            agent.kill();
        }
    }
}

#[test]
fn killed_learners_disturb_nobody_and_use_up_no_limit() {
    let server = Server::start(SMALL);
    let (agent, learner) = start_with_learner(&server.instance, "");
    for _ in 0..20 {
        let before = learner.last().step;
        let mut child = start_child(&server.instance);
        let decides = eventually(PATIENCE, || learner.last().step > before + 2);
        child.kill().expect("kill the learner");
        child.wait().expect("wait for it");
        assert!(decides, "{}", agent.stderr());
    }
    agent.until(|| Learner::try_open(&server.instance).is_ok());
    let before = learner.last().step;
    assert_eq!(learner.decide(2).step, before + 1);
}

/// This program again, as a learner that decides without end.
fn start_child(instance: &Instance) -> std::process::Child {
    let mut command = Command::new(std::env::current_exe().expect("this program"));
    let test = "decision_ends::a_learner_to_be_killed";
    command.args(["--exact", test, "--ignored"]);
    command.env(CHILD, instance.name()).stdout(Stdio::null());
    command.spawn().expect("start a learner")
}

#[test]
#[ignore = "the child of another test"]
fn a_learner_to_be_killed() {
    let Ok(name) = std::env::var(CHILD) else {
        return;
    };
    let instance = Instance::new(&name).expect("a plain name");
    let mut learner = None;
    eventually(PATIENCE, || {
        learner = Learner::try_open(&instance).ok();
        learner.is_some()
    });
    let learner = learner.expect("connected");
    loop {
        learner.decide(2);
    }
}
