//! What a learner keeps between runs: named tensors, bytes and text in one safetensors file.
//!
//! Written beside the file and renamed, so whoever reads finds all or nothing. Read whole or refused:
//! the file says which learner it is of, and a digest tells damage that keeps its form.

mod contents;
mod problem;

pub use self::contents::{Bytes, Contents, Tensor};
pub use self::problem::{CheckpointError, Problem};

use self::problem::MAX_BYTES;

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use std::collections::HashMap;
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

/// Entries of the metadata that this file makes itself.
const KIND: &str = "emberwatch.kind";
const DIGEST: &str = "emberwatch.digest";

/// Writes a checkpoint of a kind of learner, whole or not at all.
///
/// # Errors
/// [`CheckpointError`]; the file is then as it was.
pub fn write(path: &Path, kind: &'static str, contents: &Contents) -> Result<(), CheckpointError> {
    let bytes = encode(kind, contents).map_err(|problem| problem.of(path))?;
    let mut beside = path.as_os_str().to_owned();
    beside.push(format!(".{}", std::process::id()));
    let beside = PathBuf::from(beside);
    // It holds beliefs about worlds, which are their owner's.
    let _ = std::fs::remove_file(&beside);
    let mut options = OpenOptions::new();
    options.write(true).create_new(true).mode(0o600);
    let written = options.open(&beside).and_then(|mut file| {
        file.write_all(&bytes)?;
        file.sync_all()?;
        std::fs::rename(&beside, path)
    });
    if written.is_err() {
        // The first error is the one to tell.
        let _ = std::fs::remove_file(&beside);
    }
    written.map_err(|error| Problem::Io(error).of(path))
}

/// Reads a checkpoint of a kind of learner.
///
/// # Errors
/// [`CheckpointError`] names the file and what is wrong with it.
pub fn read(path: &Path, kind: &'static str) -> Result<Contents, CheckpointError> {
    read_any(path, &[kind]).map(|(_, contents)| contents)
}

