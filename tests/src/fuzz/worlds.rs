//! Fuzz targets for files of worlds: snapshots, recordings and recorded states.

use super::messages::Seed;
use crate::harness::recorded_info;
use emberwatch_protocol::Move;
use emberwatch_protocol::message::{FrameHeader, RobotResult, VERSION};
use emberwatch_protocol::observer::Sample;
use emberwatch_protocol::recording::{Event, Reader, Record, Writer};
use emberwatch_protocol::settings::WorldSettings;
use emberwatch_sim::config::ServerConfig;
use emberwatch_sim::snapshot::{NewEpisode, SnapshotWorld, WorldSpec, decode, encode};
use emberwatch_sim::states_file::Sequences;
use emberwatch_sim::world::{Episode, Flown};
use ndarray::{Array3, Axis};
use ndarray_npy::WriteNpyExt;
use std::io::{Cursor, Write};
use std::sync::OnceLock;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// Length of a snapshot's header in bytes.
const HEADER_BYTES: usize = 24;

/// Lengths of the headers of a recording and of each record, in bytes.
const RECORDING_HEADER: usize = 16;
const RECORD_HEADER: usize = 24;

fn spec() -> &'static WorldSpec {
    static SPEC: OnceLock<WorldSpec> = OnceLock::new();
    SPEC.get_or_init(|| {
        let config = ServerConfig {
            history: 3,
            world: WorldSettings {
                height: 2,
                width: 3,
                moves: 2,
                burn_in: 5,
                robots: 2,
                ..WorldSettings::default()
            },
            ..ServerConfig::default()
        };
        let checked = config.check().expect("valid settings");
        WorldSpec::of(&checked).expect("a valid model")
    })
}

/// Checks that a snapshot is refused, or that its worlds can step and be reset. First corrects the checksum, because it
/// protects only against damage, not against attackers.
pub fn snapshot(bytes: &[u8]) -> bool {
    let mut bytes = bytes.to_vec();
    if bytes.len() >= HEADER_BYTES {
        let (header, body) = bytes.split_at_mut(HEADER_BYTES);
        header[12..16].copy_from_slice(&crc32fast::hash(body).to_ne_bytes());
        header[16..24].copy_from_slice(&(body.len() as u64).to_ne_bytes());
    }
    let WorldSpec { settings, rules } = spec();
    let restored = decode(&bytes).and_then(|snapshot| snapshot.restore(spec()));
    let Ok(worlds) = restored else { return false };
    for world in worlds {
        if let SnapshotWorld::Ready(mut episode) = world {
            let again = encode(settings, &[SnapshotWorld::Ready(&episode)]).expect("small");
            assert!(decode(&again).is_ok());
            if !episode.is_over() {
                episode.step(rules, &flown(3, 0));
            }
            let step = episode.outcome().step;
            assert!(episode.recall(step).is_ok() && episode.recall(step + 1).is_err());
            episode.reset(rules, 5);
        }
    }
    true
}

/// Returns the paths of two robots, with masks of the robots that fly and of those that observe every cell.
fn flown(ready: u64, full: u64) -> Flown<'static> {
    Flown {
        moves: &[Move::Right, Move::Down, Move::Left, Move::Down],
        ready,
        full,
        hovered: !ready & 1,
        late: !ready & 2,
    }
}

/// Corrects a recording's checksums, then checks that the recording is either refused or read to its end.
pub fn recording(bytes: &[u8]) -> bool {
    let mut bytes = bytes.to_vec();
    mend(&mut bytes);
    let Ok(reader) = Reader::new(&*bytes) else {
        return false;
    };
    let mut n_records = 0;
    let mut is_whole = true;
    for record in reader {
        n_records += 1;
        is_whole &= record.is_ok();
        assert!(n_records <= bytes.len(), "more records than bytes");
    }
    is_whole
}

