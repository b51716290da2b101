//! PROTOCOL.md against the code: byte tables, codes, limits, JSON examples, and the worked example.

mod document;

use document::{Field, Layout, PROTOCOL, documented_struct, fences, rows_under};
use emberwatch_protocol::channels::{
    AGENT_BUFFER, Channel, FRAME_BUFFER, Instance, MAX_AGENT_READERS, MAX_CLIENTS, MAX_NODES,
    MAX_OBSERVERS, MAX_ROBOT_NUMBERS, MAX_ROBOTS, MAX_TEAM_CELLS, MAX_TRUTH_READERS, MAX_WORLDS,
    TRUTH_BUFFER, WireHeader, service_name,
};
use emberwatch_protocol::control::{MAX_CONTROL_BYTES, Reply, Request};
use emberwatch_protocol::grid::MAX_SIDE;
use emberwatch_protocol::message::{
    AgentHeader, ControlReply, ControlRequest, FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, FrameHeader,
    Header, Operation, RobotResult, Status, StepReply, StepRequest, TruthHeader, VERSION,
    WorldResult,
};
use emberwatch_protocol::path::{MAX_MOVES, path_from_bytes};
use emberwatch_protocol::payload::split_step_payload;
use emberwatch_protocol::recording::{
    self, FileHeader, Kind, MAX_BODY_BYTES, MAX_STORED_BYTES, RecordHeader, Totals,
};
use emberwatch_protocol::{Coverage, Frame, Move, Shape, UNOBSERVED};
use iceoryx2::prelude::ZeroCopySend;
use serde_json::Value;
use std::collections::BTreeSet;

/// The fields of a struct; one that is not listed does not compile.
macro_rules! fields {
    ($name:ident { $($field:ident),* $(,)? }) => {{
        let $name { $($field),* } = $name::default();
        vec![$(Field {
            name: stringify!($field).into(),
            offset: std::mem::offset_of!($name, $field),
            size: size_of_val(&$field),
            of: type_of(&$field),
        }),*]
    }};
}

/// The layout of a struct.
macro_rules! layout {
    ($name:ident { $($field:ident),* $(,)? }) => {
        Layout {
            name: stringify!($name),
            type_name: type_name::<$name>(),
            size: size_of::<$name>(),
            alignment: align_of::<$name>(),
            fields: fields!($name { $($field),* }),
        }
    };
}

#[expect(unsafe_code, reason = "iceoryx2 marks the name unsafe to override")]
fn type_name<T: Header>() -> &'static str {
    // SAFETY: reads a constant.
    unsafe { <WireHeader<T> as ZeroCopySend>::type_name() }
}

/// The type of a field as PROTOCOL.md writes it.
fn type_of<T>(_: &T) -> String {
    match std::any::type_name::<T>() {
        "[u8; 8]" => "u8[8]".into(),
        name => name.rsplit("::").next().unwrap_or(name).into(),
    }
}

fn layouts() -> Vec<Layout> {
    vec![
        layout!(StepRequest {
            version,
            operation,
            lease,
            sequence,
            first_robot,
            n_robots,
            n_moves,
            flags,
            listener_low,
            listener_high,
        }),
        layout!(StepReply {
            version,
            status,
            sequence,
            first_robot,
            n_robots,
            n_worlds,
            flags,
            height,
            width,
            simulation_nanos,
            detail,
        }),
        layout!(WorldResult {
            step,
            seed,
            episode,
            reward,
            hovered,
            late,
            n_target_cells,
            n_visited,
            n_hits,
            terminated,
            truncated,
        }),
        layout!(RobotResult {
            reward,
            marginal,
            n_visited,
            n_hits,
            start_row,
            start_col,
            row,
            col,
            coverage,
            n_moves,
        }),
        layout!(ControlRequest {
            version,
            reserved,
            sequence,
            listener_low,
            listener_high,
        }),
        layout!(ControlReply {
            version,
            status,
            sequence,
        }),
        layout!(FrameHeader {
            version,
            world,
            sequence,
            first_robot,
            n_robots,
            height,
            width,
            result,
        }),
        layout!(TruthHeader {
            version,
            world,
            sequence,
            episode,
            step,
            seed,
            height,
            width,
        }),
        layout!(AgentHeader {
            version,
            world,
            sequence,
            episode,
            step,
            seed,
            height,
            width,
            n_states,
            pid,
            first_robot,
            n_robots,
        }),
    ]
}

#[test]
fn every_header_is_laid_out_as_documented() {
    let layouts = layouts();
    assert_eq!(PROTOCOL.matches("\n### ").count(), layouts.len());
    for layout in layouts {
        let (documented, format) = documented_struct(layout.name);
        assert_eq!(documented, layout, "PROTOCOL.md (left), code (right)");
        assert_eq!(
            document::sizes_of_struct_format(&format),
            document::scalar_sizes(&documented),
            "{}: struct {format}",
            layout.name
        );
    }
}

