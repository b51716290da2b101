//! The figures' worst cases; the pictures stay in `target/tmp/report` for people to look at.

use crate::synthetic::{Scene, ladder, model, noise, run, scene};
use agent::report::figures::FIRE_CELLS_PER_STEP;
use agent::report::figures::curves::{Curve, Page, Panel, Scale, draw_curves};
use agent::report::training::{FIGURES, draw_training};
use agent::report::{PolicyRun, ReportError, Snapshot, draw_ladder, draw_rewards, draw_snapshot};
use protocol::{Cell, Model};
use std::collections::HashSet;
use std::path::{Path, PathBuf};

fn target(name: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("report");
    std::fs::create_dir_all(&directory).expect("target is writable");
    directory.join(format!("{name}.png"))
}

/// Decodes a picture; expects its width of 1200 points in pixels and more than a blank page.
fn check(path: &Path, height: Option<u32>) {
    let file = std::io::BufReader::new(std::fs::File::open(path).expect("a file"));
    let mut reader = png::Decoder::new(file).read_info().expect("a PNG");
    let mut pixels = vec![0; reader.output_buffer_size()];
    let info = reader.next_frame(&mut pixels).expect("a whole PNG");
    assert_eq!((info.width, info.color_type), (2400, png::ColorType::Rgb));
    if let Some(height) = height {
        assert_eq!(info.height, height);
    }
    let colors: HashSet<&[u8]> = pixels.chunks_exact(3).collect();
    assert!(colors.len() > 20, "{} colours", colors.len());
    // Nothing runs into the page's edge.
    let row = 3 * info.width as usize;
    let is_edge = |at: usize| {
        let (y, x) = (at / row, at % row / 3);
        y < 16 || y + 16 >= info.height as usize || x < 40 || x + 40 >= info.width as usize
    };
    let dirty = (0..pixels.len())
        .step_by(3)
        .find(|&at| is_edge(at) && pixels[at..at + 3] != [255; 3]);
    assert_eq!(dirty, None);
}

/// Expects the same page as a small SVG file whose texts are texts.
fn check_svg(path: &Path, height: u32, texts: &[&str]) {
    let svg = std::fs::read_to_string(path).expect("a file");
    let size = format!("width=\"2400\" height=\"{height}\" viewBox=\"0 0 2400 {height}\"");
    assert!(svg.lines().next().is_some_and(|root| root.contains(&size)));
    assert!(
        svg.ends_with("</svg>\n") && svg.len() < 300_000,
        "{} bytes",
        svg.len()
    );
    for text in texts {
        assert!(
            svg.contains(&format!(">{text}</text>")),
            "no {text:?} in {path:?}"
        );
    }
}

fn check_ladder(name: &str, runs: &[PolicyRun], n_rows: u32) {
    let (path, height) = (target(name), 2 * (132 + 44 * n_rows + 72));
    draw_ladder(&path, runs, FIRE_CELLS_PER_STEP).expect("drawn");
    check(&path, Some(height));
    let svg = path.with_extension("svg");
    draw_ladder(&svg, runs, FIRE_CELLS_PER_STEP).expect("drawn");
    check_svg(&svg, height, &[FIRE_CELLS_PER_STEP, "random walk"]);
}

#[test]
fn ladders_of_many_and_of_few() {
    check_ladder("ladder", &ladder(8, 1500), 12);
    check_ladder("ladder_one_world", &ladder(1, 1500), 12);
    check_ladder("ladder_one_policy", &ladder(3, 10)[..3], 1);
    check_ladder("ladder_many_worlds", &ladder(64, 10), 12);
}

#[test]
fn ladders_of_zero_and_negative_rewards() {
    let with = |scale: f64| -> Vec<PolicyRun> {
        let mut runs = ladder(5, 10);
        for run in &mut runs {
            run.mean_reward = (run.mean_reward - 20.0) * scale;
        }
        runs
    };
    check_ladder("ladder_zero", &with(0.0), 12);
    check_ladder("ladder_negative", &with(100.0), 12);
    check_ladder("ladder_tiny", &with(1e-3), 12);
}

