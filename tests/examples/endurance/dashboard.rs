//! Measures how much a dashboard, with and without a browser, slows the simulator, and what resources it uses.

use crate::observers::table;
use std::time::Instant;
use tempfile::TempDir;
use tests::harness::{Program, Server};
use tests::meter::{Use, processor_seconds};
use tests::report::say;

/// A dashboard that shows a server, optionally open in a browser. When dropped, prints the resources that the dashboard
/// used.
struct Audience {
    dashboard: Program,
    browser: Option<Program>,
    began: Instant,
    _profile: TempDir,
}

/// Compares the time of a step on a square grid without a dashboard, with a dashboard, and with a dashboard that is
/// open in Chromium.
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
        let flags = format!("--instance {} --listen 127.0.0.1:0", server.instance.name());
        let dashboard = Program::start("emberwatch-dashboard", &flags);
        dashboard.until(|| dashboard.stdout().contains('\n'));
        let url = dashboard.stdout();
        let profile = TempDir::new().expect("a folder for the browser");
        let began = Instant::now();
        let browser = with_browser.then(|| {
            let flags = [
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--window-size=1280,720",
                // Without a debugging port, Chromium would end immediately.
                "--remote-debugging-port=0",
                &format!("--user-data-dir={}", profile.path().display()),
                url.trim(),
            ];
            Program::start_at("chromium".as_ref(), &flags)
        });
        Self {
            dashboard,
            browser,
            began,
            _profile: profile,
        }
    }
}

impl Drop for Audience {
    fn drop(&mut self) {
        let pid = self.dashboard.pid();
        let share = processor_seconds(pid) / self.began.elapsed().as_secs_f64();
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
