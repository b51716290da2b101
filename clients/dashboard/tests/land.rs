//! Tests of the data that pages receive about zones, no-fly cells and sensors.

use crate::server_info;
use emberwatch_dashboard::scene::Info;
use emberwatch_protocol::Airspace;
use serde_json::{Value, json};

fn info(keys: Value) -> Info {
    Info::new(&server_info(keys))
}

#[test]
fn land_and_sensor_are_told() {
    let zones = json!({"names": ["a", "b"], "colors": ["#000000", "#ffffff"], "map": [[0, 1, 1], [0, 0, 1]]});
    let no_fly = [0, 0, 1, 0, 0, 0];
    let airspace = json!({"radius": 2, "no_fly": [no_fly[..3], no_fly[3..]]});
    let info = info(json!({"airspace": airspace, "zones": zones}));
    let zones: Vec<u8> = info.zone_map.iter().flatten().copied().collect();
    assert_eq!(zones, [0, 1, 1, 0, 0, 1]);
    let map = info.airspace.as_ref().and_then(Airspace::no_fly);
    let map = map.expect("no-fly cells").mapv(u8::from);
    assert_eq!(map.into_raw_vec_and_offset().0, no_fly);
    let told = serde_json::to_value(&info).expect("JSON");
    assert_eq!(told["radius"], json!(2));
    assert_eq!(told["zones"], json!(["a", "b"]));
    assert!(told.get("zone_map").is_none(), "maps go as arrays");
}

#[test]
fn land_of_another_grid_counts_as_none() {
    let zones = json!({"names": ["a"], "colors": ["#000000"], "map": [[0, 0]]});
    let airspace = json!({"radius": 9});
    let told = info(json!({"airspace": airspace, "zones": zones}));
    assert_eq!((&told.zone_map, &told.airspace), (&None, &None));
    let told = serde_json::to_value(&told).expect("JSON");
    assert_eq!(told["zones"], Value::Null);
}