#[test]
fn rewards_over_time() {
    let fire: Vec<f32> = (0..1500)
        .map(|step| {
            (350.0 + 200.0 * (f64::from(step) / 300.0).sin() + 20.0 * noise(1, step as u64)) as f32
        })
        .collect();
    let drawn = |name: &str, runs: &[PolicyRun], fire: Option<&[f32]>| {
        let path = target(name);
        draw_rewards(&path, runs, FIRE_CELLS_PER_STEP, fire).expect("drawn");
        check(&path, Some(1400));
        let svg = path.with_extension("svg");
        draw_rewards(&svg, runs, FIRE_CELLS_PER_STEP, fire).expect("drawn");
        check_svg(&svg, 1400, &[FIRE_CELLS_PER_STEP, "step k"]);
    };
    let runs = ladder(1, 1500);
    drawn("rewards", &runs, Some(&fire));
    drawn("rewards_three", &runs[4..7], None);
    drawn("rewards_long", &ladder(1, 25_000)[5..11], None);
    drawn("rewards_worlds", &ladder(8, 1500), Some(&fire));
    drawn("rewards_worlds_long", &ladder(3, 25_000), None);
    drawn("rewards_one_step", &ladder(1, 1), Some(&[0.0]));
    let mut dark = runs[..4].to_vec();
    dark.iter_mut().for_each(|run| run.rewards.fill(0.0));
    dark[3].rewards.iter_mut().for_each(|reward| *reward -= 2.5);
    drawn("rewards_zero", &dark, Some(&[0.0; 1500]));
}

fn snapshot(scene: &Scene) -> Snapshot<'_> {
    Snapshot {
        model: &scene.model,
        truth: scene.truth.clone(),
        observation: scene.observation.clone(),
        frame: scene.frame.clone(),
        path_cells: scene.path_cells.clone(),
        belief: &scene.belief,
        step: 1234,
        seed: 100,
    }
}

#[test]
fn snapshots_of_every_shape() {
    let drawn = |name: &str, scene: Scene| {
        let path = target(name);
        draw_snapshot(&path, &snapshot(&scene)).expect("drawn");
        check(&path, None);
    };
    drawn("snapshot", scene(Model::wildfire(), 64, 64));
    drawn("snapshot_wide", scene(Model::wildfire(), 5, 40));
    drawn("snapshot_tall", scene(Model::wildfire(), 40, 5));
    drawn("snapshot_six_states", scene(model(6), 30, 48));
    drawn("snapshot_two_states", scene(model(2), 8, 8));
    drawn("snapshot_one_cell", scene(Model::wildfire(), 1, 1));
    drawn("snapshot_large", scene(Model::wildfire(), 700, 1000));
}

#[test]
fn a_snapshot_without_a_path_is_drawn() {
    let mut scene = scene(Model::wildfire(), 12, 12);
    scene.path_cells.clear();
    scene.frame.clear();
    let path = target("snapshot_no_path");
    draw_snapshot(&path, &snapshot(&scene)).expect("drawn");
    check(&path, None);
}

#[test]
fn parts_that_do_not_fit_are_named() {
    let rejected = |change: &dyn Fn(&mut Snapshot<'_>), what: &str| {
        let scene = scene(Model::wildfire(), 6, 9);
        let mut snapshot = snapshot(&scene);
        change(&mut snapshot);
        let error = draw_snapshot(&target("never"), &snapshot).expect_err("a misfit");
        assert!(
            error.to_string().starts_with(&format!("snapshot: {what}:")),
            "{error}"
        );
    };
    rejected(&|s| s.truth[[0, 0]] = 3, "truth");
    rejected(&|s| s.truth = protocol::Grid::zeros((0, 9)), "truth");
    rejected(
        &|s| s.observation = protocol::Grid::zeros((6, 8)),
        "observation",
    );
    rejected(&|s| s.observation[[1, 1]] = 255, "observation");
    let nan = protocol::Probabilities::from_elem((3, 6, 9), f32::NAN);
    let error = {
        let scene = scene(Model::wildfire(), 6, 9);
        let snapshot = Snapshot {
            belief: &nan,
            ..snapshot(&scene)
        };
        draw_snapshot(&target("never"), &snapshot).expect_err("a NaN")
    };
    assert!(
        error.to_string().contains("belief: expected finite"),
        "{error}"
    );
    rejected(&|s| s.path_cells.push(Cell { row: 6, col: 0 }), "path");
    assert!(!target("never").exists());
}

