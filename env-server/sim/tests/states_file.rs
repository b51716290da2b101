//! States files as NumPy writes them, and broken ones: one error each.

use emberwatch_model::built_in::state_names;
use emberwatch_sim::config::ServerConfig;
use emberwatch_sim::states_file::{Sequences, StatesFile};
use ndarray::{Array, Array3, Dimension};
use ndarray_npy::{WritableElement, WriteNpyExt};
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

/// What the header of an array says.
const HEADER: &str = "{'descr': '|u1', 'fortran_order': False, 'shape': (2, 3, 4), }\n";

/// What replaces a part of this header, and the problem of the array then.
const WRONG_HEADERS: &str = "
|u1 => <f4 => expected dtype '|u1' (uint8), got '<f4'
|u1 => |i1 => expected dtype '|u1' (uint8), got '|i1'
|u1 => |b1 => expected dtype '|u1' (uint8), got '|b1'
(2, 3, 4) => (2, 3, 4, 1) => expected three axes [K, H, W], got 4
(2, 3, 4) => (24,) => expected three axes [K, H, W], got 1
(2, 3, 4) => (0, 3, 4) => expected the array alone, got 24 bytes
(2, 3, 4) => (2, 3, 5) => cut short: expected 6 bytes more
2, 3 => 999999, 999999999 => cut short: expected
2, 3 => 99999999999, 99999999999 => expected a NumPy array:
'shape' => 'form' => expected a NumPy array:
False => [[[[[[[[ => expected a NumPy array:
";

fn sequence(first: usize, dim: (usize, usize, usize)) -> Array3<u8> {
    let mut states = (first..).map(|n| (n % 3) as u8);
    Array3::from_shape_simple_fn(dim, || states.next().expect("endless"))
}

fn npy<T: WritableElement, D: Dimension>(array: &Array<T, D>) -> Vec<u8> {
    let mut bytes = Vec::new();
    array.write_npy(&mut bytes).expect("into memory");
    bytes
}

/// An array of 24 cells under a header of one's own.
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

/// A file with a description beside it.
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
    // As Python sorts them: "a" before "a-b", whose member's name would come first.
    let members = [("b.npy", third), ("a.npy", first), ("a-b.npy", second)];
    let mut checksums = Vec::new();
    for method in [CompressionMethod::Stored, CompressionMethod::Deflated] {
        let file = read("lab.npz", &npz(&members, method)).expect("valid");
        assert_eq!(file.sequences.arrays, sequences);
        assert_eq!((file.shape.height(), file.shape.width()), (3, 4));
        assert_eq!(
            (&*file.description.step, file.model.n_states()),
            ("10 min", 3)
        );
        checksums.push(file.sequences.checksum());
    }
    let [_, second, third] = members.map(|(_, bytes)| bytes);
    let others = read("lab.npz", &stored(&[("a.npy", second), ("b.npy", third)]));
    checksums.push(others.expect("valid").sequences.checksum());
    assert_eq!(checksums[0], checksums[1]);
    assert_ne!(checksums[0], checksums[2]);
}

#[test]
fn an_array_is_a_sequence_in_either_order_of_memory() {
    let rows = sequence(0, (4, 3, 5));
    let file = read("lab.npy", &npy(&rows)).expect("valid");
    assert_eq!(file.sequences.arrays, std::slice::from_ref(&rows));
    let mut columns = Array3::zeros(ndarray::ShapeBuilder::f(rows.dim()));
    columns.assign(&rows);
    let bytes = npy(&columns);
    assert!(
        bytes.windows(4).any(|word| word == b"True"),
        "Fortran order"
    );
    let file = read("lab.npy", &bytes).expect("valid");
    assert_eq!(file.sequences.arrays, [rows]);
    assert!(file.sequences.arrays[0].is_standard_layout());
}

#[test]
fn a_folder_is_read_in_the_order_of_its_files() {
    let folder = TempDir::new().expect("a folder");
    let [first, second, third] = [0, 1, 2].map(|n| sequence(n, (3, 2, 2)));
    let place = |name: &str| folder.path().join(name);
    write(place("2.npy"), npy(&second)).expect("write");
    write(place("10.npz"), stored(&[("x.npy", npy(&first))])).expect("write");
    write(place("3.npz"), stored(&[("x.npy", npy(&third))])).expect("write");
    write(place("README.md"), "not read").expect("write");
    write(place("states.toml"), DESCRIPTION).expect("write");
    let file = StatesFile::read(folder.path()).expect("valid");
    assert_eq!(file.sequences.arrays, [first, second, third]);
}

#[test]
fn broken_files_are_refused_each_by_its_problem() {
    let whole = npy(&sequence(0, (2, 3, 4)));
    let check = |name: &str, bytes: &[u8], words: &str| {
        let error = read(name, bytes).expect_err(words);
        assert!(error.starts_with("states file /"), "{error}");
        assert!(error.contains(words), "{error:?} does not say {words:?}");
    };
    let array = |bytes: &[u8], words: &str| {
        check("lab.npy", bytes, &format!("array \"lab\": {words}"));
        let archive = stored(&[("one.npy", bytes.to_vec())]);
        check("lab.npz", &archive, &format!("array \"one\": {words}"));
    };
    let header = |from: &str, to: &str| npy_with(&HEADER.replace(from, to));
    let right = read("lab.npy", &npy_with(HEADER));
    assert!(right.is_ok(), "but for what is replaced");
    for line in WRONG_HEADERS.trim_start().lines() {
        let mut parts = line.split(" => ");
        let [from, to, words] = [(); 3].map(|()| parts.next().expect(line));
        array(&header(from, to), words);
    }
    let short = "expected at least 2 recorded steps, got 1";
    array(&npy(&sequence(0, (1, 3, 4))), short);
    for (height, width) in [(0, 4), (1, 4097)] {
        let got = format!("expected height and width in 1..=4096, got {height} x {width}");
        let empty = npy(&sequence(0, (2, height, width)));
        array(&empty, &format!("grid shape: {got}"));
    }
    let long = "expected a NumPy array with a header of at most 512 bytes, got 60058";
    array(&header("False", &"[".repeat(60_000)), long);
    let cut = &whole[..whole.len() - 1];
    array(cut, "cut short: expected 1 bytes more");
    array(b"", "expected a NumPy array: ");
    array(b"PNG and so on", "expected a NumPy array: ");
    let mut fourth = sequence(0, (2, 3, 4));
    fourth[[1, 2, 3]] = 3;
    let words =
        "expected states below 3, as the description has, got 3 in cell (2, 3) of recorded step 1";
    array(&npy(&fourth), words);
    check("lab.npz", &whole, "expected a .npz archive: ");
    check("lab.npz", b"", "expected a .npz archive: ");
    let none = "expected at least one array, got none";
    check("lab.npz", &stored(&[]), none);
    let text = "expected arrays alone, got the member \"a.txt\"";
    check("lab.npz", &stored(&[("a.txt", whole.clone())]), text);
    let turned = npy(&sequence(0, (2, 4, 3)));
    let two = stored(&[("a.npy", whole.clone()), ("b.npy", turned)]);
    let words = "array \"b\": expected 3 x 4 cells as the first array has, got 4 x 3";
    check("lab.npz", &two, words);
    let deflated = npz(&[("a.npy", whole.clone())], CompressionMethod::Deflated);
    let half = &deflated[..deflated.len() / 2];
    check("lab.npz", half, "expected a .npz archive: ");
    let place = deflated.len() / 4;
    let mut damaged = deflated;
    damaged[place] ^= 0xff;
    check("lab.npz", &damaged, "array \"a\": ");
    let mut twice = stored(&[("one.npy", whole.clone()), ("two.npy", whole.clone())]);
    while let Some(at) = twice.windows(7).position(|name| name == b"two.npy") {
        twice[at..at + 7].copy_from_slice(b"one.npy");
    }
    let words = "expected 1 arrays, one of each name, got 2";
    check("lab.npz", &twice, words);
    let words = "expected a .npz or .npy file, or a folder of these, got \"lab.tif\"";
    check("lab.tif", &whole, words);
}

/// What replaces a part of the description, and the problem then.
const WRONG_DESCRIPTIONS: &str = r#"
step = => pace = => unknown field `pace`
step = "10 min" =>  => missing field `step`
step = => kernel_size = => unknown field `kernel_size`
reward = 1.0 => initial = 1.0 => unknown field `initial`
[0.2, 0.8] => [0.2, 0.7] => state "burning": observed_as: expected a sum of 1
[0.2, 0.8] => [1.0] => expected 2 probabilities, one per observation, got 1
"burnt" => "burning" => state name "burning" stands twice
#777777 => grey => expected #rrggbb, got grey
step = => step => expected
"#;

#[test]
fn descriptions_are_checked_as_model_files_are() {
    let folder = TempDir::new().expect("a folder");
    let path = file_in(&folder, "lab.npy", &npy(&sequence(0, (2, 3, 4))));
    let place = path.with_extension("toml");
    let check = |words: &str| {
        let error = StatesFile::read(&path).expect_err(words).to_string();
        let about = format!("description {}: ", place.display());
        let is_named = error.contains(&about) && error.contains(words);
        assert!(is_named, "{error:?}: {words:?}");
    };
    for line in WRONG_DESCRIPTIONS.trim().lines() {
        let mut parts = line.split(" => ");
        let [from, to, words] = [(); 3].map(|()| parts.next().expect(line));
        assert!(DESCRIPTION.contains(from));
        write(&place, DESCRIPTION.replace(from, to)).expect("write");
        check(words);
    }
    std::fs::remove_file(&place).expect("remove");
    check("No such file");
}

#[test]
fn what_is_no_file_is_refused() {
    let folder = TempDir::new().expect("a folder");
    let check = |path: &Path, words: &str| {
        let error = StatesFile::read(path).expect_err(words).to_string();
        assert!(error.contains(words), "{error:?} does not say {words:?}");
    };
    let gone = folder.path().join("gone.npz");
    check(&gone, "gone.npz: No such file");
    write(gone.with_extension("toml"), DESCRIPTION).expect("write");
    check(&gone, "gone.npz: No such file");
    let empty = folder.path().join("empty");
    create_dir(&empty).expect("make");
    let words = "expected .npz or .npy files in the folder, got none";
    check(&empty, words);
    write(empty.join("a.npy"), npy(&sequence(0, (2, 3, 4)))).expect("write");
    check(&empty, "empty/states.toml: No such file");
    write(empty.join("states.toml"), DESCRIPTION).expect("write");
    assert!(StatesFile::read(&empty).is_ok());
    create_dir(empty.join("b.npy")).expect("make");
    let other = "expected a regular file, got something else";
    check(&empty, &format!("b.npy: {other}"));
    std::fs::remove_file(empty.join("states.toml")).expect("remove");
    create_dir(empty.join("states.toml")).expect("make");
    check(&empty, &format!("states.toml: {other}"));
}

#[test]
fn what_is_claimed_takes_no_memory_before_it_is_checked() {
    // A member that says that it has 3 GiB, twice: neither is there.
    let header = HEADER.replace("(2, 3, 4)", "(196608, 128, 128)");
    let bytes = npy_with(&header);
    let claimed = (3_u32 << 30) + 10 + header.len() as u32;
    let mut archive = stored(&[("a.npy", bytes.clone()), ("b.npy", bytes)]);
    let central = archive.windows(4).position(|word| word == b"PK\x01\x02");
    let mut at = central.expect("a directory");
    for _ in 0..2 {
        archive[at + 24..at + 28].copy_from_slice(&claimed.to_le_bytes());
        at += 46 + "a.npy".len();
    }
    let error = read("lab.npz", &archive).expect_err("neither is there");
    assert!(
        error.contains(&format!("array \"a\": expected {claimed} bytes, got ")),
        "{error}"
    );
}

#[test]
fn a_header_is_checked_before_the_values_are_read() {
    let with = |bytes: &[u8]| {
        let values = bytes.len() as u64 + (1 << 30);
        let cut = bytes.chain(Broken);
        let added = Sequences::new(3).add_array("one", values, cut);
        added.expect_err("the values break off")
    };
    let zeros = |header: &str| npy_with(header)[..10 + header.len()].to_vec();
    for (from, to, words) in [
        ("|u1", "<f4", "expected dtype '|u1' (uint8), got '<f4'"),
        (
            "(2, 3, 4)",
            "(2, 3)",
            "expected three axes [K, H, W], got 2",
        ),
        ("(2, 3, 4)", "(2, 3, 4)", "expected the array alone, got "),
        ("(2, 3, 4)", "(9, 32768, 32768)", "cut short: expected "),
        ("(2, 3, 4)", "(1, 32768, 32768)", "grid shape: expected "),
        ("(2, 3, 4)", "(1, 1, 1073741824)", "grid shape: expected "),
    ] {
        let error = with(&zeros(&HEADER.replace(from, to)));
        assert!(error.contains(words), "{error:?} does not say {words:?}");
    }
    let right = with(&zeros(&HEADER.replace("(2, 3, 4)", "(64, 4096, 4096)")));
    assert_eq!(right, "array \"one\": broken");
}

/// A reader that ends in an error.
struct Broken;

impl Read for Broken {
    fn read(&mut self, _: &mut [u8]) -> std::io::Result<usize> {
        Err(std::io::Error::other("broken"))
    }
}

#[test]
fn settings_follow_the_file_and_offsets_leave_a_step() {
    let folder = TempDir::new().expect("a folder");
    let members = [
        ("a.npy", npy(&sequence(0, (5, 3, 4)))),
        ("b.npy", npy(&sequence(0, (9, 3, 4)))),
    ];
    let path = file_in(&folder, "lab.npz", &stored(&members));
    let config = |states_offset| ServerConfig {
        states: path.display().to_string(),
        states_offset,
        ..ServerConfig::default()
    };
    let checked = config(3).check().expect("valid");
    let settings = &checked.config;
    assert_eq!(
        (settings.height, settings.width, settings.burn_in),
        (3, 4, 0)
    );
    assert_eq!(settings.model, "");
    let recorded = checked.recorded.expect("it is").recorded;
    assert_eq!((recorded.n_sequences(), recorded.n_steps()), (2, 1));
    let error = config(4).check().expect_err("no step is left").to_string();
    assert_eq!(
        error,
        "states_offset: expected 0 to 3, as the shortest sequence allows, got 4"
    );
    let without = ServerConfig {
        states_symmetries: true,
        ..ServerConfig::default()
    };
    let error = without.check().expect_err("no file").to_string();
    assert!(
        error.contains("expected none without a states file"),
        "{error}"
    );
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
