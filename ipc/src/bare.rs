//! iceoryx2 without the contract, for `roomcast latency` to compare with. It has no checks, no settings and no history: publish, notify,
//! wake, receive.

use std::time::{Duration, Instant};

use iceoryx2::config::Config;
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::{NodeBuilder, ServiceName, SignalHandlingMode};
use iceoryx2::service::port_factory::{event, publish_subscribe};

use crate::IpcError;
use crate::domain::{Flavour, Node};
use crate::port::port;
use crate::raw::Message;

/// Sends payloads of `M`'s layout, unchecked.
#[derive(Debug)]
pub struct BareSender<M: Message> {
    publisher: iceoryx2::port::publisher::Publisher<Flavour, M, ()>,
    notifier: Notifier<Flavour>,
    service: &'static str,
}

/// Receives payloads of `M`'s layout, unchecked.
#[derive(Debug)]
pub struct BareReceiver<M: Message> {
    subscriber: iceoryx2::port::subscriber::Subscriber<Flavour, M, ()>,
    listener: Listener<Flavour>,
    service: &'static str,
}

impl<M: Message> BareSender<M> {
    /// Opens or makes `service`, with iceoryx2's own defaults.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn open(node: &Node, service: &'static str) -> Result<Self, IpcError> {
        let (data, events) = services::<M>(node, service)?;
        Ok(Self {
            publisher: data.publisher_builder().create().map_err(|error| port(service, "open", &error))?,
            notifier: events.notifier_builder().create().map_err(|error| port(service, "open", &error))?,
            service,
        })
    }

    /// Publishes a copy and notifies.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn send(&self, payload: &M) -> Result<(), IpcError> {
        self.publisher.send_copy(*payload).map_err(|error| port(self.service, "send", &error))?;
        self.notifier.notify().map_err(|error| port(self.service, "notify", &error))?;
        Ok(())
    }
}

impl<M: Message> BareReceiver<M> {
    /// Opens or makes `service`, with iceoryx2's own defaults.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn open(node: &Node, service: &'static str) -> Result<Self, IpcError> {
        let (data, events) = services::<M>(node, service)?;
        Ok(Self {
            listener: events.listener_builder().create().map_err(|error| port(service, "open", &error))?,
            subscriber: data.subscriber_builder().create().map_err(|error| port(service, "open", &error))?,
            service,
        })
    }

    /// Sleeps until a payload is there, at most for `timeout`, and copies it out.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn receive(&self, timeout: Duration) -> Result<Option<M>, IpcError> {
        let end = Instant::now() + timeout;
        loop {
            let sample = self.subscriber.receive().map_err(|error| port(self.service, "receive", &error))?;
            if let Some(sample) = sample {
                return Ok(Some(*sample.payload()));
            }
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            // The library waits without limit if less than a microsecond is left.
            match self.listener.timed_wait(|_| (), left.max(Duration::from_micros(1))) {
                // A signal, after which there is still time.
                Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
                Err(error) => return Err(port(self.service, "wait", &error)),
            }
        }
    }
}

type Services<M> = (publish_subscribe::PortFactory<Flavour, M, ()>, event::PortFactory<Flavour>);

fn services<M: Message>(node: &Node, service: &'static str) -> Result<Services<M>, IpcError> {
    let name = ServiceName::new(service).map_err(|error| port(service, "open", &error))?;
    let mut config = node.config().clone();
    config.defaults = Config::default().defaults;
    let node =
        NodeBuilder::new().config(&config).signal_handling_mode(SignalHandlingMode::Disabled).create::<Flavour>();
    let node = node.map_err(|error| port(service, "open", &error))?;
    let data = node.service_builder(&name).publish_subscribe::<M>().open_or_create();
    let events = node.service_builder(&name).event().open_or_create();
    Ok((data.map_err(|error| port(service, "open", &error))?, events.map_err(|error| port(service, "open", &error))?))
}
