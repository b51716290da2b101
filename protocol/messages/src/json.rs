//! Parses the JSON requests of `control`.

use super::codes::Status;
use emberwatch_model::text::parse_problem;
use serde::de::DeserializeOwned;

/// Maximum size of a control message in bytes: 1 MiB.
pub const MAX_CONTROL_BYTES: usize = 1 << 20;

/// Maximum length of the reason in a refusal, in characters: it may quote a long word of the request.
const MAX_REASON: usize = 300;

/// Parses a request in JSON.
///
/// # Errors
/// If the request is too long or malformed. The error is the message of a [`Status::Malformed`] refusal.
pub fn parse<T: DeserializeOwned>(text: &[u8]) -> Result<T, String> {
    let malformed = |problem: String| format!("{}: {problem}", Status::Malformed.explain(0));
    if text.len() > MAX_CONTROL_BYTES {
        let got = text.len();
        return Err(malformed(format!(
            "expected at most {MAX_CONTROL_BYTES} bytes, got {got}"
        )));
    }
    serde_json::from_slice(text).map_err(|error| {
        let reason = parse_problem(error);
        malformed(reason.chars().take(MAX_REASON).collect())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, serde::Deserialize)]
    #[serde(tag = "op")]
    enum Request {
        Status {},
    }

    #[test]
    fn requests_too_long_or_deep_get_a_short_refusal() {
        let op = |word: &str| format!(r#"{{"op":"{word}"}}"#);
        for text in [
            op(&"x".repeat(MAX_CONTROL_BYTES - 9)),
            op(&"é".repeat(100_000)),
            " ".repeat(MAX_CONTROL_BYTES + 1),
            "[".repeat(200_000) + &"]".repeat(200_000),
            r#"{"a":"#.repeat(200_000) + &"}".repeat(200_000),
        ] {
            let reason = parse::<Request>(text.as_bytes()).expect_err("no operation");
            assert!(reason.chars().count() < MAX_REASON + 50, "{reason}");
        }
    }
}
