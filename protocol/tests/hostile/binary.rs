//! Bytes and codes: paths, frames, step answers.

use proptest::collection::vec;
use proptest::prelude::*;
use proptest::sample::select;
use protocol::frame::FrameError;
use protocol::message::{
    FLAG_TEAM_FRAMES, FrameHeader, Operation, RobotResult, Status, StepReply, UnknownCode,
    WorldResult,
};
use protocol::path::{MoveError, path_from_bytes, path_to_bytes};
use protocol::payload::{ROBOT_BYTES, WORLD_BYTES, split_frame_payload, split_step_payload};
use protocol::{Coverage, Frame, Move, Shape, UNOBSERVED};

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

    #[test]
    fn any_bytes_are_a_path_or_name_the_first_byte_that_is_no_move(
        bytes in vec(prop_oneof![9 => 0u8..4, 1 => any::<u8>()], 0..200),
    ) {
        match path_from_bytes(&bytes) {
            Ok(path) => prop_assert_eq!(path_to_bytes(&path), bytes),
            Err(MoveError { index, value }) => {
                prop_assert!(value > 3 && bytes[index] == value);
                prop_assert!(bytes[..index].iter().all(|&byte| byte < 4));
            }
        }
    }

    #[test]
    fn any_bytes_are_a_frame_or_an_error(
        side in (1usize..9, 1usize..9),
        n_observations in 0usize..300,
        bytes in vec(prop_oneof![Just(UNOBSERVED), 0u8..4, any::<u8>()], 0..90),
        fits in any::<bool>(),
    ) {
        let shape = Shape::new(side.0, side.1).expect("a small grid");
        let mut bytes = bytes;
        if fits {
            bytes.resize(shape.n_cells(), UNOBSERVED);
        }
        let valid = |&byte: &u8| byte == UNOBSERVED || usize::from(byte) < n_observations;
        match Frame::from_bytes(shape, n_observations, &bytes) {
            Ok(frame) => {
                prop_assert!(bytes.iter().all(valid));
                prop_assert_eq!(frame.as_bytes(), &bytes[..]);
            }
            Err(FrameError::Length { .. }) => prop_assert_ne!(bytes.len(), shape.n_cells()),
            Err(FrameError::Value { index, .. }) => {
                prop_assert_eq!(bytes.iter().position(|byte| !valid(byte)), Some(index));
            }
        }
    }

    #[test]
    fn a_step_payload_splits_only_at_its_exact_length(
        numbers in any::<[u32; 5]>(),
        length in 0usize..300,
    ) {
        let [n_worlds, n_robots, flags, height, width] = numbers;
        let reply = StepReply { n_worlds, n_robots, flags, height, width, ..StepReply::default() };
        if let Ok(parts) = split_step_payload(&reply, &vec![7; length]) {
            let counts = (parts.worlds.len(), parts.robots.len());
            prop_assert_eq!(counts, (n_worlds as usize, n_robots as usize));
            prop_assert_eq!(counts.0 * WORLD_BYTES + counts.1 * ROBOT_BYTES + parts.frames.len(), length);
        }
    }

    #[test]
    fn results_and_frames_come_back_as_they_were_sent(
        side in (1u32..6, 1u32..6),
        worlds in vec(any::<[u8; WORLD_BYTES]>(), 0..5),
        robots in vec(any::<[u8; ROBOT_BYTES]>(), 0..5),
        is_team in any::<bool>(),
        excess in 0usize..3,
        shift in 0usize..8,
    ) {
        let n_frames = if is_team { worlds.len() } else { robots.len() };
        let n_cells = (side.0 * side.1) as usize;
        let frames: Vec<u8> = (0..n_frames * n_cells).map(|byte| byte as u8).collect();
        // In shared memory a payload begins at any address.
        let mut memory = vec![0; shift];
        memory.extend(worlds.iter().flatten().chain(robots.iter().flatten()).chain(&frames));
        memory.resize(memory.len() + excess, 0);
        let reply = StepReply {
            n_worlds: worlds.len() as u32,
            n_robots: robots.len() as u32,
            flags: if is_team { FLAG_TEAM_FRAMES } else { 0 },
            height: side.0,
            width: side.1,
            ..StepReply::default()
        };
        match split_step_payload(&reply, &memory[shift..]) {
            Ok(parts) => {
                prop_assert!(excess == 0 && parts.frames == frames);
                prop_assert_eq!(bytemuck::cast_slice::<_, u8>(&parts.worlds), worlds.concat());
                prop_assert_eq!(bytemuck::cast_slice::<_, u8>(&parts.robots), robots.concat());
            }
            Err(expected) => {
                prop_assert!(excess > 0 && expected + excess + shift == memory.len());
            }
        }
    }

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

    #[test]
    fn any_number_is_a_code_or_an_error(value in prop_oneof![0u32..300, any::<u32>()]) {
        match Status::try_from(value) {
            Ok(status) => prop_assert_eq!(status as u32, value),
            Err(error) => prop_assert_eq!(error, UnknownCode { what: "status", value }),
        }
        match Operation::try_from(value) {
            Ok(operation) => prop_assert_eq!(operation as u32, value),
            Err(error) => prop_assert_eq!(error, UnknownCode { what: "operation", value }),
        }
        match Coverage::try_from(value) {
            Ok(coverage) => prop_assert_eq!(coverage as u32, value),
            Err(error) => prop_assert_eq!(error, value),
        }
        if let Ok(byte) = u8::try_from(value) {
            prop_assert_eq!(Move::try_from(byte).map(|step| step as u8).unwrap_or_else(|e| e), byte);
        }
    }

    #[test]
    fn every_status_explains_itself_whatever_its_detail(
        status in select(Status::ALL.to_vec()),
        detail in prop_oneof![Just(0), Just(u64::MAX), any::<u64>()],
    ) {
        prop_assert!(!status.explain(detail).is_empty());
    }
}
