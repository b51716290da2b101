//! A training's metrics as curves: the paper's figure of improvement over iterations, and step sizes.

use crate::benchmark::report::figures::save;
use crate::benchmark::report::statistics::Estimate;
use crate::charts::{Curve, Lines, Panel, Point, Scale};
use crate::training::metrics::Rows;
use anyhow::Result;
use std::path::Path;

/// The figure's name in the folder of a training.
pub const FIGURE: &str = "training.svg";

const POINTS: usize = 200;

pub fn draw_training(folder: &Path) -> Result<()> {
    let rows = Rows::read(folder)?;
    let per_point = rows.len().div_ceil(POINTS).max(1);
    let page = Lines {
        title: "Learning while acting".into(),
        note: match per_point {
            1 => "each row of metrics.csv".into(),
            n => format!(
                "means over {n} rows of metrics.csv each; bands: ±1 standard error, as if rows were independent"
            ),
        },
        axis: "world steps, of all worlds together".into(),
        panels: panels(&rows),
    };
    save(&folder.join(FIGURE), &page.svg()?)
}

fn panels(rows: &Rows) -> Vec<Panel> {
    let curve = |column: &str, name: &str| averages(rows, column, name);
    let rates = [curve("rate", "model"), curve("dqn_rate", "DQN")];
    let quotient = quotient(&rates);
    let [model, dqn] = rates;
    let panels = [
        (
            "reward per world step",
            Scale::Linear,
            vec![curve("mean_reward", "reward")],
        ),
        (
            "loss of the model on its window, nats per observed cell",
            Scale::Linear,
            vec![curve("loss", "loss")],
        ),
        (
            "log-likelihood of new frames before they are learned from, nats per observed cell",
            Scale::Linear,
            vec![curve("held_out_log_likelihood", "log-likelihood")],
        ),
        (
            "loss of the DQN",
            Scale::Logarithmic,
            vec![curve("dqn_loss", "DQN loss")],
        ),
        ("step sizes", Scale::Logarithmic, vec![model, dqn, quotient]),
    ];
    let panel = |(title, scale, curves): (&str, _, _)| Panel {
        title: title.into(),
        scale,
        curves,
    };
    panels.map(panel).into()
}

fn averages(rows: &Rows, column: &str, name: &str) -> Curve {
    let (steps, values) = (rows.column("world_steps"), rows.column(column));
    let part = rows.len().div_ceil(POINTS).max(1);
    let parts = steps.chunks(part).zip(values.chunks(part));
    let average = |(steps, values): (&[Option<f64>], &[Option<f64>])| {
        let there: Vec<f64> = values.iter().flatten().copied().collect();
        let last = steps.iter().flatten().last()?;
        Some(Estimate::of(&there)?.at(*last))
    };
    Curve {
        name: name.into(),
        points: parts.filter_map(average).collect(),
    }
}

/// Returns the model's step size divided by the DQN's, where both exist (paper eq. 20).
fn quotient([model, dqn]: &[Curve; 2]) -> Curve {
    let of_dqn = |x: f64| dqn.points.iter().find(|point| point.x == x);
    let share = |point: &Point| {
        let quotient = point.y / of_dqn(point.x)?.y;
        Some(Point::new(point.x, quotient))
    };
    Curve {
        name: "model / DQN".into(),
        points: model.points.iter().filter_map(share).collect(),
    }
}
