//! Ports: participants send and receive through them.

use std::cell::{Cell, RefCell};
use std::fmt::Debug;
use std::hint::black_box;
use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use iceoryx2::node::NodeView;
use iceoryx2::port::listener::{Listener, ListenerCreateError, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::PublisherCreateError;
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::port::{DegradationAction, DegradationCause, DegradationInfo};
use iceoryx2::prelude::{CallbackProgression, EventId, FileDescriptorBased, NodeState, PortFactory};
use iceoryx2::service::port_factory::publish_subscribe;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use sealed::Sleeper;

use crate::domain::{Flavour, Node, OpenFailure, is_running, process_in};
use crate::message::Message;
use crate::{IpcError, MessageError};

mod items_and_status;
mod opening;

pub use items_and_status::{ItemScores, ItemScoresPublisher, ItemScoresSubscriber, StatusClient, StatusServer};
pub(crate) use opening::{
    described, occupied, passing, port, request_response, request_response_failure, service_name, wake, waker,
};
use opening::{joined, open_event, open_service, publishers, subscribers};

/// Event ids on every event service.
const DATA: usize = 1;
const CREATED: usize = 2;
const DROPPED: usize = 3;
const DEAD: usize = 4;
/// Most participants that have one service open at once.
pub(crate) const MAX_NODES: usize = 32;
/// Spare notifiers of a service, in addition to those of its publishers. iceoryx2 keeps the place of a notifier if its process was killed
/// at an unlucky moment, and without spare places the next publisher could never join. The limit on publishers is separate.
const LEFT_BEHIND: usize = 64;
/// The longest sleep without a look at the listener. iceoryx2 leaves out wake-ups of a listener that it believes awake, and a notifier that
/// is paused between two of its steps could make it believe that of a sleeping listener.
const SLICE: Duration = Duration::from_millis(250);

const ITEM_SCORES: &str = "roomcast/v1/item-scores";
const STATUS: &str = "roomcast/v1/status";
const STATUS_CLIENTS: usize = 8;

const RECONNECT: Duration = Duration::from_secs(1);

/// Failed connections, for example for lack of file descriptors or memory. iceoryx2 retries only when ports come or go, so without this the
/// two ends would stay disconnected.
#[derive(Debug, Default)]
struct Connections {
    failed: Arc<AtomicBool>,
    again: Cell<Option<Instant>>,
}

impl Connections {
    /// The handler that iceoryx2 calls when a connection fails.
    fn watch(&self) -> impl Fn(DegradationCause, &DegradationInfo) -> DegradationAction + Send + use<> {
        let failed = Arc::clone(&self.failed);
        move |_, _| {
            failed.store(true, Ordering::Relaxed);
            DegradationAction::Ignore
        }
    }

    fn are_due(&self) -> bool {
        match self.again.get() {
            Some(at) if at <= Instant::now() => {
                self.again.set(None);
                true
            }
            Some(_) => false,
            None => {
                if self.failed.load(Ordering::Relaxed) && self.failed.swap(false, Ordering::Relaxed) {
                    self.again.set(Some(Instant::now() + RECONNECT));
                }
                false
            }
        }
    }
}

type Factory<P, H> = publish_subscribe::PortFactory<Flavour, P, H>;

/// Sends messages of one kind. Never blocks on a slow subscriber.
///
/// A subscriber notices a new publisher at its next receive. Until then the publisher's messages are lost if it is dropped. So a publisher
/// that wants to leave waits for a sign: a narrator waits until scores contain its events.
#[derive(Debug)]
pub struct Publisher<M: Message> {
    publisher: iceoryx2::port::publisher::Publisher<Flavour, M, ()>,
    factory: Factory<M, ()>,
    notifier: Notifier<Flavour>,
    /// The subscribers at the last tick, as the sum of their ports' numbers: a count does not change if one comes as another goes.
    known: Cell<u128>,
    connections: Connections,
}

impl<M: Message> Publisher<M> {
    pub(crate) fn open(node: &Node) -> Result<Self, OpenFailure> {
        let quality = M::SERVICE;
        let factory = open_service::<M>(node)?;
        // The publisher comes first, since its place may be taken.
        let connections = Connections::default();
        let publisher = factory.publisher_builder().set_degradation_handler(connections.watch()).create();
        let publisher = publisher.map_err(|error| match error {
            PublisherCreateError::ExceedsMaxSupportedPublishers => {
                occupied(node, &factory, &publishers(&factory), quality.name, "publisher", quality.publishers)
            }
            other => passing(quality.name, &other),
        })?;
        let notifier = open_event(node, quality.name, quality.publishers, quality.subscribers)?
            .notifier_builder()
            .default_event_id(EventId::new(DATA))
            .create();
        let notifier = notifier.map_err(|error| passing(quality.name, &error))?;
        Ok(Self { publisher, factory, notifier, known: Cell::new(0), connections })
    }

    /// Sends a copy and wakes the subscribers. Returns the number of subscribers that received the message: 0 if no process listens.
    ///
    /// # Errors
    ///
    /// [`IpcError::Refused`] when the message is malformed; [`IpcError::Port`] when iceoryx2 cannot deliver.
    pub fn send(&self, message: &M) -> Result<usize, IpcError> {
        message.check().map_err(|source| IpcError::Refused { service: M::SERVICE.name, source })?;
        self.send_unchecked(message)
    }

    /// As [`Publisher::send`] without the check, for tests with malformed messages.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn send_unchecked(&self, message: &M) -> Result<usize, IpcError> {
        let sample = self.publisher.loan_uninit().map_err(|error| port(M::SERVICE.name, "send", &error))?;
        let receivers = sample.write_payload(*message).send().map_err(|error| port(M::SERVICE.name, "send", &error))?;
        self.wake();
        Ok(receivers)
    }

    /// Sends the history to new subscribers; to be called about every 100 ms. Returns whether any subscriber joined or left.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn tick(&self) -> Result<bool, IpcError> {
        if self.connections.are_due() {
            // iceoryx2 checks all connections when a subscriber comes or goes. If this one cannot be created, another will come.
            drop(self.factory.subscriber_builder().create());
        }
        let joined = joined(&self.factory);
        self.publisher.update_connections().map_err(|error| port(M::SERVICE.name, "connect", &error))?;
        // A new subscriber has its history now and may be asleep.
        let changed = self.known.replace(joined) != joined;
        if changed {
            self.wake();
        }
        Ok(changed)
    }

    /// Subscribers connected to the service.
    #[must_use]
    pub fn subscribers(&self) -> usize {
        self.factory.dynamic_config().number_of_subscribers()
    }

    /// The names of the participants that subscribe.
    #[must_use]
    pub fn listeners(&self) -> Vec<String> {
        let holders = subscribers(&self.factory);
        let mut names = Vec::new();
        // If the list fails, some names are missing until the next call.
        let _listed = self.factory.nodes(|state| {
            if let NodeState::Alive(node) = state
                && holders.iter().any(|holder| holder.participant == *node.id())
            {
                names.extend(node.details().as_ref().map(|details| details.name().as_str().to_owned()));
            }
            CallbackProgression::Continue
        });
        names
    }

    /// An error is ignored: the message is in the buffer, and a waiting subscriber looks there when its time-out ends.
    fn wake(&self) {
        let _listeners_woken = self.notifier.notify();
    }
}

