//! Subscriptions at the broker.

use std::collections::HashSet;

use rumqttc::v5::AsyncClient;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{ConnAck, SubAck, SubscribeProperties, SubscribeReasonCode, UnsubAck};

use super::MqttError;
use super::rules::{covers, fingerprint};

/// Subscribes to one filter after the other, so that each answer has its filter. A filter that another one covers is left out while the
/// broker grants the other: for an absent client the broker would store two copies. Each has an identifier, if the broker supports them.
#[derive(Debug)]
pub(super) struct Subscriptions {
    filters: Vec<String>,
    /// Filters that are left out.
    covered: Vec<String>,
    /// Filters that may be in the session that the broker keeps, from this narrator or an earlier one with other rules.
    standing: HashSet<String>,
    /// The filter of the open unsubscription.
    ending: Option<String>,
    answered: usize,
    granted: usize,
    /// The next filter is requested as soon as the client has room.
    due: bool,
    /// The open request. Answers to no request are ignored.
    asked: Option<u16>,
    identified: bool,
    /// Filters with a logged refusal.
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

    pub(super) fn stop(&mut self) {
        (self.answered, self.granted, self.due, self.asked, self.ending) = (0, 0, false, None, None);
    }

    /// Leaves out filters that another, granted filter covers.
    fn leave_out_covered(&mut self) {
        let all = std::mem::take(&mut self.filters);
        let is_covered = |filter: &String| all.iter().any(|other| other != filter && covers(other, filter));
        (self.covered, self.filters) = all.iter().cloned().partition(is_covered);
    }

    /// Requests the filters that only the refused filter covered.
    fn take_over(&mut self, refused: &str) {
        let (over, asked): (Vec<_>, Vec<_>) = {
            let others: Vec<_> =
                self.filters.iter().filter(|filter| *filter != refused && !self.told.contains(*filter)).collect();
            let is_free =
                |filter: &String| covers(refused, filter) && !others.iter().any(|other| covers(other, filter));
            self.covered.drain(..).partition(is_free)
        };
        self.covered = asked;
        // One of these may cover another one.
        for filter in &over {
            let is_covered = over.iter().any(|other| other != filter && covers(other, filter));
            (if is_covered { &mut self.covered } else { &mut self.filters }).push(filter.clone());
        }
    }

    /// Requests the next filter. After the last one it ends the left-out ones, if the client has room.
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

    /// Whether no request is in the client's queue or without an answer.
    pub(super) fn are_at_rest(&self) -> bool {
        self.asked.is_none() && self.ending.is_none() && (self.due || self.answered == self.filters.len())
    }

    /// The last request was sent in this packet.
    pub(super) fn sent(&mut self, packet: u16) {
        self.asked = Some(packet);
    }

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
                    return Err(MqttError::Refused(broker.to_owned(), reason));
                }
            }
        }
        Ok(())
    }

    pub(super) fn ended(&mut self, answer: &UnsubAck) {
        if self.asked == Some(answer.pkid)
            && let Some(filter) = self.ending.take()
        {
            self.standing.remove(&filter);
            self.asked = None;
        }
    }
}

/// A filter has the same identifier in every configuration: messages that a broker stored for an earlier one name their filter. Two filters
/// with one identifier are rare and do no harm: a message that matches both may be narrated twice. All have four bytes. The client's
/// library counts a byte too many for each identifier, and with up to five of that length in one message it still reads the message
/// correctly.
fn identifier(filter: &str) -> usize {
    const LONG: u32 = 1 << 27;
    let [a, b, c, d, ..] = fingerprint(filter.as_bytes());
    (u32::from_be_bytes([a, b, c, d]) % LONG + LONG) as usize
}

#[cfg(test)]
mod tests {
    use rumqttc::v5::mqttbytes::v5::ConnectReturnCode;

    use super::*;

    /// A broker may send a message once for each matching filter: the press of a button was narrated twice.
    #[test]
    fn what_another_filter_covers_is_asked_for_only_where_that_is_refused() {
        let greeting = ConnAck { session_present: true, code: ConnectReturnCode::Success, properties: None };
        let asked = |refused: &[&str]| {
            let filters = ["#", "z/+", "z/button", "z/+/x", "y/b"].map(str::to_owned).to_vec();
            let mut subscriptions = Subscriptions::new(filters);
            let mut all = Vec::new();
            // A later connection begins in the same way.
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
