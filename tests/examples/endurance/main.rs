//! What long and rough use does to a server: agents and servers that are killed, observers that are
//! stopped, hours of coming and going.
//!
//! `cargo run --release -p tests --example endurance -- agents 1000 | teams 1000 | servers 200 | starts 2000 | observers 5 |
//! dashboard 5 64 | snapshots 9 | soak 3600 FOLDER`

#[expect(dead_code, reason = "the tests use all of it")]
#[path = "../../harness.rs"]
mod harness;
#[path = "../../kills.rs"]
mod kills;
#[path = "../../mirror.rs"]
mod mirror;

mod agents;
mod dashboard;
mod meter;
mod observers;
mod servers;
mod snapshots;
mod soak;
mod starts;
mod teams;

use std::io::Write;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    fn number<T: std::str::FromStr>(text: &str) -> T {
        text.parse()
            .unwrap_or_else(|_| panic!("expected a number, got {text:?}"))
    }
    match words[..] {
        ["agents", n] => agents::kill(number(n)),
        ["teams", n] => teams::disturb(number(n)),
        ["servers", n] => servers::kill(number(n)),
        ["starts", n] => starts::kill(number(n)),
        ["observers", n] => observers::compare(number(n)),
        ["dashboard", rounds, side] => dashboard::compare(number(rounds), number(side)),
        ["snapshots", n] => snapshots::compare(number(n)),
        ["observe", instance] => observers::observe(instance),
        ["soak", seconds, folder] => soak::soak(number(seconds), folder.as_ref()),
        _ => panic!(
            "expected agents N, teams N, servers N, starts N, observers ROUNDS, dashboard ROUNDS SIDE, snapshots ROUNDS or soak SECONDS FOLDER, got {words:?}"
        ),
    }
}

/// Median, least and greatest.
fn range(mut numbers: Vec<f64>, digits: usize) -> String {
    numbers.sort_by(f64::total_cmp);
    let (least, most) = (numbers[0], numbers[numbers.len() - 1]);
    let median = numbers[numbers.len() / 2];
    format!("{median:.digits$} ({least:.digits$}-{most:.digits$})")
}

/// Writes a line.
fn say(line: &str) {
    let mut out = std::io::stdout();
    let _ = writeln!(out, "{line}");
}

/// Median, 99th percentile and the largest, in milliseconds.
fn spread(mut seconds: Vec<f64>) -> String {
    seconds.sort_by(f64::total_cmp);
    let at = |q: f64| seconds[((seconds.len() as f64 * q) as usize).min(seconds.len() - 1)] * 1e3;
    format!(
        "p50 {:.2} p99 {:.2} max {:.2} ms",
        at(0.5),
        at(0.99),
        at(1.0)
    )
}
