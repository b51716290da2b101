//! Compares PROTOCOL.md with the code: byte tables, codes, limits, JSON examples, and the worked example.

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
use emberwatch_protocol::path::{MAX_MOVES, check_moves};
use emberwatch_protocol::payload::split_step_payload;
use emberwatch_protocol::recording::{
    self, FileHeader, Kind, MAX_BODY_BYTES, MAX_STORED_BYTES, RecordHeader, Totals,
};
use emberwatch_protocol::{Coverage, Frame, Move, Shape, UNOBSERVED};
use iceoryx2::prelude::ZeroCopySend;
use serde_json::Value;
use std::collections::BTreeSet;

/// Returns the fields of a struct. The macro does not compile if a field is missing from the list.
macro_rules! fields {
    ($name:ident: $($field:ident)*) => {{
        let $name { $($field),* } = $name::default();
        vec![$(Field {
            name: stringify!($field).into(),
            offset: std::mem::offset_of!($name, $field),
            size: size_of_val(&$field),
            of: type_of(&$field),
        }),*]
    }};
}

/// Returns the layouts of structs.
macro_rules! layouts {
    ($($name:ident: $($field:ident)*;)*) => {
        vec![$(Layout {
            name: stringify!($name),
            type_name: type_name::<$name>(),
            size: size_of::<$name>(),
            alignment: align_of::<$name>(),
            fields: fields!($name: $($field)*),
        }),*]
    };
}

#[expect(unsafe_code, reason = "iceoryx2 marks the name unsafe to override")]
fn type_name<T: Header>() -> &'static str {
    // SAFETY: reads a constant.
    unsafe { <WireHeader<T> as ZeroCopySend>::type_name() }
}

/// Returns the type of a field as PROTOCOL.md writes it.
fn type_of<T>(_: &T) -> String {
    match std::any::type_name::<T>() {
        "[u8; 8]" => "u8[8]".into(),
        name => name.rsplit("::").next().unwrap_or(name).into(),
    }
}

fn layouts() -> Vec<Layout> {
    layouts! {
        StepRequest: version operation lease sequence first_robot n_robots n_moves flags listener_low listener_high;
        StepReply: version status sequence first_robot n_robots n_worlds flags height width simulation_nanos detail;
        WorldResult: step seed episode reward hovered late n_target_cells n_visited n_hits terminated truncated;
        RobotResult: reward marginal n_visited n_hits start_row start_col row col coverage n_moves;
        ControlRequest: version reserved sequence listener_low listener_high;
        ControlReply: version status sequence;
        FrameHeader: version world sequence first_robot n_robots height width result;
        TruthHeader: version world sequence episode step seed height width;
        AgentHeader: version world sequence episode step seed height width n_states pid first_robot n_robots;
    }
}

#[test]
fn every_header_is_laid_out_as_documented() {
    let layouts = layouts();
    assert_eq!(PROTOCOL.matches("\n### ").count(), layouts.len());
    for layout in layouts {
        let (documented, format) = documented_struct(layout.name);
        assert_eq!(documented, layout, "PROTOCOL.md (left), code (right)");
        let codes = document::struct_codes(&documented.fields);
        assert_eq!(format, format!("={codes}"), "{}", layout.name);
    }
}

/// Returns the rows of a table of names and numbers.
fn numbers_under(header: &str) -> Vec<(String, usize)> {
    let row = |row: Vec<String>| (row[0].replace('`', ""), row[1].parse().expect("a number"));
    rows_under(header).into_iter().map(row).collect()
}

#[test]
fn every_code_is_documented() {
    let statuses = Status::ALL.map(|status| (snake_case(&status), status as usize));
    assert_eq!(numbers_under("| status | code |"), statuses);
    let documented: BTreeSet<Vec<String>> = rows_under("| kind | name | code |")
        .into_iter()
        .map(|row| row[..3].to_vec())
        .collect();
    let mut known = BTreeSet::new();
    let mut add = |kind: &str, name: &dyn std::fmt::Debug, code: u32| {
        let name = format!("{name:?}").to_lowercase().replace('"', "");
        known.insert(vec![kind.to_owned(), name, code.to_string()]);
    };
    add("flag", &"full_coverage", FLAG_FULL_COVERAGE);
    add("flag", &"team_frames", FLAG_TEAM_FRAMES);
    Move::ALL.iter().for_each(|it| add("move", it, *it as u32));
    for code in 0..=255 {
        if let Ok(operation) = Operation::try_from(code) {
            add("operation", &operation, code);
        }
        if let Ok(coverage) = Coverage::try_from(code) {
            add("coverage", &coverage, code);
        }
    }
    assert_eq!(documented, known);
    assert!(PROTOCOL.contains(&format!("The version is {VERSION}.")));
    assert!(PROTOCOL.contains(&format!("**{UNOBSERVED} where nothing was")));
}

