use super::*;
use crate::KernelEntry;

#[test]
fn built_in_models_have_their_names_and_fit_the_grid() {
    let shape = Shape::new(64, 64).expect("test shape");
    for name in Model::built_in_names() {
        let model = Model::built_in(name).expect(name);
        assert_eq!(model.name(), name);
        assert_eq!(model.check_on(shape), Ok(()), "{name}");
    }
    assert_eq!(Model::built_in("wildfire-dense"), None);
}

#[test]
fn the_built_in_model_has_the_published_parameters() {
    // Factors g = 0.1, a0 = 0.9999, a1 = 0.99992, a2 = 0.999; the authors' kernel.
    let model = Model::wildfire();
    let around = [[0.1, 0.1, 0.1], [0.1, 1.0, 0.1], [0.1, 0.1, 0.1]];
    let drift = [[0.12, 0.12, 0.12], [0.1, 1.0, 0.1], [0.08, 0.08, 0.08]];
    let blocks = [
        (0, 0, 0.9999, around),
        (0, 2, 1.0 - 0.9999, around),
        (1, 1, 0.99992, around),
        (1, 0, 1.0 - 0.99992, around),
        (2, 1, 1.0 - 0.999, around),
        (2, 2, 0.999, drift),
    ];
    let mut expected = Array4::<f64>::zeros((3, 3, 3, 3));
    for (to, from, scale, block) in blocks {
        for (row, values) in block.iter().enumerate() {
            for (col, value) in values.iter().enumerate() {
                expected[[to, from, row, col]] = scale * value;
            }
        }
    }
    assert!((&expected - model.kernel()).iter().all(|d| d.abs() < 1e-12));
    assert_eq!(model.likelihood().row(1).to_vec(), [0.80, 0.15, 0.05]);
    assert_eq!(model.initial().to_vec(), [0.99, 0.01, 0.0]);
    assert_eq!(model.target_state(), 2);
}

fn check(change: impl FnOnce(&mut ModelFile), expected: &str) {
    let mut file = Model::wildfire().file;
    change(&mut file);
    let error = Model::new(file)
        .expect_err("the change must be rejected")
        .to_string();
    assert!(
        error.contains(expected),
        "{error:?} does not say {expected:?}"
    );
}

#[test]
fn wrong_entries_are_rejected_by_name() {
    check(|f| f.states.truncate(1), "expected 2 to 64 states, got 1");
    check(
        |f| f.states[1].name = "normal".into(),
        "state name \"normal\" stands twice",
    );
    check(
        |f| f.kernel[0].weights[0][1] = -0.1,
        "kernel from \"normal\" to \"normal\": expected finite weights >= 0, got -0.",
    );
    check(
        |f| f.states[0].name = "explore".into(),
        "state name: expected letters, digits, '-' and '_', and none of",
    );
    check(|f| f.kernel[0].scale = f64::NAN, "got NaN");
    check(|f| f.kernel[0].to = "ash".into(), "names state \"ash\"");
    check(
        |f| f.edge = Some("sea".into()),
        "edge: expected the name of a state, one of [\"normal\", \"latent\", \"fire\"], got \"sea\"",
    );
    check(|f| f.kernel_size = [3, 5], "expected 3 rows of 5 weights");
    check(
        |f| f.kernel_size = [2, 3],
        "two odd numbers up to 15, got [2, 3]",
    );
    check(
        |f| f.states[2].observed_as = vec![0.5, 0.4, 0.0],
        "observed_as: expected a sum of 1, got 0.9",
    );
    check(
        |f| f.states[2].observed_as = vec![1.0],
        "expected 3 probabilities",
    );
    check(
        |f| f.states[0].initial = 0.5,
        "initial: expected a sum of 1, got 0.51",
    );
    check(|f| f.states[0].bias = -1.0, "state \"normal\": bias");
    check(
        |f| f.states[0].color = "red".into(),
        "expected #rrggbb, got red",
    );
    check(|f| f.states[0].color = "#+1+2+3".into(), "got #+1+2+3");
    check(
        |f| f.kernel.push(f.kernel[0].clone()),
        "expected one entry for each pair of states, got two",
    );
}

