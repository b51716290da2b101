//! Reads requests in JSON, of `control`.

use super::codes::Status;
use serde::de::DeserializeOwned;

/// Longest control message accepted: 1 MiB.
pub const MAX_CONTROL_BYTES: usize = 1 << 20;

/// Longest reason in a refusal, characters: it may quote a word of the request, which may be long.
const MAX_REASON: usize = 300;

/// Reads a request in JSON.
///
/// # Errors
/// If it is too long or malformed; the error is the message of a refusal as [`Status::Malformed`].
pub fn parse<T: DeserializeOwned>(text: &[u8]) -> Result<T, String> {
    let malformed = |problem: String| format!("{}: {problem}", Status::Malformed.explain(0));
    if text.len() > MAX_CONTROL_BYTES {
        let got = text.len();
        return Err(malformed(format!(
            "expected at most {MAX_CONTROL_BYTES} bytes, got {got}"
        )));
    }
    serde_json::from_slice(text).map_err(|error| {
        let reason = error.to_string();
        malformed(reason.chars().take(MAX_REASON).collect())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A request of one operation.
    #[derive(Debug, serde::Deserialize)]
    #[serde(tag = "op")]
    enum Request {
        Status {},
    }

    #[test]
    fn a_reason_is_short_whatever_it_quotes() {
        for word in ["x".repeat(MAX_CONTROL_BYTES - 9), "é".repeat(100_000)] {
            let reason = parse::<Request>(format!(r#"{{"op":"{word}"}}"#).as_bytes());
            let reason = reason.expect_err("no operation");
            assert!(
                reason.chars().count() < MAX_REASON + 50,
                "{} bytes",
                reason.len()
            );
        }
    }
}
