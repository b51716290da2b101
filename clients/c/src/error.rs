//! Return codes and messages. No panic leaves this library.

use emberwatch_messages::errors::{ChannelError, ConnectionError, ErrorClass};
use emberwatch_messages::message::Status;
use emberwatch_sim::embedded::settings::ReadError;
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
    /// Always 0.
    pub reserved: u32,
    /// The detail of an ew_status; the server's version for EW_FAILURE_OTHER_VERSION; otherwise 0.
    pub detail: u64,
    /// A sentence in UTF-8, ended by 0 and cut if it is too long.
    pub message: [c_char; EW_MESSAGE_BYTES],
}

pub struct Error {
    code: i32,
    detail: u64,
    message: String,
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

/// Returns the error for an invalid argument.
pub fn invalid(what: &str, expected: impl Display, got: impl Display) -> Error {
    let text = format!("{what}: expected {expected}, got {got}");
    Error::of_class(ErrorClass::Invalid, text)
}

impl From<ConnectionError> for Error {
    fn from(error: ConnectionError) -> Self {
        let other = Self::of_class(error.class(), &error);
        let (code, detail, message) = match error {
            ConnectionError::Refused {
                status: status @ Status::Busy,
                detail,
                ..
            } => {
                let text =
                    format!("busy: held by pid {detail}; wait for its release, or take over");
                (status as i32, detail, text)
            }
            ConnectionError::Refused {
                status,
                detail,
                message,
            } => (status as i32, detail, message),
            ConnectionError::Channel(ChannelError::OtherVersion { version }) => {
                (other.code, version.into(), other.message)
            }
            _ => return other,
        };
        Self {
            code,
            detail,
            message,
        }
    }
}

impl From<ChannelError> for Error {
    fn from(error: ChannelError) -> Self {
        ConnectionError::from(error).into()
    }
}

impl From<ReadError> for Error {
    fn from(error: ReadError) -> Self {
        match error {
            ReadError::Config(error) => Self::of_class(ErrorClass::Invalid, error),
            ReadError::Threads(error) => Self::of_class(ErrorClass::Memory, error),
            ReadError::Wait(error) => error.into(),
        }
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
    let end = error.message.floor_char_boundary(EW_MESSAGE_BYTES - 1);
    to.message = [0; EW_MESSAGE_BYTES];
    for (to, byte) in to.message.iter_mut().zip(&error.message.as_bytes()[..end]) {
        *to = *byte as c_char;
    }
    (to.code, to.reserved, to.detail) = (error.code, 0, error.detail);
}