#[test]
fn every_status_is_documented_with_its_code() {
    let documented: Vec<(String, u32)> = rows_under("| status | code |")
        .into_iter()
        .map(|row| (row[0].clone(), row[1].parse().expect("a code")))
        .collect();
    let known: Vec<(String, u32)> = Status::ALL
        .into_iter()
        .map(|status| (snake_case(&status), status as u32))
        .collect();
    assert_eq!(documented, known);
}

#[test]
fn every_other_code_is_documented() {
    let documented: BTreeSet<[String; 3]> = rows_under("| kind | name | code |")
        .into_iter()
        .map(|row| [row[0].clone(), row[1].clone(), row[2].clone()])
        .collect();
    let entry = |kind: &str, name: String, code: u32| [kind.into(), name, code.to_string()];
    let operations = (0..=255).filter_map(|code| Operation::try_from(code).ok());
    let coverages = (0..=255).filter_map(|code| Coverage::try_from(code).ok());
    let flags = [
        ("full_coverage", FLAG_FULL_COVERAGE),
        ("team_frames", FLAG_TEAM_FRAMES),
    ];
    let known = operations
        .map(|it| entry("operation", format!("{it:?}").to_lowercase(), it as u32))
        .chain(flags.map(|(name, code)| entry("flag", name.into(), code)))
        .chain(
            Move::ALL
                .iter()
                .map(|it| entry("move", format!("{it:?}").to_lowercase(), *it as u32)),
        )
        .chain(coverages.map(|it| entry("coverage", snake_case(&it), it as u32)));
    assert_eq!(documented, known.collect());
    for sentence in [
        format!("The version is {VERSION}."),
        format!("**{UNOBSERVED} where nothing was"),
    ] {
        assert!(PROTOCOL.contains(&sentence), "{sentence:?} is not there");
    }
}

#[test]
fn every_limit_is_documented() {
    let documented: Vec<(String, usize)> = rows_under("| limit | value |")
        .into_iter()
        .map(|row| {
            (
                row[0].replace('`', ""),
                row[1].parse().expect("a whole number"),
            )
        })
        .collect();
    let known = [
        ("MAX_CLIENTS", MAX_CLIENTS),
        ("MAX_OBSERVERS", MAX_OBSERVERS),
        ("MAX_TRUTH_READERS", MAX_TRUTH_READERS),
        ("MAX_AGENT_READERS", MAX_AGENT_READERS),
        ("FRAME_BUFFER", FRAME_BUFFER),
        ("TRUTH_BUFFER", TRUTH_BUFFER),
        ("AGENT_BUFFER", AGENT_BUFFER),
        ("MAX_NODES", MAX_NODES),
        ("MAX_CONTROL_BYTES", MAX_CONTROL_BYTES),
        ("MAX_MOVES", MAX_MOVES),
        ("MAX_SIDE", MAX_SIDE),
        ("MAX_WORLDS", MAX_WORLDS),
        ("MAX_ROBOTS", MAX_ROBOTS),
        ("MAX_ROBOT_NUMBERS", MAX_ROBOT_NUMBERS),
        ("MAX_TEAM_CELLS", MAX_TEAM_CELLS),
    ];
    assert_eq!(
        documented,
        known.map(|(name, value)| (name.to_owned(), value))
    );
}

#[test]
fn every_control_message_has_an_example_that_round_trips() {
    let (mut operations, mut replies) = (BTreeSet::new(), BTreeSet::new());
    for line in lines_of_fences("") {
        let value: Value = serde_json::from_str(line).expect("examples are JSON");
        let name = |key: &str| value.get(key).map(|name| name.to_string());
        let again = match (name("op"), name("reply")) {
            (Some(operation), None) => {
                operations.insert(operation.replace('"', ""));
                let request: Request = serde_json::from_str(line).expect(line);
                serde_json::to_value(&request)
            }
            (None, Some(kind)) => {
                replies.insert(kind.replace('"', ""));
                let reply: Reply = serde_json::from_str(line).expect(line);
                if let Reply::Error {
                    status,
                    detail,
                    message,
                } = &reply
                {
                    assert_eq!(*message, status.explain(*detail));
                }
                serde_json::to_value(&reply)
            }
            other => panic!("expected op or reply, got {other:?} in {line}"),
        };
        assert_eq!(again.expect("messages serialise"), value);
    }
    assert_eq!(operations, variants_of::<Request>("op"));
    assert_eq!(replies, variants_of::<Reply>("reply"));
}

#[test]
fn every_service_is_documented() {
    let documented: BTreeSet<String> = rows_under("| service | pattern |")
        .into_iter()
        .map(|row| row[0].replace('`', ""))
        .collect();
    let instance = Instance::new("x").expect("a plain name");
    let known = [
        Channel::Step,
        Channel::Control,
        Channel::Frames,
        Channel::Truth,
        Channel::Agent,
        Channel::WakeServer,
        Channel::WakeClient,
    ];
    let names = known.map(|channel| service_name(&instance, channel).to_string());
    let known = names.map(|name| name.replace("emberwatch/v2/x/", ""));
    assert_eq!(documented, BTreeSet::from(known));
}

