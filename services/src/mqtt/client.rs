//! Additions to the MQTT library's client.

use rumqttc::v5::mqttbytes::v5::{ConnAck, DisconnectReasonCode};
use rumqttc::v5::{ConnectionError, EventLoop, MqttState, StateError};

use super::{KEEP_ALIVE, MESSAGES_AHEAD_MAX};

/// The text for a broken connection. A broker that gives it to another client of the same name reports that by MQTT 5, or only closes it,
/// as mosquitto 2.0.11 does.
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

pub(super) fn renew(events: &mut EventLoop) {
    events.clean();
    events.pending.clear();
    // The last broker's settings apply only to its connection.
    events.options.set_keep_alive(KEEP_ALIVE);
    let most = events.options.get_outgoing_inflight_upper_limit().unwrap_or(MESSAGES_AHEAD_MAX);
    events.state = MqttState::new(most, events.options.manual_acks());
}

/// A broker without pings sends 0, which the client would take for no pause between them.
pub(super) fn correct_keep_alive(events: &mut EventLoop) {
    if events.options.keep_alive().is_zero() {
        events.options.set_keep_alive(KEEP_ALIVE);
    }
}