type Port<M> = iceoryx2::port::subscriber::Subscriber<Flavour, M, ()>;

/// Receives messages of one kind, each copied out of shared memory and checked.
#[derive(Debug)]
pub struct Subscriber<M: Message> {
    subscriber: RefCell<Port<M>>,
    /// The previous subscriber while it has messages. They are older than all messages of the new one.
    former: RefCell<Option<Port<M>>>,
    connections: Connections,
    factory: Factory<M, ()>,
    listener: Listener<Flavour>,
    /// The last wait ended with news that the listener still holds.
    woken: Cell<bool>,
    /// The number of earlier messages that the subscriber receives.
    history: usize,
    malformed: Cell<u64>,
}

/// Whether a copied message is good, or the reason why it is malformed, and its port.
pub type Judged = (Result<(), MessageError>, Sender);

/// The port of a message. Each publisher ever opened in a domain has another one, and so has each process. It separates senders only if
/// participants use this crate. The user id is the boundary for all others.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Sender(u128);

impl Sender {
    /// A sender without a port, for simulations and tests.
    #[must_use]
    pub const fn simulated(number: u64) -> Self {
        Self(number as u128)
    }

    /// The sender as bytes, to be stored over a restart: ports outlive the process that listens to them.
    #[must_use]
    pub const fn to_bytes(self) -> [u8; 16] {
        self.0.to_le_bytes()
    }

