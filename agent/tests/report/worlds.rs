//! Tests of the checks that runs are comparable, and that leaderboard entries contain only plain text.

use super::synthetic::run;
use emberwatch_agent::benchmark::report::PolicyRun;
use emberwatch_agent::benchmark::report::common_worlds::{World, check_worlds};
use emberwatch_agent::benchmark::report::leaderboard::{About, Entry};
use emberwatch_agent::benchmark::report::suite::TaskRuns;
use serde::Serialize;
use serde::de::DeserializeOwned;

/// Returns a copy of a value with the fields that a line of TOML sets.
fn changed<T: Serialize + DeserializeOwned>(value: &T, line: &str) -> T {
    let mut table = toml::Table::try_from(value).expect("a table");
    table.extend(line.parse::<toml::Table>().expect("TOML"));
    table.try_into().expect("of the same type")
}

fn runs() -> Vec<PolicyRun> {
    (0..3).map(|seed| run("mine", "none", seed, 1.0)).collect()
}

#[test]
fn a_policy_has_one_run_for_each_world() {
    let runs = runs();
    let worlds: Vec<World> = runs.iter().map(World::of).collect();
    let check = |runs: &[&PolicyRun]| {
        let checked = check_worlds("mine", runs, &worlds);
        checked.map_err(|error| error.to_string())
    };
    let [first, second, third] = [&runs[0], &runs[1], &runs[2]];
    assert_eq!(check(&[third, first, second]), Ok(()));
    for (runs, words) in [
        (vec![first, second], "each of 3 worlds, got 2 rows"),
        (
            vec![first, second, second, third],
            "expected a row for world 2, got one for world 1",
        ),
        (
            vec![first, &changed(second, "steps = 5"), third],
            "got world 1 for 5 steps",
        ),
        (
            vec![&changed(first, "worlds_fingerprint = ''")],
            "worlds_fingerprint \"\"",
        ),
    ] {
        let refusal = check(&runs).expect_err(words);
        assert!(refusal.contains(words), "{refusal}");
    }
}

#[test]
fn an_entry_has_nothing_but_plain_words_and_web_addresses() {
    let about = About {
        policy: "mine".into(),
        by: "Zoë O'Neil & Søn (MIT), 北京".into(),
        code: "https://example.org/~zoe/mine?tag=v1#readme".into(),
        commit: "abcdef0".into(),
        training_seconds: 5.0,
    };
    let check = |about: &About, task: &str, run: PolicyRun| {
        let mut runs = runs();
        runs[1] = run;
        let entry = Entry {
            about: about.clone(),
            tasks: vec![TaskRuns {
                task: task.into(),
                runs,
            }],
        };
        entry.check().map_err(|error| format!("{error:#}"))
    };
    let run = runs().swap_remove(1);
    assert_eq!(check(&about, "small", run.clone()), Ok(()));
    for change in [
        "policy = '<b>mine</b>'",
        "policy = '../mine'",
        "by = '<svg onload=alert(2)>'",
        "by = '![](//example.org/a.png)'",
        "by = '&#60;svg&#62;'",
        "by = 'two | cells'",
        "by = \"two\\nlines\"",
        "by = ''",
        "code = '[here](javascript:alert(1))'",
        "code = 'javascript:alert(1)'",
        "code = '`rm`'",
        "commit = '<i>abcdef0'",
        "training_seconds = nan",
        "estimator = '<i>none'",
        "team = '<i>'",
        "brier = nan",
    ] {
        let name = change.split(' ').next().expect("a name");
        let refusal = match name {
            "estimator" | "team" | "brier" => check(&about, "small", changed(&run, change)),
            _ => check(&changed(&about, change), "small", run.clone()),
        };
        let refusal = refusal.expect_err(change);
        let name = if name == "brier" { "world 1" } else { name };
        assert!(refusal.starts_with(&format!("{name}: ")), "{refusal}");
    }
    let refusal = check(&about, "<script>", run).expect_err("no name");
    assert!(refusal.starts_with("task: "), "{refusal}");
}
