//! Tests of the checks that runs are comparable, and that leaderboard entries contain only plain text.

use super::synthetic::run;
use emberwatch_agent::benchmark::report::PolicyRun;
use emberwatch_agent::benchmark::report::common_worlds::{check_worlds, worlds};
use emberwatch_agent::benchmark::report::leaderboard::Entry;

#[test]
fn a_policy_has_one_run_for_each_world() {
    let runs = [0, 1, 2].map(|seed| run("mine", "none", seed, 1.0));
    let expected = worlds(&runs);
    let check = |runs: Vec<&PolicyRun>| {
        check_worlds("mine", runs, &expected).map_err(|error| error.to_string())
    };
    let [first, second, third] = &runs;
    assert_eq!(check(vec![third, first, second]), Ok(()));
    let [mut longer, mut elsewhere] = [second.clone(), first.clone()];
    longer.steps = 5;
    elsewhere.worlds_fingerprint.clear();
    for (runs, words) in [
        (vec![first, second], "each of 3 worlds, got 2 rows"),
        (
            vec![first, second, second, third],
            "expected world 2 for 4 steps, worlds_fingerprint \"884869f24f9fd933\", got world 1 for 4 steps",
        ),
        (vec![first, &longer, third], "got world 1 for 5 steps"),
        (vec![&elsewhere], "worlds_fingerprint \"\""),
    ] {
        let refusal = check(runs).expect_err(words);
        assert!(refusal.contains(words), "{refusal}");
    }
}

const HEADER: &str = "policy,by,code,commit,training_seconds,estimator,task,world_seed,steps,robots,team,mean_reward,\
                      brier,log_likelihood,worlds_fingerprint";

#[test]
fn an_entry_has_nothing_but_plain_words_and_web_addresses() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("mine.csv");
    let row = "\"mine\",\"Zoë O'Neil & Søn (MIT), 北京\",\"https://example.org/~zoe/mine?tag=v1#readme\",\"abcdef0\",\
               \"5\",\"none\",\"small\",1,40,1,\"alone\",1.5,\"0.25\",,ab";
    let read = |row: &str| {
        let written = std::fs::write(&path, format!("{HEADER}\n{row}\n"));
        written.expect("written");
        Entry::read(&path).map_err(|error| format!("{error:#}"))
    };
    let entry = read(row).expect("plain");
    let path_of_copy = folder.path().join("copy.csv");
    entry.write(&path_of_copy).expect("written");
    let copy = Entry::read(&path_of_copy).expect("an entry");
    assert_eq!((copy.about, copy.runs), (entry.about, entry.runs));
    let fields: Vec<&str> = row.split('"').collect();
    for line in "\
policy <b>mine</b>
policy ../mine
by <svg onload=alert(2)>
by ![](//example.org/a.png)
by &#60;svg&#62;
by two | cells
by two\rlines
by
code [here](javascript:alert(1))
code javascript:alert(1)
code `rm`
commit <i>abcdef0
training_seconds nan
estimator <i>none
task <script>
team <i>
brier nan"
        .split('\n')
    {
        let (name, text) = line.split_once(' ').unwrap_or((line, ""));
        // Numbers have no quotes.
        let numbers = ["world_seed", "steps", "robots", "mean_reward"];
        let mut columns = HEADER.split(',').filter(|name| !numbers.contains(name));
        let index = columns.position(|column| column == name).expect("a column");
        let mut fields = fields.clone();
        fields[1 + 2 * index] = text;
        let refusal = read(&fields.join("\"")).expect_err(line);
        let name = if name == "brier" { "world 1" } else { name };
        assert!(refusal.starts_with(&format!("{name}: ")), "{refusal}");
    }
}