/// Reads a checkpoint of one of some kinds, and tells which.
///
/// # Errors
/// [`CheckpointError`] names the file and what is wrong with it.
pub fn read_any(
    path: &Path,
    kinds: &[&'static str],
) -> Result<(&'static str, Contents), CheckpointError> {
    let bytes = || {
        let found = std::fs::metadata(path)?;
        if !found.is_file() {
            return Err(Problem::NoFile);
        }
        if found.len() > MAX_BYTES {
            return Err(Problem::Large(found.len()));
        }
        let mut bytes = Vec::new();
        File::open(path)?.take(MAX_BYTES).read_to_end(&mut bytes)?;
        Ok(bytes)
    };
    let contents = bytes().and_then(|bytes| decode(kinds, &bytes));
    contents.map_err(|problem| problem.of(path))
}

/// A checkpoint of a kind of learner as bytes.
///
/// # Errors
/// [`Problem`].
pub fn encode(kind: &'static str, contents: &Contents) -> Result<Vec<u8>, Problem> {
    let form = |error: safetensors::SafeTensorError| Problem::Form(error.to_string());
    let Contents {
        tensors,
        bytes,
        texts,
    } = contents;
    let numbers = |tensor: &Tensor| -> Vec<u8> {
        let numbers = tensor.numbers.iter();
        numbers.flat_map(|number| number.to_le_bytes()).collect()
    };
    let numbers: Vec<Vec<u8>> = tensors.values().map(numbers).collect();
    let floats = tensors.iter().zip(&numbers);
    let floats = floats.map(|((name, tensor), numbers)| (name, Dtype::F32, &tensor.shape, numbers));
    let bytes = bytes.iter();
    let bytes = bytes.map(|(name, Bytes { shape, bytes })| (name, Dtype::U8, shape, bytes));
    let views = floats.chain(bytes);
    let views = views
        .map(|(name, kind, shape, bytes)| Ok((name, TensorView::new(kind, shape.clone(), bytes)?)));
    let views = views.collect::<Result<Vec<_>, _>>().map_err(form)?;
    let mut texts: HashMap<String, String> = texts.clone().into_iter().collect();
    texts.insert(KIND.into(), kind.into());
    texts.insert(DIGEST.into(), contents.digest());
    let file = safetensors::serialize(views, Some(texts)).map_err(form)?;
    match file.len() as u64 {
        ..=MAX_BYTES => Ok(file),
        size => Err(Problem::Large(size)),
    }
}

/// The checkpoint of one of some kinds that bytes are, and which.
///
/// # Errors
/// [`Problem`].
pub fn decode(kinds: &[&'static str], bytes: &[u8]) -> Result<(&'static str, Contents), Problem> {
    let form = |error: safetensors::SafeTensorError| Problem::Form(error.to_string());
    let file = SafeTensors::deserialize(bytes).map_err(form)?;
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(form)?;
    let mut texts = metadata.metadata().clone().unwrap_or_default();
    let got = texts
        .remove(KIND)
        .unwrap_or_else(|| "something else".into());
    let Some(&kind) = kinds.iter().find(|kind| **kind == got) else {
        let expected = kinds.join(" or ");
        return Err(Problem::Kind { expected, got });
    };
    let expected = texts.remove(DIGEST).unwrap_or_default();
    let mut contents = Contents {
        texts: texts.into_iter().collect(),
        ..Contents::default()
    };
    for (name, view) in file.iter() {
        contents.insert(name, &view)?;
    }
    let got = contents.digest();
    if got != expected {
        return Err(Problem::Digest { expected, got });
    }
    Ok((kind, contents))
}

impl Contents {
    fn insert(&mut self, name: &str, view: &TensorView<'_>) -> Result<(), Problem> {
        let (shape, bytes) = (view.shape().to_vec(), view.data());
        match view.dtype() {
            Dtype::U8 => {
                let bytes = bytes.to_vec();
                self.bytes.insert(name.into(), Bytes { shape, bytes });
            }
            Dtype::F32 => {
                let (numbers, _) = bytes.as_chunks();
                let numbers = numbers.iter().map(|&number| f32::from_le_bytes(number));
                let numbers = numbers.collect();
                self.tensors.insert(name.into(), Tensor { shape, numbers });
            }
            other => {
                return Err(Problem::Value {
                    name: name.into(),
                    expected: "32-bit floats or bytes".into(),
                    got: format!("{other:?}"),
                });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    fn contents() -> Contents {
        let mut contents = Contents::default();
        let tensor = Tensor {
            shape: vec![2, 2],
            numbers: vec![1.0, -0.5, 0.0, 3e-9],
        };
        contents.tensors.insert("kernel".into(), tensor);
        let counts = Bytes::of_counts([3, u64::MAX]);
        contents.bytes.insert("lap".into(), counts);
        let floats = Bytes::of_floats([0.1, 1e-300]);
        contents.bytes.insert("owed".into(), floats);
        let empty = Bytes::of_rows(5, Vec::new());
        contents.bytes.insert("frames".into(), empty);
        contents.texts.insert("updates".into(), "12".into());
        contents
    }

    fn place() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("checkpoint.safetensors");
        (folder, path)
    }

    #[test]
    fn what_is_written_is_read() {
        let (folder, path) = place();
        std::fs::write(&path, "open to everybody").expect("written");
        write(&path, "tests", &contents()).expect("written");
        write(&path, "tests", &contents()).expect("written over");
        assert_eq!(read(&path, "tests").expect("read"), contents());
        let mode = path.metadata().expect("the file").permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        let files = std::fs::read_dir(folder.path()).expect("the folder");
        assert_eq!(files.count(), 1, "nothing left beside it");
    }

    #[test]
    fn every_cut_and_every_flipped_byte_is_refused_by_name() {
        let (_folder, path) = place();
        write(&path, "tests", &contents()).expect("written");
        let whole = std::fs::read(&path).expect("readable");
        let check = |bytes: &[u8], what: &str| {
            std::fs::write(&path, bytes).expect("written");
            let error = read(&path, "tests").expect_err(what).to_string();
            assert!(
                error.contains("checkpoint.safetensors: expected"),
                "{what}: {error}"
            );
        };
        for length in 0..whole.len() {
            check(&whole[..length], &format!("cut to {length}"));
        }
        for at in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 1;
            std::fs::write(&path, &bytes).expect("written");
            // Space that pads the header may change without a change of meaning.
            if let Ok(got) = read(&path, "tests") {
                assert_eq!(got, contents(), "byte {at}");
            }
        }
    }

    #[test]
    fn another_kind_shape_or_number_is_named() {
        let (_folder, path) = place();
        write(&path, "tests", &contents()).expect("written");
        let error = read(&path, "others").expect_err("another kind").to_string();
        assert!(
            error.ends_with("expected a checkpoint of others, got one of tests"),
            "{error}"
        );
        let read = read(&path, "tests").expect("read");
        let error = |result: Result<&[f32], Problem>| result.expect_err("wrong").to_string();
        let words = "kernel: expected shape [4], got [2, 2]";
        assert_eq!(error(read.tensor("kernel", &[4])), words);
        assert_eq!(
            error(read.tensor("bias", &[4])),
            "expected \"bias\" in it, found none"
        );
        assert_eq!(read.count("updates").ok(), Some(12));
        assert_eq!(read.counts("lap").ok(), Some(vec![3, u64::MAX]));
        assert_eq!(read.floats("owed", 2).ok(), Some(vec![0.1, 1e-300]));
        assert_eq!(read.rows("frames", 5).ok(), Some(&[][..]));
        let error = |result: Result<&[u8], Problem>| result.expect_err("wrong").to_string();
        let words = "frames: expected shape [0, 4], got [0, 5]";
        assert_eq!(error(read.rows("frames", 4)), words);
        let words = "lap: expected shape [16], got [2, 8]";
        assert_eq!(error(read.bytes("lap", &[16])), words);
        let error = read.counts("kernel").expect_err("floats").to_string();
        assert_eq!(error, "expected \"kernel\" in it, found none");
        let endless = super::read(Path::new("/dev/zero"), "tests").expect_err("no file");
        assert!(endless.to_string().contains("expected a regular file"));
        let missing = super::read(Path::new("no/such"), "tests").expect_err("none");
        assert!(
            missing
                .to_string()
                .starts_with("checkpoint no/such: No such file")
        );
    }
}
