//! The figures' worst cases; the pictures stay in `target/tmp/report` for people to look at.

use super::synthetic::{ladder, noise, run, teams};
use emberwatch_agent::benchmark::report::figures::FIRE_CELLS_PER_STEP;
use emberwatch_agent::benchmark::report::training::{FIGURE, draw_training};
use emberwatch_agent::benchmark::report::{
    PolicyRun, Snapshot, draw_ladder, draw_rewards, draw_snapshot, draw_teams,
};
use emberwatch_belief::Belief;
use emberwatch_protocol::randomness::split_mix;
use emberwatch_protocol::{Frame, Grid, Model, Move, Shape};
use std::path::{Path, PathBuf};

fn target(name: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("report");
    std::fs::create_dir_all(&directory).expect("target is writable");
    directory.join(format!("{name}.svg"))
}

/// Expects a page in a small SVG file whose texts are texts.
fn check(path: &Path, height: u32, texts: &[&str]) {
    let svg = std::fs::read_to_string(path).expect("a file");
    let size = format!("width=\"1200\" height=\"{height}\" viewBox=\"0 0 1200 {height}\"");
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
    let (path, height) = (target(name), 132 + 44 * n_rows + 72);
    draw_ladder(&path, runs, FIRE_CELLS_PER_STEP).expect("drawn");
    check(&path, height, &[FIRE_CELLS_PER_STEP, "random walk"]);
}

#[test]
fn ladders_of_many_few_zero_and_negative_rewards() {
    let with = |scale: f64| -> Vec<PolicyRun> {
        let mut runs = ladder(5, 10);
        for run in &mut runs {
            run.mean_reward = (run.mean_reward - 20.0) * scale;
        }
        runs
    };
    check_ladder("ladder", &ladder(8, 1500), 12);
    check_ladder("ladder_one_policy", &ladder(3, 10)[..3], 1);
    check_ladder("ladder_zero", &with(0.0), 12);
    check_ladder("ladder_negative", &with(100.0), 12);
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
        check(&path, 704, &[FIRE_CELLS_PER_STEP, "step k"]);
    };
    let runs = ladder(1, 1500);
    drawn("rewards", &runs, Some(&fire));
    drawn("rewards_three", &runs[4..7], None);
    drawn("rewards_worlds_long", &ladder(3, 25_000), None);
    drawn("rewards_one_step", &ladder(1, 1), Some(&[0.0]));
    let mut dark = runs[..4].to_vec();
    dark.iter_mut().for_each(|run| run.rewards.fill(0.0));
    dark[3].rewards.iter_mut().for_each(|reward| *reward -= 2.5);
    drawn("rewards_zero", &dark, Some(&[0.0; 1500]));
}

#[test]
fn rewards_of_teams_are_drawn_over_the_number_of_robots() {
    let path = target("teams");
    draw_teams(&path, &teams(3), FIRE_CELLS_PER_STEP).expect("drawn");
    check(&path, 704, &["robots", "alone", "joint"]);
    draw_ladder(&target("teams_ladder"), &teams(3), FIRE_CELLS_PER_STEP).expect("drawn");
    // Robots of one number make no curve.
    let never = target("teams_never");
    draw_teams(&never, &ladder(2, 4), FIRE_CELLS_PER_STEP).expect("nothing to draw");
    assert!(!never.exists());
}

#[test]
fn a_snapshot_calls_the_beliefs_states_by_their_names() {
    let (model, shape) = (Model::wildfire(), Shape::new(30, 48).expect("test shape"));
    let truth = Grid::from_shape_fn(shape.dim(), |(row, col)| {
        (split_mix(3, (row / 4 * 12 + col / 4) as u64) % 3) as u8
    });
    let moves = (0..64).map(|step| Move::from_low_bits(split_mix(11, step / 5)));
    let mut path_cells = vec![shape.centre()];
    path_cells.extend(moves.scan(shape.centre(), |cell, step| {
        *cell = step.apply(*cell, shape);
        Some(*cell)
    }));
    let mut frame = Frame::empty(shape);
    for cell in &path_cells[1..] {
        frame.observe(shape.index(*cell), truth[[cell.row, cell.col]]);
    }
    let mut snapshot = Snapshot {
        seed: 100,
        step: 1234,
        belief: Some(Belief::from_states(&truth, 3).expect("states of the model")),
        truth: truth.clone(),
        frame,
        path_cells,
        learned_target: None,
    };
    let path = target("snapshot");
    for (learned_target, name) in [(None, "fire"), (Some(2), "what pays most")] {
        snapshot.learned_target = learned_target;
        draw_snapshot(&path, &model, &snapshot, &truth).expect("drawn");
        let svg = std::fs::read_to_string(&path).expect("a file");
        for text in [&format!("belief: {name}"), "wildfire, step k = 1234"] {
            assert!(svg.contains(&format!(">{text}</text>")), "{text}");
        }
    }
}

#[test]
fn results_that_cannot_be_drawn_are_errors() {
    let path = target("never");
    let label = FIRE_CELLS_PER_STEP;
    let runs = |reward| [run("beam", "truth", 3, reward)];
    let (nan, without) = (runs(f64::NAN), runs(1.0));
    let nowhere = Path::new("/nonexistent/a.svg");
    for (drawn, words) in [
        (draw_ladder(&path, &[], label), "ladder: expected at least"),
        (draw_rewards(&path, &[], label, None), "rewards: expected"),
        (draw_ladder(&path, &nan, label), "\"beam\" on world seed 3"),
        (
            draw_rewards(&path, &without, label, None),
            "rewards: expected",
        ),
        (
            draw_ladder(nowhere, &ladder(1, 1), label),
            "write /nonexist",
        ),
    ] {
        let error = drawn.expect_err(words).to_string();
        assert!(error.contains(words), "{error}");
    }
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
    let height = 84 + 5 * 190 + 64;
    let texts = [
        "reward per world step",
        "world steps, of all worlds together",
    ];
    check(&folder.join(FIGURE), height, &texts);
    let missing = draw_training(Path::new("no/such")).expect_err("no metrics");
    assert!(
        missing
            .to_string()
            .starts_with("metrics no/such/metrics.csv"),
        "{missing}"
    );
}
