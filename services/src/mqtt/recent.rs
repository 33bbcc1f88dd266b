//! Which messages a broker sends again.

use std::collections::HashMap;

use rumqttc::Outgoing;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::Publish;
use sha2::{Digest, Sha256};

use super::MESSAGES_AHEAD_MAX;
use super::rules::Fingerprint;

/// A broker whose identifiers have gone up so far takes them all in turn, and none again before.
const RISEN_LONG: u64 = 8 * MESSAGES_AHEAD_MAX as u64;

/// What a broker may send again after a connection broke: messages that it may not have seen acknowledged. There are no more than packet
/// identifiers, however far ahead a broker sends.
///
/// What this side has not acknowledged comes again for sure. Of what it has acknowledged it cannot know: the acknowledgement may be lost
/// with the connection, and then the message comes again; or it has arrived, so that its identifier is free, and a new message has it, whose
/// own first sending was lost. Both look the same. So an identifier is free as soon as something shows that the broker has the
/// acknowledgement: the answer to a later ping, a session that is not kept, or another message of that identifier. In doubt the message is said
/// again, but where the broker cannot have come round to this identifier. It takes either the lowest that is free, or all from 1 to some end
/// in turn. Whichever it is, there are at least as many as the highest that it has used, so fewer new messages do not come round.
#[derive(Debug, Default)]
pub(super) struct Recent {
    messages: HashMap<u16, Remembered>,
    /// New messages until now.
    new: u64,
    /// The identifier of the last new message, and how far identifiers have gone up until then without going back.
    last: u16,
    risen: u64,
    /// The highest identifier of the session until now.
    highest: u16,
}

#[derive(Debug, Clone, Copy)]
struct Remembered {
    connection: u64,
    text: Fingerprint,
    /// The last line that it said, or that was said before it.
    line: u64,
    /// Its number among the new messages.
    number: u64,
    acknowledged: Acknowledged,
}

/// What is known of an acknowledgement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Acknowledged {
    No,
    /// On its way.
    Sent,
    /// On its way, and a ping behind it.
    Pinged,
}

impl Recent {
    /// For a message that an earlier connection brought, the line that it waits for.
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

    /// Takes note of a message that waits for a line.
    pub(super) fn take(&mut self, connection: u64, message: &Publish, line: u64) {
        if message.qos == QoS::AtMostOnce {
            return;
        }
        // After the highest identifier comes 1.
        let step = (u32::from(message.pkid) + u32::from(u16::MAX) - u32::from(self.last)) % u32::from(u16::MAX);
        let is_near = (1..=2 * u32::from(MESSAGES_AHEAD_MAX)).contains(&step);
        self.risen = if is_near { self.risen + u64::from(step) } else { 0 };
        (self.new, self.last, self.highest) = (self.new + 1, message.pkid, self.highest.max(message.pkid));
        let (text, acknowledged) = (Self::text(message), Acknowledged::No);
        self.messages.insert(message.pkid, Remembered { connection, text, line, number: self.new, acknowledged });
    }

    /// What the client has sent.
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

    /// The broker has answered a ping: it has read all that was sent before.
    pub(super) fn answered(&mut self) {
        self.messages.retain(|_, message| message.acknowledged != Acknowledged::Pinged);
    }

    /// A connection begins. Pings of the last one are not answered any more; of a session that the broker has not kept nothing comes again.
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
