//! Every decoder.

use super::files;
use super::messages;
use super::requests;
use super::target::{Seed, Target};
use super::worlds;

/// All of them.
pub const TARGETS: [Target; 11] = [
    target("step_request", requests::step, requests::step_seeds),
    target("control_request", requests::control, Vec::new),
    target(
        "step_answer",
        messages::step_answer,
        messages::step_answer_seeds,
    ),
    target("frame", messages::frame, messages::frame_seeds),
    target("outlook", messages::outlook, messages::outlook_seeds),
    target("control_reply", messages::control_reply, Vec::new),
    target("model", files::model, Vec::new),
    target("checkpoint", files::checkpoint, files::checkpoint_seeds),
    target("states", worlds::states, worlds::states_seeds),
    target("snapshot", worlds::snapshot, worlds::snapshot_seeds),
    target("recording", worlds::recording, worlds::recording_seeds),
];

type Body = fn(&[u8]) -> bool;
type Seeds = fn() -> Vec<Seed>;

const fn target(name: &'static str, body: Body, seeds: Seeds) -> Target {
    Target { name, body, seeds }
}

/// The target of a name.
pub fn named(name: &str) -> Option<&'static Target> {
    TARGETS.iter().find(|target| target.name == name)
}

/// Decodes bytes as a target of a name does.
///
/// # Panics
/// If something is wrong with its decoder, or there is no such target.
pub fn decode(name: &str, bytes: &[u8]) -> bool {
    let target = named(name).expect("a target of this name");
    (target.body)(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_protocol::Model;
    use emberwatch_protocol::control::{Reply, Request, parse};
    use std::path::Path;

    #[test]
    fn the_corpus_holds_the_seeds_of_this_release() {
        for target in TARGETS {
            for (name, bytes) in (target.seeds)() {
                let path = target.folder().join(name);
                let kept = std::fs::read(&path).unwrap_or_default();
                assert!(
                    kept == bytes,
                    "{} is not what it was made of: run `cargo run -p tests --example corpus`",
                    path.display()
                );
            }
        }
    }

    #[test]
    fn the_texts_of_the_corpus_are_of_this_release() {
        let read = |path: &str| {
            let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus");
            std::fs::read_to_string(corpus.join(path)).expect(path)
        };
        let check = |folder: &str, names: &str, is_read: fn(&str) -> bool| {
            for name in names.split(' ') {
                let text = read(&format!("{folder}/{name}"));
                assert!(is_read(&text), "{folder}/{name}: {text}");
            }
        };
        check("control_reply", "hello land lease status error", |text| {
            parse::<Reply>(text.as_bytes()).is_ok()
        });
        let models = "burnout.toml land.toml line.toml sparse.toml wildfire.toml";
        check("model", models, |text| Model::from_toml(text).is_ok());
        let requests = "acquire belief fork hello leave_belief release renew reset reset_none \
                        restore shutdown snapshot status takeover";
        check("control_request", requests, |text| {
            // Behind the byte that says what happened before.
            parse::<Request>(text[1..].replace("LEASE", "1").as_bytes()).is_ok()
        });
    }

    #[test]
    fn every_target_has_a_program_and_every_program_a_target() {
        let programs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/fuzz_targets");
        for target in TARGETS {
            let program = std::fs::read_to_string(programs.join(format!("{}.rs", target.name)));
            let program = program.expect("a program of libFuzzer");
            assert!(program.contains(&format!("{:?}", target.name)), "{program}");
        }
        let n_programs = std::fs::read_dir(programs).expect("the programs").count();
        assert_eq!(n_programs, TARGETS.len());
    }
}
