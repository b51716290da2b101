//! The least and the greatest value of each number among the settings.

use emberwatch_messages::capacity::{MAX_ROBOTS, MAX_WORLDS};
use emberwatch_model::MAX_RADIUS;
use emberwatch_model::grid::MAX_SIDE;
use emberwatch_model::path::MAX_MOVES;

/// Milliseconds.
const DAY: i128 = 86_400_000;

/// Any number of 64 bits.
const ANY: i128 = u64::MAX as i128;

/// By the name of the setting. A `sensor_radius` of -1 is the model's own.
pub const BOUNDS: [(&str, i128, i128); 16] = [
    ("worlds", 1, MAX_WORLDS as i128),
    ("moves", 1, MAX_MOVES as i128),
    ("sensor_radius", -1, MAX_RADIUS as i128),
    ("height", 1, MAX_SIDE as i128),
    ("width", 1, MAX_SIDE as i128),
    ("robots", 1, MAX_ROBOTS as i128),
    ("deadline_millis", 0, DAY),
    ("lease_millis", 100, DAY),
    ("threads", 0, 256),
    ("burn_in", 0, 1 << 40),
    ("history", 1, 1_000_000),
    ("snapshot_keep", 1, 1_000_000),
    ("states_offset", 0, ANY),
    ("seed", 0, ANY),
    ("max_steps", 0, ANY),
    ("snapshot_every", 0, ANY),
];