    /// Whether the sender's process runs. iceoryx2 lists a killed process's port until another participant cleans up. If this cannot be
    /// read, the process counts as running.
    #[must_use]
    pub fn is_running(self) -> bool {
        is_running(process_in(self.0))
    }

    /// The sender of [`Sender::to_bytes`].
    #[must_use]
    pub const fn from_bytes(bytes: [u8; 16]) -> Self {
        Self(u128::from_le_bytes(bytes))
    }
}

impl<M: Message> Subscriber<M> {
    pub(crate) fn open(node: &Node, history: usize) -> Result<Self, OpenFailure> {
        let quality = M::SERVICE;
        let factory = open_service::<M>(node)?;
        // The listener exists before the subscriber, so that no wake-up is missed in between.
        let events = open_event(node, quality.name, quality.publishers, quality.subscribers)?;
        let is_full =
            || occupied(node, &factory, &subscribers(&factory), quality.name, "subscriber", quality.subscribers);
        let listener = events.listener_builder().create().map_err(|error| match error {
            ListenerCreateError::ExceedsMaxSupportedListeners => is_full(),
            other => passing(quality.name, &other),
        })?;
        let connections = Connections::default();
        let subscriber = factory.subscriber_builder().buffer_size(quality.buffer).history_request(history);
        let subscriber = subscriber.set_degradation_handler(connections.watch()).create();
        let subscriber = subscriber.map_err(|error| match error {
            SubscriberCreateError::ExceedsMaxSupportedSubscribers => is_full(),
            other => passing(quality.name, &other),
        })?;
        wake(waker(node, quality.name).as_ref());
        let (subscriber, former) = (RefCell::new(subscriber), RefCell::new(None));
        let (woken, malformed) = (Cell::new(false), Cell::new(0));
        Ok(Self { subscriber, former, connections, factory, listener, woken, history, malformed })
    }

