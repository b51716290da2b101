//! One request and its answer: send, wait, copy the answer out of shared memory.
//!
//! A wait ends at once when the server answers or dies: a pidfd of the server is in the poll set.

use super::channels::ipc_error;
use super::cleanup::remove_leftovers;
use super::ipc::Ipc;
use super::ipc::WireHeader;
use super::process::WatchedProcess;
use super::wait::{Waiter, descriptor, drain, sleep_until_readable};
use emberwatch_messages::errors::{ChannelError, ConnectionError};
use emberwatch_messages::instance::Instance;
use emberwatch_messages::interrupt::check_interrupt;
use emberwatch_messages::limits::memory::{NoMemory, with_capacity};
use emberwatch_messages::message::Header;
use iceoryx2::node::Node;
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::{Client, RequestSendError};
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use std::time::{Duration, Instant};

/// Maximum time between two checks for the answer, which limits the cost of a lost wake-up.
const LONGEST_SLEEP: Duration = Duration::from_millis(50);

const RELEASE_TIMEOUT: Duration = Duration::from_millis(500);

pub(super) type RequestClient<Q, R> = Client<Ipc, [u8], WireHeader<Q>, [u8], WireHeader<R>>;

/// The resources of a request and its answer: the wake-ups in both directions, and the server's process.
pub(super) struct Exchange {
    pub(super) instance: Instance,
    pub(super) server: Notifier<Ipc>,
    pub(super) listener: Listener<Ipc>,
    pub(super) server_process: WatchedProcess,
    pub(super) waiter: Waiter,
    pub(super) node: Node<Ipc>,
}

impl Exchange {
    pub(super) fn listener_id(&self) -> (u64, u64) {
        let id = self.listener.id().value();
        (id as u64, (id >> 64) as u64)
    }

    /// Sends one request and waits for its answer, which `read` copies out of shared memory.
    pub(super) fn request<Q: Header, R: Header, T>(
        &self,
        client: &RequestClient<Q, R>,
        header: Q,
        payload: &[u8],
        what: &'static str,
        timeout: Duration,
        read: impl Fn(&R, &[u8]) -> T,
    ) -> Result<T, ConnectionError> {
        if self.server_process.has_ended() {
            // A new server on the instance would receive the request, but does not know the client.
            return Err(self.server_gone());
        }
        let pending = send(client, header, payload)?;
        if pending.number_of_server_connections() == 0 {
            return Err(self.server_gone());
        }
        self.server.notify().map_err(ipc_error("wake the server"))?;
        self.answer(&pending, timeout, read)?
            .ok_or_else(|| ConnectionError::Timeout {
                what,
                instance: self.instance.name().into(),
                timeout,
            })
    }

    fn answer<Q: Header, R: Header, T>(
        &self,
        pending: &Pending<Q, R>,
        timeout: Duration,
        read: impl Fn(&R, &[u8]) -> T,
    ) -> Result<Option<T>, ConnectionError> {
        let has_ended = std::cell::Cell::new(false);
        let poll = || match pending.receive().map_err(ipc_error("receive an answer"))? {
            Some(response) => Ok(Some(read(&response.user_header().0, response.payload()))),
            None if has_ended.get() => Err(self.server_gone()),
            None => Ok(None),
        };
        self.waiter.wait(timeout, poll, |remaining| {
            let [is_woken, is_over] = self.sleep(remaining.min(LONGEST_SLEEP))?;
            has_ended.set(is_over || !pending.is_connected());
            if !is_woken {
                check_interrupt()?;
            }
            Ok(())
        })
    }

    /// Sleeps until woken. Returns whether it was woken, and whether the server has ended.
    fn sleep(&self, timeout: Duration) -> Result<[bool; 2], ChannelError> {
        let descriptors = [descriptor(&self.listener), self.server_process.descriptor()];
        let readable = sleep_until_readable(&descriptors, timeout)
            .map_err(ipc_error("wait for the server"))?;
        // Remaining wake-ups would end the next sleep at once.
        drain(&self.listener)?;
        Ok([readable[0], readable[1]])
    }

    pub(super) fn server_gone(&self) -> ConnectionError {
        let _ = remove_leftovers(); // If this fails, the next program removes them.
        ConnectionError::ServerGone {
            instance: self.instance.name().into(),
        }
    }
}

type Pending<Q, R> = PendingResponse<Ipc, [u8], WireHeader<Q>, [u8], WireHeader<R>>;

fn send<Q: Header, R: Header>(
    client: &RequestClient<Q, R>,
    header: Q,
    payload: &[u8],
) -> Result<Pending<Q, R>, ChannelError> {
    let start = Instant::now();
    loop {
        let request = client.loan_slice_uninit(payload.len());
        let mut request = request.map_err(ipc_error("send a request"))?;
        *request.user_header_mut() = WireHeader(header);
        match request.write_from_slice(payload).send() {
            Err(RequestSendError::ExceedsMaxActiveRequests)
                if start.elapsed() < RELEASE_TIMEOUT =>
            {
                std::thread::sleep(Duration::from_millis(5));
            }
            sent => return sent.map_err(ipc_error("send a request")),
        }
    }
}

pub(super) fn copied(what: &str, payload: &[u8]) -> Result<Vec<u8>, NoMemory> {
    let mut copy = with_capacity(format_args!("the answer to {what}"), payload.len())?;
    copy.extend_from_slice(payload);
    Ok(copy)
}
