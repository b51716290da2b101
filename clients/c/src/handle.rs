//! Handles, and what C passes besides them: texts, arrays, timeouts.

use crate::error::{EW_FAILURE_FORKED, EW_FAILURE_IN_USE, Error, Outcome, guard, invalid};
use std::any::{TypeId, type_name};
use std::ffi::{CStr, c_char, c_void};
use std::mem::forget;
use std::ptr::null_mut;
use std::sync::{Mutex, MutexGuard, TryLockError};
use std::time::Duration;

/// What a handle points to. The tag comes first, whatever the type.
#[repr(C)]
struct Tagged<T> {
    tag: Tag,
    value: T,
}

#[repr(C)]
#[derive(Clone, Copy)]
struct Tag {
    kind: TypeId,
    pid: u32,
    free: fn(*mut c_void, bool),
}

pub fn give<T: Send + 'static>(value: T, to: *mut *mut T) -> Outcome {
    let tag = Tag {
        kind: TypeId::of::<T>(),
        pid: std::process::id(),
        free: free::<T>,
    };
    if to.is_null() {
        return Err(invalid("out", "a pointer", "NULL")); // Drops the value, which nobody could free.
    }
    put(to, Box::into_raw(Box::new(Tagged { tag, value })).cast());
    Ok(())
}

pub fn of<'a, T: 'static>(handle: *mut T) -> Outcome<&'a T> {
    let expected = match type_name::<T>() {
        name if name.ends_with("Server") => "an ew_server",
        name if name.ends_with("LeaseHandle") => "an ew_lease",
        _ => "an ew_samples",
    };
    // SAFETY: the caller passes null or a handle that it has not freed, and a handle begins with its tag.
    let Some(tag) = (unsafe { handle.cast::<Tag>().as_ref() }) else {
        return Err(invalid("handle", expected, "NULL"));
    };
    if tag.kind != TypeId::of::<T>() {
        return Err(invalid(
            "handle",
            expected,
            "another kind of handle, or one that was freed",
        ));
    }
    if tag.pid != std::process::id() {
        let text = "this handle belongs to the process that forked this one: make a new one here";
        return Err(Error::new(EW_FAILURE_FORKED, text));
    }
    // SAFETY: the tag says that it is this type, and handles are shared by `&` only.
    Ok(unsafe { &(*handle.cast::<Tagged<T>>()).value })
}

/// Takes the part of a handle that only one thread may use at a time.
pub fn hold<T>(part: &Mutex<T>) -> Outcome<MutexGuard<'_, T>> {
    match part.try_lock() {
        Ok(held) => Ok(held),
        Err(TryLockError::Poisoned(held)) => Ok(held.into_inner()),
        Err(TryLockError::WouldBlock) => {
            let text = "another thread is using this handle";
            Err(Error::new(EW_FAILURE_IN_USE, text))
        }
    }
}

/// Writes a result to where C wants it. NULL: C does not want it.
pub fn put<T>(to: *mut T, value: T) {
    if !to.is_null() {
        // SAFETY: the caller passes a pointer to a variable of this type.
        unsafe { to.write(value) };
    }
}

pub fn text<'a>(what: &str, given: *const c_char) -> Outcome<&'a str> {
    if given.is_null() {
        return Err(invalid(what, "a text", "NULL"));
    }
    // SAFETY: the caller passes a text ended by 0, which it does not change during the call.
    let given = unsafe { CStr::from_ptr(given) };
    given
        .to_str()
        .map_err(|error| invalid(what, "UTF-8", error))
}

pub fn array<'a, T>(what: &str, given: *const T, n: usize) -> Outcome<&'a [T]> {
    if n == 0 {
        return Ok(&[]);
    }
    if given.is_null() || n > isize::MAX as usize / size_of::<T>() {
        let got = if given.is_null() {
            "NULL"
        } else {
            "more than memory has"
        };
        return Err(invalid(what, format!("{n} values"), got));
    }
    // SAFETY: the caller passes `n` values, which it does not change during the call.
    Ok(unsafe { std::slice::from_raw_parts(given, n) })
}

pub fn duration(what: &str, seconds: f64) -> Outcome<Duration> {
    if seconds.is_nan() || seconds < 0.0 {
        return Err(invalid(what, "seconds of at least 0", seconds));
    }
    Ok(Duration::try_from_secs_f64(seconds.min(1e9)).unwrap_or_default())
}

/// Frees any handle of this library; NULL does nothing. Handles may be freed in any order: a connection closes when its
/// server and all its leases are freed. Freeing a lease releases its robots, which takes up to a second if the server
/// is stopped. In the child of a fork, it only forgets the handle. No other thread may be using the handle.
#[unsafe(no_mangle)]
pub extern "C" fn ew_free(handle: *mut c_void) {
    // SAFETY: the caller passes null or a handle, which begins with its tag.
    if let Some(&tag) = unsafe { handle.cast::<Tag>().as_ref() } {
        let is_own = tag.pid == std::process::id();
        guard(null_mut(), || {
            (tag.free)(handle, is_own);
            Ok(())
        });
    }
}

fn free<T>(handle: *mut c_void, is_own: bool) {
    // SAFETY: `give` made it from a box of this type.
    let handle = unsafe { Box::from_raw(handle.cast::<Tagged<T>>()) };
    if is_own {
        drop(handle);
    } else {
        forget(handle); // Its channels are the parent's, and its threads do not run here.
    }
}
