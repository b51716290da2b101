//! Process setup for programs that run networks: the allocator's options and candle's thread counts.

pub use mimalloc::MiMalloc as Allocator;
use std::thread::available_parallelism;

/// `mi_option_purge_delay` of mimalloc.h, which libmimalloc-sys does not name: milliseconds after which freed
/// memory is returned to the system. A negative value means never.
const PURGE_DELAY: libmimalloc_sys::mi_option_t = 15;

/// Environment variables with candle's thread counts. If the first is not set, candle reads `/proc/cpuinfo` for each
/// matrix product, which takes longer than a small product itself. The second is the number of threads that spin while
/// they wait.
const THREADS: [&str; 2] = ["RAYON_NUM_THREADS", "CANDLE_NUM_THREADS"];

/// Keeps freed memory for the next tensor, and sets candle's thread counts. Programs whose global allocator is
/// [`Allocator`] call this before they start a thread.
///
/// An update allocates and frees hundreds of megabytes of tensors. If that memory were returned to the system each
/// time, page faults would take as long as the arithmetic.
#[expect(unsafe_code, reason = "a foreign function, and the environment")]
pub fn set_up_process() {
    // SAFETY: the call only stores a number in the allocator's table of options.
    unsafe {
        libmimalloc_sys::mi_option_set(PURGE_DELAY, -1);
    }
    let cores = available_parallelism().map_or(1, |cores| cores.get());
    for (name, threads) in THREADS.into_iter().zip([cores, 1]) {
        if std::env::var_os(name).is_none() {
            // SAFETY: no other thread reads the environment yet.
            unsafe {
                std::env::set_var(name, threads.to_string());
            }
        }
    }
}
