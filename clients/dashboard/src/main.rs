//! `emberwatch-dashboard`: a web page that shows a running instance, or a recording.

use anyhow::{Context, Result, ensure};
use clap::Parser;
use emberwatch_dashboard::scene::{Scene, Stage};
use emberwatch_dashboard::{access, player, server, watcher};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::program::{
    WatchedProcess, parse_flags, print, start_logging, stop_on_signals,
};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;
use tokio::net::TcpListener;

const TICK: Duration = Duration::from_millis(50);

/// This process's niceness (at most 19). With it, on a busy machine, a simulator that wakes up runs first.
const NICENESS: i32 = 5;

const LISTEN: &str = "expected an address of this machine and a free port; port 0 selects one";

/// Shows an Emberwatch instance, or a recording, in a browser. Only reads, never acts.
#[derive(Parser)]
#[command(name = "emberwatch-dashboard", version)]
struct Cli {
    /// The instance to watch; its server may start later, and may restart
    #[arg(long, default_value = "default")]
    instance: String,
    /// Play this recording instead
    #[arg(long, value_name = "FILE", conflicts_with = "instance")]
    recording: Option<PathBuf>,
    /// The page's address; port 0 selects a free port. Whoever can reach this address sees everything
    #[arg(long, default_value = "127.0.0.1:8600", value_name = "ADDRESS:PORT")]
    listen: SocketAddr,
    /// A host name under which browsers may reach the page besides this machine's addresses, such as a TLS proxy's;
    /// repeatable
    #[arg(long, value_name = "HOST", value_parser = access::host_name)]
    name: Vec<String>,
    /// Open the page in the default browser
    #[arg(long)]
    open: bool,
    /// Exit when this process ends
    #[arg(long, value_name = "PID")]
    exit_with: Option<i32>,
}

fn main() -> ExitCode {
    let cli: Cli = parse_flags();
    let _log = start_logging();
    match run(&cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            tracing::error!("{error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(cli: &Cli) -> Result<()> {
    if let Err(error) = rustix::process::nice(NICENESS) {
        tracing::warn!("priority not lowered: {error}");
    }
    let exit_with = cli.exit_with.map(WatchedProcess::watch).transpose()?;
    let stop = stop_on_signals().context("handle signals")?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("start the web server")?;
    let bound = runtime.block_on(TcpListener::bind(cli.listen));
    let listener = bound.with_context(|| format!("--listen {}: {LISTEN}", cli.listen))?;
    let address = listener.local_addr().context("read the page's address")?;
    let (stage, threads) = start(cli, &stop)?;
    announce(address, cli.open)?;
    let served = runtime.block_on(async {
        tokio::select! {
            served = server::serve(listener, stage, &cli.name) => served,
            () = end(&stop, exit_with.as_ref()) => Ok(()),
        }
    });
    // The threads that opened the ports must also close them.
    stop.store(true, Ordering::Relaxed);
    let ended = threads.into_iter().map(JoinHandle::join);
    let n_panics = ended.filter(Result::is_err).count();
    ensure!(n_panics == 0, "{n_panics} threads failed");
    served.context("serve the page")
}

async fn end(stop: &AtomicBool, exit_with: Option<&WatchedProcess>) {
    while !stop.load(Ordering::Relaxed) && !exit_with.is_some_and(WatchedProcess::has_ended) {
        tokio::time::sleep(TICK).await;
    }
}

fn start(cli: &Cli, stop: &Arc<AtomicBool>) -> Result<(Arc<Stage>, Vec<JoinHandle<()>>)> {
    match &cli.recording {
        Some(file) => {
            let stage = Arc::new(Stage::new(Scene::new(&file.display().to_string())));
            let thread = player::play(file, &stage, stop)?;
            Ok((stage, vec![thread]))
        }
        None => {
            let instance = Instance::new(&cli.instance)?;
            let stage = Arc::new(Stage::new(Scene::new(instance.name())));
            let threads = watcher::watch(&instance, &stage, stop)?;
            Ok((stage, threads.into()))
        }
    }
}

fn announce(address: SocketAddr, open: bool) -> Result<()> {
    let url = format!("http://{address}/");
    print(&format!("{url}\n"))?;
    if open {
        let opener = std::process::Command::new("xdg-open").arg(&url).spawn();
        if let Err(error) = opener {
            tracing::warn!("no browser was opened ({error}): open {url}");
        }
    }
    Ok(())
}
