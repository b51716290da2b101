use super::*;
use emberwatch_model::Model;

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

#[test]
fn written_checkpoints_are_read_back_and_errors_name_the_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("checkpoint.safetensors");
    write(&path, "tests", &contents()).expect("written");
    write(&path, "tests", &contents()).expect("written over");
    let (kind, got) = read(&path).expect("read");
    assert_eq!((&*kind, &got), ("tests", &contents()));
    assert_eq!(got.state::<State>().expect("its state"), state());
    assert_eq!(got.settings().expect("settings").seed, 3);
    let files = std::fs::read_dir(folder.path()).expect("the folder");
    assert_eq!(files.count(), 1, "nothing left next to it");
    std::fs::write(&path, "no checkpoint").expect("written");
    let damaged = path.display().to_string();
    for (path, words) in [
        (&*damaged, "expected"),
        ("no/such", "No such file"),
        ("/dev/zero", "expected a regular file"),
    ] {
        let error = read(Path::new(path)).map(drop).expect_err(words);
        let (error, start) = (
            format!("{error:#}"),
            format!("{}: ", named(Path::new(path))),
        );
        assert!(
            error.starts_with(&start) && error.contains(words),
            "{error}"
        );
    }
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
    let whole = encode("tests", &contents()).expect("small");
    let check = |bytes: &[u8], what: String| match decode(bytes) {
        // The file stays readable if only the header's padding changes.
        Ok((_, got)) => assert!(bytes.len() == whole.len() && got == contents(), "{what}"),
        Err(error) => assert!(
            format!("{error:#}").contains("expected"),
            "{what}: {error:#}"
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
    let forged = |from: &str, to: &str, words: &str| {
        let mut parts = whole.windows(from.len());
        let at = parts
            .position(|part| part == from.as_bytes())
            .expect("in the file");
        let mut bytes = whole.clone();
        bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
        let error = decode(&bytes).expect_err(to).to_string();
        assert!(error.starts_with(&format!("emberwatch.{words}")), "{error}");
    };
    let words = "kind: expected the name of a learner, got none";
    forged("emberwatch.kind", "emberwatch.kinb", words);
    let words = "format: expected 6, got 9, of another release: train it again";
    forged(r#"format":"6""#, r#"format":"9""#, words);
    forged(
        r#"format":"6""#,
        r#"formar":"6""#,
        "format: expected 6, got none",
    );
    let got = contents();
    for (name, words) in [
        ("kernel", "kernel: expected shape [4], got [2, 2]"),
        ("bias", "bias: expected a tensor of shape [4], got none"),
    ] {
        assert_eq!(got.tensor(name, &[4]).expect_err(name).to_string(), words);
    }
    let error = got.state::<u64>().expect_err("a longer state").to_string();
    assert!(
        error.starts_with("state: expected 8 bytes, got "),
        "{error}"
    );
    let error = Contents::new([], &u64::MAX)
        .state::<Vec<String>>()
        .expect_err("no words");
    assert!(
        error
            .to_string()
            .starts_with("state: expected the state of its learner"),
        "{error}"
    );
}
