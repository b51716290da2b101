//! Draws the most demanding figures. The files stay in `target/tmp/report`, so that people can look at them.

use super::synthetic::{ladder, noise, run, teams};
use emberwatch_agent::benchmark::report::figures::FIRE_CELLS_PER_STEP as LABEL;
use emberwatch_agent::benchmark::report::training::{FIGURE, draw_training};
use emberwatch_agent::benchmark::report::{draw_ladder, draw_rewards, draw_teams};
use std::path::{Path, PathBuf};

fn target(name: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("report");
    std::fs::create_dir_all(&directory).expect("target is writable");
    directory.join(format!("{name}.svg"))
}

/// Draws a page, and checks that the result is a small SVG file of this height that contains the texts.
fn check(name: &str, height: u32, texts: &[&str], draw: impl Fn(&Path) -> anyhow::Result<()>) {
    let path = target(name);
    draw(&path).expect("drawn");
    let svg = std::fs::read_to_string(&path).expect("a file");
    let size = format!("width=\"1200\" height=\"{height}\" viewBox=\"0 0 1200 {height}\"");
    assert!(svg.lines().next().is_some_and(|root| root.contains(&size)));
    assert!(svg.ends_with("</svg>\n") && svg.len() < 300_000);
    for text in texts {
        assert!(svg.contains(&format!(">{text}</text>")), "{name}: {text}");
    }
}

#[test]
fn pages_have_their_size_and_labels() {
    let height = 132 + 44 * 5 + 72;
    check("ladder", height, &[LABEL, "random walk"], |path| {
        draw_ladder(path, &ladder(8, 100), LABEL)
    });
    let fire: Vec<f32> = (0..1500).map(|step| (step as f32 / 300.0).sin()).collect();
    for (name, n_steps, fire) in [
        ("rewards", 1500, Some(&fire[..])),
        ("rewards_long", 25_000, None),
        ("rewards_one_step", 1, Some(&[0.0][..])),
    ] {
        check(name, 704, &[LABEL, "step k"], |path| {
            draw_rewards(path, &ladder(2, n_steps), LABEL, fire)
        });
    }
    check("teams", 704, &["robots", "alone", "joint"], |path| {
        draw_teams(path, &teams(3), LABEL)
    });
    draw_ladder(&target("teams_ladder"), &teams(3), LABEL).expect("drawn");
    // If all runs have the same number of robots, there is no curve to draw.
    let never = target("teams_never");
    draw_teams(&never, &ladder(2, 4), LABEL).expect("nothing to draw");
    assert!(!never.exists());
}

#[test]
fn results_that_cannot_be_drawn_are_errors() {
    let path = target("never");
    let [nan, one] = [f64::NAN, 1.0].map(|reward| [run("beam", "truth", 3, reward)]);
    let nowhere = Path::new("/nonexistent/a.svg");
    for (drawn, words) in [
        (draw_ladder(&path, &[], LABEL), "ladder: expected at least"),
        (draw_rewards(&path, &[], LABEL, None), "rewards: expected"),
        (draw_ladder(&path, &nan, LABEL), "\"beam\" on world seed 3"),
        (draw_rewards(&path, &one, LABEL, None), "rewards: expected"),
        (draw_ladder(nowhere, &one, LABEL), "write /nonexist"),
    ] {
        let error = drawn.expect_err(words).to_string();
        assert!(error.contains(words), "{error}");
    }
}

#[test]
fn a_training_is_drawn_from_its_metrics() {
    let folder = target("training").with_extension("");
    std::fs::create_dir_all(&folder).expect("target is writable");
    let columns =
        "update,world_steps,loss,held_out_log_likelihood,mean_reward,rate,dqn_loss,dqn_rate";
    let mut text = format!("{columns}\n");
    for row in 0..2000_u64 {
        let [loss, reward, dqn_loss] = [(1, 0.5), (2, 7.0), (3, 1.0)]
            .map(|(seed, mean)| (mean + noise(seed, row)).to_string());
        let loss = if row < 500 { String::new() } else { loss };
        text += &format!("{row},{row},{loss},-0.4,{reward},1e-4,{dqn_loss},0.01\n");
    }
    std::fs::write(folder.join("metrics.csv"), text).expect("written");
    let texts = [
        "reward per world step",
        "world steps, of all worlds together",
    ];
    assert_eq!(FIGURE, "training.svg");
    check("training/training", 84 + 5 * 190 + 64, &texts, |_| {
        draw_training(&folder)
    });
    let error = draw_training(Path::new("no/such")).expect_err("no metrics");
    assert!(
        error.to_string().starts_with("metrics no/such/metrics.csv"),
        "{error}"
    );
}
