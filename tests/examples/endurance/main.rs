//! What long and rough use does to a server: agents and servers that are killed, observers that are
//! stopped, hours of coming and going.
//!
//! `cargo run --release -p tests --example endurance -- agents 1000 | teams 1000 | servers 200 | starts 2000 | observers 5 |
//! dashboard 5 64 | snapshots 9 | soak 3600 FOLDER`

mod agents;
mod dashboard;
mod observers;
mod servers;
mod snapshots;
mod soak;
mod starts;
mod teams;

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