/// Corrects the checksum of each complete record.
fn mend(bytes: &mut [u8]) {
    let mut rest = bytes.get_mut(RECORDING_HEADER..).unwrap_or_default();
    while let Some((header, behind)) = rest.split_first_chunk_mut::<RECORD_HEADER>() {
        let length = u32::from_ne_bytes([header[12], header[13], header[14], header[15]]);
        let Some((body, next)) = behind.split_at_mut_checked(length as usize) else {
            break;
        };
        let mut hasher = crc32fast::Hasher::new();
        hasher.update(&header[..RECORD_HEADER - 4]);
        hasher.update(body);
        header[RECORD_HEADER - 4..].copy_from_slice(&hasher.finalize().to_ne_bytes());
        rest = next;
    }
}

pub fn snapshot_seeds() -> Vec<Seed> {
    let WorldSpec { settings, rules } = spec();
    let mut flown_in = Episode::new(rules, 3);
    for (ready, full) in [(3, 0), (3, 1), (1, 0), (2, 2)] {
        flown_in.step(rules, &flown(ready, full));
    }
    let in_burn_in = SnapshotWorld::New(NewEpisode {
        seed: 1,
        episode: 2,
    });
    let new = Episode::new(rules, 4);
    let written = |worlds: &[SnapshotWorld<&Episode>]| encode(settings, worlds).expect("small");
    vec![
        ("flown", written(&[SnapshotWorld::Ready(&flown_in)])),
        (
            "three",
            written(&[
                SnapshotWorld::Ready(&new),
                in_burn_in,
                SnapshotWorld::Ready(&flown_in),
            ]),
        ),
        ("none", written(&[])),
    ]
}

pub fn recording_seeds() -> Vec<Seed> {
    let info = recorded_info(2, 2);
    let mut header = FrameHeader {
        version: VERSION,
        n_robots: 2,
        height: 2,
        width: 3,
        ..FrameHeader::default()
    };
    (header.result.step, header.result.late) = (1, 2);
    let robots = [2, 0].map(|n_moves| RobotResult {
        n_moves,
        ..RobotResult::default()
    });
    let behind = [255, 0, 255, 255, 1, 255, 255, 255, 255, 255, 255, 255, 3, 1];
    let payload = [bytemuck::cast_slice(&robots), behind.as_slice()].concat();
    let events = [
        Event::Server(Box::new(info)),
        Event::Frame(Sample { header, payload }),
    ];
    let mut bytes = Vec::new();
    let mut writer = Writer::new(&mut bytes).expect("memory");
    for (nanos, event) in events.into_iter().enumerate() {
        let record = Record {
            nanos: nanos as u64,
            n_lost: 0,
            event,
        };
        writer.write(&record).expect("a record that may be");
    }
    writer.finish().expect("memory");
    drop(writer);
    let cut = bytes[..bytes.len() - 5].to_vec();
    vec![("frame", bytes), ("cut", cut)]
}

/// Checks that an archive or array of recorded states (values 0 to 2) is refused, or that all its sequences are on the
/// same grid.
pub fn states(bytes: &[u8]) -> bool {
    let mut sequences = Sequences::new(3);
    let added = if bytes.starts_with(b"\x93NUMPY") {
        sequences.add_array("one", bytes.len() as u64, bytes)
    } else {
        sequences.add_archive(Cursor::new(bytes))
    };
    let shape = |array: &Array3<u8>| [1, 2].map(|axis| array.len_of(Axis(axis)));
    for array in &sequences.arrays {
        assert!(array.len_of(Axis(0)) >= 2 && array.iter().all(|&state| state < 3));
        assert_eq!(shape(array), shape(&sequences.arrays[0]));
        assert!(array.as_slice().is_some() && array.len() <= 2000 * bytes.len());
    }
    added.is_ok()
}

pub fn states_seeds() -> Vec<Seed> {
    let array = |n_recorded: usize| {
        let states = Array3::from_shape_fn((n_recorded, 2, 3), |(k, row, col)| {
            ((k + row + col) % 3) as u8
        });
        let mut bytes = Vec::new();
        states.write_npy(&mut bytes).expect("into memory");
        bytes
    };
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for (name, n_recorded) in [("states_000.npy", 2), ("states_001.npy", 3)] {
        archive.start_file(name, options).expect("a new member");
        archive.write_all(&array(n_recorded)).expect("into memory");
    }
    let archive = archive.finish().expect("into memory").into_inner();
    vec![("array", array(4)), ("archive", archive)]
}
