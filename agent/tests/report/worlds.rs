//! Which runs can be compared, and what entries of the leaderboard may say.

use super::synthetic::run;
use emberwatch_agent::benchmark::report::PolicyRun;
use emberwatch_agent::benchmark::report::common_worlds::{CommonWorlds, check_added, check_fire};
use emberwatch_agent::benchmark::report::leaderboard::{About, Entry};
use emberwatch_agent::benchmark::report::suite::TaskRuns;

type Change<T> = fn(&mut T);

fn worlds() -> CommonWorlds {
    CommonWorlds {
        fingerprint: Some("884869f24f9fd933".into()),
        seeds: vec![0, 1, 2],
        steps: 4,
        moves: Some(64),
        robots: Some(1),
        recent_steps: Some(10),
    }
}

fn runs() -> Vec<PolicyRun> {
    (0..3).map(|seed| run("mine", "none", seed, 1.0)).collect()
}

fn check(worlds: &CommonWorlds, runs: &[PolicyRun]) -> Result<(), String> {
    let runs: Vec<&PolicyRun> = runs.iter().collect();
    let checked = worlds.check("mine", &runs);
    checked.map_err(|error| format!("{error:#}"))
}

#[test]
fn runs_of_other_worlds_are_refused_with_what_differs() {
    assert_eq!(check(&worlds(), &runs()), Ok(()));
    let changes: [(Change<Vec<PolicyRun>>, &str); 9] = [
        (|runs| runs[1].steps = 5, "steps: expected 4, got 5"),
        (|runs| runs[1].moves = 16, "moves: expected 64, got 16"),
        (|runs| runs[1].robots = 4, "robots: expected 1, got 4"),
        (
            |runs| runs[1].recent_steps = Some(25),
            "--recent-steps: expected 10, got 25",
        ),
        (
            |runs| runs[1].worlds_fingerprint = "0123456789abcdef".into(),
            "expected 884869f24f9fd933, got 0123456789abcdef",
        ),
        (
            |runs| runs[1].worlds_fingerprint.clear(),
            "expected 884869f24f9fd933, got none",
        ),
        (
            |runs| runs[1].policy_fingerprint.clear(),
            "policy_fingerprint: expected 0df41e66fd442aca, got ",
        ),
        (
            |runs| runs.truncate(2),
            "one row for each world, 3 from seed 0 to 2, got 2 from seed 0 to 1",
        ),
        (
            |runs| runs[1].world_seed = 2,
            "one row for each world, 3 from seed 0 to 2, got 3 from seed 0 to 2",
        ),
    ];
    for (change, words) in changes {
        let mut changed = runs();
        change(&mut changed);
        let refusal = check(&worlds(), &changed).expect_err(words);
        assert!(
            refusal.starts_with("policy \"mine\"") && refusal.contains(words),
            "{refusal}"
        );
    }
}

#[test]
fn added_runs_of_older_files_need_no_fingerprint_but_the_same_fire() {
    let mut old = runs();
    for run in &mut old {
        run.worlds_fingerprint.clear();
    }
    check_added(&old, &["coverage"], &worlds()).expect("all that the file has is equal");
    check_fire(&old, &runs()).expect("the same fire");
    old[2].mean_fire_cells += 1.0;
    let error = format!("{:#}", check_fire(&old, &runs()).expect_err("other fire"));
    assert!(error.contains("burning cells"), "{error}");
    old[2].worlds_fingerprint = "0123456789abcdef".into();
    let error = check_added(&old, &["coverage"], &worlds()).expect_err("rows of two files");
    assert!(error.to_string().contains("got none"), "{error}");
    let error = check_added(&runs(), &["mine"], &worlds()).expect_err("one name for two");
    assert!(error.to_string().contains("\"mine\""), "{error}");
}

#[test]
fn an_entry_has_nothing_but_plain_words_and_web_addresses() {
    let entry = |change: Change<Entry>| {
        let mut entry = Entry {
            about: About {
                policy: "mine".into(),
                by: "Zoë O'Neil & Søn (MIT), 北京".into(),
                code: "https://example.org/~zoe/mine?tag=v1#readme".into(),
                commit: "abcdef0".into(),
                training_seconds: 5.0,
            },
            tasks: vec![TaskRuns {
                task: "small".into(),
                runs: runs(),
            }],
        };
        change(&mut entry);
        entry.check().map_err(|error| format!("{error:#}"))
    };
    assert_eq!(entry(|_| ()), Ok(()));
    let wrong: [(Change<Entry>, &str); 15] = [
        (|it| it.about.policy = "<b>mine</b>".into(), "policy: "),
        (|it| it.about.policy = "../mine".into(), "policy: "),
        (|it| it.about.by = "<svg onload=alert(2)>".into(), "by: "),
        (|it| it.about.by = "![](//example.org/a.png)".into(), "by: "),
        (|it| it.about.by = "&#60;svg&#62;".into(), "by: "),
        (|it| it.about.by = "two | cells".into(), "by: "),
        (|it| it.about.by = "two\nlines".into(), "by: "),
        (|it| it.about.by.clear(), "by: "),
        (
            |it| it.about.code = "[here](javascript:alert(1))".into(),
            "code: ",
        ),
        (|it| it.about.code = "javascript:alert(1)".into(), "code: "),
        (|it| it.about.code = "`rm`".into(), "code: "),
        (|it| it.about.commit = "<i>abcdef0".into(), "commit: "),
        (|it| it.tasks[0].task = "<script>".into(), "task: "),
        (
            |it| it.tasks[0].runs[2].estimator = "<i>none".into(),
            "estimator: ",
        ),
        (|it| it.tasks[0].runs[1].team = "<i>".into(), "team: "),
    ];
    for (change, words) in wrong {
        let refusal = entry(change).expect_err(words);
        assert!(refusal.starts_with(words), "{refusal}");
    }
    let refusal = entry(|it| it.about.training_seconds = f64::NAN).expect_err("no number");
    assert!(refusal.starts_with("training_seconds: "), "{refusal}");
    let refusal = entry(|it| it.tasks[0].runs[1].brier = Some(f64::NAN)).expect_err("no number");
    assert!(refusal.starts_with("world 1: "), "{refusal}");
}