#[test]
fn a_recording_is_laid_out_as_documented() {
    let file = fields!(FileHeader {
        magic,
        version,
        reserved,
    });
    let record = fields!(RecordHeader {
        nanos,
        kind,
        length,
        n_lost,
        checksum,
    });
    assert_eq!(document::fields_under("| file offset |"), file);
    assert_eq!(document::fields_under("| record offset |"), record);
    let kinds = [Kind::Server, Kind::Frame, Kind::Truth, Kind::End];
    let known = kinds.map(|kind| (format!("{kind:?}").to_lowercase(), kind as u32));
    let documented: Vec<(String, u32)> = rows_under("| record kind | code |")
        .into_iter()
        .map(|row| (row[0].clone(), row[1].parse().expect("a code")))
        .collect();
    assert_eq!(documented, known);
    for sentence in [
        format!("`{}` in ASCII", recording::MAGIC.escape_ascii()),
        format!("{}; refuse any other", recording::VERSION),
        format!(
            "version {0} is {1}",
            recording::VERSION,
            recording::VERSION.swap_bytes()
        ),
        format!("has {} bytes, struct `=QIIII`", size_of::<RecordHeader>()),
        format!("stored, at most {MAX_STORED_BYTES} |"),
        format!("of at most {MAX_BODY_BYTES} bytes"),
    ] {
        assert!(PROTOCOL.contains(&sentence), "{sentence:?} is not there");
    }
    let [end] = lines_of_fences(" end")[..] else {
        panic!("expected one example of an end")
    };
    let totals: Totals = serde_json::from_str(end).expect("an end");
    assert_eq!(serde_json::to_string(&totals).expect("serialises"), end);
}

#[test]
fn the_worked_example_decodes_to_what_stands_beside_it() {
    let request = document::worked_example("StepRequest", &layouts());
    let (header, body) = request.split_at(size_of::<StepRequest>());
    let header: StepRequest = bytemuck::pod_read_unaligned(header);
    assert_eq!(Operation::try_from(header.operation), Ok(Operation::Step));
    let (step, paths) = body.split_at(size_of::<u64>());
    assert_eq!((header.n_robots, step), (2, &[0; 8][..]));
    assert_eq!(paths.len(), 2 * header.n_moves as usize);
    let path = path_from_bytes(&paths[..4]).expect("a path");
    assert_eq!(path, [Move::Down, Move::Right, Move::Right, Move::Down]);

    let reply = document::worked_example("StepReply", &layouts());
    let (header, payload) = reply.split_at(size_of::<StepReply>());
    let header: StepReply = bytemuck::pod_read_unaligned(header);
    assert_eq!(Status::try_from(header.status), Ok(Status::Ok));
    let parts = split_step_payload(&header, payload).expect("the right length");
    let shape = Shape::new(header.height as usize, header.width as usize).expect("a grid");
    let frames = parts.frames.chunks_exact(shape.n_cells()).map(|bytes| {
        let frame = Frame::from_bytes(shape, 3, bytes).expect("a frame");
        frame.observed().map(|(cell, _)| cell).collect()
    });
    let seen: Vec<Vec<usize>> = frames.collect();
    assert_eq!(seen, [[5, 6, 7, 12], [2, 7, 8, 9]]);
    for (robot, seen) in parts.robots.iter().zip(&seen) {
        assert_eq!((robot.n_visited as usize, robot.n_moves), (seen.len(), 4));
        assert_eq!(Coverage::try_from(robot.coverage), Ok(Coverage::Path));
    }
    let [world] = parts.worlds[..] else {
        panic!("expected one world");
    };
    assert_eq!((world.step, world.n_visited), (1, 7));
    let shares: f64 = parts.robots.iter().map(|robot| robot.reward).sum();
    assert_eq!(world.reward, shares);
}

/// The lines of the JSON examples with this behind `json`.
fn lines_of_fences(title: &str) -> Vec<&'static str> {
    let fences = fences("json").into_iter();
    let titled = fences.filter(|(found, _)| *found == title);
    titled.flat_map(|(_, text)| text.lines()).collect()
}

fn snake_case<T: serde::Serialize>(value: &T) -> String {
    let text = serde_json::to_string(value).expect("codes serialise");
    text.replace('"', "")
}

/// Every variant of a tagged enum, as serde lists them when it meets an unknown one.
fn variants_of<T: serde::de::DeserializeOwned>(tag: &str) -> BTreeSet<String> {
    let unknown = serde_json::from_str::<T>(&format!(r#"{{"{tag}":"?"}}"#));
    let error = unknown.err().expect("no such variant").to_string();
    let (_, known) = error.split_once("expected one of").expect("serde's words");
    let names = known.split('`').skip(1).step_by(2);
    names.map(str::to_owned).collect()
}