#[test]
fn numbers_too_large_or_too_small_to_compute_with_are_rejected() {
    let around = "0, or a size of 1e-100 to 1e100";
    for (number, shown) in [(1e101, "e101"), (1e-320, "e-320")] {
        check(|f| f.states[0].bias = number, around);
        check(|f| f.states[2].reward = -number, shown);
        check(|f| f.kernel[0].weights[1][1] = number, around);
    }
    // Each factor is in range, their product vanishes.
    check(
        |f| {
            f.kernel[0].scale = 1e-99;
            f.kernel[0].weights = vec![vec![1e-99; 3]; 3];
        },
        "kernel from \"normal\" to \"normal\": expected 0, or a size of",
    );
}

#[test]
fn weights_that_can_vanish_beside_the_largest_are_rejected() {
    let mut file = Model::wildfire().file;
    for entry in file.kernel.iter_mut().filter(|e| e.from == "latent") {
        entry.scale *= 1e-31;
    }
    let shape = Shape::new(4, 4).expect("test shape");
    let error = Model::new(file.clone()).expect("valid until a grid is named");
    let error = error.check_on(shape).expect_err("a cell among latent ones");
    assert!(
        matches!(error, ModelError::FaintWeight { share, .. } if share > 0.0),
        "{error}"
    );
    file.states[0].bias = 1e-6;
    let rescued = Model::new(file).expect("valid");
    assert_eq!(rescued.check_on(shape), Ok(()));
}

#[test]
fn zero_sums_of_weights_are_rejected_where_the_grid_allows_them() {
    let mut file = Model::wildfire().file;
    for entry in &mut file.kernel {
        entry.weights[1][1] = 0.0;
    }
    let model = Model::new(file).expect("valid until a grid is named");
    let shape = |height, width| Shape::new(height, width).expect("test shape");
    assert_eq!(model.check_on(shape(5, 9)), Ok(()));
    let error = model
        .check_on(shape(1, 1))
        .expect_err("a cell without neighbours");
    assert!(error.to_string().contains("cell (0, 0)"), "{error}");
    assert_eq!(Model::wildfire().check_on(shape(1, 1)), Ok(()));
}

#[test]
fn kernels_of_own_states_are_checked() {
    let check = |change: fn(&mut ModelFile), expected: &str| {
        let mut file = burnout().file;
        change(&mut file);
        let error = Model::new(file).and_then(|model| {
            let shape = Shape::new(2, 2).expect("test shape");
            model.check_on(shape)
        });
        let error = error.expect_err(expected).to_string();
        assert!(
            error.contains(expected),
            "{error:?} does not say {expected:?}"
        );
    };
    check(
        |f| f.kernel[1].own = None,
        "kernel: expected own in every entry, or in none, got 7 of 8",
    );
    check(
        |f| f.kernel[1].own = Some("ash".into()),
        "names state \"ash\"",
    );
    check(
        |f| f.kernel.push(f.kernel[7].clone()),
        "kernel of \"burnt\" from \"burnt\" to \"unburnt\": expected one entry for each",
    );
    check(|f| f.kernel[2].scale = -1.0, "expected finite weights >= 0");
    // Burning cells have no weight left; those of others in the centre are no help.
    check(
        |f| {
            f.kernel
                .retain(|entry| entry.own.as_deref() != Some("burning"));
            let unburnt = f.kernel[0].clone();
            f.kernel.push(KernelEntry {
                own: Some("burning".into()),
                ..unburnt
            });
        },
        "transition weights of cell (0, 0) can sum to zero",
    );
}

fn burnout() -> Model {
    Model::built_in("wildfire-burnout").expect("built in")
}

#[test]
fn a_model_file_survives_toml() {
    for model in [Model::wildfire(), burnout()] {
        let text = toml::to_string(model.file()).expect("models serialise");
        assert_eq!(Model::from_toml(&text), Ok(model));
    }
    assert!(matches!(
        Model::from_toml("name = 3"),
        Err(ModelError::Toml(_))
    ));
}
