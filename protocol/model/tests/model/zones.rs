//! Land whose kernels differ from zone to zone, against the formula as it stands in docs/model-file.md.

use super::models::{
    check_draws, check_predictions, one_hot, random_belief, random_model, random_own_model,
    random_states, shape,
};
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{CellMap, KernelEntry, ModelFile, ZoneEntry};
use emberwatch_model::{Dynamics, Model};
use ndarray::Array3;
use proptest::prelude::*;

fn zone_entry(zone: usize) -> ZoneEntry {
    ZoneEntry {
        name: format!("z{zone}"),
        color: "#808080".into(),
    }
}

/// Kernels of other models in zones that are scattered over a grid.
fn zoned(models: &[Model], key: u64, (height, width): (usize, usize)) -> Model {
    let mut file = models[0].file().clone();
    file.zones = (0..models.len()).map(zone_entry).collect();
    let zone = |row: usize, col: usize| (split_mix(key, (row * width + col) as u64) >> 9) as usize;
    let rows = (0..height).map(|row| {
        let cells = (0..width).map(|col| (zone(row, col / 3) % models.len()) as u8);
        cells.collect()
    });
    file.zone_map = Some(CellMap::Rows(rows.collect()));
    let entries = models.iter().enumerate().flat_map(|(zone, model)| {
        model.file().kernel.iter().map(move |entry| KernelEntry {
            zone: Some(format!("z{zone}")),
            ..entry.clone()
        })
    });
    file.kernel = entries.collect();
    Model::new(file).expect("test models are valid")
}

/// `p`: each state's probability in each cell, from the entries of the model's file that hold in the cell's zone.
fn formula(model: &Model, p: &Array3<f64>) -> Array3<f64> {
    let file = model.file();
    let (n_states, height, width) = p.dim();
    let zones = model.zone_map().expect("a land");
    let state = |name: &str| model.state_named(name).expect("a state");
    let [up, left] = file.kernel_size.map(|side| side / 2);
    let mut next = Array3::zeros(p.dim());
    for (row, col) in ndarray::indices((height, width)) {
        let zone = &file.zones[usize::from(zones[[row, col]])].name;
        let owns: Vec<Option<usize>> = if model.sees_own_state() {
            (0..n_states).map(Some).collect()
        } else {
            vec![None]
        };
        for own in owns {
            let mut weights: Vec<f64> = file.states.iter().map(|state| state.bias).collect();
            for entry in &file.kernel {
                if entry.zone.as_ref() != Some(zone) || entry.own.as_deref().map(state) != own {
                    continue;
                }
                let (from, to) = (state(&entry.from), state(&entry.to));
                for (a, c) in ndarray::indices((file.kernel_size[0], file.kernel_size[1])) {
                    let x = match own {
                        Some(own) if (a, c) == (up, left) => f64::from(u8::from(own == from)),
                        _ => {
                            let at = ((row + a).wrapping_sub(up), (col + c).wrapping_sub(left));
                            p.get([from, at.0, at.1]).copied().unwrap_or(0.0)
                        }
                    };
                    weights[to] += entry.scale * entry.weights[a][c] * x;
                }
            }
            let total: f64 = weights.iter().sum();
            let share = own.map_or(1.0, |own| p[[own, row, col]]);
            for (to, weight) in weights.iter().enumerate() {
                next[[to, row, col]] += share * weight / total;
            }
        }
    }
    next
}

fn random_land(key: u64, n_states: usize, n_zones: u64, own: bool, side: (usize, usize)) -> Model {
    let of_zone = |zone| {
        if own {
            random_own_model(key + 1000 * zone, n_states, [3, 3])
        } else {
            random_model(key + 1000 * zone, n_states, [3, 3])
        }
    };
    let models: Vec<Model> = (0..n_zones).map(of_zone).collect();
    let mut file = zoned(&models, key, side).file().clone();
    // Some weights are the same in all zones.
    let n_entries = models[0].file().kernel.len();
    for at in (0..file.kernel.len()).filter(|at| (at % n_entries).is_multiple_of(3)) {
        file.kernel[at].weights = file.kernel[at % n_entries].weights.clone();
    }
    Model::new(file).expect("test models are valid")
}

#[test]
fn steps_are_drawn_from_the_formula() {
    for (own, n_states, n_zones, side, n_draws) in [
        (false, 4, 3, (7, 5), 100_000),
        (true, 4, 3, (7, 5), 100_000),
        (false, 3, 9, (3, 140), 20_000),
        (true, 3, 9, (3, 140), 20_000),
        (true, 3, 1, (4, 4), 50_000),
        // Too many weights for tables: kernels are summed.
        (true, 16, 5, (2, 3), 20_000),
    ] {
        let model = random_land(7, n_states, n_zones, own, side);
        let states = random_states(8, n_states, side);
        let expected = formula(&model, &one_hot(n_states, &states));
        check_draws(&model, &states, n_draws, &expected);
    }
}