    /// Sleeps until there is news (a message; a publisher that comes, goes or dies) or `timeout` is over. Returns whether there was news;
    /// in rare cases the news was already handled. A signal ends the sleep too.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn wait(&self, timeout: Duration) -> Result<bool, IpcError> {
        wait_for_any(&[self], timeout)
    }

    /// Empties the listener. Returns whether there was any event, and whether any was not about messages.
    fn told(&self) -> Result<(bool, bool), IpcError> {
        let mut others = false;
        let told = self.listener.try_wait(|event| others |= event.id != EventId::new(DATA));
        match told {
            Ok(news) => Ok((news > 0, others)),
            Err(ListenerWaitError::InterruptSignal) => Ok((false, others)),
            Err(error) => Err(port(M::SERVICE.name, "wait", &error)),
        }
    }

    fn has_messages(&self) -> Result<bool, IpcError> {
        if self.former.borrow().is_some() {
            return Ok(true);
        }
        self.subscriber.borrow().has_samples().map_err(|error| port(M::SERVICE.name, "wait", &error))
    }

    /// Takes the oldest message that waits, `None` if no message waits. Malformed messages are dropped and counted:
    /// [`Subscriber::malformed`].
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    ///
    /// ```
    /// # let root = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp")?;
    /// # let domain = roomcast_ipc::Domain::new(root.path(), &format!("doc-{}", std::process::id()))?;
    /// use roomcast_ipc::raw::{NarrationV1, narration_kind};
    ///
    /// let node = domain.open("both-ends")?;
    /// let subscriber = node.subscriber::<NarrationV1>()?;
    /// let message = NarrationV1::new(narration_kind::SENTENCE, "They grab the mug.")?;
    /// node.publisher()?.send(&NarrationV1 { source: 7, epoch: 1, sequence: 1, ..message })?;
    /// # drop(subscriber);
    /// # drop(node);
    /// # domain.clean_up()?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn receive(&self) -> Result<Option<M>, IpcError> {
        let mut message = M::default();
        Ok(self.receive_into(&mut message)?.then_some(message))
    }

    /// As [`Subscriber::receive`], into the caller's memory: a loop that reuses it saves copies of some thousand bytes. Returns whether
    /// there was a message. If not, the memory may hold a malformed message.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn receive_into(&self, message: &mut M) -> Result<bool, IpcError> {
        while let Some((checked, _)) = self.receive_from(message)? {
            if checked.is_ok() {
                return Ok(true);
            }
            self.malformed.set(self.malformed.get() + 1);
        }
        Ok(false)
    }

    /// Malformed messages that [`Subscriber::receive`], [`Subscriber::receive_into`] and [`Subscriber::newest`] have dropped.
    #[must_use]
    pub fn malformed(&self) -> u64 {
        self.malformed.get()
    }

    /// Takes the oldest waiting message, malformed or not, with its port. The fields of a malformed message must not be used.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn receive_from(&self, message: &mut M) -> Result<Option<Judged>, IpcError> {
        if self.connections.are_due() {
            self.connect_again();
        }
        let fail = |error| port(M::SERVICE.name, "receive", &error);
        let former = self.former.take();
        let left = former.as_ref().map_or(Ok(None), |former| former.receive());
        if !matches!(left, Ok(None)) {
            self.former.replace(former);
        }
        let left = left.map_err(fail)?;
        let sample = match left {
            Some(left) => Some(left),
            None => self.subscriber.borrow().receive().map_err(fail)?,
        };
        Ok(sample.map(|sample| {
            // The sender can still write to the sample, and the check must see the data that is used. So this copies first, and the black
            // box keeps the compiler from reading the shared memory a second time.
            *message = *sample.payload();
            // The number is from the connection: the sender can write to the number in the sample's header.
            (black_box(message).check(), Sender(sample.origin().value()))
        }))
    }

    /// Replaces the subscriber, so that all connections are made again. Publishers send the new one as much of their history as it asks
    /// for. Messages that the former one has received are read first; those in the history come twice.
    fn connect_again(&self) {
        if self.former.borrow().is_some() {
            self.connections.failed.store(true, Ordering::Relaxed);
            return;
        }
        let subscriber = self.factory.subscriber_builder().buffer_size(M::SERVICE.buffer).history_request(self.history);
        match subscriber.set_degradation_handler(self.connections.watch()).create() {
            Ok(subscriber) => drop(self.former.replace(Some(self.subscriber.replace(subscriber)))),
            // There may be no place for two at this moment.
            Err(_) => self.connections.failed.store(true, Ordering::Relaxed),
        }
    }

    /// Takes all waiting messages and returns the newest good one.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn newest(&self) -> Result<Option<M>, IpcError> {
        let mut newest = None;
        while let Some(received) = self.receive()? {
            newest = Some(received);
        }
        Ok(newest)
    }

    /// Publishers connected to the service.
    #[must_use]
    pub fn publishers(&self) -> usize {
        self.factory.dynamic_config().number_of_publishers()
    }

    /// The ports of the publishers connected to the service.
    #[must_use]
    pub fn senders(&self) -> Vec<Sender> {
        let mut senders = Vec::new();
        self.factory.dynamic_config().list_publishers(|publisher| {
            senders.push(Sender(publisher.publisher_id.value()));
            CallbackProgression::Continue
        });
        senders
    }

    /// Subscribers of the service, this one included.
    #[must_use]
    pub fn subscribers(&self) -> usize {
        self.factory.dynamic_config().number_of_subscribers()
    }
}

