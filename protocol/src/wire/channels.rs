//! The channels of one instance: names, services and limits.
//!
//! All channels of an instance are under `emberwatch/v3/<instance>/`. Each user has a separate directory and prefix, so
//! that users never collide and no stray configuration file is read.

use super::channel_files::other_version;
use super::directory::no_server;
use emberwatch_messages::message::{
    AgentHeader, ControlReply, ControlRequest, FrameHeader, Header, StepReply, StepRequest,
    TruthHeader,
};
use iceoryx2::node::Node;
use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::{CallbackProgression, ServiceName};
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenOrCreateError;
use iceoryx2::service::builder::request_response as request_response_builder;
use iceoryx2::service::builder::request_response::RequestResponseOpenError;
use iceoryx2::service::port_factory::{PortFactory, event, publish_subscribe, request_response};
use std::sync::{Mutex, PoisonError};

pub use super::channel_files::lives_elsewhere;
pub use super::directory::{Entries, SHARED_MEMORY, channel_directory, node_config};
pub use super::ipc::{Ipc, WireHeader};
pub use super::node::create_node;
pub use super::resources::{call_error, check_room, ipc_error, limited_error};
pub use emberwatch_messages::capacity::{
    MAX_CLIENTS, MAX_ROBOT_NUMBERS, MAX_ROBOTS, MAX_TEAM_CELLS, MAX_WORLDS,
};
pub use emberwatch_messages::errors::ChannelError;
pub use emberwatch_messages::instance::Instance;

/// Maximum number of observers of `frames` at a time.
pub const MAX_OBSERVERS: usize = 16;

/// Maximum number of readers of `truth` at a time.
pub const MAX_TRUTH_READERS: usize = 4;

/// Number of frames that an observer may be behind before it loses the oldest.
pub const FRAME_BUFFER: usize = 64;

/// Number of hidden states that a reader may be behind before it loses the oldest. The states of this many worlds can
/// be published at once without loss.
pub const TRUTH_BUFFER: usize = 128;

/// Maximum number of readers of `agent` at a time.
pub const MAX_AGENT_READERS: usize = 4;

/// Number of beliefs that a reader may be behind before it loses the oldest. A display needs only the newest.
pub const AGENT_BUFFER: usize = 4;

/// Maximum number of processes attached to an instance at a time.
pub const MAX_NODES: usize = 64;

pub type RequestResponse<Q, R> =
    request_response::PortFactory<Ipc, [u8], WireHeader<Q>, [u8], WireHeader<R>>;

pub type StepService = RequestResponse<StepRequest, StepReply>;

pub type ControlService = RequestResponse<ControlRequest, ControlReply>;

pub type Publications<H> = publish_subscribe::PortFactory<Ipc, [u8], WireHeader<H>>;

pub type FrameService = Publications<FrameHeader>;

pub type TruthService = Publications<TruthHeader>;

pub type AgentService = Publications<AgentHeader>;

pub type WakeService = event::PortFactory<Ipc>;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Channel {
    /// Steps, request-response.
    Step,
    /// All other requests, request-response.
    Control,
    /// Frames of the robots, publish-subscribe.
    Frames,
    /// Hidden states, publish-subscribe.
    Truth,
    /// Beliefs of agents, publish-subscribe.
    Agent,
    /// Wake-ups of the server, event.
    WakeServer,
    /// Wake-ups of clients, event.
    WakeClient,
}

impl Channel {
    fn name(self) -> &'static str {
        match self {
            Self::Step => "step",
            Self::Control => "control",
            Self::Frames => "frames",
            Self::Truth => "truth",
            Self::Agent => "agent",
            Self::WakeServer => "wake-server",
            Self::WakeClient => "wake-client",
        }
    }
}

pub fn service_name(instance: &Instance, channel: Channel) -> ServiceName {
    let name = format!("emberwatch/v3/{}/{}", instance.name(), channel.name());
    ServiceName::new(&name).expect("invariant: instance names are short and plain")
}

fn none_of(instance: &Instance, channel: Channel) -> ChannelError {
    match other_version(instance.name(), channel.name()) {
        Some(version) => ChannelError::OtherVersion { version },
        None => no_server(instance),
    }
}

pub struct Services<'a> {
    pub node: &'a Node<Ipc>,
    pub instance: &'a Instance,
}

