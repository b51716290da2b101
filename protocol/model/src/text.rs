//! Reads the text of settings and model files.

use std::borrow::Cow;
use std::fmt::Display;
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Maximum size of a settings or model file in bytes. A model file with 64 states and kernels of 15 x 15 cells has 5
/// MB.
pub const MAX_TEXT_BYTES: u64 = 16 << 20;

/// Reads the text of a settings or model file. The file may be a pipe.
///
/// # Errors
/// If the file cannot be read, is larger than [`MAX_TEXT_BYTES`], or is not UTF-8.
pub fn read_text(path: &Path) -> std::io::Result<String> {
    let mut bytes = Vec::new();
    let mut file = File::open(path)?.take(MAX_TEXT_BYTES + 1);
    if file.read_to_end(&mut bytes)? as u64 > MAX_TEXT_BYTES {
        let problem = format!("expected at most {MAX_TEXT_BYTES} bytes, got more");
        return Err(std::io::Error::other(problem));
    }
    decoded(&bytes).map_err(std::io::Error::other)
}

const MAX_QUOTED: usize = 80;

/// Returns a given value for an error: of a value with more than 80 characters, its beginning and its end.
pub fn shortened(value: &str) -> Cow<'_, str> {
    let n = value.chars().count();
    if n <= MAX_QUOTED {
        return value.into();
    }
    let half = MAX_QUOTED / 2;
    let begin: String = value.chars().take(half - 1).collect();
    let end: String = value.chars().skip(n - half).collect();
    format!("{begin}…{end}").into()
}

/// Returns an error of a parser, with at most 80 characters of each line, quoted value and word of the text that it read.
pub fn parse_problem(error: impl Display) -> String {
    let text = error.to_string();
    let words = |line: &str| line.split(' ').map(shortened).collect::<Vec<_>>().join(" ");
    // Between the first and the last quote of a kind may be a value with quotes in it, so each part is shortened.
    let quoted = |line: &str| -> String {
        let parts = line.split_inclusive(['`', '"']).enumerate();
        let parts = parts.map(|(index, part)| {
            let most = [2 * MAX_QUOTED, MAX_QUOTED + 1][index % 2];
            let is_long = part.chars().count() > most;
            if is_long {
                shortened(part)
            } else {
                part.into()
            }
        });
        parts.collect()
    };
    let cut = |line: &str| match line.split_once('|') {
        // A line of the text, or the marks under it.
        Some((number, rest))
            if number.trim().parse::<u32>().is_ok() || number.trim().is_empty() =>
        {
            format!(
                "{number}|{}",
                rest.chars().take(MAX_QUOTED).collect::<String>().trim_end()
            )
        }
        _ => quoted(&words(line)),
    };
    text.lines().map(cut).collect::<Vec<_>>().join("\n")
}

/// Decodes UTF-8 without the byte order mark, which editors on Windows write.
fn decoded(bytes: &[u8]) -> Result<String, String> {
    let begins_wide = bytes
        .iter()
        .take(4)
        .any(|byte| [0x00, 0xFE, 0xFF].contains(byte));
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    match std::str::from_utf8(bytes) {
        Ok(text) if !begins_wide => Ok(text.into()),
        Err(error) if !begins_wide => {
            let line = bytes[..error.valid_up_to()]
                .split(|byte| *byte == b'\n')
                .count();
            Err(format!(
                "expected text in UTF-8, got other bytes in line {line}: save the file as UTF-8"
            ))
        }
        _ => Err("expected text in UTF-8, got UTF-16 or UTF-32: save the file as UTF-8".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_values_are_quoted_by_their_ends() {
        for (value, expected) in [
            ("short".into(), "short".into()),
            ("é".repeat(80), "é".repeat(80)),
            (
                "a".repeat(50) + &"é".repeat(50),
                "a".repeat(39) + "…" + &"é".repeat(40),
            ),
        ] {
            assert_eq!(shortened(&value), expected);
            assert!(shortened(&value).chars().count() <= 80);
        }
        let (word, line) = ("x".repeat(500), "y ".repeat(500));
        let problem =
            format!("at line 3\n  |\n3 | {line}\n  | ^\nunknown field `{word}`, expected one\n");
        let told = parse_problem(problem);
        assert!(told.ends_with("x`, expected one"), "{told}");
        assert!(
            told.lines().all(|line| line.chars().count() < 120),
            "{told}"
        );
        let key = "word ".repeat(900);
        let told = parse_problem(format!("unknown field `{key}`, expected one of `a`, `b`"));
        assert!(told.ends_with("`, expected one of `a`, `b`"), "{told}");
        assert!(told.chars().count() < 140, "{told}");
    }

    #[test]
    fn text_must_be_utf_8_and_errors_name_other_encodings() {
        let wide = |text: &str, bytes: fn(u16) -> [u8; 2]| -> Vec<u8> {
            text.encode_utf16().flat_map(bytes).collect()
        };
        let expected = "expected text in UTF-8, got";
        let is_wide = format!("{expected} UTF-16 or UTF-32: save the file as UTF-8");
        let is_other = format!("{expected} other bytes in line 2: save the file as UTF-8");
        for (bytes, decodes_to) in [
            (b"".to_vec(), Ok("")),
            (b"\xEF\xBB\xBF".to_vec(), Ok("")),
            (b"a = \"\xC3\xA9\"".to_vec(), Ok("a = \"\u{e9}\"")),
            (
                b"\xEF\xBB\xBFa = \"\xC3\xA9\"".to_vec(),
                Ok("a = \"\u{e9}\""),
            ),
            (wide("a = 1", u16::to_le_bytes), Err(&is_wide)),
            (wide("a = 1", u16::to_be_bytes), Err(&is_wide)),
            (wide("\u{feff}a = 1", u16::to_le_bytes), Err(&is_wide)),
            (wide("\u{feff}a = 1", u16::to_be_bytes), Err(&is_wide)),
            (b"# ash\nname = \"\xE9\"".to_vec(), Err(&is_other)),
        ] {
            let expected = decodes_to.map(str::to_owned).map_err(String::clone);
            assert_eq!(decoded(&bytes), expected, "{bytes:?}");
        }
    }
}
