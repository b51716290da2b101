//! The service variant of iceoryx2 that all channels use, and the headers in its shared memory.

use emberwatch_messages::message::Header;
use iceoryx2::prelude::ZeroCopySend;
use iceoryx2::service::ipc_threadsafe;

/// iceoryx2's inter-process variant whose ports may move between threads.
pub type Ipc = ipc_threadsafe::Service;

/// A header in shared memory, for iceoryx2.
#[repr(transparent)]
#[derive(Debug, Clone, Copy, Default)]
pub struct WireHeader<H>(pub H);

#[expect(unsafe_code, reason = "iceoryx2 requires an unsafe trait")]
// SAFETY: a header is plain bytes (`Pod`), so it has no pointers and no destructor.
unsafe impl<H: Header> ZeroCopySend for WireHeader<H> {
    unsafe fn type_name() -> &'static str {
        H::TYPE_NAME
    }
}