#[test]
fn results_that_cannot_be_drawn_are_errors() {
    let path = target("never");
    let label = FIRE_CELLS_PER_STEP;
    assert_eq!(
        draw_ladder(&path, &[], label),
        Err(ReportError::Empty { what: "ladder" })
    );
    assert_eq!(
        draw_rewards(&path, &[], label, None),
        Err(ReportError::Empty { what: "rewards" })
    );
    let nan = draw_ladder(&path, &[run("beam", "truth", 3, f64::NAN)], label);
    let error = nan.expect_err("a NaN").to_string();
    assert!(error.contains("\"beam\" on world seed 3"), "{error}");
    let without = draw_rewards(&path, &[run("beam", "truth", 3, 1.0)], label, None);
    assert_eq!(without, Err(ReportError::Empty { what: "rewards" }));
    let nowhere = draw_ladder(Path::new("/nonexistent/a.png"), &ladder(1, 1), label);
    assert!(
        matches!(nowhere, Err(ReportError::Write { .. })),
        "{nowhere:?}"
    );
}

fn page(panels: Vec<Panel>) -> Page {
    Page {
        title: "Curves".into(),
        note: "small print".into(),
        axis: "iteration n".into(),
        panels,
    }
}

#[test]
fn curves_of_many_and_of_few_points() {
    let curve = |name: &str, n: usize, value: fn(f64) -> f64| {
        Curve::new(name, (0..n).map(|x| (x as f64, value(x as f64))).collect())
    };
    let panel = |scale, curves| Panel {
        title: "rate per update".into(),
        scale,
        curves,
    };
    let path = target("curves");
    let mut banded = curve("its band reaches zero", 1000, |x| 1e-4 * (1.0 + x));
    banded.errors = (0..1000).map(|x| 1e-4 * f64::from(x)).collect();
    banded.errors[999] = 1.0;
    let logarithmic = vec![
        banded,
        curve("vanishes", 1000, |x| 1e-3 / (1.0 + x)),
        curve("is zero at first", 1000, |x| (x - 10.0).max(0.0)),
    ];
    let panels = vec![
        panel(Scale::Logarithmic, logarithmic),
        panel(Scale::Linear, vec![curve("one point", 1, |_| -3.0)]),
        panel(Scale::Linear, vec![curve("none", 0, |x| x)]),
        panel(Scale::Linear, vec![curve("none either", 9, |_| f64::NAN)]),
    ];
    draw_curves(&path, &page(panels)).expect("drawn");
    // Two panels: the others have nothing to draw.
    check(&path, Some(2 * (84 + 2 * 190 + 64)));
    let empty = draw_curves(&target("never"), &page(Vec::new()));
    assert_eq!(empty, Err(ReportError::Empty { what: "curves" }));
}

#[test]
fn a_training_is_drawn_from_its_metrics() {
    let folder = target("training").with_extension("");
    std::fs::create_dir_all(&folder).expect("target is writable");
    let mut text = "update,world_steps,loss,held_out_log_likelihood,mean_reward,rate,dqn_loss,\
                    dqn_rate\n"
        .to_owned();
    for row in 0..2000_u64 {
        let loss = if row < 500 {
            String::new()
        } else {
            format!("{}", 0.5 + noise(1, row))
        };
        let reward = 7.0 + noise(2, row);
        text += &format!(
            "{row},{row},{loss},{},{reward},1e-4,{},0.01\n",
            -0.4,
            1.0 + noise(3, row)
        );
    }
    std::fs::write(folder.join("metrics.csv"), text).expect("written");
    draw_training(&folder).expect("drawn");
    let height = 2 * (84 + 5 * 190 + 64);
    check(&folder.join(FIGURES[0]), Some(height));
    let texts = [
        "reward per world step",
        "world steps, of all worlds together",
    ];
    check_svg(&folder.join(FIGURES[1]), height, &texts);
    let missing = draw_training(Path::new("no/such")).expect_err("no metrics");
    assert!(
        missing
            .to_string()
            .starts_with("metrics no/such/metrics.csv"),
        "{missing}"
    );
}
