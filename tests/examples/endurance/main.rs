//! Measures how much observers, dashboards and snapshots slow a server, and how a server fares when clients come and go
//! for hours.
//!
//! `cargo run --release -p tests --example endurance -- observers 5 | dashboard 5 64 | snapshots 9 | soak 3600 FOLDER`

mod dashboard;
mod observers;
mod snapshots;
mod soak;

fn number<T: std::str::FromStr>(text: &str) -> T {
    let number = text.parse();
    number.unwrap_or_else(|_| panic!("expected a number, got {text:?}"))
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["observers", n] => observers::compare(number(n)),
        ["dashboard", rounds, side] => dashboard::compare(number(rounds), number(side)),
        ["snapshots", n] => snapshots::compare(number(n)),
        ["observe", instance] => observers::observe(instance),
        ["soak", seconds, folder] => soak::soak(number(seconds), folder.as_ref()),
        _ => panic!(
            "expected observers ROUNDS, dashboard ROUNDS SIDE, snapshots ROUNDS or soak SECONDS FOLDER, got {arguments:?}"
        ),
    }
}
