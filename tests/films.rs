//! `emberwatch-agent film`: films and stills of recordings, and what they say of what is missing.

use crate::commands::{AGENT, check_table};
use crate::harness::{Ended, PATIENCE, Paths, Server, fly, run};
use crate::recording::{new_file, read_whole, start_recorder, text, write_recording};
use protocol::recording::{Event, Record, Writer};
use std::fs::File;
use std::path::{Path, PathBuf};

/// A server with small worlds whose first belief is soon simulated.
const WORLDS: &str = "--worlds 2 --height 5 --width 8 --moves 6 --burn-in 20 --publish-truth";

/// Height and width of a picture of these worlds.
const SIZE: [u32; 2] = [241, 716];

/// Flies so many steps in world 1 and records them, hidden states too.
fn record(n_steps: u64, flags: &str) -> (tempfile::TempDir, PathBuf, Vec<Record>) {
    let server = Server::start(&format!("{WORLDS} {flags}"));
    let (folder, file) = new_file();
    let steps = n_steps.to_string();
    let recorder = start_recorder(&server.instance, &file, &["--truth", "--steps", &steps]);
    let mut client = server.acquire(1..2);
    let mut paths = Paths::new(3);
    (0..n_steps).for_each(|_| drop(fly(&mut client, paths.next(6))));
    assert_eq!(recorder.wait(PATIENCE).code, Some(0));
    let records = read_whole(&file);
    (folder, file, records)
}

fn write(file: &Path, records: &[Record]) {
    let mut writer = Writer::new(File::create(file).expect("create")).expect("begin");
    for record in records {
        writer.write(record).expect("write");
    }
    writer.finish().expect("finish");
}

fn film(file: &Path, flags: &str) -> Ended {
    let own = ["film", text(file), "--world", "1"];
    let words: Vec<&str> = own.into_iter().chain(flags.split_whitespace()).collect();
    let ended = run(AGENT, &words, PATIENCE);
    assert_eq!(ended.code, Some(0), "{flags}: {}", ended.stderr);
    ended
}

/// Delays of a GIF's pictures, hundredths of a second.
fn delays(gif: &Path) -> Vec<u16> {
    let file = File::open(gif).expect("the film");
    let mut decoder = gif::DecodeOptions::new().read_info(file).expect("a GIF");
    let size = [decoder.height(), decoder.width()].map(u32::from);
    assert_eq!(size, SIZE);
    let mut delays = Vec::new();
    while let Some(frame) = decoder.read_next_frame().expect("a whole GIF") {
        delays.push(frame.delay);
    }
    delays
}

/// The pixels of a PNG, or of the first picture of an animated one; and how many pictures there are.
fn pixels(png: &Path) -> (Vec<u8>, u32) {
    let file = std::io::BufReader::new(File::open(png).expect("the still"));
    let mut reader = png::Decoder::new(file).read_info().expect("a PNG");
    let control = reader.info().animation_control;
    let mut pixels = vec![0; reader.output_buffer_size()];
    let info = reader.next_frame(&mut pixels).expect("a whole PNG");
    assert_eq!([info.height, info.width], SIZE);
    (pixels, control.map_or(1, |control| control.num_frames))
}

#[test]
fn a_film_shows_every_step_and_a_still_one_of_them() {
    let (folder, file, _) = record(12, "");
    let path = |name: &str| folder.path().join("new").join(name);
    let flags = |out: &str, rest: &str| format!("{} {rest}", path(out).display());
    film(&file, &format!("--gif {}", flags("all.gif", "--fps 20")));
    let all = delays(&path("all.gif"));
    // Steps 1 to 12, perhaps also what the world showed before; the last one stays.
    assert!(all.len() == 12 || all.len() == 13, "{all:?}");
    assert!(all.ends_with(&[5, 5, 100]), "{all:?}");
    film(
        &file,
        &format!("--gif {}", flags("some.gif", "--from 3 --to 9 --every 3")),
    );
    assert_eq!(delays(&path("some.gif")), [10, 10, 100]);
    film(
        &file,
        &format!("--apng {}", flags("some.png", "--from 3 --to 9 --every 3")),
    );
    let (first, n_pictures) = pixels(&path("some.png"));
    assert_eq!(n_pictures, 3);
    film(&file, &format!("--png {}", flags("still.png", "--step 3")));
    assert_eq!(pixels(&path("still.png")), (first, 1));
}

