//! All integration tests in one program: separate programs would each link the crate.

mod lease;
mod payload;
mod recording;

use emberwatch_messages::control::ServerInfo;

/// Returns the settings of a server with two robots in each world.
fn server(height: usize, width: usize, n_moves: usize, n_worlds: u32) -> ServerInfo {
    let text = r#"{"protocol": 3, "build": "0.1.0", "pid": 7, "height": 0, "width": 0, "n_moves": 0, "n_worlds": 0,
        "n_robots": 2, "n_observations": 3, "observations": ["normal", "latent", "fire"], "model": null, "burn_in": 20,
        "max_steps": 0, "max_clients": 16, "coverage": "path", "publish_truth": true, "lease_millis": 30000,
        "deadline_millis": 0, "recorded_world": null, "task": null}"#;
    let mut info: ServerInfo = serde_json::from_str(text).expect("a server's settings");
    (info.height, info.width) = (height, width);
    (info.n_moves, info.n_worlds) = (n_moves, n_worlds);
    info
}
