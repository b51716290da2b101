//! What programs that use networks set up first.

pub use mimalloc::MiMalloc as Allocator;
use std::thread::available_parallelism;

/// `mi_option_purge_delay` of mimalloc.h, which libmimalloc-sys does not name: milliseconds after which freed
/// memory is given back; never if negative.
const PURGE_DELAY: libmimalloc_sys::mi_option_t = 15;

/// Variables that tell candle its threads. Without the first it reads `/proc/cpuinfo` for each product of matrices,
/// which takes longer than a small product. The second is for threads that spin while they wait.
const THREADS: [&str; 2] = ["RAYON_NUM_THREADS", "CANDLE_NUM_THREADS"];

/// Keeps memory that is freed for the next tensor, and tells candle its threads. For programs whose
/// global allocator is [`Allocator`]; they call it before they start a thread.
///
/// An update makes and drops hundreds of megabytes of tensors. Where these are given back to the system each
/// time, page faults take as long as the arithmetic.
#[expect(unsafe_code, reason = "a foreign function, and the environment")]
pub fn set_up_process() {
    // SAFETY: it stores a number in the allocator's table of options.
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
