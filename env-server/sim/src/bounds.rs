//! The minimum and maximum of each numeric setting.

use emberwatch_messages::capacity::{MAX_ROBOTS, MAX_WORLDS};
use emberwatch_model::MAX_RADIUS;
use emberwatch_model::grid::MAX_SIDE;
use emberwatch_model::path::MAX_MOVES;

/// One day in milliseconds.
const DAY: i128 = 86_400_000;

/// The maximum of settings that accept any unsigned 64-bit number.
const ANY: i128 = u64::MAX as i128;

/// Name, minimum and maximum of each numeric setting. A `sensor_radius` of -1 means the radius of the model file.
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
