//! What the broker is asked for.

use std::collections::HashSet;

use rumqttc::v5::AsyncClient;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{ConnAck, SubAck, SubscribeProperties, SubscribeReasonCode, UnsubAck};

use super::MqttError;
use super::rules::{covers, fingerprint};

/// A subscription to each filter, one after the other, so that it is known which one the broker answers. One that another one covers is left
/// out while the broker grants that: whoever is away would have the broker keep two copies. Each has an identifier, where the broker takes them.
#[derive(Debug)]
pub(super) struct Subscriptions {
    filters: Vec<String>,
    /// Those that are left out.
    covered: Vec<String>,
    /// Those that the broker may have in the session that it keeps, from now or from a narrator whose rules were others.
    standing: HashSet<String>,
    /// The one that the broker was asked to end.
    ending: Option<String>,
    answered: usize,
    granted: usize,
    /// The next filter is to be asked for, as soon as the client has room.
    due: bool,
    /// The packet that the broker has to answer: more answers than questions say nothing.
    asked: Option<u16>,
    /// Whether the broker takes identifiers.
    identified: bool,
    /// Filters whose refusal was told.
    told: HashSet<String>,
}

impl Subscriptions {
    pub(super) fn new(filters: Vec<String>) -> Self {
        Self {
            standing: filters.iter().cloned().collect(),
            filters,
            covered: Vec::new(),
            ending: None,
            answered: 0,
            granted: 0,
            due: false,
            asked: None,
            identified: true,
            told: HashSet::new(),
        }
    }

    /// Begins at the first filter.
    pub(super) fn start(&mut self, greeting: &ConnAck) {
        self.stop();
        self.filters.append(&mut self.covered);
        self.leave_out_covered();
        if !greeting.session_present {
            self.standing.clear();
        }
        let available =
            greeting.properties.as_ref().and_then(|properties| properties.subscription_identifiers_available);
        (self.due, self.identified) = (true, available != Some(0));
    }

    /// The connection has ended, and what was asked with it.
    pub(super) fn stop(&mut self) {
        (self.answered, self.granted, self.due, self.asked, self.ending) = (0, 0, false, None, None);
    }

    /// Leaves out what another filter covers that is not refused.
    fn leave_out_covered(&mut self) {
        let all = std::mem::take(&mut self.filters);
        let is_covered = |filter: &String| all.iter().any(|other| other != filter && covers(other, filter));
        (self.covered, self.filters) = all.iter().cloned().partition(is_covered);
    }

    /// Asks for what a refused filter covered, and no other does.
    fn take_over(&mut self, refused: &str) {
        let (over, asked): (Vec<_>, Vec<_>) = {
            let others: Vec<_> =
                self.filters.iter().filter(|filter| *filter != refused && !self.told.contains(*filter)).collect();
            let is_free =
                |filter: &String| covers(refused, filter) && !others.iter().any(|other| covers(other, filter));
            self.covered.drain(..).partition(is_free)
        };
        self.covered = asked;
        // Of these, too, one may cover another.
        for filter in &over {
            let is_covered = over.iter().any(|other| other != filter && covers(other, filter));
            (if is_covered { &mut self.covered } else { &mut self.filters }).push(filter.clone());
        }
    }

    /// Asks for the filter that is due, and behind all of them for the end of what is left out, where the client has room.
    pub(super) fn send(&mut self, client: &AsyncClient) {
        if self.due {
            let Some(filter) = self.filters.get(self.answered) else {
                self.due = false;
                return;
            };
            let id = self.identified.then(|| identifier(filter));
            let properties = SubscribeProperties { id, user_properties: Vec::new() };
            if client.try_subscribe_with_properties(filter, QoS::AtLeastOnce, properties).is_ok() {
                self.standing.insert(filter.clone());
                self.due = false;
            }
        } else if self.granted > 0
            && self.answered == self.filters.len()
            && self.ending.is_none()
            && let Some(covered) = self.covered.iter().find(|filter| self.standing.contains(*filter))
            && client.try_unsubscribe(covered).is_ok()
        {
            self.ending = Some(covered.clone());
        }
    }

    /// Whether the client has none of these requests in its queue, and the broker has none to answer.
    pub(super) fn are_at_rest(&self) -> bool {
        self.asked.is_none() && self.ending.is_none() && (self.due || self.answered == self.filters.len())
    }

    /// What the broker was asked for last has gone out in this packet.
    pub(super) fn sent(&mut self, packet: u16) {
        self.asked = Some(packet);
    }

