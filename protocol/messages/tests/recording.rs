//! Recordings: what was written is what is read, and what is missing or damaged is said.

use emberwatch_messages::control::{CoverageRule, ServerInfo};
use emberwatch_messages::message::{FrameHeader, RobotResult, TruthHeader, VERSION, WorldResult};
use emberwatch_messages::recording::{
    Event, MAX_STORED_BYTES, Reader, Record, RecordHeader, RecordingError, Totals, Writer,
};
use emberwatch_messages::sample::Sample;
use proptest::collection::vec;
use proptest::prelude::*;
use std::io::Write;

/// Robots of a world.
const N_ROBOTS: usize = 2;

fn server(height: usize, width: usize, n_moves: usize) -> Event {
    Event::Server(Box::new(ServerInfo {
        protocol: VERSION,
        build: "0.1.0".into(),
        pid: 7,
        pid_namespace: None,
        height,
        width,
        n_moves,
        n_worlds: 3,
        n_robots: N_ROBOTS as u32,
        n_observations: 3,
        observations: vec!["normal".into(), "latent".into(), "fire".into()],
        model: None,
        task: None,
        worlds_fingerprint: None,
        airspace: None,
        zones: None,
        recorded_world: None,
        burn_in: 20,
        max_steps: 0,
        max_clients: 16,
        coverage: CoverageRule::Path,
        publish_truth: true,
        lease_millis: 30_000,
        deadline_millis: 0,
    }))
}

/// A sample of robots that flew so many moves; `bytes` are their frames and paths.
fn frame(
    sequence: u64,
    (height, width): (usize, usize),
    n_moves: [usize; N_ROBOTS],
    bytes: &[u8],
) -> Sample<FrameHeader> {
    let world = sequence as u32 % 3;
    let header = FrameHeader {
        version: VERSION,
        world,
        sequence,
        first_robot: world * N_ROBOTS as u32,
        n_robots: N_ROBOTS as u32,
        height: height as u32,
        width: width as u32,
        result: WorldResult {
            step: sequence,
            reward: 1.5,
            ..WorldResult::default()
        },
    };
    let results = n_moves.map(|n_moves| RobotResult {
        n_moves: n_moves as u32,
        ..RobotResult::default()
    });
    let payload = [bytemuck::cast_slice(&results), bytes].concat();
    Sample { header, payload }
}

fn truth(sequence: u64, (height, width): (usize, usize), payload: Vec<u8>) -> Event {
    let header = TruthHeader {
        version: VERSION,
        world: sequence as u32 % 3,
        sequence,
        height: height as u32,
        width: width as u32,
        ..TruthHeader::default()
    };
    Event::Truth(Sample { header, payload })
}

/// A server, hidden states, frames, and a second server of another grid.
fn example() -> Vec<Record> {
    let events = [
        server(2, 3, 4),
        truth(0, (2, 3), vec![0, 1, 2, 2, 1, 0]),
        Event::Frame(frame(0, (2, 3), [0, 0], &[255; 12])),
        Event::Frame(frame(4, (2, 3), [0, 4], &[1; 16])),
        server(1, 2, 1),
        Event::Frame(frame(1, (1, 2), [1, 1], &[255, 1, 0, 2, 3, 0])),
    ];
    let nanos = [5, 5, 6, 1 << 40, 1 << 40, u64::MAX];
    let n_lost = [0, 0, 0, 3, 0, 0];
    let parts = events.into_iter().zip(nanos).zip(n_lost);
    parts
        .map(|((event, nanos), n_lost)| Record {
            nanos,
            n_lost,
            event,
        })
        .collect()
}

fn written(records: &[Record]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut writer = Writer::new(&mut bytes).expect("begin");
    for record in records {
        writer.write(record).expect("write");
    }
    writer.finish().expect("finish");
    let n_bytes = writer.n_bytes();
    assert_eq!(bytes.len() as u64, n_bytes);
    bytes
}

/// How long a recording of these records is before its end is written.
fn length_without_end(records: &[Record]) -> usize {
    let mut writer = Writer::new(Vec::new()).expect("begin");
    for record in records {
        writer.write(record).expect("write");
    }
    writer.n_bytes() as usize
}

/// The records that can be read, and the error that ends them, if any.
fn read(bytes: &[u8]) -> (Vec<Record>, Option<RecordingError>) {
    let reader = match Reader::new(bytes) {
        Ok(reader) => reader,
        Err(error) => return (Vec::new(), Some(error)),
    };
    let mut records = Vec::new();
    for record in reader {
        match record {
            Ok(record) => records.push(record),
            Err(error) => return (records, Some(error)),
        }
    }
    (records, None)
}

/// Frames of steps; none of the example's comes twice.
fn count_steps(records: &[Record]) -> u64 {
    let is_step = |record: &&Record| matches!(&record.event, Event::Frame(sample) if sample.header.result.step > 0);
    records.iter().filter(is_step).count() as u64
}

