use super::*;
use emberwatch_model::Model;
use std::path::PathBuf;

type State = (Vec<u64>, Option<String>);

fn state() -> State {
    (vec![3, u64::MAX], Some("words".into()))
}

fn contents() -> Contents {
    let kernel = ("kernel".into(), vec![2, 2], vec![1.0, -0.5, 0.0, 3e-9]);
    let mut contents = Contents::new([kernel], &state());
    contents.settings = "seed = 3".into();
    contents.worlds = WorldNames::of(&Model::wildfire());
    contents
}

fn place() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("checkpoint.safetensors");
    (folder, path)
}

#[test]
fn written_checkpoints_are_read_back() {
    let (folder, path) = place();
    write(&path, "tests", &contents()).expect("written");
    write(&path, "tests", &contents()).expect("written over");
    let (kind, read) = read(&path).expect("read");
    assert_eq!((&*kind, &read), ("tests", &contents()));
    assert_eq!(read.state::<State>().expect("its state"), state());
    assert_eq!(read.settings().expect("settings").seed, 3);
    let files = std::fs::read_dir(folder.path()).expect("the folder");
    assert_eq!(files.count(), 1, "nothing left next to it");
}

#[test]
fn equal_contents_encode_to_equal_bytes() {
    let mut other = contents();
    let kernel = other.tensors.remove("kernel").expect("a tensor");
    other
        .tensors
        .insert("bias \"\u{e9}\n".into(), kernel.clone());
    other.tensors.insert("kernel".into(), kernel);
    for contents in [contents(), other] {
        let first = encode("tests", &contents).expect("small");
        let (_, read) = decode(&first).expect("whole");
        assert_eq!(read, contents);
        // safetensors iterates over a hash map in one of 24 random orders, so ten equal results in a row are no
        // coincidence.
        for _ in 0..10 {
            assert!(encode("tests", &contents).expect("small") == first);
        }
    }
}

#[test]
fn truncated_and_corrupted_files_are_rejected() {
    let (_folder, path) = place();
    write(&path, "tests", &contents()).expect("written");
    let whole = std::fs::read(&path).expect("readable");
    let read = |bytes: &[u8]| {
        std::fs::write(&path, bytes).expect("written");
        let read = read(&path).map(|(_, contents)| contents);
        read.map_err(|error| format!("{error:#}"))
    };
    let check = |bytes: &[u8], what: String| match read(bytes) {
        // The file stays readable if only the header's padding changes.
        Ok(got) => assert!(bytes.len() == whole.len() && got == contents(), "{what}"),
        Err(error) => assert!(
            error.contains("checkpoint.safetensors: ") && error.contains("expected"),
            "{what}: {error}"
        ),
    };
    for at in 0..whole.len() {
        check(&whole[..at], format!("cut to {at}"));
        let mut bytes = whole.clone();
        bytes[at] ^= 1;
        check(&bytes, format!("byte {at}"));
    }
}

#[test]
fn errors_name_the_kind_format_tensor_or_state() {
    let whole = encode("tests", &contents()).expect("small");
    for (from, to, words) in [
        (
            "emberwatch.kind",
            "emberwatch.kinb",
            "kind: expected the name of a learner, got none",
        ),
        (
            r#"format":"6""#,
            r#"format":"9""#,
            "format: expected 6, got 9, of another release: train it again",
        ),
        (
            r#"format":"6""#,
            r#"formar":"6""#,
            "format: expected 6, got none, of another release: train it again",
        ),
    ] {
        let mut words_at = whole.windows(from.len());
        let at = words_at.position(|word| word == from.as_bytes());
        let (mut bytes, at) = (whole.clone(), at.expect("in the file"));
        bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
        let error = decode(&bytes).expect_err(to).to_string();
        assert_eq!(error, format!("emberwatch.{words}"));
    }
    let got = contents();
    for (name, words) in [
        ("kernel", "kernel: expected shape [4], got [2, 2]"),
        ("bias", "bias: expected a tensor of shape [4], got none"),
    ] {
        assert_eq!(got.tensor(name, &[4]).expect_err(name).to_string(), words);
    }
    let forged = Contents::new([], &u64::MAX).state::<Vec<String>>();
    for (error, words) in [
        (
            got.state::<u64>().map(drop),
            "state: expected 8 bytes, got ",
        ),
        (forged.map(drop), "state: expected the state of its learner"),
        (
            read(Path::new("no/such")).map(drop),
            "checkpoint no/such: No such file",
        ),
        (
            read(Path::new("/dev/zero")).map(drop),
            "checkpoint /dev/zero: expected a regular file",
        ),
    ] {
        let error = format!("{:#}", error.expect_err(words));
        assert!(error.starts_with(words), "{error}");
    }
}
