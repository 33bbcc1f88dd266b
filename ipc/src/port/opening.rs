//! How services are opened, and why that fails.

use std::error::Error;
use std::fmt::Debug;

use iceoryx2::node::NodeView;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::{
    CallbackProgression, EventId, IceoryxSend, MessagingPattern, NodeState, PortFactory, Service, ServiceName,
    ZeroCopySend,
};
use iceoryx2::service::builder::event::EventOpenOrCreateError;
use iceoryx2::service::builder::publish_subscribe::{PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError};
use iceoryx2::service::builder::request_response::{RequestResponseOpenError, RequestResponseOpenOrCreateError};

use super::{CREATED, DEAD, DROPPED, Factory, ITEM_SCORES, LEFT_BEHIND, MAX_NODES, STATUS, STATUS_CLIENTS};
use crate::domain::{Flavour, Node, OpenFailure, Place, shown};
use crate::message::{
    DecisionV1, ItemScoreV1, ItemScoresHeaderV1, Layout, Message, NarrationV1, RobotReportV1, RoomScoresV1,
    StatusRequestV1, StatusResponseV1,
};
use crate::{ICEORYX2_VERSION, IpcError};

/// Wakes the participant that serves a service when another one joins or asks, so that it need not look for newcomers all the time. It
/// sleeps on the news of another service. `None` if no participant serves it; then, or if waking fails, a newcomer waits some hundred
/// milliseconds.
pub(crate) fn waker(node: &Node, service: &'static str) -> Option<Notifier<Flavour>> {
    let heard = match service {
        name if name == DecisionV1::SERVICE.name => RoomScoresV1::SERVICE,
        name if name == NarrationV1::SERVICE.name || name == RobotReportV1::SERVICE.name => return None,
        _ => NarrationV1::SERVICE,
    };
    let events = open_event(node, heard.name, heard.publishers, heard.subscribers).ok()?;
    events.notifier_builder().default_event_id(EventId::new(CREATED)).create().ok()
}

pub(crate) fn wake(waker: Option<&Notifier<Flavour>>) {
    if let Some(waker) = waker {
        let _listeners_woken = waker.notify();
    }
}

pub(super) fn open_service<M: Message>(node: &Node) -> Result<Factory<M, ()>, OpenFailure> {
    let quality = M::SERVICE;
    let opened = node
        .inner()
        .service_builder(&service_name(quality.name)?)
        .publish_subscribe::<M>()
        .max_publishers(quality.publishers)
        .max_subscribers(quality.subscribers)
        .max_nodes(MAX_NODES)
        .subscriber_max_buffer_size(quality.buffer)
        .subscriber_max_borrowed_samples(2)
        .history_size(quality.history)
        .enable_safe_overflow(true)
        .open_or_create();
    opened
        .map_err(|error| publish_subscribe_failure(node, quality.name, &described(M::TYPE_NAME, size_of::<M>()), error))
}

pub(super) fn open_item_scores(node: &Node) -> Result<Factory<[ItemScoreV1], ItemScoresHeaderV1>, OpenFailure> {
    let opened = node
        .inner()
        .service_builder(&service_name(ITEM_SCORES)?)
        .publish_subscribe::<[ItemScoreV1]>()
        .user_header::<ItemScoresHeaderV1>()
        .max_publishers(1)
        .max_subscribers(8)
        .max_nodes(MAX_NODES)
        .subscriber_max_buffer_size(2)
        .subscriber_max_borrowed_samples(2)
        .history_size(1)
        .enable_safe_overflow(true)
        .open_or_create();
    let ours = described(ItemScoreV1::TYPE_NAME, size_of::<ItemScoreV1>());
    opened.map_err(|error| publish_subscribe_failure(node, ITEM_SCORES, &ours, error))
}

/// A service with one server; all its options are in one place. This is a macro because iceoryx2's builders of fixed and of dynamic
/// payloads have no trait in common.
macro_rules! request_response {
    ($node:expr, $service:expr, $request:ty, $response:ty, $clients:expr) => {
        $node
            .inner()
            .service_builder(&$crate::port::service_name($service)?)
            .request_response::<$request, $response>()
            .max_servers(1)
            .max_clients($clients)
            .max_nodes($crate::port::MAX_NODES)
            .max_active_requests_per_client(4)
            .max_response_buffer_size(2)
            .max_borrowed_responses_per_pending_response(2)
            .max_loaned_requests(2)
            .enable_fire_and_forget_requests(true)
            .enable_safe_overflow_for_requests(true)
            .enable_safe_overflow_for_responses(true)
            .open_or_create()
    };
}
pub(crate) use request_response;

