//! `film`: a recording as moving pictures, or one step of it.

use super::{make_folder_of, model_named};
use agent::config::AgentFlags;
use agent::film::{Format, Order, Product, Selection, film};
use anyhow::{Result, ensure};
use clap::{ArgGroup, Args};
use std::path::PathBuf;

/// Make a film or a still of a recording
#[derive(Args)]
#[command(group = ArgGroup::new("out").required(true).args(["gif", "apng", "png"]))]
pub struct FilmCommand {
    /// What `emberwatch-server record` wrote; with --truth, hidden states are shown too
    recording: PathBuf,
    /// Make a GIF
    #[arg(long, value_name = "FILE")]
    gif: Option<PathBuf>,
    /// Make an animated PNG
    #[arg(long, value_name = "FILE")]
    apng: Option<PathBuf>,
    /// Make a PNG of one step
    #[arg(long, value_name = "FILE", requires = "step")]
    png: Option<PathBuf>,
    /// That step
    #[arg(long, requires = "png", conflicts_with_all = ["gif", "apng"])]
    step: Option<u64>,
    /// First step to show
    #[arg(long, value_name = "K", default_value_t = 0, conflicts_with = "png")]
    from: u64,
    /// Last step to show [default: the last]
    #[arg(long, value_name = "K", conflicts_with = "png")]
    to: Option<u64>,
    /// Show every so many steps
    #[arg(long, value_name = "N", default_value_t = 1, conflicts_with = "png",
        value_parser = clap::value_parser!(u64).range(1..))]
    every: u64,
    /// Pictures a second
    #[arg(long, default_value = "10", conflicts_with = "png", value_parser = parse_rate)]
    fps: u16,
    /// The world
    #[arg(long, default_value_t = 0)]
    world: u32,
    /// Pixels of a cell's side [default: such that a panel is about 200 pixels wide]
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..=100))]
    scale: Option<u16>,
    /// A built-in model or a model file, where the recording's server hid its model
    #[arg(long, value_name = "MODEL")]
    model: Option<String>,
    #[command(flatten)]
    settings: AgentFlags,
}

impl FilmCommand {
    /// Makes the file.
    pub fn run(&self) -> Result<()> {
        let (out, product) = self.product()?;
        let model = self.model.as_deref().map(model_named).transpose()?;
        make_folder_of(&out)?;
        let summary = film(&Order {
            recording: self.recording.clone(),
            world: self.world,
            out: out.clone(),
            product,
            scale: self.scale.map(usize::from),
            model,
            config: self.settings.effective()?,
        })?;
        let ((width, height), bytes) = (summary.size, summary.n_bytes);
        let pictures = summary.n_pictures;
        tracing::info!(pictures, width, height, bytes, file = %out.display(), "written");
        Ok(())
    }

    fn product(&self) -> Result<(PathBuf, Product)> {
        if let (Some(out), Some(step)) = (&self.png, self.step) {
            return Ok((out.clone(), Product::Still { step }));
        }
        let steps = self.from..=self.to.unwrap_or(u64::MAX);
        let (from, to) = (steps.start(), steps.end());
        ensure!(
            from <= to,
            "--to: expected at least --from {from}, got {to}"
        );
        let selection = Selection {
            steps,
            every: self.every,
        };
        let (out, format) = match (&self.gif, &self.apng) {
            (Some(out), _) => (out, Format::Gif),
            (None, out) => (
                out.as_ref().expect("invariant: the group is required"),
                Format::Apng,
            ),
        };
        let centis = self.fps;
        let product = Product::Film {
            format,
            selection,
            centis,
        };
        Ok((out.clone(), product))
    }
}

/// Pictures a second as hundredths of a second each, the unit of GIF.
fn parse_rate(text: &str) -> Result<u16, String> {
    let rate = text.parse().ok();
    // Faster ones are slowed down by browsers.
    let rate = rate.filter(|rate: &f64| (0.1..=50.0).contains(rate));
    let rate = rate.ok_or("expected 0.1 to 50 pictures a second")?;
    Ok((100.0 / rate).round() as u16)
}
