//! TensorBoard event files: numbers and images over steps, which TensorBoard reads while they grow.
//!
//! A file is a sequence of TensorFlow records. A record consists of a length, the checksum of the length, the data, and
//! the checksum of the data. The data are protocol buffers of the types `Event` and `Summary`. Only a few of their
//! fields are needed, so this module encodes them itself: the crate `tensorboard-rs` depends on protobuf 2 and
//! image 0.23, which are long out of support. Steps must increase within a file: TensorBoard drops repeated steps.

use anyhow::{Context, Result};
use crc::{CRC_32_ISCSI, Crc};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

const CASTAGNOLI: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);

const FILE_VERSION: &str = "brain.Event:2";

/// `SessionLog.START`: TensorBoard discards earlier events for this step and later steps, even in older files.
const SESSION_START: u64 = 1;

/// The value of `colorspace` in `Summary.Image` that means RGB.
const RGB: u64 = 3;

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Value<'a> {
    Scalar(f64),
    Image {
        height: usize,
        width: usize,
        png: &'a [u8],
    },
}

#[derive(Debug)]
pub struct EventFile {
    path: PathBuf,
    file: BufWriter<File>,
}

impl EventFile {
    /// Creates a file in a folder, and the folder if it is missing. TensorBoard then ignores events from `next_step` on
    /// in older files of the folder.
    pub fn begin(folder: &Path, next_step: u64) -> Result<Self> {
        let created = std::fs::create_dir_all(folder).and_then(|()| create(folder));
        let (path, file) = created.with_context(|| of_file(folder))?;
        let file = BufWriter::new(file);
        let mut events = Self { path, file };
        events.write(&event(0).text(3, FILE_VERSION))?;
        let start = Message::default().integer(1, SESSION_START);
        events.write(&event(next_step).message(7, &start))?;
        events.flush()?;
        Ok(events)
    }

    /// Adds values of a step, each with its name.
    pub fn add<'a>(
        &mut self,
        step: u64,
        values: impl IntoIterator<Item = (&'a str, Value<'a>)>,
    ) -> Result<()> {
        let add = |summary: Message, (name, value)| summary.message(1, &named(name, value));
        let summary = values.into_iter().fold(Message::default(), add);
        self.write(&event(step).message(5, &summary))
    }

    pub fn flush(&mut self) -> Result<()> {
        let flushed = self.file.flush();
        flushed.with_context(|| of_file(&self.path))
    }

    fn write(&mut self, event: &Message) -> Result<()> {
        let written = self.file.write_all(&record(&event.0));
        written.with_context(|| of_file(&self.path))
    }
}

fn of_file(path: &Path) -> String {
    format!("TensorBoard events {}", path.display())
}

/// Creates a file whose name sorts after the names of earlier files.
fn create(folder: &Path) -> std::io::Result<(PathBuf, File)> {
    let seconds = since_1970().as_secs();
    let mut number = 0;
    loop {
        let name = format!("events.out.tfevents.{seconds:010}.emberwatch.{number:03}");
        let path = folder.join(name);
        match File::create_new(&path) {
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => number += 1,
            created => return created.map(|file| (path, file)),
        }
    }
}

fn since_1970() -> Duration {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    since.unwrap_or_default()
}

fn record(bytes: &[u8]) -> Vec<u8> {
    let length = (bytes.len() as u64).to_le_bytes();
    let [of_length, of_bytes] = [&length, bytes].map(|part| masked_checksum(part).to_le_bytes());
    [&length, &of_length[..], bytes, &of_bytes].concat()
}

/// Returns TensorFlow's masked CRC-32C. The mask is meant for data that may contain checksums themselves.
fn masked_checksum(bytes: &[u8]) -> u32 {
    let checksum = CASTAGNOLI.checksum(bytes);
    checksum.rotate_right(15).wrapping_add(0xa282_ead8)
}

fn named(name: &str, value: Value<'_>) -> Message {
    let named = Message::default().text(1, name);
    match value {
        Value::Scalar(number) => named.float(2, number as f32),
        Value::Image { height, width, png } => {
            let size = Message::default().integer(1, height as u64);
            let size = size.integer(2, width as u64).integer(3, RGB);
            named.message(4, &size.bytes(4, png))
        }
    }
}