fn check_refused(bytes: &[u8], words: &str) {
    let (_, error) = read(bytes);
    let said = error.expect("refused").to_string();
    assert!(said.contains(words), "{said:?} does not say {words:?}");
}

/// A record of these bytes, with the right checksum.
fn raw_record(kind: u32, body: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::DeflateEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(body).expect("compress");
    sealed(kind, &encoder.finish().expect("compress"))
}

fn sealed(kind: u32, stored: &[u8]) -> Vec<u8> {
    let mut header = RecordHeader {
        nanos: u64::MAX,
        kind,
        length: stored.len() as u32,
        ..RecordHeader::default()
    };
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&bytemuck::bytes_of(&header)[..20]);
    hasher.update(stored);
    header.checksum = hasher.finalize();
    [bytemuck::bytes_of(&header), stored].concat()
}

#[test]
fn what_was_written_is_read_with_its_losses() {
    let bytes = written(&example());
    assert_eq!(read(&bytes).0, example());
    let mut reader = Reader::new(&bytes[..]).expect("begin");
    assert!(reader.by_ref().all(|record| record.is_ok()));
    let expected = Totals {
        n_servers: 2,
        n_frames: 3,
        n_truths: 1,
        n_lost_frames: 3,
        n_lost_truths: 0,
    };
    assert_eq!(reader.totals(), expected);
}

#[test]
fn a_cut_recording_is_read_to_its_last_whole_record() {
    let bytes = written(&example());
    let ends: Vec<usize> = (0..=example().len())
        .map(|n_records| length_without_end(&example()[..n_records]))
        .collect();
    for length in 0..bytes.len() {
        let (records, error) = read(&bytes[..length]);
        let n_whole = ends.iter().filter(|&&end| end <= length).count();
        let offset = if n_whole == 0 { 0 } else { ends[n_whole - 1] };
        assert_eq!(records, example()[..n_whole.saturating_sub(1)], "{length}");
        match error {
            Some(RecordingError::Cut {
                offset: said,
                got,
                n_steps,
            }) => {
                assert_eq!((said, got), (offset as u64, (length - offset) as u64));
                assert_eq!(n_steps, count_steps(&records));
            }
            other => panic!("cut after {length} bytes: {other:?}"),
        }
    }
}

#[test]
fn a_flipped_bit_anywhere_is_noticed() {
    let bytes = written(&example());
    for position in 0..bytes.len() {
        for bit in 0..8 {
            let mut damaged = bytes.clone();
            damaged[position] ^= 1 << bit;
            let (records, error) = read(&damaged);
            let error = error.unwrap_or_else(|| panic!("byte {position}, bit {bit}"));
            assert_eq!(records, example()[..records.len()]);
            if let RecordingError::Damaged { n_steps, .. } = error {
                assert_eq!(n_steps, count_steps(&records));
            }
        }
    }
}

#[test]
fn a_record_that_is_missing_is_noticed() {
    let bytes = written(&example());
    let first = length_without_end(&example()[..2]);
    let second = length_without_end(&example()[..3]);
    let without = [&bytes[..first], &bytes[second..]].concat();
    check_refused(&without, "totals: expected");
}

#[test]
fn other_files_are_refused_by_what_they_begin_with() {
    check_refused(
        b"PK\x03\x04 and so on, long enough",
        "got \"PK\\\\x03\\\\x04 and\"",
    );
    check_refused(
        b"E",
        "cut short: expected a whole record at byte 0, got 1 bytes",
    );
    let mut bytes = written(&example());
    bytes[8..12].copy_from_slice(&2u32.to_be_bytes());
    check_refused(&bytes, "version: expected 2, got 33554432");
    bytes[8..16].copy_from_slice(&[2, 0, 0, 0, 2, 0, 0, 0]);
    check_refused(&bytes, "expected 0 in byte 12 to 15, got 2");
}

#[test]
fn a_hostile_record_is_refused_by_where_it_is() {
    let whole = written(&example());
    let beginning = &whole[..16];
    let check = |record: &[u8], words: &str| {
        check_refused(&[beginning, record].concat(), "at byte 16");
        check_refused(&[beginning, record].concat(), words);
    };
    let mut liar = RecordHeader {
        kind: 2,
        length: MAX_STORED_BYTES as u32,
        ..RecordHeader::default()
    };
    check(bytemuck::bytes_of(&liar), "got 24 bytes");
    liar.length = u32::MAX;
    check(bytemuck::bytes_of(&liar), "bytes, got 4294967295");
    check(&raw_record(2, &vec![0; 100 << 20]), "bytes, got more");
    check(&sealed(2, b"\xff\xff"), "expected deflate");
    let twice = [&raw_record(1, b"")[24..], b"more"].concat();
    check(&sealed(1, &twice), "4 bytes behind it");
    check(&raw_record(5, b""), "kind: expected 1 to 4, got 5");
    check(&raw_record(1, b"{\"protocol\":1}"), "JSON: missing field");
    check(&raw_record(2, &[0; 95]), "expected 96 bytes, got 95");
    check(&raw_record(3, &[0; 48]), "expected a server before");
    check(&[raw_record(4, b"{}")].concat(), "JSON: missing field");
    check_refused(&[&whole[..], b"x"].concat(), "nothing behind the end");
    let again = [&whole[..], &whole[16..]].concat();
    check_refused(&again, "nothing behind the end");
}

