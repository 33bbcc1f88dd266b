//! What the client needs beyond its library, whoever uses it.

use rumqttc::v5::mqttbytes::v5::{ConnAck, DisconnectReasonCode};
use rumqttc::v5::{ConnectionError, EventLoop, MqttState, StateError};

use super::{KEEP_ALIVE, MESSAGES_AHEAD_MAX};

/// What to say of a connection that broke. A broker that gives it to another client of the same name says so by MQTT 5, or closes it only, as
/// mosquitto 2.0.11 does.
pub(super) fn broken(error: &ConnectionError) -> String {
    const REMEDY: &str = "another client has this one's name: give each narrator a narrator.name of its own, and start one bridge, and one robot \
        service for each robot";
    match error {
        ConnectionError::MqttState(StateError::ServerDisconnect {
            reason_code: DisconnectReasonCode::SessionTakenOver,
            ..
        }) => format!("the broker gave the connection away: {REMEDY}"),
        ConnectionError::MqttState(StateError::ConnectionAborted) => {
            format!("the broker closed the connection; where it does that again and again, {REMEDY}")
        }
        error => error.to_string(),
    }
}

/// Why a connection is of no use; none for one that is.
pub(super) fn fault_of(greeting: &ConnAck) -> Option<&'static str> {
    let properties = greeting.properties.as_ref()?;
    if properties.receive_max == Some(0) {
        return Some(
            "the broker is broken: it allows no message at all (a receive maximum of 0, which MQTT 5 forbids)",
        );
    }
    let none = properties.max_packet_size == Some(0);
    none.then_some(
        "the broker is broken: it allows no packet at all (a maximum packet size of 0, which MQTT 5 forbids)",
    )
}

/// Makes the client ready to connect again, as if for the first time.
pub(super) fn renew(events: &mut EventLoop) {
    events.clean();
    events.pending.clear();
    // What the last broker wished holds for its connection only.
    events.options.set_keep_alive(KEEP_ALIVE);
    let most = events.options.get_outgoing_inflight_upper_limit().unwrap_or(MESSAGES_AHEAD_MAX);
    events.state = MqttState::new(most, events.options.manual_acks());
}

/// A broker that wants no pings says 0, which the client takes for no pause at all between them.
pub(super) fn correct_keep_alive(events: &mut EventLoop) {
    if events.options.keep_alive().is_zero() {
        events.options.set_keep_alive(KEEP_ALIVE);
    }
}