#[test]
fn a_river_does_not_burn_and_bytes_may_be_certain() {
    let burnout = Model::built_in("wildfire-burnout").expect("built in");
    let mut river = burnout.file().clone();
    for entry in &mut river.kernel {
        let is_centre = entry.own.as_ref() == Some(&entry.from);
        entry.to = "unburnt".into();
        entry.weights = vec![
            vec![0.0; 3],
            vec![0.0, f64::from(u8::from(is_centre)), 0.0],
            vec![0.0; 3],
        ];
    }
    river.kernel.retain({
        let mut seen = Vec::new();
        move |entry| {
            let key = (entry.own.clone(), entry.from.clone());
            let is_new = !seen.contains(&key);
            seen.push(key);
            is_new
        }
    });
    let river = Model::new(river).expect("a river");
    for models in [
        vec![burnout.clone(), river.clone()],
        vec![river.clone(), river.clone(), burnout],
    ] {
        let model = zoned(&models, 3, (6, 70));
        let states = random_states(5, 3, (6, 70));
        let expected = formula(&model, &one_hot(3, &states));
        check_draws(&model, &states, 20_000, &expected);
        check_predictions(
            &model,
            &random_belief(5, 3, (6, 70)),
            &formula(&model, &random_belief(5, 3, (6, 70))),
        );
        let mut dynamics = Dynamics::new(&model, shape(6, 70)).expect("a land");
        let mut states = states;
        dynamics.step(1, 1, &mut states);
        let n_rivers = models.len() as u8 - 1;
        let zones = model.zone_map().expect("a land");
        let is_river = |zone: u8| if n_rivers == 1 { zone == 1 } else { zone < 2 };
        let cells = zones.iter().zip(&states);
        assert!(
            cells
                .filter(|(zone, _)| is_river(**zone))
                .all(|(_, state)| *state == 0)
        );
    }
}

proptest! {
    // No file of failures: tests leave the source tree alone.
    #![proptest_config(ProptestConfig { cases: 100, failure_persistence: None, ..Default::default() })]

    #[test]
    fn predictions_are_those_of_the_formula(
        key in 0_u64..1_000_000,
        n_states in 2_usize..5,
        n_zones in 1_u64..6,
        own in any::<bool>(),
        side in (1_usize..12, 1_usize..70),
    ) {
        let model = random_land(key, n_states, n_zones, own, side);
        let belief = random_belief(key, n_states, side);
        check_predictions(&model, &belief, &formula(&model, &belief));
    }
}

#[test]
fn zones_that_do_not_fit_are_refused_by_name() {
    let check = |change: &dyn Fn(&mut ModelFile), expected: &str| {
        let mut file = random_land(3, 3, 2, true, (4, 5)).file().clone();
        change(&mut file);
        let error = Model::new(file).and_then(|model| model.check_on(shape(4, 5)));
        let error = error.expect_err(expected).to_string();
        assert!(
            error.contains(expected),
            "{error:?} does not say {expected:?}"
        );
    };
    check(
        &|f| f.zone_map = None,
        "zone_map: expected the zone of each cell, got none",
    );
    check(
        &|f| f.zones.push(zone_entry(2)),
        "zone \"z2\": expected kernel entries with its name",
    );
    check(
        &|f| drop(f.zones.pop()),
        "zone: expected the name of one of `zones`, got \"z1\"",
    );
    check(
        &|f| f.kernel[3].zone = None,
        "zone: expected the name of one of `zones`, got none",
    );
    check(
        &|f| f.zones[1].name = "z0".into(),
        "zone name \"z0\" stands twice",
    );
    check(
        &|f| f.zones[1].color = "grey".into(),
        "expected #rrggbb, got grey",
    );
    let map = |rows| move |f: &mut ModelFile| f.zone_map = Some(CellMap::Rows(rows));
    let map = |rows: Vec<Vec<u8>>| move |f: &mut ModelFile| map(rows.clone())(f);
    check(
        &map(vec![vec![0; 5]; 3]),
        "zone_map: expected a map of the 4 x 5 grid, got 3 x 5",
    );
    check(
        &map(vec![vec![2; 5]; 4]),
        "zone_map: expected zones below 2, as `zones` has, got 2",
    );
    check(
        &map(vec![vec![0; 5], vec![0; 4]]),
        "zone_map: expected rows of 5 numbers, got 4",
    );
    check(&map(Vec::new()), "got 0 x 0");
    check(
        &|f| f.zone_map = Some(CellMap::File("zones.npy".into())),
        "zone_map: expected rows of numbers",
    );
    // In one zone alone a state has no weight.
    check(
        &|f| {
            let is_of = |entry: &KernelEntry| {
                entry.zone.as_deref() == Some("z1") && entry.own.as_deref() == Some("s2")
            };
            f.kernel.retain(|entry| !is_of(entry));
            f.states.iter_mut().for_each(|state| state.bias = 0.0);
        },
        "can sum to zero",
    );
    let text = toml::to_string(random_land(3, 3, 2, true, (4, 5)).file()).expect("TOML");
    assert_eq!(
        Model::from_toml(&text),
        Ok(random_land(3, 3, 2, true, (4, 5)))
    );
    let error = Model::from_toml(&text.replace("zone_map = ", "zone_map = -1 # "));
    let error = error.expect_err("no map").to_string();
    assert!(
        error.contains("rows of numbers from 0 to 255, or the name"),
        "{error}"
    );
}