#[test]
fn a_writer_refuses_what_a_reader_would() {
    let mut writer = Writer::new(Vec::new()).expect("begin");
    let mut check = |nanos: u64, event: Event, words: &str| {
        let record = Record {
            nanos,
            n_lost: 0,
            event,
        };
        let result = writer.write(&record);
        match words {
            "" => result.expect("written"),
            words => {
                let said = result.expect_err("refused").to_string();
                assert!(said.contains(words), "{said:?} does not say {words:?}");
            }
        }
    };
    let good = frame(1, (2, 3), [0, 4], &[0; 16]);
    check(1, Event::Frame(good.clone()), "expected a server before");
    check(1, server(0, 3, 1), "got 0 x 3");
    check(1, server(2, 3, 5000), "at most 4096, got 5000");
    check(1, server(2, 3, 4), "");
    check(0, server(2, 3, 4), "time: expected at least 1 ns, got 0");
    let mut check_frame = |change: fn(&mut Sample<FrameHeader>), words: &str| {
        let mut sample = good.clone();
        change(&mut sample);
        check(2, Event::Frame(sample), words);
    };
    check_frame(
        |it| *it = frame(1, (3, 2), [0, 0], &[0; 12]),
        "grid: expected 2 x 3, got 3 x 2",
    );
    check_frame(
        |it| *it = frame(1, (2, 3), [1, 0], &[0; 13]),
        "expected 0 or 4 moves, got 1",
    );
    check_frame(
        |it| it.payload.push(0),
        "payload bytes: expected 112, got 113",
    );
    check_frame(
        |it| it.header.n_robots = 1,
        "payload bytes: expected 54, got 112",
    );
    check_frame(
        |it| it.header.n_robots = 65,
        "robots: expected 1 to 64, got 65",
    );
    check_frame(
        |it| it.header.first_robot = 3,
        "first robot: expected 2, got 3",
    );
    check_frame(
        |it| it.header.result.hovered = 4,
        "expected bits below 2, got 0x4",
    );
    check_frame(|_| (), "");
    let Event::Truth(mut sample) = truth(0, (2, 3), vec![0; 6]) else {
        unreachable!("truth() makes a truth")
    };
    sample.payload.pop();
    check(2, Event::Truth(sample.clone()), "expected 6, got 5");
    sample.payload.push(0);
    sample.header.world = 3;
    check(2, Event::Truth(sample.clone()), "below 3, got 3");
    sample.header.world = 2;
    sample.header.version = 9;
    check(2, Event::Truth(sample), "version: expected 2, got 9");
}

/// Records of a random grid, each a frame or hidden states of any bytes.
fn records() -> impl Strategy<Value = Vec<Record>> {
    let flew = any::<[bool; N_ROBOTS]>();
    let sample = (any::<bool>(), any::<u32>(), 0..1u64 << 50, flew);
    (1usize..20, 1usize..20, 0usize..9, vec(sample, 0..9)).prop_flat_map(
        |(height, width, n_moves, samples)| {
            let grid = (height, width);
            let first = Record {
                nanos: 0,
                n_lost: 0,
                event: server(height, width, n_moves),
            };
            let mut nanos = 0;
            let made = samples.into_iter().enumerate().map(
                move |(sequence, (is_frame, n_lost, wait, flew))| {
                    nanos += wait;
                    let (nanos, sequence) = (nanos, sequence as u64);
                    let n_moves = flew.map(|flew| if flew { n_moves } else { 0 });
                    let n_frames = if is_frame { N_ROBOTS } else { 1 };
                    let n_path_bytes = if is_frame { n_moves.iter().sum() } else { 0 };
                    let length = n_frames * height * width + n_path_bytes;
                    vec(any::<u8>(), length).prop_map(move |bytes| Record {
                        nanos,
                        n_lost,
                        event: if is_frame {
                            Event::Frame(frame(sequence, grid, n_moves, &bytes))
                        } else {
                            truth(sequence, grid, bytes)
                        },
                    })
                },
            );
            made.collect::<Vec<_>>()
                .prop_map(move |rest| [vec![first.clone()], rest].concat())
        },
    )
}

proptest! {
    #[test]
    fn any_records_come_back(records in records()) {
        let (read, error) = read(&written(&records));
        prop_assert!(error.is_none(), "{error:?}");
        prop_assert_eq!(read, records);
    }
}
