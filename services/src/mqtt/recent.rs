//! Recognises messages that a broker sends again.

use std::collections::HashMap;

use rumqttc::Outgoing;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::Publish;
use sha2::{Digest, Sha256};

use super::MESSAGES_AHEAD_MAX;
use super::rules::Fingerprint;

/// If a broker's identifiers have risen this far, it uses all in turn before it repeats one.
const RISEN_LONG: u64 = 8 * MESSAGES_AHEAD_MAX as u64;

/// Messages that a broker may send again after a connection broke: it may lack their acknowledgement. There are no more than packet
/// identifiers.
///
/// A message without an acknowledgement certainly comes again. After an acknowledgement there are two cases that look the same. Either it
/// was lost with the connection, and the message comes again. Or it arrived, and a new message has the free identifier, but its first
/// sending was lost. So an identifier is free when the broker is known to have the acknowledgement: by the answer to a later ping, a new
/// session, or another message of that identifier. If in doubt, the message is processed again, unless the broker cannot have reused the
/// identifier. A broker uses either the lowest free one, or all from 1 to some end in turn. In both cases it uses at least as many as its
/// highest so far, so fewer new messages do not reuse one.
#[derive(Debug, Default)]
pub(super) struct Recent {
    messages: HashMap<u16, Remembered>,
    new: u64,
    /// The identifier of the last new message, and the rise of identifiers without a fall until then.
    last: u16,
    risen: u64,
    highest: u16,
}

#[derive(Debug, Clone, Copy)]
struct Remembered {
    connection: u64,
    text: Fingerprint,
    /// Its last line, or the last line before it.
    line: u64,
    number: u64,
    acknowledged: Acknowledged,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Acknowledged {
    No,
    /// It is on its way.
    Sent,
    /// It is on its way, and a ping follows it.
    Pinged,
}

impl Recent {
    /// The line of a message that an earlier connection delivered already.
    pub(super) fn again(&mut self, connection: u64, message: &Publish) -> Option<u64> {
        let ahead = u64::from(MESSAGES_AHEAD_MAX);
        let before = self.messages.get_mut(&message.pkid).filter(|_| message.dup && message.qos != QoS::AtMostOnce)?;
        if before.connection >= connection || before.text != Self::text(message) {
            return None;
        }
        // At most `ahead` new messages were lost on their way.
        let since = self.new - before.number;
        let is_long = self.risen > RISEN_LONG || u64::from(self.highest) > since + ahead;
        let counts = is_long && self.risen >= since && since + ahead < u64::from(u16::MAX);
        if before.acknowledged != Acknowledged::No && !counts {
            return None;
        }
        (before.connection, before.acknowledged) = (connection, Acknowledged::No);
        Some(before.line)
    }

    pub(super) fn take(&mut self, connection: u64, message: &Publish, line: u64) {
        if message.qos == QoS::AtMostOnce {
            return;
        }
        // 1 follows the highest identifier.
        let step = (u32::from(message.pkid) + u32::from(u16::MAX) - u32::from(self.last)) % u32::from(u16::MAX);
        let is_near = (1..=2 * u32::from(MESSAGES_AHEAD_MAX)).contains(&step);
        self.risen = if is_near { self.risen + u64::from(step) } else { 0 };
        (self.new, self.last, self.highest) = (self.new + 1, message.pkid, self.highest.max(message.pkid));
        let (text, acknowledged) = (Self::text(message), Acknowledged::No);
        self.messages.insert(message.pkid, Remembered { connection, text, line, number: self.new, acknowledged });
    }

    pub(super) fn sent(&mut self, packet: &Outgoing) {
        match packet {
            Outgoing::PubAck(pkid) => {
                if let Some(message) = self.messages.get_mut(pkid) {
                    message.acknowledged = Acknowledged::Sent;
                }
            }
            Outgoing::PingReq => self.every(Acknowledged::Sent, Acknowledged::Pinged),
            _ => {}
        }
    }

    /// After the answer to a ping, the broker has read all packets before it.
    pub(super) fn answered(&mut self) {
        self.messages.retain(|_, message| message.acknowledged != Acknowledged::Pinged);
    }

    /// Begins a connection. Earlier pings will have no answer. After a new session no message comes again.
    pub(super) fn connect(&mut self, is_kept: bool) {
        if is_kept {
            self.every(Acknowledged::Pinged, Acknowledged::Sent);
        } else {
            *self = Self::default();
        }
    }

    fn every(&mut self, from: Acknowledged, to: Acknowledged) {
        self.messages.values_mut().filter(|message| message.acknowledged == from).for_each(|m| m.acknowledged = to);
    }

    fn text(message: &Publish) -> Fingerprint {
        let mut text = Sha256::new();
        text.update((message.topic.len() as u64).to_le_bytes());
        text.update(&message.topic);
        text.update(&message.payload);
        text.finalize().into()
    }
}
