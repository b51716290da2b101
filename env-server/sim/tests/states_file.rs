//! Tests of states files: files in the form in which NumPy writes them, and the error for each kind of broken file.

use emberwatch_model::built_in::state_names;
use emberwatch_sim::config::ServerConfig;
use emberwatch_sim::states_file::{Sequences, StatesFile};
use ndarray::{Array, Array3, Dimension};
use ndarray_npy::{WritableElement, WriteNpyExt};
use serde_json::{Value, json};
use std::fs::{create_dir, write};
use std::io::{Cursor, Read, Write};
use std::path::{Path, PathBuf};
use tempfile::TempDir;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

const DESCRIPTION: &str = r##"
name = "lab"
step = "10 min"
states = [
    { name = "unburnt", color = "#000000", observed_as = [0.9, 0.1] },
    { name = "burning", color = "#ff0000", observed_as = [0.2, 0.8], reward = 1.0 },
    { name = "burnt", color = "#777777", observed_as = [0.9, 0.1] },
]
observations = [{ name = "cold", color = "#000000" }, { name = "hot", color = "#ff0000" }]
"##;

/// A valid header of an array.
const HEADER: &str = "{'descr': '|u1', 'fortran_order': False, 'shape': (2, 3, 4), }\n";

/// Rows of three fields: a part of [`HEADER`] => its replacement => a part of the expected error.
const WRONG_HEADERS: &str = "
|u1 => <f4 => expected dtype '|u1' (uint8), got '<f4'
|u1 => |b1 => expected dtype '|u1' (uint8), got '|b1'
(2, 3, 4) => (2, 3, 4, 1) => expected three axes [K, H, W], got 4
(2, 3, 4) => (0, 3, 4) => expected the end after the array, got 24 more bytes
(2, 3, 4) => (1, 4, 6) => expected at least 2 recorded steps, got 1
(2, 3, 4) => (2, 3, 5) => cut short: expected 6 more bytes
2, 3 => 999999, 999999999 => cut short: expected
2, 3 => 99999999999, 99999999999 => expected a NumPy array:
'shape' => 'form' => expected a NumPy array:
False => [[[[[[[[ => expected a NumPy array:
";

/// Builds an array of `(bytes, words)` pairs from rows.
macro_rules! rows {
    ($($bytes:expr => $words:expr;)*) => {
        [$(($bytes, $words)),*]
    };
}

fn sequence(first: usize, dim: (usize, usize, usize)) -> Array3<u8> {
    let mut states = (first..).map(|n| (n % 3) as u8);
    Array3::from_shape_simple_fn(dim, || states.next().expect("endless"))
}

fn npy<T: WritableElement, D: Dimension>(array: &Array<T, D>) -> Vec<u8> {
    let mut bytes = Vec::new();
    array.write_npy(&mut bytes).expect("into memory");
    bytes
}

/// Returns an array file of 24 cells with the given header.
fn npy_with(header: &str) -> Vec<u8> {
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend([0; 24]);
    bytes
}

fn npz(members: &[(&str, Vec<u8>)], method: CompressionMethod) -> Vec<u8> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(method);
    for (name, bytes) in members {
        archive.start_file(*name, options).expect("a new member");
        archive.write_all(bytes).expect("into memory");
    }
    archive.finish().expect("into memory").into_inner()
}

fn stored(members: &[(&str, Vec<u8>)]) -> Vec<u8> {
    npz(members, CompressionMethod::Stored)
}

/// Writes a file and a description next to it, and returns the file's path.
fn file_in(folder: &TempDir, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.path().join(name);
    write(&path, bytes).expect("write");
    write(path.with_extension("toml"), DESCRIPTION).expect("write");
    path
}

fn read(name: &str, bytes: &[u8]) -> Result<StatesFile, String> {
    let folder = TempDir::new().expect("a folder");
    let path = file_in(&folder, name, bytes);
    StatesFile::read(&path).map_err(|error| error.to_string())
}

#[test]
fn archives_stored_or_deflated_are_read_in_the_order_of_names() {
    let sequences = [
        sequence(0, (5, 3, 4)),
        sequence(1, (2, 3, 4)),
        sequence(2, (9, 3, 4)),
    ];
    let [first, second, third] = sequences.each_ref().map(npy);
    // Python sorts the names without `.npy`, so "a" comes before "a-b". With the ending, "a-b.npy" would come before
    // "a.npy".
    let members = [("b.npy", third), ("a.npy", first), ("a-b.npy", second)];
    let mut checksums = Vec::new();
    for method in [CompressionMethod::Stored, CompressionMethod::Deflated] {
        let file = read("lab.npz", &npz(&members, method)).expect("valid");
        assert_eq!(file.sequences.arrays, sequences);
        assert_eq!((file.shape.height(), file.shape.width()), (3, 4));
        assert_eq!(&*file.description.step, "10 min");
        checksums.push(file.sequences.checksum());
    }
    let other = read("lab.npz", &stored(&members[1..])).expect("valid");
    assert_eq!(checksums[0], checksums[1]);
    assert_ne!(checksums[0], other.sequences.checksum());
}

#[test]
fn arrays_of_either_order_are_read_in_the_order_of_their_files() {
    let sequences = [0, 1, 2].map(|n| sequence(n, (3, 4, 5)));
    let [first, second, third] = &sequences;
    let mut columns = Array3::zeros(ndarray::ShapeBuilder::f(second.dim()));
    columns.assign(second);
    let columns = npy(&columns);
    assert!(columns.windows(4).any(|word| word == b"True"), "Fortran");
    let folder = TempDir::new().expect("a folder");
    for (name, bytes) in [
        ("2.npy", columns),
        ("10.npz", stored(&[("x.npy", npy(first))])),
        ("3.npy", npy(third)),
        ("README.md", b"not read".to_vec()),
        ("states.toml", DESCRIPTION.into()),
    ] {
        write(folder.path().join(name), bytes).expect("write");
    }
    let file = StatesFile::read(folder.path()).expect("valid");
    assert_eq!(file.sequences.arrays, sequences);
    assert!(file.sequences.arrays[1].is_standard_layout());
}

#[test]
fn broken_arrays_are_refused_each_by_its_problem() {
    let check = |bytes: &[u8], words: &str| {
        let error = read("lab.npy", bytes).expect_err(words);
        let expected = format!("array \"lab\": {words}");
        assert!(error.starts_with("states file /"), "{error}");
        assert!(error.contains(&expected), "{error:?}: {expected:?}");
    };
    // The header is checked before the values are read.
    let breaks_off = |header: &str, n_values: u64| {
        let bytes = npy_with(header);
        let start = &bytes[..10 + header.len()];
        let n_bytes = start.len() as u64 + n_values;
        let added = Sequences::new(3).add_array("one", n_bytes, start.chain(Broken));
        added.expect_err("the values are cut short")
    };
    let header = |from: &str, to: &str| HEADER.replace(from, to);
    assert!(read("lab.npy", &npy_with(HEADER)).is_ok());
    let largest = header("(2, 3, 4)", "(64, 4096, 4096)");
    assert_eq!(breaks_off(&largest, 1 << 30), "array \"one\": broken");
    for line in WRONG_HEADERS.trim_start().lines() {
        let mut parts = line.split(" => ");
        let [from, to, words] = [(); 3].map(|()| parts.next().expect(line));
        check(&npy_with(&header(from, to)), words);
        let error = breaks_off(&header(from, to), 24);
        assert!(error.contains(words), "{error:?}: {words:?}");
    }
    for (dim, n_cells) in [
        ("(1, 32768, 32768)", 1 << 30),
        ("(1, 1, 1073741824)", 1 << 30),
        ("(2, 0, 4)", 0),
    ] {
        let error = breaks_off(&header("(2, 3, 4)", dim), n_cells);
        let words = "grid shape: expected height and width in 1..=4096, got";
        assert!(error.contains(words), "{error}");
    }
    let mut fourth = sequence(0, (2, 3, 4));
    fourth[[1, 2, 3]] = 3;
    for (bytes, words) in rows! {
        npy(&fourth) => "expected states below 3, as in the description, got 3 in cell (2, 3) of recorded step 1";
        npy_with(&header("False", &"[".repeat(60_000))) => "expected a NumPy array with a header of at most 512 bytes, got 60058";
        b"".to_vec() => "expected a NumPy array: ";
    } {
        check(&bytes, words);
    }
}

/// A reader that always fails.
struct Broken;

impl Read for Broken {
    fn read(&mut self, _: &mut [u8]) -> std::io::Result<usize> {
        Err(std::io::Error::other("broken"))
    }
}

#[test]
fn broken_archives_are_refused_each_by_its_problem() {
    let whole = npy(&sequence(0, (2, 3, 4)));
    let two = |name: &'static str, second: &[u8]| {
        stored(&[("one.npy", whole.clone()), (name, second.to_vec())])
    };
    let deflated = npz(&[("a.npy", whole.clone())], CompressionMethod::Deflated);
    let mut damaged = deflated.clone();
    damaged[deflated.len() / 4] ^= 0xff;
    let mut twice = two("two.npy", &whole);
    while let Some(at) = twice.windows(7).position(|name| name == b"two.npy") {
        twice[at..at + 7].copy_from_slice(b"one.npy");
    }
    // Two members claim 3 GiB each but contain less. Memory must not be allocated for the claimed sizes.
    let header = HEADER.replace("(2, 3, 4)", "(196608, 128, 128)");
    let bytes = npy_with(&header);
    let claimed = (3_u32 << 30) + 10 + header.len() as u32;
    let mut large = stored(&[("a.npy", bytes.clone()), ("b.npy", bytes)]);
    let central = large.windows(4).position(|word| word == b"PK\x01\x02");
    let first = central.expect("a directory") + 24;
    for at in [first, first + 46 + "a.npy".len()] {
        large[at..at + 4].copy_from_slice(&claimed.to_le_bytes());
    }
    let turned = npy(&sequence(0, (2, 4, 3)));
    for (bytes, words) in rows! {
        whole.clone() => "expected a .npz (zip) archive, got another or a damaged file (";
        deflated[..deflated.len() / 2].to_vec() => "expected a .npz (zip) archive, got another or a damaged file (";
        stored(&[]) => "expected at least one array, got none";
        two("a.txt", &whole) => "expected only .npy members, got \"a.txt\"";
        two("two.npy", &turned) => "array \"two\": expected 3 x 4 cells, as in the first array, got 4 x 3";
        damaged => "array \"a\": ";
        twice => "expected distinct array names, got 1 for 2 arrays";
        large => &*format!("array \"a\": expected {claimed} bytes, got ");
    } {
        let error = read("lab.npz", &bytes).expect_err(words);
        assert!(error.contains(words), "{error:?} does not say {words:?}");
    }
    for (name, good) in [("lab.npz", &deflated), ("lab.npy", &whole)] {
        for at in 0..good.len() {
            let mut changed = good.clone();
            changed[at] ^= 0x81;
            let _ = read(name, &changed); // any result, but no panic
        }
    }
    let error = read("lab.tif", &whole).expect_err("another ending");
    let words = "expected a .npz or .npy file, or a folder of these, got \"lab.tif\"";
    assert!(error.contains(words), "{error}");
}

#[test]
fn what_is_no_file_or_has_no_description_is_refused() {
    let folder = TempDir::new().expect("a folder");
    let check = |path: &Path, words: &str| {
        let error = StatesFile::read(path).expect_err(words).to_string();
        assert!(error.contains(words), "{error:?} does not say {words:?}");
    };
    let other = "expected a regular file, got a folder, pipe or device";
    check(&folder.path().join("gone.npz"), "gone.npz: No such file");
    let words = "expected .npz or .npy files in the folder, got none";
    check(folder.path(), words);
    write(folder.path().join("a.npy"), npy(&sequence(0, (2, 3, 4)))).expect("write");
    let place = folder.path().join("states.toml");
    let about = format!("description {}: ", place.display());
    check(folder.path(), &format!("{about}No such file"));
    write(&place, DESCRIPTION.replace("[0.2, 0.8]", "[0.2, 0.7]")).expect("write");
    check(
        folder.path(),
        &format!("{about}model \"lab\": state \"burning\": observed_as: expected a sum of 1"),
    );
    write(&place, DESCRIPTION.replace("step", "pace")).expect("write");
    check(folder.path(), &format!("{about}TOML parse error"));
    write(&place, DESCRIPTION).expect("write");
    create_dir(folder.path().join("b.npy")).expect("make");
    check(folder.path(), &format!("b.npy: {other}"));
    std::fs::remove_file(&place).expect("remove");
    create_dir(&place).expect("make");
    check(folder.path(), &format!("{about}{other}"));
}

#[test]
fn settings_follow_the_file_and_offsets_leave_a_step() {
    let folder = TempDir::new().expect("a folder");
    let members = [
        ("a.npy", npy(&sequence(0, (5, 3, 4)))),
        ("b.npy", npy(&sequence(0, (9, 3, 4)))),
    ];
    let path = file_in(&folder, "lab.npz", &stored(&members));
    let check = |given: Value| {
        let config = ServerConfig::default().with(given.as_object().expect("a dictionary"));
        config.expect("settings").check()
    };
    let config = |offset: u32| json!({"states": path, "states_offset": offset});
    let checked = check(config(3)).expect("valid");
    let settings = &checked.config.world;
    let decided = (settings.height, settings.width, settings.burn_in);
    assert_eq!((decided, &*settings.model), ((3, 4, 0), ""));
    let recorded = checked.recorded.expect("it is").recorded;
    assert_eq!((recorded.n_sequences(), recorded.n_steps()), (2, 1));
    let words = "states_offset: expected 0 to 3, as the shortest sequence allows, got 4";
    let alone = "states_symmetries: expected false without a states file";
    for (given, words) in [
        (config(4), words),
        (json!({"states_symmetries": true}), alone),
    ] {
        let error = check(given).expect_err(words).to_string();
        assert!(error.contains(words), "{error}");
    }
}

#[test]
fn built_in_states_are_those_of_their_files() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/landscapes");
    for name in state_names() {
        let file = folder.join(name).join(name).with_extension("npz");
        let file = StatesFile::read(&file).expect("a states file");
        let built_in = StatesFile::named(name).expect("built in");
        let of = |file: StatesFile| (file.sequences.checksum(), file.description, file.shape);
        assert_eq!(of(built_in), of(file));
    }
}
