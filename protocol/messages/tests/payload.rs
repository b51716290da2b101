//! Payloads of steps and frames: only payloads of the exact length are split, and impossible values are refused.

use emberwatch_messages::message::{
    FLAG_TEAM_FRAMES, FrameHeader, RobotResult, StepReply, WorldResult,
};
use emberwatch_messages::payload::{StepParts, split_frame_payload, split_step_payload};

#[test]
fn a_step_payload_of_the_wrong_length_is_refused() {
    let reply = StepReply {
        n_worlds: 1,
        n_robots: 2,
        height: 3,
        width: 5,
        ..StepReply::default()
    };
    let (mut team, mut huge) = (reply, reply);
    team.flags = FLAG_TEAM_FRAMES;
    for (reply, expected) in [(reply, 64 + 2 * (48 + 15)), (team, 64 + 2 * 48 + 15)] {
        // In shared memory a payload can begin at any address.
        assert!(split_step_payload(&reply, &vec![0; expected + 1][1..]).is_ok());
        for wrong in [3, expected - 1, expected + 1] {
            assert_eq!(split_step_payload(&reply, &vec![0; wrong]), Err(expected));
        }
    }
    (huge.n_worlds, huge.n_robots) = (u32::MAX, u32::MAX);
    (huge.height, huge.width) = (u32::MAX, u32::MAX);
    assert!(split_step_payload(&huge, &[]).is_err());
}

fn flew(n_moves: u32) -> RobotResult {
    RobotResult {
        n_moves,
        ..RobotResult::default()
    }
}

#[test]
fn values_that_cannot_be_are_refused() {
    let observations = "frame: expected observations below 3 or 255, got";
    for (hovered, n_moves, value, words) in [
        (0, 4, 2, ""),
        (3, 0, 255, ""),
        (
            4,
            0,
            0,
            "robots that stayed: expected bits below 2, got 0x4",
        ),
        (0, 3, 0, "n_moves: expected 0 or 4, got 3"),
        (0, 0, 3, &*format!("{observations} 3")),
        (0, 0, 254, &*format!("{observations} 254")),
    ] {
        let world = WorldResult {
            hovered,
            ..WorldResult::default()
        };
        let parts = StepParts {
            worlds: vec![world],
            robots: vec![flew(0), flew(n_moves)],
            frames: &[255, 0, value],
        };
        let problem = parts.check(&crate::server(1, 3, 4, 1)).err();
        assert_eq!(problem.unwrap_or_default(), words);
    }
}

#[test]
fn a_sample_gives_each_robot_its_frame_and_path() {
    let header = FrameHeader {
        n_robots: 2,
        height: 1,
        width: 3,
        ..FrameHeader::default()
    };
    let robots = [flew(0), flew(2)];
    let payload = [
        bytemuck::cast_slice::<_, u8>(&robots),
        &[255, 255, 255, 0, 255, 2, 3, 3],
    ]
    .concat();
    // In shared memory a payload can begin at any address.
    let memory = [&[0], &payload[..]].concat();
    let robots = split_frame_payload(&header, &memory[1..]).expect("well-formed");
    assert_eq!((robots[0].frame, robots[0].path), (&[255; 3][..], &[][..]));
    assert_eq!(
        (robots[1].frame, robots[1].path),
        (&[0, 255, 2][..], &[3, 3][..])
    );

    type Change = fn(&mut FrameHeader, &mut Vec<u8>);
    let changes: [(Change, &str); 9] = [
        (|_, bytes| bytes.truncate(103), "expected 104, got 103"),
        (|_, bytes| bytes.push(0), "expected 104, got 105"),
        (|_, bytes| bytes.truncate(95), "expected 102, got 95"),
        (|it, _| it.n_robots = 0, "robots: expected 1 to 64, got 0"),
        (|it, _| it.n_robots = 65, "robots: expected 1 to 64, got 65"),
        (|it, _| it.width = 0, "got 1 x 0"),
        (|it, _| it.height = u32::MAX, "got 4294967295 x 3"),
        (|it, _| it.result.late = 4, "expected bits below 2, got 0x4"),
        (fly_far, "path: expected at most 4096 moves, got 4097"),
    ];
    for (change, words) in changes {
        let (mut header, mut payload) = (header, payload.clone());
        change(&mut header, &mut payload);
        let error = split_frame_payload(&header, &payload).expect_err(words);
        assert!(error.contains(words), "{error}");
    }
}

fn fly_far(header: &mut FrameHeader, payload: &mut Vec<u8>) {
    header.n_robots = 1;
    *payload = [bytemuck::bytes_of(&flew(4097)), &[0; 4100]].concat();
}