impl Services<'_> {
    /// Opens or creates the `step` service. Only servers call this.
    ///
    /// # Errors
    /// If iceoryx2 cannot create it, for example because clients of an older release keep a service with different
    /// limits open.
    pub fn create_step(&self) -> Result<StepService, ChannelError> {
        self.create(Channel::Step)
    }

    /// Opens or creates the `control` service. Only servers call this.
    ///
    /// # Errors
    /// The same as [`Self::create_step`].
    pub fn create_control(&self) -> Result<ControlService, ChannelError> {
        self.create(Channel::Control)
    }

    pub fn open_step(&self) -> Result<StepService, ChannelError> {
        self.open(Channel::Step)
    }

    pub fn open_control(&self) -> Result<ControlService, ChannelError> {
        self.open(Channel::Control)
    }

    /// Opens or creates the `frames` service. Observers may create it before the server starts.
    pub fn frames(&self) -> Result<FrameService, ChannelError> {
        self.publications(Channel::Frames, 1, MAX_OBSERVERS, FRAME_BUFFER)
            .map_err(ipc_error("open the frames channel"))
    }

    /// Opens or creates the `truth` service. It is for evaluation and display, and learners must never read it.
    ///
    /// # Errors
    /// If iceoryx2 can neither open nor create it.
    pub fn truth(&self) -> Result<TruthService, ChannelError> {
        self.publications(Channel::Truth, 1, MAX_TRUTH_READERS, TRUTH_BUFFER)
            .map_err(ipc_error("open the truth channel"))
    }

    /// Opens or creates the `agent` service. An agent or a reader may create it.
    pub fn agent(&self) -> Result<AgentService, ChannelError> {
        self.publications(Channel::Agent, MAX_CLIENTS, MAX_AGENT_READERS, AGENT_BUFFER)
            .map_err(ipc_error("open the agent channel"))
    }

    pub fn wake(&self, channel: Channel) -> Result<WakeService, ChannelError> {
        self.node
            .service_builder(&service_name(self.instance, channel))
            .event()
            .max_listeners(MAX_NODES)
            .max_notifiers(MAX_NODES)
            .max_nodes(MAX_NODES)
            .open_or_create()
            .map_err(ipc_error("open a wake channel"))
    }

    pub fn listener(&self, channel: Channel) -> Result<Listener<Ipc>, ChannelError> {
        // iceoryx2 0.10 changes the umask of the process while it binds a listener's socket. If two threads did this at
        // once, the second could permanently restore the umask that the first had set only for a moment.
        static BINDING: Mutex<()> = Mutex::new(());
        let wake = self.wake(channel)?;
        let _alone = BINDING.lock().unwrap_or_else(PoisonError::into_inner);
        wake.listener_builder()
            .create()
            .map_err(ipc_error("create a listener"))
    }

    fn publications<H: Header>(
        &self,
        channel: Channel,
        n_publishers: usize,
        n_readers: usize,
        buffer: usize,
    ) -> Result<Publications<H>, PublishSubscribeOpenOrCreateError> {
        self.node
            .service_builder(&service_name(self.instance, channel))
            .publish_subscribe::<[u8]>()
            .user_header::<WireHeader<H>>()
            .max_publishers(n_publishers)
            .max_subscribers(n_readers)
            .max_nodes(MAX_NODES)
            .history_size(1)
            .subscriber_max_buffer_size(buffer)
            .subscriber_max_borrowed_samples(1)
            .enable_safe_overflow(true)
            .open_or_create()
    }

    fn create<Q: Header, R: Header>(
        &self,
        channel: Channel,
    ) -> Result<RequestResponse<Q, R>, ChannelError> {
        self.builder::<Q, R>(channel)
            .max_servers(1)
            .max_clients(MAX_CLIENTS)
            .max_nodes(MAX_NODES)
            .max_active_requests_per_client(1)
            .max_loaned_requests(1)
            .max_response_buffer_size(1)
            .max_borrowed_responses_per_pending_response(1)
            .enable_fire_and_forget_requests(false)
            .open_or_create()
            .map_err(ipc_error("create a request channel"))
    }

    fn open<Q: Header, R: Header>(
        &self,
        channel: Channel,
    ) -> Result<RequestResponse<Q, R>, ChannelError> {
        let service = self
            .builder::<Q, R>(channel)
            .open()
            .map_err(|error| match error {
                RequestResponseOpenError::DoesNotExist => none_of(self.instance, channel),
                other => ipc_error("open a request channel")(other),
            })?;
        if service.dynamic_config().number_of_servers() > 0 {
            Ok(service)
        } else {
            Err(no_server(self.instance))
        }
    }

    fn builder<Q: Header, R: Header>(
        &self,
        channel: Channel,
    ) -> request_response_builder::Builder<[u8], WireHeader<Q>, [u8], WireHeader<R>, Ipc> {
        self.node
            .service_builder(&service_name(self.instance, channel))
            .request_response::<[u8], [u8]>()
            .request_user_header::<WireHeader<Q>>()
            .response_user_header::<WireHeader<R>>()
    }
}

pub(crate) fn server_node<Q: Header, R: Header>(service: &RequestResponse<Q, R>) -> Option<u128> {
    let mut node = None;
    service.dynamic_config().list_servers(|server| {
        node = Some(server.node_id.value());
        CallbackProgression::Stop
    });
    node
}
