//! Recordings: written records are read back unchanged, and missing or damaged parts are reported.

use emberwatch_messages::message::{FrameHeader, RobotResult, TruthHeader, VERSION};
use emberwatch_messages::recording::{
    Event, MAX_STORED_BYTES, Reader, Record, RecordHeader, RecordingError, Totals, Writer,
};
use emberwatch_messages::sample::Sample;
use std::io::Write;

/// Number of robots in a world.
const N_ROBOTS: usize = 2;

fn server(height: usize, width: usize, n_moves: usize) -> Event {
    Event::Server(Box::new(crate::server(height, width, n_moves, 3)))
}

/// Makes a sample of robots that flew `n_moves` moves. `bytes` contains their frames and paths.
fn frame(
    sequence: u64,
    (height, width): (u32, u32),
    n_moves: [u32; N_ROBOTS],
    bytes: &[u8],
) -> Sample<FrameHeader> {
    let world = sequence as u32 % 3;
    let mut header = FrameHeader {
        version: VERSION,
        world,
        sequence,
        first_robot: world * N_ROBOTS as u32,
        n_robots: N_ROBOTS as u32,
        height,
        width,
        ..FrameHeader::default()
    };
    (header.result.step, header.result.reward) = (sequence, 1.5);
    let results = n_moves.map(|n_moves| RobotResult {
        n_moves,
        ..RobotResult::default()
    });
    let payload = [bytemuck::cast_slice(&results), bytes].concat();
    Sample { header, payload }
}

/// Makes a sample of the hidden states of a 2 x 3 grid.
fn truth(world: u32, payload: Vec<u8>) -> Sample<TruthHeader> {
    let header = TruthHeader {
        version: VERSION,
        world,
        height: 2,
        width: 3,
        ..TruthHeader::default()
    };
    Sample { header, payload }
}

fn record(nanos: u64, n_lost: u32, event: Event) -> Record {
    Record {
        nanos,
        n_lost,
        event,
    }
}

/// Returns example records: a server with its hidden states and frames, and a second server with another grid.
fn example() -> Vec<Record> {
    let flown =
        |sequence, grid, n_moves, bytes: &[u8]| Event::Frame(frame(sequence, grid, n_moves, bytes));
    vec![
        record(5, 0, server(2, 3, 4)),
        record(5, 0, Event::Truth(truth(0, vec![0, 1, 2, 2, 1, 0]))),
        record(6, 0, flown(0, (2, 3), [0, 0], &[255; 12])),
        record(1 << 40, 3, flown(4, (2, 3), [0, 4], &[1; 16])),
        record(1 << 40, 0, server(1, 2, 1)),
        record(u64::MAX, 0, flown(1, (1, 2), [1, 1], &[255, 1, 0, 2, 3, 0])),
    ]
}

/// Returns a recording of the example, with the offset where each record begins and where the last one ends.
fn written() -> (Vec<u8>, Vec<usize>) {
    let mut bytes = Vec::new();
    let mut writer = Writer::new(&mut bytes).expect("begin");
    let mut places = vec![writer.n_bytes() as usize];
    for record in example() {
        writer.write(&record).expect("write");
        places.push(writer.n_bytes() as usize);
    }
    writer.finish().expect("finish");
    let n_bytes = writer.n_bytes();
    assert_eq!(bytes.len() as u64, n_bytes);
    (bytes, places)
}

/// Returns the readable records, and the error that ends them, if any.
fn read(bytes: &[u8]) -> (Vec<Record>, Option<RecordingError>) {
    let reader = match Reader::new(bytes) {
        Ok(reader) => reader,
        Err(error) => return (Vec::new(), Some(error)),
    };
    let mut error = None;
    let good = reader.map_while(|record| record.map_err(|it| error = Some(it)).ok());
    (good.collect(), error)
}

/// Counts the records of steps, which are frames with k > 0. The example contains no step twice.
fn count_steps(records: &[Record]) -> u64 {
    let is_step = |record: &&Record| matches!(&record.event, Event::Frame(sample) if sample.header.result.step > 0);
    records.iter().filter(is_step).count() as u64
}

fn check_refused(bytes: &[u8], words: &str) {
    let (_, error) = read(bytes);
    let said = error.expect("refused").to_string();
    assert!(said.contains(words), "{said:?} does not say {words:?}");
}

/// Returns a record with this body and a valid checksum.
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
    let (bytes, _) = written();
    let mut reader = Reader::new(&bytes[..]).expect("begin");
    let records: Result<Vec<Record>, _> = reader.by_ref().collect();
    assert_eq!(records.expect("undamaged"), example());
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
    let (bytes, places) = written();
    for length in 0..bytes.len() {
        let (records, error) = read(&bytes[..length]);
        let last = places.iter().rposition(|&place| place <= length);
        assert_eq!(records, example()[..last.unwrap_or(0)], "{length}");
        let offset = last.map_or(0, |last| places[last]);
        let expected = (
            offset as u64,
            (length - offset) as u64,
            count_steps(&records),
        );
        let Some(RecordingError::Cut {
            offset,
            got,
            n_steps,
        }) = error
        else {
            panic!("cut after {length} bytes: {error:?}")
        };
        assert_eq!((offset, got, n_steps), expected);
    }
}

