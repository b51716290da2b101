//! Tests of the data that pages receive about maps, no-fly cells and sensors.

use crate::server_info;
use emberwatch_dashboard::scene::Info;
use emberwatch_protocol::model::MapsEntry;
use emberwatch_protocol::{Airspace, Model};
use ndarray::{ArrayD, arr2};
use serde_json::{Value, json};

fn info(keys: Value) -> Info {
    Info::new(&server_info(keys))
}

#[test]
fn land_and_sensor_are_told() {
    let no_fly = [0, 0, 1, 0, 0, 0];
    let airspace = json!({"radius": 2, "no_fly": [no_fly[..3], no_fly[3..]]});
    let told = info(json!({"airspace": airspace}));
    let map = told.airspace.as_ref().and_then(Airspace::no_fly);
    let map = map.expect("no-fly cells").mapv(u8::from);
    assert_eq!(map.into_raw_vec_and_offset().0, no_fly);
    let told = serde_json::to_value(&told).expect("JSON");
    assert_eq!(told["radius"], json!(2));
    assert_eq!(told["maps"], json!([]));
    assert!(told.get("levels").is_none(), "maps go as arrays");
    assert_eq!(info(json!({"airspace": {"radius": 9}})).airspace, None);
}

#[test]
fn maps_of_a_revealed_model_are_told() {
    let mut file = Model::built_in("wildfire-burnout")
        .expect("built in")
        .file()
        .clone();
    let fuel = arr2(&[[0.5, 1.0, 1.5], [0.5, 0.5, 2.5]]).into_dyn();
    let wind = ArrayD::from_shape_fn(vec![3, 3, 2, 3], |at| {
        // The centre does not count.
        if (at[0], at[1]) == (1, 1) {
            100.0
        } else {
            (at[0] * at[3]) as f32
        }
    });
    let maps = [("fuel".to_owned(), fuel), ("wind".to_owned(), wind)];
    file.maps = Some(MapsEntry::packed(&maps.into()));
    file.transitions[0].times = vec!["fuel".into(), "wind".into()];
    let model = toml::to_string(&file).expect("TOML");
    let told = info(json!({"model": model}));
    let levels: Vec<Vec<u8>> = told
        .levels
        .iter()
        .map(|map| map.iter().copied().collect())
        .collect();
    assert_eq!(
        levels,
        [[0, 63, 127, 0, 0, 255], [0, 127, 255, 0, 127, 255]]
    );
    let told = serde_json::to_value(&told).expect("JSON");
    let expected =
        json!([{"name": "fuel", "range": [0.5, 2.5]}, {"name": "wind", "range": [0.0, 2.0]}]);
    assert_eq!(told["maps"], expected);
}
