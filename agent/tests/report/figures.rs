//! Charts of usual and unusual results. The files stay in `target/tmp/report`, so that people can look at them.

use super::synthetic::{ladder, noise, run, teams};
use emberwatch_agent::benchmark::report::figures::FIRE_CELLS_PER_STEP as LABEL;
use emberwatch_agent::benchmark::report::training::{FIGURE, draw_training};
use emberwatch_agent::benchmark::report::{draw_ladder, draw_rewards, draw_teams};
use emberwatch_agent::charts::{Bar, Curve, Ladder, Lines, Panel, Point, RGBColor, Scale};
use roxmltree::Document;
use std::path::{Path, PathBuf};

fn target(name: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("report");
    std::fs::create_dir_all(&directory).expect("target is writable");
    directory.join(format!("{name}.svg"))
}

/// Checks that a page is XML, that everything lies on it, and that it contains the texts. A text's letters count as half
/// as wide as the text size.
fn check_page(svg: &str, texts: &[&str]) {
    let document = Document::parse(svg).expect("XML");
    let size: Vec<f64> = numbers(document.root_element().attribute("viewBox")).collect();
    let mut found = Vec::new();
    for node in document.root_element().descendants().skip(1) {
        let number = |name| numbers(node.attribute(name)).next().unwrap_or(0.0);
        let (x, y) = (number("x") + number("cx"), number("y") + number("cy"));
        let text = node.text().unwrap_or_default().trim();
        let length = text.chars().count() as f64 * 0.5 * number("font-size");
        let left = match node.attribute("text-anchor") {
            Some("end") => x - length,
            Some("middle") => x - length / 2.0,
            _ => x,
        };
        let (right, bottom) = (left + length + number("width"), y + number("height"));
        let points = numbers(node.attribute("points")).chain([left, y, right, bottom]);
        for point in points.collect::<Vec<_>>().chunks(2) {
            let is_on_page =
                (0.0..=size[2]).contains(&point[0]) && (0.0..=size[3]).contains(&point[1]);
            assert!(is_on_page, "{point:?} {node:?}");
        }
        found.push(text);
    }
    for text in texts {
        assert!(
            found.iter().any(|it| it.starts_with(text)),
            "{text}: {found:?}"
        );
    }
}

fn numbers(text: Option<&str>) -> impl Iterator<Item = f64> + '_ {
    let words = text.unwrap_or_default().split([' ', ',']);
    words.flat_map(|word| word.parse())
}

/// Draws a file twice, and checks that both are equal and have the texts.
fn check(name: &str, texts: &[&str], draw: impl Fn(&Path) -> anyhow::Result<()>) {
    let path = target(name);
    let [first, second] = [(), ()].map(|()| {
        draw(&path).expect("drawn");
        std::fs::read_to_string(&path).expect("a file")
    });
    assert_eq!(first, second);
    check_page(&first, texts);
}

#[test]
fn charts_of_results_have_all_names() {
    let names = [LABEL, "random walk", "oracle beam", "a very long name"];
    for n_worlds in [1, 8] {
        check("ladder", &names, |path| {
            draw_ladder(path, &ladder(n_worlds, 100), LABEL)
        });
    }
    for (name, n_steps) in [("rewards", 1500), ("rewards_one_step", 1)] {
        check(name, &names, |path| {
            draw_rewards(path, &ladder(2, n_steps), LABEL)
        });
    }
    check("teams", &["robots", "alone", "joint"], |path| {
        draw_teams(path, &teams(3), LABEL)
    });
    // If all runs have the same number of robots, there is no curve to draw.
    let never = target("teams_never");
    draw_teams(&never, &ladder(2, 4), LABEL).expect("nothing to draw");
    assert!(!never.exists());
}

const HOSTILE: &str = "</text><script>&amp;\u{1}\"'";

#[test]
fn unusual_values_and_names_are_drawn_or_omitted() {
    let long = || "a very long name ".repeat(40);
    for value in [f64::NAN, f64::INFINITY, f64::MAX, -1e99, 2e-99, 0.0] {
        let bar = |name: &str| Bar {
            name: name.into(),
            remark: long(),
            label: long(),
            kind: ("added", RGBColor(0, 114, 178)),
            value,
            ends: Some([0.0, value]),
            worlds: vec![(1, value), (2, 1.0)],
        };
        let page = Ladder {
            title: long(),
            note: long(),
            axis: long(),
            bars: vec![bar(HOSTILE), bar(&long())],
        };
        check_page(&page.svg().expect("drawn"), &["</text>", "a very"]);
        let points = [(0.0, value), (value, 1.0), (5.0, 2.0)];
        let point = |&(x, y): &(f64, f64)| Point { x, y, error: value };
        let curve = |name: &str| Curve {
            name: name.into(),
            points: points.iter().map(point).collect(),
        };
        let panel = |scale, curves| Panel {
            title: long(),
            scale,
            curves,
        };
        let [linear, logarithmic] = [Scale::Linear, Scale::Logarithmic]
            .map(|scale| panel(scale, vec![curve(HOSTILE), curve(&long())]));
        let mut page = Lines {
            title: HOSTILE.into(),
            note: long(),
            axis: long(),
            panels: vec![linear, logarithmic, panel(Scale::Linear, Vec::new())],
        };
        check_page(&page.svg().expect("points"), &["</text>", "a very"]);
        page.panels.drain(..2);
        page.svg().expect_err("no points");
    }
}

#[test]
fn results_that_cannot_be_drawn_are_errors() {
    let path = target("never");
    let one = [run("beam", "truth", 3, 1.0)];
    let nowhere = Path::new("/nonexistent/a.svg");
    for (drawn, words) in [
        (draw_rewards(&path, &one, LABEL), "expected points"),
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
    assert_eq!(FIGURE, "training.svg");
    let texts = [
        "reward per world step",
        "world steps, of all",
        "DQN loss",
        "model / DQN",
    ];
    check("training/training", &texts, |_| draw_training(&folder));
    let error = draw_training(Path::new("no/such"))
        .expect_err("no metrics")
        .to_string();
    assert!(error.starts_with("metrics no/such/metrics.csv"), "{error}");
}