/// Returns constants together with their names.
macro_rules! limits {
    ($($name:ident)*) => {
        [$((stringify!($name).to_owned(), $name)),*]
    };
}

#[test]
fn every_limit_and_every_service_is_documented() {
    let known = limits! {
        MAX_CLIENTS MAX_OBSERVERS MAX_TRUTH_READERS MAX_AGENT_READERS FRAME_BUFFER TRUTH_BUFFER AGENT_BUFFER MAX_NODES
        MAX_CONTROL_BYTES MAX_MOVES MAX_SIDE MAX_WORLDS MAX_ROBOTS MAX_ROBOT_NUMBERS MAX_TEAM_CELLS
    };
    assert_eq!(numbers_under("| limit | value |"), known);
    let documented = rows_under("| service | pattern |").into_iter();
    let documented: BTreeSet<String> = documented.map(|row| row[0].replace('`', "")).collect();
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
    let known = names.map(|name| name.replace("emberwatch/v3/x/", ""));
    assert_eq!(documented, BTreeSet::from(known));
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
fn a_recording_is_laid_out_as_documented() {
    let file = fields!(FileHeader: magic version reserved);
    let record = fields!(RecordHeader: nanos kind length n_lost checksum);
    assert_eq!(document::fields_under("| file offset |"), file);
    assert_eq!(document::fields_under("| record offset |"), record);
    let kinds = [Kind::Server, Kind::Frame, Kind::Truth, Kind::End];
    let known = kinds.map(|kind| (format!("{kind:?}").to_lowercase(), kind as usize));
    assert_eq!(numbers_under("| record kind | code |"), known);
    for sentence in [
        format!("`{}` in ASCII", recording::MAGIC.escape_ascii()),
        format!(
            "{VERSION} or {}; refuse any other",
            recording::VERSIONS.start()
        ),
        format!("version {} instead of {VERSION}", VERSION.swap_bytes()),
        format!(
            "has {} bytes, struct `={}`",
            size_of::<RecordHeader>(),
            document::struct_codes(&record)
        ),
        format!("stored, at most {MAX_STORED_BYTES} |"),
        format!("of at most {MAX_BODY_BYTES} bytes"),
    ] {
        assert!(PROTOCOL.contains(&sentence), "{sentence:?} is missing");
    }
    let [end] = lines_of_fences(" end")[..] else {
        panic!("expected one example of an end")
    };
    let totals: Totals = serde_json::from_str(end).expect("an end");
    assert_eq!(serde_json::to_string(&totals).expect("serialises"), end);
}

#[test]
fn the_worked_example_is_as_long_as_its_headers_say() {
    let request = document::worked_example("StepRequest");
    let (header, body) = request.split_at(size_of::<StepRequest>());
    let header: StepRequest = bytemuck::pod_read_unaligned(header);
    let n_moves = header.n_robots * header.n_moves;
    assert_eq!(body.len(), size_of::<u64>() + n_moves as usize);
    check_moves(&body[size_of::<u64>()..]).expect("paths");

    let reply = document::worked_example("StepReply");
    let (header, payload) = reply.split_at(size_of::<StepReply>());
    let header: StepReply = bytemuck::pod_read_unaligned(header);
    let parts = split_step_payload(&header, payload).expect("the right length");
    let shape = Shape::new(header.height as usize, header.width as usize).expect("a grid");
    let frames = parts.frames.chunks_exact(shape.n_cells());
    for (robot, bytes) in parts.robots.iter().zip(frames) {
        let frame = Frame::from_bytes(shape, 3, bytes).expect("a frame");
        assert_eq!(frame.observed().count(), robot.n_visited as usize);
    }
}

/// Returns the lines of the JSON examples whose fence has this title after `json`.
fn lines_of_fences(title: &str) -> Vec<&'static str> {
    let fences = fences("json").into_iter();
    let titled = fences.filter(|(found, _)| *found == title);
    titled.flat_map(|(_, text)| text.lines()).collect()
}

fn snake_case<T: serde::Serialize>(value: &T) -> String {
    let text = serde_json::to_string(value).expect("codes serialise");
    text.replace('"', "")
}

/// Returns every variant of a tagged enum, as listed by serde in the error for an unknown variant.
fn variants_of<T: serde::de::DeserializeOwned>(tag: &str) -> BTreeSet<String> {
    let unknown = serde_json::from_str::<T>(&format!(r#"{{"{tag}":"?"}}"#));
    let error = unknown.err().expect("no such variant").to_string();
    let (_, known) = error.split_once("expected one of").expect("serde's words");
    let names = known.split('`').skip(1).step_by(2);
    names.map(str::to_owned).collect()
}
