//! Fuzz targets for files of worlds: snapshots, recordings and recorded states.

use emberwatch_protocol::Move;
use emberwatch_protocol::recording::Reader;
use emberwatch_protocol::settings::WorldSettings;
use emberwatch_sim::config::ServerConfig;
use emberwatch_sim::snapshot::{SnapshotWorld, WorldSpec, decode, encode};
use emberwatch_sim::states_file::Sequences;
use emberwatch_sim::world::Flown;
use ndarray::{Array3, Axis};
use std::io::Cursor;
use std::sync::OnceLock;

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
                let flown = Flown {
                    moves: &[Move::Right, Move::Down, Move::Left, Move::Down],
                    ready: 3,
                    full: 0,
                    hovered: 0,
                    late: 0,
                };
                episode.step(rules, &flown);
            }
            let step = episode.outcome().step;
            assert!(episode.recall(step).is_ok() && episode.recall(step + 1).is_err());
            episode.reset(rules, 5);
        }
    }
    true
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