#[test]
fn what_is_not_recorded_is_shown_and_told() {
    let (folder, file, mut records) = record(12, "");
    let gap = folder.path().join("gap.recording");
    records.retain(|record| match &record.event {
        Event::Frame(frame) => !(5..8).contains(&frame.header.result.step),
        _ => true,
    });
    write(&gap, &records);
    let (whole, lacking) = (
        folder.path().join("whole.gif"),
        folder.path().join("gap.gif"),
    );
    let flags = |out: &Path, rest: &str| format!("--gif {} --from 2 {rest}", out.display());
    let ended = film(&file, &flags(&whole, ""));
    assert!(!ended.stderr.contains("not recorded"), "{}", ended.stderr);
    assert_eq!(delays(&whole).len(), 11);
    let ended = film(&gap, &flags(&lacking, ""));
    assert!(ended.stderr.contains("not recorded"), "{}", ended.stderr);
    assert!(ended.stderr.contains("steps=3"), "{}", ended.stderr);
    // Steps 2 to 4, a picture for 5 to 7 that stays, and 8 to 12.
    assert_eq!(delays(&lacking), [10, 10, 10, 100, 10, 10, 10, 10, 100]);
    film(&gap, &flags(&lacking, "--to 8 --every 6"));
    assert_eq!(delays(&lacking), [10, 100, 100], "a gap is not left out");
}

#[test]
fn a_cut_or_damaged_recording_is_shown_as_far_as_it_is_good() {
    let (folder, file, _) = record(6, "");
    let bytes = std::fs::read(&file).expect("read");
    let cut = folder.path().join("cut.recording");
    std::fs::write(&cut, &bytes[..bytes.len() - 60]).expect("write");
    let out = folder.path().join("cut.gif");
    let mut damaged = bytes.clone();
    damaged[bytes.len() - 300] ^= 1;
    let wrong = folder.path().join("damaged.recording");
    std::fs::write(&wrong, &damaged).expect("write");
    for (file, words, shown) in [
        (&cut, "cut short", 4..=5),
        (&wrong, "damaged at byte", 1..=5),
    ] {
        let ended = film(file, &format!("--gif {} --from 2", out.display()));
        assert!(ended.stderr.contains(words), "{}", ended.stderr);
        assert!(ended.stderr.contains("good before it"), "{}", ended.stderr);
        assert!(shown.contains(&delays(&out).len()));
    }
}

#[test]
fn a_model_that_the_server_hid_is_given() {
    let (folder, file, _) = record(3, "--reveal-model false");
    let out = folder.path().join("still.png");
    let flags = format!("--png {} --step 2 --model wildfire", out.display());
    film(&file, &flags);
    assert_eq!(pixels(&out).1, 1);
    let hidden = format!("film {} --world 1 --gif g", text(&file));
    let table = format!(
        "{hidden} => --model: expected the model of this recording\n\
         {hidden} --model no.toml => model file no.toml\n"
    );
    check_table(AGENT, &table);
}

#[test]
fn wrong_input_is_named() {
    let (folder, good) = new_file();
    write_recording(&good, 2, 0);
    let bytes = std::fs::read(&good).expect("read");
    let damaged = folder.path().join("damaged");
    std::fs::write(
        &damaged,
        [&bytes[..60], &[!bytes[60]], &bytes[61..]].concat(),
    )
    .expect("write");
    let table = r#"
film GOOD => --gif
film GOOD --gif g --png p --step 1 => cannot be used with
film GOOD --png p => --step
film GOOD --gif g --step 1 => --step | cannot be used with
film GOOD --step 1 => --png
film GOOD --gif g --world 7 => --world: expected one of the recorded worlds {0}, got 7
film GOOD --png p --step 9 => --step: expected one of the recorded steps 0 to 1, got 9
film GOOD --gif g --from 5 => --from, --to: expected one of the recorded steps 0 to 1, got 5 and later
film GOOD --gif g --from 5 --to 4 => --to: expected at least --from 5, got 4
film GOOD --gif g --every 0 => --every
film GOOD --gif g --fps 0 => --fps | 0.1 to 50 pictures a second
film GOOD --gif g --fps fast => --fps | 0.1 to 50 pictures a second
film GOOD --gif g --scale 0 => --scale
film GOOD --gif / --model wildfire => cannot write /
film no/such --gif g => recording no/such: No such file
film DAMAGED --gif g => damaged at byte 16
"#;
    let table = table.replace("GOOD", text(&good));
    check_table(AGENT, &table.replace("DAMAGED", text(&damaged)));
}
