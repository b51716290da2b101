//! Runs a server for hours. Meanwhile agents and observers start, end, are killed or stopped and lose their robots to
//! other agents, and snapshots are written. Writes the server's resource usage, second by second, as a CSV file and as
//! a figure.

use emberwatch_agent::charts::{Curve, Lines, Panel, Point, Scale};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rustix::process::Signal;
use std::fmt::Write;
use std::path::Path;
use std::time::{Duration, Instant};
use tests::harness::{PATIENCE, Program, Server};
use tests::meter::Use;
use tests::report::say;

const FLAGS: &str =
    "--height 64 --width 64 --worlds 4 --burn-in 1000 --lease-millis 1000 --publish-truth";

/// Runs the test for this many seconds and writes `soak.csv` and `soak.svg`.
pub fn soak(seconds: u64, folder: &Path) {
    std::fs::create_dir_all(folder).expect("the folder");
    let snapshots = folder.join("snapshots");
    let flags = format!(
        "{FLAGS} --snapshot-every 1000 --snapshot-dir {}",
        snapshots.display()
    );
    let server = Server::start(&flags);
    let mut guests = Guests {
        server: &server,
        rng: ChaCha8Rng::seed_from_u64(0),
        programs: Vec::new(),
        counts: [0; 7],
    };
    let (started, mut rows) = (Instant::now(), Vec::new());
    while started.elapsed() < Duration::from_secs(seconds) {
        guests.act(folder);
        let now = started.elapsed().as_secs_f64();
        if rows
            .last()
            .is_none_or(|(last, _): &(f64, Use)| now - last > seconds as f64 / 1000.0)
        {
            rows.push((now, Use::of(server.program.pid())));
        }
    }
    let n_steps = server.status().n_steps;
    say(&format!(
        "{seconds} s, {n_steps} steps; started, killed, stopped, woken, told to stop, taken over, snapshots: {:?}",
        guests.counts
    ));
    let tenth = &rows[rows.len() / 10];
    say(&format!("after a tenth: {}", tenth.1));
    drop(guests);
    server.program.until(|| server.status().n_clients == 1);
    let end = (
        started.elapsed().as_secs_f64(),
        Use::of(server.program.pid()),
    );
    rows.push(end);
    say(&format!("at the end:    {}", end.1));
    write(folder, &rows);
}

/// The agents and observers that come and go.
struct Guests<'a> {
    server: &'a Server,
    rng: ChaCha8Rng,
    programs: Vec<(Program, bool)>,
    counts: [u64; 7],
}

impl Guests<'_> {
    fn act(&mut self, folder: &Path) {
        let what = self.rng.random_range(0..7);
        let chosen = self.rng.random_range(0..self.programs.len().max(1));
        let has_one = !self.programs.is_empty();
        match what {
            0 if self.programs.len() < 8 => self.start(false),
            5 if self.programs.len() < 8 => self.start(true),
            1 if has_one => self.programs.swap_remove(chosen).0.signal(Signal::KILL),
            2 if has_one => self.signal(chosen, Signal::STOP, true),
            3 if has_one => self.signal(chosen, Signal::CONT, false),
            4 if has_one && !self.programs[chosen].1 => {
                let (program, _) = self.programs.swap_remove(chosen);
                program.signal(Signal::TERM);
                program.wait(PATIENCE);
            }
            6 => {
                let file = folder.join("now.snapshot");
                let command = format!("snapshot {}", file.display());
                self.server.command(&command).check(0);
            }
            _ => return,
        }
        self.counts[what] += 1;
        std::thread::sleep(Duration::from_millis(self.rng.random_range(0..100)));
    }

    fn start(&mut self, is_takeover: bool) {
        let world = self.rng.random_range(0..4);
        let takeover = if is_takeover { "--takeover" } else { "" };
        let flags = format!("--world {world} --policy coverage {takeover}");
        let agent = Program::agent(&self.server.instance, &flags);
        self.programs.push((agent, false));
    }

    fn signal(&mut self, chosen: usize, signal: Signal, stops: bool) {
        self.programs[chosen].0.signal(signal);
        self.programs[chosen].1 = stops;
    }
}

fn write(folder: &Path, rows: &[(f64, Use)]) {
    let mut text = String::from("seconds,resident_kib,descriptors,files,shared_kib\n");
    for (seconds, used) in rows {
        let Use {
            resident,
            descriptors,
            files,
            shared,
        } = used;
        let _ = writeln!(
            text,
            "{seconds:.1},{resident},{descriptors},{files},{shared}"
        );
    }
    std::fs::write(folder.join("soak.csv"), text).expect("write the table");
    let panel = |title: &str, value: fn(&Use) -> f64| Panel {
        title: title.into(),
        scale: Scale::Linear,
        curves: vec![Curve {
            name: title.split(',').next().unwrap_or_default().into(),
            points: rows
                .iter()
                .map(|(seconds, used)| Point::new(*seconds, value(used)))
                .collect(),
        }],
    };
    let page = Lines {
        title: "A server while agents come and go".into(),
        note: "agents start, are killed, stopped, woken, told to stop and taken over; snapshots are written".into(),
        axis: "seconds".into(),
        panels: vec![
            panel("resident memory, MiB", |used| used.resident as f64 / 1024.0),
            panel("descriptors, open", |used| used.descriptors as f64),
            panel("channel files, of all processes", |used| used.files as f64),
            panel("shared memory, MiB in use", |used| used.shared as f64 / 1024.0),
        ],
    };
    std::fs::write(folder.join("soak.svg"), page.svg().expect("points")).expect("write the figure");
}
