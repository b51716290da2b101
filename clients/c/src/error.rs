//! Return codes and messages. No panic leaves this library.

use emberwatch_messages::errors::{ChannelError, ConnectionError, ErrorClass};
use std::ffi::c_char;
use std::fmt::Display;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Failure: the handle belongs to the process that forked this one.
pub const EW_FAILURE_FORKED: i32 = -12;

/// Failure: another thread is using this handle.
pub const EW_FAILURE_IN_USE: i32 = -13;

/// Failure: a bug in this library. Free the handle.
pub const EW_FAILURE_BUG: i32 = -14;

/// Bytes of the message of an ew_error, including its final 0.
pub const EW_MESSAGE_BYTES: usize = 496;

/// What went wrong. Pass a pointer to one, or NULL. A call that succeeds does not write it.
#[repr(C)]
pub struct ErrorInfo {
    /// The returned code.
    pub code: i32,
    /// The detail of an ew_status; the server's version for EW_FAILURE_OTHER_VERSION; otherwise 0.
    pub detail: u64,
    /// A sentence in UTF-8, ended by 0 and cut if it is too long.
    pub message: [c_char; EW_MESSAGE_BYTES],
}

pub struct Error {
    code: i32,
    detail: u64,
    pub message: String,
}

pub type Outcome<T = ()> = Result<T, Error>;

impl Error {
    pub fn new(code: i32, message: impl Display) -> Self {
        let (detail, message) = (0, message.to_string());
        Self {
            code,
            detail,
            message,
        }
    }

    pub fn of_class(class: ErrorClass, message: impl Display) -> Self {
        Self::new(class as i32, message)
    }
}

pub fn invalid(what: &str, expected: impl Display, got: impl Display) -> Error {
    let text = format!("{what}: expected {expected}, got {got}");
    Error::of_class(ErrorClass::Invalid, text)
}

impl From<ConnectionError> for Error {
    fn from(error: ConnectionError) -> Self {
        let mut new = Self::of_class(error.class(), &error);
        match error {
            ConnectionError::Refused {
                status,
                detail,
                message,
            } => (new.code, new.detail, new.message) = (status as i32, detail, message),
            ConnectionError::Channel(ChannelError::OtherVersion { version }) => {
                new.detail = version.into();
            }
            _ => {}
        }
        new
    }
}

impl From<ChannelError> for Error {
    fn from(error: ChannelError) -> Self {
        ConnectionError::from(error).into()
    }
}

/// Runs a call. Returns its code, and describes an error in `to`, which may be null.
pub fn guard(to: *mut ErrorInfo, call: impl FnOnce() -> Outcome) -> i32 {
    let outcome = catch_unwind(AssertUnwindSafe(call));
    let bug = |_| Err(Error::new(EW_FAILURE_BUG, "a bug in libemberwatch"));
    match outcome.unwrap_or_else(bug) {
        Ok(()) => 0,
        Err(error) => {
            // SAFETY: the caller passes null or a pointer to an `ew_error`.
            if let Some(to) = unsafe { to.as_mut() } {
                write(&error, to);
            }
            error.code
        }
    }
}

fn write(error: &Error, to: &mut ErrorInfo) {
    let mut end = error.message.len().min(EW_MESSAGE_BYTES - 1);
    while !error.message.is_char_boundary(end) {
        end -= 1;
    }
    to.message = [0; EW_MESSAGE_BYTES];
    for (to, byte) in to.message.iter_mut().zip(&error.message.as_bytes()[..end]) {
        *to = *byte as c_char;
    }
    (to.code, to.detail) = (error.code, error.detail);
}
