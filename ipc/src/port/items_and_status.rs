//! Two special ports: item scores have a slice, and the status answers questions.

use std::cell::{Cell, RefCell};
use std::fmt::Debug;
use std::hint::black_box;
use std::time::{Duration, Instant};

use iceoryx2::port::client::Client;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::PublisherCreateError;
use iceoryx2::port::server::Server;
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::{CallbackProgression, PortFactory};
use iceoryx2::service::port_factory::server::ServerCreateError;

use super::opening::{
    StatusFactory, occupied, open_item_scores, open_status, passing, port, publishers, subscribers, wake, waker,
};
use super::{Factory, ITEM_SCORES, STATUS};
use crate::domain::{Flavour, Node, OpenFailure, Place};
use crate::message::{ItemScoreV1, ItemScoresHeaderV1, MAX_ITEMS, StatusRequestV1, StatusResponseV1};
use crate::{IpcError, MessageError};

/// A snapshot of all items' scores.
#[derive(Debug, Clone, PartialEq)]
pub struct ItemScores {
    /// The header, which names the room scores of the same moment.
    pub header: ItemScoresHeaderV1,
    /// One score per item, in the map's order; if the map has more than [`MAX_ITEMS`], only the best scores.
    pub items: Vec<ItemScoreV1>,
}

/// Sends item scores, a slice with a header.
#[derive(Debug)]
pub struct ItemScoresPublisher {
    publisher: iceoryx2::port::publisher::Publisher<Flavour, [ItemScoreV1], ItemScoresHeaderV1>,
    factory: Factory<[ItemScoreV1], ItemScoresHeaderV1>,
    known: Cell<usize>,
}

impl ItemScoresPublisher {
    pub(crate) fn open(node: &Node) -> Result<Self, OpenFailure> {
        let factory = open_item_scores(node)?;
        let publisher = factory
            .publisher_builder()
            // Growing later may fail for lack of memory.
            .initial_max_slice_len(MAX_ITEMS)
            .create()
            .map_err(|error| match error {
                PublisherCreateError::ExceedsMaxSupportedPublishers => {
                    occupied(node, &factory, &publishers(&factory), ITEM_SCORES, "publisher", 1)
                }
                other => passing(ITEM_SCORES, &other),
            })?;
        Ok(Self { publisher, factory, known: Cell::new(0) })
    }

    /// Whether there are subscribers. Without one, sending is not worth its time.
    #[must_use]
    pub fn wanted(&self) -> bool {
        self.subscribers() > 0
    }

    fn subscribers(&self) -> usize {
        self.factory.dynamic_config().number_of_subscribers()
    }

    /// Sends the scores of all items, or of the best ones.
    ///
    /// # Errors
    ///
    /// [`IpcError::Refused`] for more than [`MAX_ITEMS`]; [`IpcError::Port`].
    pub fn send(
        &self,
        header: ItemScoresHeaderV1,
        items: impl ExactSizeIterator<Item = ItemScoreV1>,
    ) -> Result<(), IpcError> {
        if items.len() > MAX_ITEMS {
            let (value, allowed) = (items.len() as f64, "0 to 1024");
            let source = MessageError::OutOfRange { field: "items", value, allowed };
            return Err(IpcError::Refused { service: ITEM_SCORES, source });
        }
        let sample = self.publisher.loan_slice_uninit(items.len());
        let mut sample = sample.map_err(|error| port(ITEM_SCORES, "send", &error))?;
        *sample.user_header_mut() = header;
        let mut items = items;
        let sample = sample.write_from_fn(|_| items.next().unwrap_or_default());
        sample.send().map_err(|error| port(ITEM_SCORES, "send", &error))?;
        Ok(())
    }

    /// Sends the history to new subscribers. Returns whether the first subscriber joined. The history may be
    /// empty.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn tick(&self) -> Result<bool, IpcError> {
        let subscribers = self.subscribers();
        self.publisher.update_connections().map_err(|error| port(ITEM_SCORES, "connect", &error))?;
        Ok(self.known.replace(subscribers) == 0 && subscribers > 0)
    }
}

/// Receives item scores.
#[derive(Debug)]
pub struct ItemScoresSubscriber {
    subscriber: iceoryx2::port::subscriber::Subscriber<Flavour, [ItemScoreV1], ItemScoresHeaderV1>,
}