pub(super) type StatusFactory =
    iceoryx2::service::port_factory::request_response::PortFactory<Flavour, StatusRequestV1, (), StatusResponseV1, ()>;

pub(super) fn open_status(node: &Node) -> Result<StatusFactory, OpenFailure> {
    let opened = request_response!(node, STATUS, StatusRequestV1, StatusResponseV1, STATUS_CLIENTS);
    let ours = described(StatusResponseV1::TYPE_NAME, size_of::<StatusResponseV1>());
    opened.map_err(|error| request_response_failure(node, STATUS, &ours, &error))
}

pub(crate) fn request_response_failure(
    node: &Node,
    service: &'static str,
    ours: &str,
    error: &RequestResponseOpenOrCreateError,
) -> OpenFailure {
    let RequestResponseOpenOrCreateError::RequestResponseOpenError(cause) = error else {
        return passing(service, error);
    };
    match cause {
        RequestResponseOpenError::IncompatibleRequestOrResponseType => OpenFailure::Final(IpcError::TypeMismatch {
            service,
            theirs: "other types".to_owned(),
            ours: ours.to_owned(),
        }),
        RequestResponseOpenError::VersionMismatch => OpenFailure::Final(version_mismatch(node, service)),
        _ => passing(service, error),
    }
}

pub(super) fn open_event(
    node: &Node,
    name: &'static str,
    notifiers: usize,
    listeners: usize,
) -> Result<iceoryx2::service::port_factory::event::PortFactory<Flavour>, OpenFailure> {
    use iceoryx2::service::builder::event::EventOpenError;
    let opened = node
        .inner()
        .service_builder(&service_name(name)?)
        .event()
        .max_notifiers(notifiers + LEFT_BEHIND)
        .max_listeners(listeners)
        .max_nodes(MAX_NODES)
        .event_id_max_value(DEAD)
        .notifier_created_event(EventId::new(CREATED))
        .notifier_dropped_event(EventId::new(DROPPED))
        .notifier_dead_event(EventId::new(DEAD))
        .disable_deadline()
        .open_or_create();
    opened.map_err(|error| match &error {
        EventOpenOrCreateError::EventOpenError(EventOpenError::VersionMismatch) => {
            OpenFailure::Final(version_mismatch(node, name))
        }
        _ => passing(name, &error),
    })
}

pub(super) fn publish_subscribe_failure(
    node: &Node,
    service: &'static str,
    ours: &str,
    error: PublishSubscribeOpenOrCreateError,
) -> OpenFailure {
    use PublishSubscribeOpenError as Open;
    let PublishSubscribeOpenOrCreateError::PublishSubscribeOpenError(cause) = &error else {
        return passing(service, &error);
    };
    match cause {
        Open::IncompatibleTypes => OpenFailure::Final(IpcError::TypeMismatch {
            service,
            theirs: their_type(node, service),
            ours: ours.to_owned(),
        }),
        Open::VersionMismatch => OpenFailure::Final(version_mismatch(node, service)),
        Open::IncompatibleMessagingPattern
        | Open::IncompatibleAttributes
        | Open::IncompatibleOverflowBehavior
        | Open::DoesNotSupportRequestedMinBufferSize
        | Open::DoesNotSupportRequestedMinHistorySize
        | Open::DoesNotSupportRequestedMinSubscriberBorrowedSamples
        | Open::DoesNotSupportRequestedAmountOfPublishers
        | Open::DoesNotSupportRequestedAmountOfSubscribers
        | Open::DoesNotSupportRequestedAmountOfNodes
        | Open::InsufficientPermissions => OpenFailure::Final(IpcError::Open {
            service,
            cause: format!(
                "{cause:?}; a participant that started earlier set it up otherwise: stop it, or make both the same"
            )
            .into(),
            tried_ms: 0,
        }),
        _ => passing(service, &error),
    }
}

