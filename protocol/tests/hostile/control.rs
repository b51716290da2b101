//! The JSON of the control channel and of decisions.

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use proptest::sample::select;
use protocol::control::{
    CoverageRule, LeaseInfo, RecordedWorld, Reply, Request, ServerInfo, ServerStatus, WorldInfo,
    WorldSeed, WorldStatus,
};
use protocol::decisions::{self, Decision};
use protocol::message::Status;

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

    #[test]
    fn control_messages_survive_json(request in request(), reply in reply()) {
        let text = serde_json::to_vec(&request).expect("requests serialise");
        prop_assert_eq!(serde_json::from_slice::<Request>(&text).ok(), Some(request));
        let text = serde_json::to_vec(&reply).expect("replies serialise");
        prop_assert_eq!(serde_json::from_slice::<Reply>(&text).ok(), Some(reply));
    }

    #[test]
    fn decisions_survive_json(worlds in vec(decision(), 0..4)) {
        let reply = decisions::Reply::Decisions { worlds };
        let text = serde_json::to_string(&reply).expect("replies serialise");
        prop_assert_eq!(serde_json::from_str::<decisions::Reply>(&text).ok(), Some(reply));
    }
}

#[test]
fn nesting_as_deep_as_a_message_can_be_is_refused() {
    for (open, close) in [("[", "]"), (r#"{"a":"#, "}")] {
        let deep = open.repeat(200_000) + &close.repeat(200_000);
        let inside = format!(r#"{{"op":"reset","lease":1,"worlds":{deep}}}"#);
        for text in [deep, inside] {
            assert!(serde_json::from_str::<Request>(&text).is_err());
            assert!(serde_json::from_str::<Reply>(&text).is_err());
        }
    }
}

fn decision() -> impl Strategy<Value = Decision> {
    let numbers = (any::<[u64; 3]>(), any::<[u32; 5]>(), any::<[bool; 2]>());
    let others = (
        any::<Option<u64>>(),
        -1e9..1e9_f64,
        vec(0.0..=1.0_f32, 0..80),
    );
    (numbers, others).prop_map(
        |(
            ([step, seed, episode], counts, [terminated, truncated]),
            (objective, reward, summary),
        )| {
            Decision {
                step,
                reward,
                n_target_cells: counts[0],
                n_visited: counts[1],
                n_hits: counts[2],
                robot: [counts[3], counts[4]],
                terminated,
                truncated,
                seed,
                episode,
                objective,
                summary,
            }
        },
    )
}

fn request() -> impl Strategy<Value = Request> {
    let seed =
        (any::<u32>(), any::<Option<u64>>()).prop_map(|(world, seed)| WorldSeed { world, seed });
    prop_oneof![
        (any::<u32>(), ".*").prop_map(|(protocol, client)| Request::Hello { protocol, client }),
        (
            any::<u32>(),
            any::<u32>(),
            any::<bool>(),
            any::<Option<u64>>()
        )
            .prop_map(
                |(first_robot, n_robots, takeover, ttl_millis)| Request::Acquire {
                    first_robot,
                    n_robots,
                    takeover,
                    ttl_millis,
                }
            ),
        any::<u64>().prop_map(|lease| Request::Renew { lease }),
        any::<u64>().prop_map(|lease| Request::Release { lease }),
        (any::<u64>(), vec(seed, 0..4))
            .prop_map(|(lease, worlds)| Request::Reset { lease, worlds }),
        Just(Request::Status {}),
        Just(Request::Shutdown {}),
    ]
}

fn world() -> impl Strategy<Value = WorldInfo> {
    let robots = vec(any::<[u32; 2]>(), 0..4);
    (any::<u32>(), any::<[u64; 3]>(), robots).prop_map(|(world, [step, seed, episode], robots)| {
        WorldInfo {
            world,
            step,
            seed,
            episode,
            robots,
        }
    })
}

fn reply() -> impl Strategy<Value = Reply> {
    prop_oneof![
        server_info().prop_map(|info| Reply::Hello(Box::new(info))),
        (
            any::<[u64; 2]>(),
            vec(any::<u32>(), 0..4),
            vec(world(), 0..4)
        )
            .prop_map(|([lease, ttl_millis], robots, worlds)| {
                Reply::Lease(LeaseInfo {
                    lease,
                    ttl_millis,
                    robots,
                    worlds,
                })
            }),
        Just(Reply::Done),
        vec(world(), 0..4).prop_map(|worlds| Reply::Reset { worlds }),
        server_status().prop_map(Reply::Status),
        (select(Status::ALL.to_vec()), any::<u64>(), ".*").prop_map(|(status, detail, message)| {
            Reply::Error {
                status,
                detail,
                message,
            }
        }),
    ]
}

fn server_info() -> impl Strategy<Value = ServerInfo> {
    let rules = [CoverageRule::Path, CoverageRule::Full, CoverageRule::Client];
    let numbers = (any::<[u32; 4]>(), any::<[usize; 5]>(), any::<[u64; 4]>());
    let texts = (
        ".*",
        vec(".*", 0..4),
        any::<Option<String>>(),
        option::of(recorded_world()),
    );
    (numbers, texts, select(rules.to_vec()), any::<bool>()).prop_map(
        |(
            (small, sizes, long),
            (build, observations, model, recorded_world),
            coverage,
            publish_truth,
        )| {
            ServerInfo {
                protocol: small[0],
                build,
                pid: small[1],
                height: sizes[0],
                width: sizes[1],
                n_moves: sizes[2],
                n_worlds: small[2],
                n_robots: small[3],
                n_observations: sizes[3],
                observations,
                model,
                recorded_world,
                burn_in: long[0],
                max_steps: long[1],
                max_clients: sizes[4],
                coverage,
                publish_truth,
                lease_millis: long[2],
                deadline_millis: long[3],
            }
        },
    )
}

fn recorded_world() -> impl Strategy<Value = RecordedWorld> {
    any::<(Option<String>, usize, u64)>().prop_map(|(description, n_sequences, n_steps)| {
        RecordedWorld {
            description,
            n_sequences,
            n_steps,
        }
    })
}

fn server_status() -> impl Strategy<Value = ServerStatus> {
    let holders = vec(any::<Option<u32>>(), 0..4);
    let status = (world(), holders, any::<u32>(), any::<bool>()).prop_map(
        |(info, holder_pids, n_paths, resetting)| WorldStatus {
            info,
            holder_pids,
            n_paths,
            resetting,
        },
    );
    let numbers = (any::<u32>(), any::<[u64; 3]>(), any::<[usize; 2]>());
    (numbers, 0.0..1e12f64, vec(status, 0..4)).prop_map(
        |((pid, [uptime_millis, n_steps, n_refused], sizes), steps_per_second, worlds)| {
            ServerStatus {
                pid,
                uptime_millis,
                n_steps,
                steps_per_second,
                n_refused,
                n_clients: sizes[0],
                n_observers: sizes[1],
                worlds,
            }
        },
    )
}
