//! Charts of unusual data: they must be valid XML, and all text must be on the page.

use emberwatch_figures::{Bar, Color, Curve, Ladder, Lines, MAX_CURVES, Panel, Scale, Shade};
use roxmltree::Document;

const BLUE: Color = Color(0x00, 0x72, 0xb2);

/// Checks for valid XML, finite numbers, and texts at least 19 points from the left and right edges. Returns the texts.
fn check(svg: &str) -> Vec<String> {
    assert!(!svg.contains("NaN") && !svg.contains("inf\""), "{svg}");
    let document = Document::parse(svg).expect("XML");
    let texts = document.descendants().filter(|it| it.has_tag_name("text"));
    let texts = texts.map(|text| {
        let number = |name| -> f64 {
            let number = text.attribute(name).and_then(|text| text.parse().ok());
            number.expect("a number")
        };
        let (x, width) = (number("x"), number("textLength"));
        assert!(x >= 20.0 && x + width <= 1181.0, "{x} {width} {text:?}");
        text.text().unwrap_or_default().to_owned()
    });
    texts.collect()
}

fn bar(name: &str, value: f64) -> Bar {
    Bar {
        name: name.into(),
        remark: " (known model)".into(),
        label: "a value".into(),
        color: BLUE,
        value,
        ends: Some([0.9 * value, 1.1 * value]),
        worlds: vec![(3, value), (4, value * 1.2)],
    }
}

fn ladder(bars: Vec<Bar>) -> Ladder {
    Ladder {
        title: "Reward of each policy".into(),
        note: "bars are means".into(),
        axis: "cells".into(),
        legend: vec![("no belief", BLUE)],
        bars,
    }
}

#[test]
fn ladders_with_zero_one_and_many_bars() {
    for n_bars in [0, 1, 100] {
        let bars = (0..n_bars).map(|at| bar(&format!("policy {at}"), f64::from(at) - 50.0));
        let texts = check(&ladder(bars.collect()).svg());
        let n_named = texts
            .iter()
            .filter(|text| text.starts_with("policy"))
            .count();
        assert_eq!(n_named as i32, n_bars);
        assert_eq!(texts.contains(&"a value".into()), n_bars > 0);
    }
}

#[test]
fn a_row_without_a_value_shows_only_its_worlds() {
    let n_dots = |bar: Bar| ladder(vec![bar]).svg().matches("<circle").count();
    let mut row = bar("beam", 40.0);
    let of_two = n_dots(row.clone());
    (row.value, row.ends) = (f64::NAN, None);
    assert_eq!(n_dots(row.clone()), of_two);
    row.worlds.truncate(1);
    assert_eq!(n_dots(row), of_two / 2);
}

#[test]
fn names_are_escaped_and_shortened() {
    let long = "a very long name ".repeat(40);
    let hostile = "</text><script>&amp;\u{1}\"'";
    let mut page = ladder(vec![bar(&long, 1.0), bar(hostile, 2.0)]);
    page.bars[0].remark = long.clone();
    page.bars[1].label = long.clone();
    let curves = vec![Curve::new(&long, vec![(0.0, 1.0), (9.0, 2.0)])];
    let mut lines = lines(vec![panel(&long, Scale::Linear, curves)]);
    for text in [
        &mut page.title,
        &mut page.axis,
        &mut page.note,
        &mut lines.title,
        &mut lines.note,
        &mut lines.axis,
    ] {
        text.clone_from(&long);
    }
    let texts = check(&page.svg());
    assert!(texts.contains(&hostile.replace('\u{1}', " ")));
    assert!(texts.iter().filter(|text| text.ends_with('…')).count() >= 5);
    check(&lines.svg().expect("a point"));
}

#[test]
fn extreme_values_are_drawn_or_omitted() {
    for value in [f64::NAN, f64::INFINITY, f64::MAX, f64::MIN_POSITIVE, -1e150] {
        let mut other = bar("error", 2.0);
        (other.ends, other.worlds) = (Some([0.0, 2.0 * value]), vec![(1, value), (2, 1.0)]);
        check(&ladder(vec![bar("value", value), other, bar("usual", 3.0)]).svg());
        for scale in [Scale::Linear, Scale::Logarithmic] {
            let points = vec![(0.0, value), (value, 1.0), (5.0, 2.0)];
            let mut curve = Curve::new("extreme", points.clone());
            curve.errors = vec![value, 1.0, value];
            let mut panel = panel("extreme", scale, vec![curve]);
            let name = "shaded".into();
            panel.shade = Some(Shade { name, points });
            check(&lines(vec![panel]).svg().expect("a point"));
        }
    }
}

fn panel(title: &str, scale: Scale, curves: Vec<Curve>) -> Panel {
    Panel {
        title: title.into(),
        scale,
        curves,
        shade: None,
    }
}

fn lines(panels: Vec<Panel>) -> Lines {
    Lines {
        title: "Curves".into(),
        note: "small print".into(),
        axis: "step k".into(),
        panels,
    }
}

#[test]
fn panels_without_points_are_omitted() {
    let curve = |name: &str, y: f64| Curve::new(name, vec![(0.0, y), (1.0, y)]);
    assert_eq!(lines(Vec::new()).svg(), None);
    let none = panel("none", Scale::Logarithmic, vec![curve("negative", -1.0)]);
    assert_eq!(lines(vec![none.clone()]).svg(), None);
    let some = panel(
        "some",
        Scale::Linear,
        vec![curve("here", -1.0), Curve::new("empty", vec![])],
    );
    let texts = check(&lines(vec![none, some]).svg().expect("a point"));
    assert!(texts.contains(&"here".into()));
    assert!(!texts.contains(&"none".into()) && !texts.contains(&"empty".into()));
}

#[test]
fn extra_curves_are_omitted_and_single_points_are_drawn() {
    let curve = |at: usize| Curve::new(&format!("curve {at}"), vec![(1.0, 7.0)]);
    let all = panel("all", Scale::Linear, (0..20).map(curve).collect());
    let other = panel("one", Scale::Linear, vec![curve(20)]);
    for panels in [vec![all.clone()], vec![all, other]] {
        let svg = lines(panels).svg().expect("a point");
        let texts = check(&svg);
        assert!(texts.contains(&format!("curve {}", MAX_CURVES - 1)));
        assert!(!texts.contains(&format!("curve {MAX_CURVES}")));
        assert!(svg.matches("<circle").count() >= MAX_CURVES);
    }
}

#[test]
fn a_logarithmic_band_omits_edges_that_are_not_positive() {
    let points = (0..10).map(|x| (f64::from(x), 1.0)).collect();
    let mut curve = Curve::new("rate", points);
    curve.errors = (0..10).map(|x| f64::from(x) / 4.0).collect();
    for (scale, n_edges) in [(Scale::Linear, 20), (Scale::Logarithmic, 8)] {
        let svg = lines(vec![panel("rate", scale, vec![curve.clone()])]).svg();
        let svg = svg.expect("a point");
        check(&svg);
        let document = Document::parse(&svg).expect("XML");
        let band = document
            .descendants()
            .find(|node| node.has_tag_name("polygon"));
        let edges = band
            .and_then(|band| band.attribute("points"))
            .map(|it| it.matches(',').count());
        assert_eq!(edges, Some(n_edges), "{scale:?}");
    }
}
