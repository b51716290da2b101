//! What a dashboard costs the simulator, with and without a browser that draws, and what it uses itself.

use crate::harness::{Server, program_path};
use crate::meter::Use;
use crate::observers::{Process, table};
use crate::say;
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::time::Instant;
use tempfile::TempDir;

/// Clock ticks a second in `/proc`.
const TICKS: f64 = 100.0;

/// A dashboard on a server, perhaps with a browser; says on drop what the dashboard used.
struct Audience {
    dashboard: Process,
    browser: Option<Process>,
    began: Instant,
    _profile: TempDir,
}

/// Compares a step's time without, with a dashboard, and with one that Chromium draws, on a grid of some side.
pub fn compare(n_rounds: usize, side: usize) {
    let audience = |with_dashboard: bool, with_browser: bool| {
        move |server: &Server| with_dashboard.then(|| Audience::attend(server, with_browser))
    };
    let audiences = [
        ("nobody".to_owned(), audience(false, false)),
        ("dashboard".to_owned(), audience(true, false)),
        ("dashboard and Chromium".to_owned(), audience(true, true)),
    ];
    let flags = format!("--burn-in 1000 --publish-truth --height {side} --width {side}");
    table(n_rounds, &flags, &audiences);
}

impl Audience {
    fn attend(server: &Server, with_browser: bool) -> Self {
        let mut command = Command::new(program_path("emberwatch-dashboard"));
        command.args([
            "--instance",
            server.instance.name(),
            "--listen",
            "127.0.0.1:0",
        ]);
        let mut dashboard = Process(command.stdout(Stdio::piped()).spawn().expect("a dashboard"));
        let mut url = String::new();
        let out = dashboard.0.stdout.take().expect("its output");
        BufReader::new(out)
            .read_line(&mut url)
            .expect("its address");
        let profile = TempDir::new().expect("a folder for the browser");
        let browser = with_browser.then(|| {
            let mut command = Command::new("chromium");
            let folder = format!("--user-data-dir={}", profile.path().display());
            let flags = [
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--window-size=1280,720",
            ];
            // Without a port to debug it, it would end at once.
            command
                .args(flags)
                .args([&folder, "--remote-debugging-port=0", url.trim()]);
            let command = command.stdout(Stdio::null()).stderr(Stdio::null());
            Process(command.spawn().expect("Chromium"))
        });
        std::thread::sleep(std::time::Duration::from_secs(3));
        Self {
            dashboard,
            browser,
            began: Instant::now(),
            _profile: profile,
        }
    }
}

impl Drop for Audience {
    fn drop(&mut self) {
        let pid = self.dashboard.0.id();
        let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).expect("its times");
        let fields: Vec<&str> = stat
            .rsplit(')')
            .next()
            .unwrap_or("")
            .split_whitespace()
            .collect();
        let ticks: f64 = [11, 12]
            .map(|n| fields[n].parse::<f64>().expect("ticks"))
            .iter()
            .sum();
        let share = ticks / TICKS / (self.began.elapsed().as_secs_f64() + 3.0);
        let drawn = if self.browser.is_some() {
            "drawn"
        } else {
            "not drawn"
        };
        say(&format!(
            "  dashboard, {drawn}: {:.1} % of a core, {}",
            share * 100.0,
            Use::of(pid)
        ));
    }
}