    /// Takes the broker's answer to the filter asked for last.
    pub(super) fn take(&mut self, answer: &SubAck, broker: &str) -> Result<(), MqttError> {
        let Some(filter) = self.filters.get(self.answered).filter(|_| self.asked == Some(answer.pkid)).cloned() else {
            return Ok(());
        };
        (self.asked, self.due) = (None, true);
        let reason = answer.return_codes.first().copied().unwrap_or(SubscribeReasonCode::Unspecified);
        if reason == SubscribeReasonCode::SubscriptionIdNotSupported && self.identified {
            self.identified = false;
            return Ok(());
        }
        self.answered += 1;
        match reason {
            SubscribeReasonCode::Success(quality) => {
                self.granted += 1;
                self.told.remove(&filter);
                if quality == QoS::AtMostOnce {
                    tracing::warn!(
                        broker,
                        filter,
                        "the broker grants quality 0 only: what it sends while away is lost"
                    );
                }
            }
            refused => {
                if self.told.insert(filter.clone()) {
                    tracing::error!(broker, filter, reason = ?refused, "the broker refuses a subscription: nothing is heard of it; give this client the right to read it");
                }
                self.take_over(&filter);
                if self.answered == self.filters.len() && self.granted == 0 {
                    let reason = format!("{filter:?}: {refused:?}");
                    return Err(MqttError::Refused { broker: broker.to_owned(), reason });
                }
            }
        }
        Ok(())
    }

    /// The broker has ended what it was asked to end, or had nothing of it.
    pub(super) fn ended(&mut self, answer: &UnsubAck) {
        if self.asked == Some(answer.pkid)
            && let Some(filter) = self.ending.take()
        {
            self.standing.remove(&filter);
            self.asked = None;
        }
    }
}

/// A filter has the same identifier in every configuration: what a broker has kept of an earlier one says by which filter it comes. Two filters
/// of one identifier are rare, and lose nothing: a message that fits both may be said twice. All have four bytes. The client's library counts a
/// byte too many for each identifier, and of five or fewer of that length in one message it reads all the same what it should.
fn identifier(filter: &str) -> usize {
    const LONG: u32 = 1 << 27;
    let [a, b, c, d, ..] = fingerprint(filter.as_bytes());
    (u32::from_be_bytes([a, b, c, d]) % LONG + LONG) as usize
}

#[cfg(test)]
mod tests {
    use rumqttc::v5::mqttbytes::v5::ConnectReturnCode;

    use super::*;

    /// A broker may send a message once for each filter that it fits: a button's press was narrated twice.
    #[test]
    fn what_another_filter_covers_is_asked_for_only_where_that_is_refused() {
        let greeting = ConnAck { session_present: true, code: ConnectReturnCode::Success, properties: None };
        let asked = |refused: &[&str]| {
            let filters = ["#", "z/+", "z/button", "z/+/x", "y/b"].map(str::to_owned).to_vec();
            let mut subscriptions = Subscriptions::new(filters);
            let mut all = Vec::new();
            // A connection after it begins in the same way.
            for _ in 0..2 {
                subscriptions.start(&greeting);
                all.clear();
                while let Some(filter) = subscriptions.filters.get(subscriptions.answered).cloned() {
                    let reason = if refused.contains(&filter.as_str()) {
                        SubscribeReasonCode::NotAuthorized
                    } else {
                        SubscribeReasonCode::Success(QoS::AtLeastOnce)
                    };
                    subscriptions.sent(1);
                    let answer = SubAck { pkid: 1, return_codes: vec![reason], properties: None };
                    subscriptions.take(&answer, "broker").unwrap();
                    all.push(filter);
                }
            }
            all
        };
        assert_eq!(asked(&[]), ["#"]);
        assert_eq!(asked(&["#"]), ["#", "z/+", "z/+/x", "y/b"]);
        assert_eq!(asked(&["#", "z/+"]), ["#", "z/+", "z/+/x", "y/b", "z/button"]);
    }

    #[test]
    fn identifiers_are_long_and_differ() {
        let all: HashSet<_> = (0..1_000).map(|n| identifier(&format!("home/{n}/+"))).collect();
        assert!(all.len() >= 999 && all.iter().all(|one| (1 << 21..1 << 28).contains(one)), "{}", all.len());
        assert_eq!(identifier("home/0/+"), identifier("home/0/+"));
    }
}