impl ItemScoresSubscriber {
    pub(crate) fn open(node: &Node) -> Result<Self, OpenFailure> {
        let factory = open_item_scores(node)?;
        let subscriber = factory.subscriber_builder().create();
        let subscriber = subscriber.map_err(|error| match error {
            SubscriberCreateError::ExceedsMaxSupportedSubscribers => {
                occupied(node, &factory, &subscribers(&factory), ITEM_SCORES, "subscriber", 8)
            }
            other => passing(ITEM_SCORES, &other),
        })?;
        wake(waker(node, ITEM_SCORES).as_ref());
        Ok(Self { subscriber })
    }

    /// Takes all waiting snapshots and returns the newest, copied.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn newest(&self) -> Result<Option<ItemScores>, IpcError> {
        let mut newest = None;
        while let Some(sample) = self.subscriber.receive().map_err(|error| port(ITEM_SCORES, "receive", &error))? {
            let items = sample.payload();
            // The sender can change the length.
            if items.len() <= MAX_ITEMS {
                newest = Some(ItemScores { header: *sample.user_header(), items: items.to_vec() });
            }
        }
        Ok(newest)
    }
}

/// Answers status requests.
#[derive(Debug)]
pub struct StatusServer {
    server: Server<Flavour, StatusRequestV1, (), StatusResponseV1, ()>,
}

impl StatusServer {
    pub(crate) fn open(node: &Node) -> Result<Self, OpenFailure> {
        let factory = open_status(node)?;
        let server = factory.server_builder().create();
        let server = server.map_err(|error| {
            if error != ServerCreateError::ExceedsMaxSupportedServers {
                return passing(STATUS, &error);
            }
            let mut servers = Vec::new();
            factory.dynamic_config().list_servers(|server| {
                servers.push(Place { participant: server.node_id, port: server.server_id.value() });
                CallbackProgression::Continue
            });
            occupied(node, &factory, &servers, STATUS, "server", 1)
        })?;
        Ok(Self { server })
    }

    /// Answers all waiting requests. Returns the number of answers that were sent.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn answer(&self, response: impl Fn() -> StatusResponseV1) -> Result<usize, IpcError> {
        let mut answered = 0;
        while let Some(request) = self.server.receive().map_err(|error| port(STATUS, "receive", &error))? {
            // If the client has gone, the daemon goes on.
            answered += usize::from(request.send_copy(response()).is_ok());
        }
        Ok(answered)
    }
}

/// Asks the daemon for its status.
#[derive(Debug)]
pub struct StatusClient {
    client: RefCell<Client<Flavour, StatusRequestV1, (), StatusResponseV1, ()>>,
    factory: StatusFactory,
    /// The last question got no answer. Its connection may have failed, and iceoryx2 does not try that again.
    unanswered: Cell<bool>,
    waker: Option<Notifier<Flavour>>,
}

impl StatusClient {
    pub(crate) fn open(node: &Node) -> Result<Self, OpenFailure> {
        let factory = open_status(node)?;
        let client = factory.client_builder().create().map_err(|error| passing(STATUS, &error))?;
        let (client, unanswered) = (RefCell::new(client), Cell::new(false));
        Ok(Self { client, factory, unanswered, waker: waker(node, STATUS) })
    }

    /// Asks, and waits for the answer.
    ///
    /// # Errors
    ///
    /// [`IpcError::NoAnswer`] after `timeout`; [`IpcError::Port`].
    pub fn ask(&self, timeout: Duration) -> Result<StatusResponseV1, IpcError> {
        if self.unanswered.replace(false)
            && let Ok(client) = self.factory.client_builder().create()
        {
            self.client.replace(client);
        }
        let start = Instant::now();
        // A daemon that starts after a question was sent never receives it, so the question is repeated.
        while start.elapsed() < timeout {
            let pending = self.client.borrow().send_copy(StatusRequestV1::default());
            let pending = pending.map_err(|error| port(STATUS, "send", &error))?;
            wake(self.waker.as_ref());
            let sent = Instant::now();
            while sent.elapsed() < Duration::from_millis(300) && start.elapsed() < timeout {
                if let Some(response) = pending.receive().map_err(|error| port(STATUS, "receive", &error))? {
                    return Ok(black_box(*response.payload()));
                }
                std::thread::sleep(Duration::from_millis(2));
            }
        }
        self.unanswered.set(true);
        Err(IpcError::NoAnswer { service: STATUS, waited_ms: timeout.as_millis() })
    }
}
