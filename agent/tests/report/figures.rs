//! Charts of usual and unusual results.

use super::synthetic::{ladder, noise, run, teams};
use emberwatch_agent::benchmark::report::figures::FIRE_CELLS_PER_STEP as LABEL;
use emberwatch_agent::benchmark::report::training::{FIGURE, draw_training};
use emberwatch_agent::benchmark::report::{draw_ladder, draw_rewards, draw_teams};
use emberwatch_agent::charts::{Bar, Curve, Ladder, Lines, Panel, Point, RGBColor, Scale};
use roxmltree::Document;
use std::path::Path;

/// Checks that a page is XML, that everything lies on it, and that it contains the texts.
fn check_page(svg: &str, texts: &[&str]) {
    let document = Document::parse(svg).expect("XML");
    let size: Vec<f64> = numbers(document.root_element().attribute("viewBox")).collect();
    let mut found = Vec::new();
    for node in document.root_element().descendants().skip(1) {
        let number = |name| numbers(node.attribute(name)).next().unwrap_or(0.0);
        let text = node.text().unwrap_or_default().trim();
        // Letters count as half as wide as the text size.
        let length = text.chars().count() as f64 * 0.5 * number("font-size");
        let before = match node.attribute("text-anchor") {
            Some("end") => length,
            Some("middle") => length / 2.0,
            _ => 0.0,
        };
        let left = number("x") + number("cx") - before;
        let top = number("y") + number("cy");
        let end = [left + length + number("width"), top + number("height")];
        let points = numbers(node.attribute("points"))
            .chain([left, top])
            .chain(end);
        for point in points.collect::<Vec<_>>().chunks(2) {
            let is_on_page = point
                .iter()
                .zip(&size[2..])
                .all(|(at, side)| (0.0..=*side).contains(at));
            assert!(is_on_page, "{point:?} {node:?}");
        }
        found.push(text);
    }
    for text in texts {
        let is_there = found.iter().any(|it| it.starts_with(text));
        assert!(is_there, "{text}: {found:?}");
    }
}

fn numbers(text: Option<&str>) -> impl Iterator<Item = f64> + '_ {
    let words = text.unwrap_or_default().split([' ', ',']);
    words.flat_map(|word| word.parse())
}

fn check_file(path: &Path, texts: &[&str]) {
    check_page(&std::fs::read_to_string(path).expect("a file"), texts);
}

#[test]
fn charts_of_results_have_all_names() {
    let names = [LABEL, "random walk", "oracle beam", "a very long name"];
    let folder = tempfile::tempdir().expect("a folder");
    let [path, never] = ["chart.svg", "never.svg"].map(|name| folder.path().join(name));
    for n_worlds in [1, 8] {
        draw_ladder(&path, &ladder(n_worlds, 100), LABEL).expect("drawn");
        check_file(&path, &names);
    }
    for n_steps in [1500, 1] {
        draw_rewards(&path, &ladder(2, n_steps), LABEL).expect("drawn");
        check_file(&path, &names);
    }
    draw_teams(&path, &teams(3), LABEL).expect("drawn");
    check_file(&path, &["robots", "alone", "joint"]);
    // If all runs have the same number of robots, there is no curve to draw.
    draw_teams(&never, &ladder(2, 4), LABEL).expect("nothing to draw");
    assert!(!never.exists());
    let error = draw_rewards(&never, &[run("beam", "truth", 3, 1.0)], LABEL).expect_err("no step");
    assert!(error.to_string().contains("expected points"), "{error}");
    let error = draw_ladder(Path::new("/no/a.svg"), &ladder(1, 4), LABEL).expect_err("no folder");
    assert!(error.to_string().contains("write /no"), "{error}");
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
        let curve = |name: &str| Curve {
            name: name.into(),
            points: [(0.0, value), (value, 1.0), (5.0, 2.0)]
                .map(|(x, y)| Point { x, y, error: value })
                .into(),
        };
        let panel = |scale, names: &[&str]| Panel {
            title: long(),
            scale,
            curves: names.iter().map(|name| curve(name)).collect(),
        };
        let names = [HOSTILE, &long()];
        let mut page = Lines {
            title: HOSTILE.into(),
            note: long(),
            axis: long(),
            panels: vec![
                panel(Scale::Linear, &names),
                panel(Scale::Logarithmic, &names),
                panel(Scale::Linear, &[]),
            ],
        };
        check_page(&page.svg().expect("points"), &["</text>", "a very"]);
        page.panels.drain(..2);
        page.svg().expect_err("no points");
    }
}

#[test]
fn a_training_is_drawn_from_its_metrics() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let mut text =
        "update,world_steps,loss,held_out_log_likelihood,mean_reward,rate,dqn_loss,dqn_rate\n"
            .to_owned();
    for row in 0..2000_u64 {
        let [loss, reward, dqn_loss] = [(1, 0.5), (2, 7.0), (3, 1.0)]
            .map(|(seed, mean)| (mean + noise(seed, row)).to_string());
        let loss = if row < 500 { String::new() } else { loss };
        text += &format!("{row},{row},{loss},-0.4,{reward},1e-4,{dqn_loss},0.01\n");
    }
    std::fs::write(folder.join("metrics.csv"), text).expect("written");
    draw_training(folder).expect("drawn");
    let texts = [
        "reward per world step",
        "world steps, of all",
        "DQN loss",
        "model / DQN",
    ];
    check_file(&folder.join(FIGURE), &texts);
    let error = draw_training(Path::new("no/such"))
        .expect_err("no metrics")
        .to_string();
    assert!(error.starts_with("metrics no/such/metrics.csv"), "{error}");
}