/// Starts an `Event` at the present time.
fn event(step: u64) -> Message {
    event_at(since_1970().as_secs_f64(), step)
}

fn event_at(seconds: f64, step: u64) -> Message {
    let event = Message::default().double(1, seconds);
    match step {
        0 => event,
        step => event.integer(2, step),
    }
}

/// A protocol buffer, built field by field.
#[derive(Debug, Default)]
struct Message(Vec<u8>);

impl Message {
    fn integer(self, field: u8, value: u64) -> Self {
        self.key(field, 0).variable(value)
    }

    fn double(self, field: u8, value: f64) -> Self {
        self.key(field, 1).raw(&value.to_le_bytes())
    }

    fn float(self, field: u8, value: f32) -> Self {
        self.key(field, 5).raw(&value.to_le_bytes())
    }

    fn text(self, field: u8, text: &str) -> Self {
        self.bytes(field, text.as_bytes())
    }

    fn message(self, field: u8, message: &Self) -> Self {
        self.bytes(field, &message.0)
    }

    fn bytes(self, field: u8, bytes: &[u8]) -> Self {
        let length = bytes.len() as u64;
        self.key(field, 2).variable(length).raw(bytes)
    }

    /// Appends a field's number, below 16 here, and its wire type.
    fn key(self, field: u8, kind: u8) -> Self {
        self.raw(&[field << 3 | kind])
    }

    /// Appends an integer of variable length: seven bits per byte, lowest first. The eighth bit means that more follow.
    fn variable(mut self, mut value: u64) -> Self {
        while value > 0x7f {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.raw(&[value as u8])
    }

    fn raw(mut self, bytes: &[u8]) -> Self {
        self.0.extend_from_slice(bytes);
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(event: &Message, expected: &str) {
        let hex = record(&event.0)
            .into_iter()
            .map(|byte| format!("{byte:02x}"));
        assert_eq!(hex.collect::<String>(), expected);
    }

    /// By TensorBoard 2.21: `RecordWriter(out).write(Event(wall_time=1.5, ...).SerializeToString())`.
    #[test]
    fn records_match_tensorboard() {
        // file_version="brain.Event:2"
        check(
            &event_at(1.5, 0).text(3, FILE_VERSION),
            "1800000000000000a37f4b2209000000000000f83f1a0d627261696e2e4576656e743a322a28646c",
        );
        // step=300, session_log=SessionLog(status=SessionLog.START)
        let start = Message::default().integer(1, SESSION_START);
        check(
            &event_at(1.5, 300).message(7, &start),
            "100000000000000095fbfe1809000000000000f83f10ac023a020801713b788a",
        );
        // step=300, summary=Summary(value=[Summary.Value(tag="loss", simple_value=0.25),
        // Summary.Value(tag="b", image=Summary.Image(height=2, width=3, colorspace=3,
        // encoded_image_string=b"png"))])
        let (height, width, png) = (2, 3, b"png");
        let image = named("b", Value::Image { height, width, png });
        let summary = Message::default().message(1, &named("loss", Value::Scalar(0.25)));
        check(
            &event_at(1.5, 300).message(5, &summary.message(1, &image)),
            "2d000000000000003c418afb09000000000000f83f10ac022a1f0a0b0a046c6f7373150000803e\
             0a100a0162220b0802100318032203706e6725d882d8",
        );
    }

    #[test]
    fn files_created_in_the_same_second_sort_in_order() {
        let folder = tempfile::tempdir().expect("a folder");
        let begin = || EventFile::begin(folder.path(), 0).expect("begun").path;
        let paths: Vec<PathBuf> = (0..12).map(|_| begin()).collect();
        assert!(paths.is_sorted(), "{paths:?}");
    }

    #[test]
    fn errors_name_a_folder_that_cannot_be_created() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        let folder = file.path().join("events");
        let error = EventFile::begin(&folder, 0).expect_err("a file is no folder");
        let expected = format!("TensorBoard events {}", folder.display());
        assert!(error.to_string().starts_with(&expected), "{error}");
    }
}