/// A [`Subscriber`] of any message, for [`wait_for_any`].
pub trait Awaited: Sleeper {}

impl<M: Message> Awaited for Subscriber<M> {}

mod sealed {
    use super::{BorrowedFd, IpcError};

    pub trait Sleeper {
        fn service(&self) -> &'static str;
        fn has_news(&self) -> Result<bool, IpcError>;
        fn descriptor(&self) -> BorrowedFd<'_>;
        /// Notes that the sleep ended with news that the listener still holds.
        fn woken(&self);
    }
}

impl<M: Message> Sleeper for Subscriber<M> {
    fn service(&self) -> &'static str {
        M::SERVICE.name
    }

    fn has_news(&self) -> Result<bool, IpcError> {
        // The listener is emptied only now, so that the woken program gets its message earlier, by some system calls.
        let woken = self.woken.take();
        let (news, others) = self.told()?;
        Ok(others || (news && (!woken || self.has_messages()?)))
    }

    #[expect(unsafe_code, reason = "iceoryx2 gives the number of its descriptor and no safe form of it")]
    fn descriptor(&self) -> BorrowedFd<'_> {
        // SAFETY: the descriptor belongs to the listener, which is borrowed for longer than this and closes it when it is dropped. The
        // number is not stored.
        unsafe { BorrowedFd::borrow_raw(self.listener.file_descriptor().native_handle()) }
    }

    fn woken(&self) {
        self.woken.set(true);
    }
}

/// Sleeps as [`Subscriber::wait`] does, for news of any of several subscribers. Returns whether there was any.
///
/// # Errors
///
/// [`IpcError::Port`].
pub fn wait_for_any(awaited: &[&dyn Awaited], timeout: Duration) -> Result<bool, IpcError> {
    // No end if it is beyond the range of the clock.
    let end = Instant::now().checked_add(timeout);
    loop {
        for one in awaited {
            if one.has_news()? {
                return Ok(true);
            }
        }
        let left = end.map_or(SLICE, |end| end.saturating_duration_since(Instant::now()));
        if left.is_zero() {
            return Ok(false);
        }
        match sleep(awaited, left.min(SLICE)) {
            Ok(true) => return Ok(true),
            Ok(false) => {}
            Err(Errno::INTR) => return Ok(false),
            Err(error) => return Err(port(awaited.first().map_or("", |first| first.service()), "wait", &error)),
        }
    }
}

fn sleep(awaited: &[&dyn Awaited], timeout: Duration) -> Result<bool, Errno> {
    let timeout = Timespec::try_from(timeout).map_err(|_| Errno::INVAL)?;
    let descriptors: Vec<BorrowedFd<'_>> = awaited.iter().map(|one| one.descriptor()).collect();
    let mut polled: Vec<PollFd<'_>> =
        descriptors.iter().map(|descriptor| PollFd::new(descriptor, PollFlags::IN)).collect();
    if poll(&mut polled, Some(&timeout))? == 0 {
        return Ok(false);
    }
    for (one, polled) in awaited.iter().zip(&polled) {
        if !polled.revents().is_empty() {
            one.woken();
        }
    }
    Ok(true)
}

impl Node {
    /// A publisher of `M`. Fails with [`IpcError::Occupied`] if all its places are taken.
    ///
    /// # Errors
    ///
    /// [`IpcError`], with both sides named where versions or types differ.
    pub fn publisher<M: Message>(&self) -> Result<Publisher<M>, IpcError> {
        self.retry(|| Publisher::open(self))
    }

    /// A subscriber of `M`. It receives the service's history.
    ///
    /// # Errors
    ///
    /// As [`Node::publisher`].
    pub fn subscriber<M: Message>(&self) -> Result<Subscriber<M>, IpcError> {
        self.retry(|| Subscriber::open(self, M::SERVICE.history))
    }

    /// A subscriber without the service's history.
    ///
    /// # Errors
    ///
    /// As [`Node::publisher`].
    pub fn subscriber_from_now<M: Message>(&self) -> Result<Subscriber<M>, IpcError> {
        self.retry(|| Subscriber::open(self, 0))
    }

