//! What comes from outside is hostile: every decoder gives an error or a valid value, never a panic. What bytes can be
//! damaged to, and what must hold of what is decoded, is in `tests/src/fuzz/`.

use emberwatch_messages::control::{Reply, Request};
use emberwatch_messages::message::{FrameHeader, RobotResult, WorldResult};
use emberwatch_messages::payload::split_frame_payload;
use proptest::collection::vec;
use proptest::prelude::*;

proptest! {
    // No file of failures: tests leave the source tree alone.
    #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

    #[test]
    fn a_sample_splits_only_at_its_exact_length(
        side in (0u32..3, 0u32..3),
        n_moves in vec(prop_oneof![9 => 0u32..4, 1 => any::<u32>()], 0..4),
        n_robots in prop_oneof![9 => Just(None), 1 => any::<u32>().prop_map(Some)],
        stayed in prop_oneof![9 => 0u64..2, 1 => any::<u64>()],
        excess in 0usize..3,
    ) {
        let n_robots = n_robots.unwrap_or(n_moves.len() as u32);
        let result = WorldResult { late: stayed, ..WorldResult::default() };
        let (height, width) = side;
        let header = FrameHeader { n_robots, height, width, result, ..FrameHeader::default() };
        let results: Vec<RobotResult> = n_moves
            .iter()
            .map(|&n_moves| RobotResult { n_moves, ..RobotResult::default() })
            .collect();
        let n_cells = (height * width) as usize;
        let n_flown: usize = n_moves.iter().map(|&n_moves| n_moves as usize % 300).sum();
        let behind = vec![1; n_moves.len() * n_cells + n_flown + excess];
        let payload = [bytemuck::cast_slice(&results), &behind].concat();
        let is_whole = n_robots > 0 && n_robots as usize == n_moves.len() && n_cells > 0;
        let is_short = n_moves.iter().all(|&n_moves| n_moves < 300);
        let is_good = is_whole && is_short && excess == 0 && stayed < 1 << n_moves.len();
        let robots = split_frame_payload(&header, &payload);
        prop_assert_eq!(robots.is_ok(), is_good, "{:?}", robots);
        for (robot, n_moves) in robots.into_iter().flatten().zip(n_moves) {
            let lengths = (robot.frame.len(), robot.path.len());
            prop_assert_eq!(lengths, (n_cells, n_moves as usize));
        }
    }
}

#[test]
fn nesting_as_deep_as_a_message_can_be_is_refused() {
    for (open, close) in [("[", "]"), (r#"{"a":"#, "}")] {
        let deep = open.repeat(200_000) + &close.repeat(200_000);
        let inside = format!(r#"{{"op":"reset","lease":1,"worlds":{deep}}}"#);
        for text in [deep, inside] {
            assert!(serde_json::from_str::<Request>(&text).is_err());
            assert!(serde_json::from_str::<Reply>(&text).is_err());
        }
    }
}
