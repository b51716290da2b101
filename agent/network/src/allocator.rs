//! The allocator of programs that train networks.
//!
//! An update makes and drops hundreds of megabytes of tensors. Where these are given back to the system each
//! time, page faults take as long as the arithmetic.

pub use mimalloc::MiMalloc as Allocator;

/// `mi_option_purge_delay` of mimalloc.h, which libmimalloc-sys does not name: milliseconds after which freed
/// memory is given back; never if negative.
const PURGE_DELAY: libmimalloc_sys::mi_option_t = 15;

/// Keeps memory that is freed, for the next tensor. For programs whose global allocator is [`Allocator`].
pub fn keep_freed_memory() {
    #[expect(unsafe_code, reason = "a foreign function")]
    // SAFETY: it stores a number in the allocator's table of options.
    unsafe {
        libmimalloc_sys::mi_option_set(PURGE_DELAY, -1);
    }
}
