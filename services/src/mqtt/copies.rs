//! Recognises further copies of a message.

use std::collections::VecDeque;

use rumqttc::v5::mqttbytes::v5::Publish;

use super::rules::{Fingerprint, fingerprint};

/// Messages that are remembered. A broker sends the copies of one message in close succession.
const REMEMBERED: usize = 256;
/// Subscriptions that are remembered per message. Copies of more subscriptions are read again.
const SUBSCRIPTIONS_MAX: usize = 64;

/// The latest messages, oldest first. If filters overlap, a broker may send a message once for each matching filter, with the
/// subscription's identifier. Each subscription delivers the messages of a topic in order, and each once. So a message is a copy if an
/// equal one was read after the last message of its subscription.
///
/// A missing copy does no harm, since no code waits for it. Nor does a broker that sends one copy with all identifiers, or with none.
#[derive(Debug, Default)]
pub(super) struct Copies(VecDeque<Read>);

#[derive(Debug)]
struct Read {
    topic: Fingerprint,
    payload: Fingerprint,
    retained: bool,
    by: Vec<usize>,
}

impl Copies {
    /// Whether this message was read already through another subscription. Records it.
    pub(super) fn take(&mut self, message: &Publish) -> bool {
        let identifiers = message.properties.iter().flat_map(|properties| &properties.subscription_identifiers);
        let mut by: Vec<_> = identifiers.copied().take(SUBSCRIPTIONS_MAX).collect();
        if by.is_empty() {
            // No subscription has the identifier 0: all without an identifier count as one.
            by.push(0);
        }
        let (topic, payload) = (fingerprint(&message.topic), fingerprint(&message.payload));
        let came_by = |read: &Read| read.topic == topic && read.by.iter().any(|one| by.contains(one));
        let after = self.0.iter().rposition(came_by).map_or(0, |last| last + 1);
        let equal = |read: &&mut Read| {
            (read.topic, read.payload, read.retained) == (topic, payload, message.retain)
                && read.by.len() + by.len() <= SUBSCRIPTIONS_MAX
        };
        if let Some(read) = self.0.iter_mut().skip(after).find(equal) {
            read.by.append(&mut by);
            return true;
        }
        if self.0.len() >= REMEMBERED {
            self.0.pop_front();
        }
        self.0.push_back(Read { topic, payload, retained: message.retain, by });
        false
    }

    /// A new session does not repeat earlier messages.
    pub(super) fn forget(&mut self) {
        self.0.clear();
    }
}

#[cfg(test)]
mod tests {
    use rumqttc::v5::mqttbytes::QoS;
    use rumqttc::v5::mqttbytes::v5::PublishProperties;

    use super::*;

    /// The payloads that are read, for messages with a payload and subscriptions.
    fn read(messages: &[(&str, &[usize])]) -> String {
        let mut copies = Copies::default();
        let mut read = String::new();
        for (payload, by) in messages {
            let by = PublishProperties { subscription_identifiers: by.to_vec(), ..PublishProperties::default() };
            let message = Publish::new("a/b", QoS::AtLeastOnce, (*payload).to_owned(), Some(by));
            if !copies.take(&message) {
                read += payload;
            }
        }
        read
    }

    #[test]
    fn a_message_is_read_once_however_its_copies_come() {
        // In succession; after other messages; in reverse order.
        assert_eq!(read(&[("x", &[1]), ("x", &[2]), ("x", &[1]), ("x", &[2])]), "xx");
        assert_eq!(read(&[("x", &[1]), ("x", &[1]), ("y", &[1]), ("x", &[2]), ("x", &[2]), ("y", &[2])]), "xxy");
        assert_eq!(read(&[("x", &[1]), ("x", &[2]), ("x", &[2]), ("x", &[1])]), "xx");
        // All in one, and three of them.
        assert_eq!(read(&[("x", &[1, 2]), ("x", &[1, 2])]), "xx");
        assert_eq!(read(&[("x", &[1]), ("x", &[2]), ("x", &[3]), ("y", &[3]), ("y", &[1]), ("y", &[2])]), "xy");
        // A subscription of an older version has no identifier.
        assert_eq!(read(&[("x", &[1]), ("x", &[]), ("x", &[1]), ("x", &[])]), "xx");
    }

    #[test]
    fn what_comes_once_is_read_each_time() {
        assert_eq!(read(&[("x", &[]), ("x", &[])]), "xx");
        assert_eq!(read(&[("x", &[1]), ("x", &[1])]), "xx");
        // The second subscription begins later, or misses one.
        assert_eq!(read(&[("x", &[1]), ("x", &[1]), ("x", &[2]), ("x", &[1]), ("x", &[2])]), "xxx");
        // More of them than are remembered.
        let many: Vec<_> = (1..=SUBSCRIPTIONS_MAX + 1).map(|one| [one]).collect();
        let many: Vec<_> = many.iter().map(|one| ("x", one.as_slice())).collect();
        assert_eq!(read(&many), "xx");
    }

    #[test]
    fn what_is_remembered_is_bounded() {
        let mut copies = Copies::default();
        for n in 0..10 * REMEMBERED {
            let message = Publish::new("a/b", QoS::AtLeastOnce, n.to_string(), None);
            assert!(!copies.take(&message));
        }
        assert_eq!(copies.0.len(), REMEMBERED);
    }
}