/// The message type of the running service, if it says so.
pub(super) fn their_type(node: &Node, service: &'static str) -> String {
    let unknown = || "other types".to_owned();
    let Ok(name) = ServiceName::new(service) else { return unknown() };
    match Flavour::details(&name, node.config(), MessagingPattern::PublishSubscribe) {
        Ok(Some(details)) => match details.static_details.messaging_pattern() {
            iceoryx2::service::static_config::messaging_pattern::MessagingPattern::PublishSubscribe(settings) => {
                let payload = &settings.message_type_details().payload;
                described(&payload.type_name().to_string(), payload.size())
            }
            _ => unknown(),
        },
        _ => unknown(),
    }
}

pub(crate) fn version_mismatch(node: &Node, service: &'static str) -> IpcError {
    let theirs = ServiceName::new(service)
        .ok()
        .and_then(|name| Flavour::details(&name, node.config(), MessagingPattern::PublishSubscribe).ok().flatten())
        .map_or_else(|| "another version".to_owned(), |details| details.static_details.iceoryx2_version().to_string());
    IpcError::VersionMismatch { service, theirs, ours: ICEORYX2_VERSION }
}

pub(crate) fn described(type_name: &str, size: usize) -> String {
    format!("{type_name} of {size} bytes")
}

/// A temporary failure: the holder may be stopping, or dead and not yet cleaned up.
pub(crate) fn occupied<F: PortFactory<Service = Flavour>>(
    node: &Node,
    factory: &F,
    holders: &[Place],
    service: &'static str,
    role: &'static str,
    limit: usize,
) -> OpenFailure {
    let mut names = Vec::new();
    // If the list fails, the error names fewer holders.
    let _listed = factory.nodes(|state| {
        if let NodeState::Alive(node) = state
            && holders.iter().any(|holder| holder.participant == *node.id())
            && let Some(details) = node.details()
        {
            names.push(shown(details));
        }
        CallbackProgression::Continue
    });
    node.free_places_of_nobody(holders, factory.service_hash());
    let holder = if names.is_empty() { "somebody".to_owned() } else { names.join(", ") };
    OpenFailure::Passing(IpcError::Occupied { service, holder, role, limit })
}

pub(super) fn publishers<P: Debug + IceoryxSend + ?Sized, H: Debug + ZeroCopySend>(
    factory: &Factory<P, H>,
) -> Vec<Place> {
    let mut places = Vec::new();
    factory.dynamic_config().list_publishers(|publisher| {
        places.push(Place { participant: publisher.node_id, port: publisher.publisher_id.value() });
        CallbackProgression::Continue
    });
    places
}

pub(super) fn subscribers<P: Debug + IceoryxSend + ?Sized, H: Debug + ZeroCopySend>(
    factory: &Factory<P, H>,
) -> Vec<Place> {
    let mut places = Vec::new();
    factory.dynamic_config().list_subscribers(|subscriber| {
        places.push(Place { participant: subscriber.node_id, port: subscriber.subscriber_id.value() });
        CallbackProgression::Continue
    });
    places
}

/// The subscribers as the sum of their ports' numbers: a count does not change if one comes as another goes, and a list takes memory.
pub(super) fn joined<P: Debug + IceoryxSend + ?Sized, H: Debug + ZeroCopySend>(factory: &Factory<P, H>) -> u128 {
    let mut sum = 0_u128;
    factory.dynamic_config().list_subscribers(|subscriber| {
        sum = sum.wrapping_add(subscriber.subscriber_id.value());
        CallbackProgression::Continue
    });
    sum
}

pub(crate) fn service_name(name: &'static str) -> Result<ServiceName, OpenFailure> {
    ServiceName::new(name).map_err(|error| passing(name, &error))
}

pub(crate) fn passing<E: Error + Clone + Send + Sync + 'static>(service: &'static str, error: &E) -> OpenFailure {
    OpenFailure::Passing(IpcError::Open { service, cause: Box::new(error.clone()), tried_ms: 0 })
}

pub(crate) fn port<E: Error + Clone + Send + Sync + 'static>(
    service: &'static str,
    operation: &'static str,
    error: &E,
) -> IpcError {
    IpcError::Port { service, operation, cause: Box::new(error.clone()) }
}
