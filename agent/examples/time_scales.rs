//! Draws the step sizes of autoencoder and DQN over a run of 25,000 iterations: the vanishing defaults
//! (`config/agent.toml`), and the constants of the authors (`--preset paper`).
//!
//! `cargo run -p emberwatch-agent --example time_scales -- docs/time-scales.svg`

use emberwatch_acting::config::{AgentConfig, StepSize};
use emberwatch_agent::benchmark::report::save;
use emberwatch_agent::charts::{Curve, Lines, Panel, Point, Scale};
use std::path::Path;

const ITERATIONS: u64 = 25_000;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1);
    let path = path.ok_or("expected the path of an SVG file")?;
    let panels = [
        ("Step sizes that vanish (default)", AgentConfig::default()),
        (
            "Step sizes of the authors' code (preset paper)",
            AgentConfig::paper(),
        ),
    ];
    let page = Lines {
        title: "Two time scales".into(),
        note: "rate (1 + n / steady)^-power at iteration n; paper eq. 20".into(),
        axis: "iteration n".into(),
        panels: panels.map(|(title, config)| panel(title, &config)).into(),
    };
    Ok(save(Path::new(&path), &page.svg()?)?)
}

fn panel(title: &str, config: &AgentConfig) -> Panel {
    let (model, dqn) = (config.autoencoder.step_size, config.dqn.step_size);
    let curve = |name: &str, value: &dyn Fn(u64) -> f64| {
        let points = (0..=ITERATIONS).step_by(100);
        let points = points.map(|n| Point::new(n as f64, value(n)));
        Curve {
            name: name.into(),
            points: points.collect(),
        }
    };
    let at = |size: StepSize| move |n| size.at(n);
    Panel {
        title: title.into(),
        scale: Scale::Logarithmic,
        curves: vec![
            curve("autoencoder", &at(model)),
            curve("DQN", &at(dqn)),
            curve("quotient", &|n| model.at(n) / dqn.at(n)),
        ],
        shade: None,
    }
}