    /// The publisher of item scores.
    ///
    /// # Errors
    ///
    /// As [`Node::publisher`].
    pub fn item_scores_publisher(&self) -> Result<ItemScoresPublisher, IpcError> {
        self.retry(|| ItemScoresPublisher::open(self))
    }

    /// A subscriber of item scores. While it lives, the daemon sends them.
    ///
    /// # Errors
    ///
    /// As [`Node::publisher`].
    pub fn item_scores_subscriber(&self) -> Result<ItemScoresSubscriber, IpcError> {
        self.retry(|| ItemScoresSubscriber::open(self))
    }

    /// As [`Node::item_scores_subscriber`] with a single try, for optional use. `None` if all places are taken or another temporary failure
    /// occurs.
    ///
    /// # Errors
    ///
    /// As [`Node::publisher`], for what does not pass.
    pub fn try_item_scores_subscriber(&self) -> Result<Option<ItemScoresSubscriber>, IpcError> {
        self.try_once(|| ItemScoresSubscriber::open(self))
    }

    /// The server of status requests.
    ///
    /// # Errors
    ///
    /// As [`Node::publisher`].
    pub fn status_server(&self) -> Result<StatusServer, IpcError> {
        self.retry(|| StatusServer::open(self))
    }

    /// A client for status requests.
    ///
    /// # Errors
    ///
    /// As [`Node::publisher`].
    pub fn status_client(&self) -> Result<StatusClient, IpcError> {
        self.retry(|| StatusClient::open(self))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Domain;
    use crate::message::RobotReportV1;
    use crate::raw::report_kind;

    /// A planner that restarted within one tick was not noticed, and received reports of one other robot alone.
    #[test]
    fn one_that_comes_as_another_goes_is_noticed() {
        let root = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(root.path(), &format!("comes-{}", std::process::id())).unwrap();
        let node = domain.open("both").unwrap();
        let publisher = node.publisher::<RobotReportV1>().unwrap();
        for _ in 0..3 {
            let subscriber = node.subscriber::<RobotReportV1>().unwrap();
            assert!(publisher.tick().unwrap(), "it has come");
            assert!(!publisher.tick().unwrap());
            drop(subscriber);
        }
        drop((publisher, node));
        domain.clean_up().unwrap();
    }

    /// A failed connection is made again. The unread messages of the other connections are not lost.
    #[test]
    fn what_good_connections_delivered_outlives_a_failed_one() {
        let root = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(root.path(), &format!("again-{}", std::process::id())).unwrap();
        let node = domain.open("both").unwrap();
        let subscriber = node.subscriber::<RobotReportV1>().unwrap();
        let publisher = node.publisher::<RobotReportV1>().unwrap();
        let report = |sequence| RobotReportV1 {
            robot: 7,
            epoch: 1,
            sequence,
            kind: report_kind::DOCKED,
            ..RobotReportV1::default()
        };
        let most = RobotReportV1::SERVICE.buffer as u64;
        for sequence in 1..=most {
            publisher.send(&report(sequence)).unwrap();
        }
        let before = subscriber.subscribers();
        subscriber.connect_again();
        assert_eq!(subscriber.subscribers(), before + 1, "the one before it has messages");
        assert!(subscriber.has_messages().unwrap());
        // A second reconnection waits until the messages are read.
        subscriber.connect_again();
        assert_eq!(subscriber.subscribers(), before + 1);
        publisher.tick().unwrap();
        publisher.send(&report(most + 1)).unwrap();
        let mut heard = Vec::new();
        while let Some(received) = subscriber.receive().unwrap() {
            let sequence = received.sequence;
            if !heard.contains(&sequence) {
                heard.push(sequence);
            }
        }
        assert_eq!(subscriber.subscribers(), before, "its place is free again");
        // The newest message came to both. If it overran the former's buffer, the oldest gave way as usual.
        assert!(heard.iter().copied().eq(2..=most + 1), "{heard:?}");
        drop((subscriber, publisher, node));
        domain.clean_up().unwrap();
    }
}
