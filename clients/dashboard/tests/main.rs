//! All tests in one program, because each further program would link the crate again.

use emberwatch_protocol::control::ServerInfo;
use serde_json::{Value, json};

mod land;
mod pictures;
mod player;

/// Returns the description of a server with a 2 x 3 world. `keys` replace keys of the description.
fn server_info(keys: Value) -> ServerInfo {
    let mut info = json!({
        "protocol": 3, "build": "0.1.0", "pid": 1, "height": 2, "width": 3, "n_moves": 1, "n_worlds": 1, "n_robots": 1,
        "n_observations": 2, "observations": ["calm", "fire"], "model": null,
        "burn_in": 0, "max_steps": 0, "max_clients": 16, "coverage": "path", "publish_truth": false,
        "lease_millis": 30_000, "deadline_millis": 0,
    });
    let all = info.as_object_mut().expect("an object");
    all.extend(keys.as_object().expect("an object").clone());
    serde_json::from_value(info).expect("what a server says")
}