#[test]
fn a_flipped_bit_anywhere_is_noticed() {
    let (mut bytes, _) = written();
    for bit in 0..8 * bytes.len() {
        bytes[bit / 8] ^= 1 << (bit % 8);
        let (records, error) = read(&bytes);
        let error = error.unwrap_or_else(|| panic!("bit {bit}"));
        assert_eq!(records, example()[..records.len()]);
        if let RecordingError::Damaged { n_steps, .. } = error {
            assert_eq!(n_steps, count_steps(&records));
        }
        bytes[bit / 8] ^= 1 << (bit % 8);
    }
}

#[test]
fn other_files_are_refused_by_what_they_begin_with() {
    let words = "got \"PK\\\\x03\\\\x04 and\"";
    check_refused(b"PK\x03\x04 and so on, long enough", words);
    let words = "cut short: expected a whole record at byte 0, got 1 bytes";
    check_refused(b"E", words);
    let (mut bytes, places) = written();
    // A missing record is detected when the end record is read, because it contains the number of records.
    let without = [&bytes[..places[2]], &bytes[places[3]..]].concat();
    check_refused(&without, "totals: expected");
    bytes[8..12].copy_from_slice(&3u32.to_be_bytes());
    check_refused(&bytes, "version: expected 2 to 3, got 50331648");
    bytes[8..16].copy_from_slice(&[3, 0, 0, 0, 2, 0, 0, 0]);
    check_refused(&bytes, "expected 0 in byte 12 to 15, got 2");
}

#[test]
fn a_hostile_record_is_refused_by_where_it_is() {
    let (whole, _) = written();
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
    check(&sealed(1, &twice), "4 bytes after it");
    check(&raw_record(5, b""), "kind: expected 1 to 4, got 5");
    check(&raw_record(1, b"{\"protocol\":1}"), "JSON: missing field");
    check(&raw_record(2, &[0; 95]), "expected 96 bytes, got 95");
    check(&raw_record(3, &[0; 48]), "expected a server before");
    check(&raw_record(4, b"{}"), "JSON: missing field");
    // A checksum does not protect a frame from its author.
    let (_, places) = written();
    let good = frame(1, (2, 3), [0, 4], &[1; 16]);
    let mut body = [bytemuck::bytes_of(&good.header), &good.payload[..]].concat();
    for bit in 0..8 * body.len() {
        body[bit / 8] ^= 1 << (bit % 8);
        let (records, _) = read(&[&whole[..places[1]], &raw_record(2, &body)].concat());
        assert!(records.len() <= 2, "bit {bit}");
        body[bit / 8] ^= 1 << (bit % 8);
    }
    for behind in [b"x", &whole[16..]] {
        check_refused(&[&whole, behind].concat(), "nothing after the end");
    }
}

/// Builds a table whose rows are a change to a sample, and a part of the error that it must cause.
macro_rules! changes {
    ($of:ty, $sample:ident: $($change:block $words:literal)*) => {{
        let changes: &[(fn(&mut Sample<$of>), &str)] = &[$((|$sample| $change, $words)),*];
        changes
    }};
}

#[test]
fn a_writer_refuses_what_a_reader_would() {
    let mut writer = Writer::new(Vec::new()).expect("begin");
    let mut check = |nanos: u64, event: Event, words: &str| {
        let said = match writer.write(&record(nanos, 0, event)) {
            Ok(()) => String::new(),
            Err(error) => error.to_string(),
        };
        let is_expected = said.contains(words) && said.is_empty() == words.is_empty();
        assert!(is_expected, "{said:?} does not say {words:?}");
    };
    let good = frame(1, (2, 3), [0, 4], &[0; 16]);
    check(1, Event::Frame(good.clone()), "expected a server before");
    check(1, server(0, 3, 1), "got 0 x 3");
    check(1, server(2, 3, 5000), "at most 4096, got 5000");
    check(1, server(2, 3, 4), "");
    check(0, server(2, 3, 4), "time: expected at least 1 ns, got 0");
    for (change, words) in changes! { FrameHeader, it:
        { *it = frame(1, (3, 2), [0, 0], &[0; 12]); } "grid: expected 2 x 3, got 3 x 2"
        { *it = frame(1, (2, 3), [1, 0], &[0; 13]); } "expected 0 or 4 moves, got 1"
        { it.payload.push(0); } "payload bytes: expected 112, got 113"
        { it.header.first_robot = 3; } "first robot: expected 2, got 3"
        { let _ = it; } ""
    } {
        let mut sample = good.clone();
        change(&mut sample);
        check(2, Event::Frame(sample), words);
    }
    for (change, words) in changes! { TruthHeader, it:
        { it.payload.pop(); } "expected 6, got 5"
        { it.header.world = 3; } "below 3, got 3"
        { it.header.version = 9; } "version: expected 3, got 9"
    } {
        let mut sample = truth(2, vec![0; 6]);
        change(&mut sample);
        check(2, Event::Truth(sample), words);
    }
}
