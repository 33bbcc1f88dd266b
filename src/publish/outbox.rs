//! Decides which messages to send, from the wanted and the published ones. No I/O.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::json;

use super::discovery::ORIGIN;

/// Most topics of earlier runs that are remembered until it is clear whether they are wanted.
pub(super) const FOUND_MAX: usize = 4096;

/// Most bytes of names in the list of our topics. A later run cannot remove topics that do not fit.
const LISTED_BYTES_MAX: usize = 48 << 10;

/// Retained messages by topic.
pub(super) type Picture = BTreeMap<String, String>;

#[derive(Debug, Default)]
pub(super) struct Outbox {
    wanted: Picture,
    /// The messages that were sent over this connection.
    said: Picture,
    /// Sent topics that have another value now: another program has overwritten or removed them.
    foreign: BTreeSet<String>,
    /// Our retained topics from earlier.
    found: BTreeSet<String>,
    /// Whether the picture is complete, so that other topics may be removed.
    complete: bool,
    /// Entities were removed since the picture was drawn. Their states are removed later, or Home Assistant would read empty ones.
    waits: bool,
    list: Option<List>,
}

/// The retained list of our topics. State messages have no origin, so a later run recognises them by this list.
#[derive(Debug)]
struct List {
    topic: String,
    base: String,
    node: String,
    /// The list of an earlier run was received and is part of this one.
    heard: bool,
    wanted: String,
    said: Option<String>,
}

pub(super) fn list_topic(base: &str) -> String {
    format!("{base}/bridge/topics")
}

/// The topics in the list of a bridge with this node; none if another program wrote it.
pub(super) fn listed(payload: &[u8], base: &str, node: &str) -> BTreeSet<String> {
    let list = serde_json::from_slice::<serde_json::Value>(payload).unwrap_or_default();
    let at = |pointer: &str| list.pointer(pointer).and_then(serde_json::Value::as_str);
    let is_own = at("/origin/name") == Some(ORIGIN) && at("/node") == Some(node);
    let topics = list.get("topics").and_then(serde_json::Value::as_array).filter(|_| is_own);
    let topics = topics.into_iter().flatten().filter_map(serde_json::Value::as_str);
    topics.take(FOUND_MAX).map(|topic| format!("{base}/{topic}")).collect()
}

impl Outbox {
    /// Creates an outbox that retains a list of its topics below `base`.
    pub(super) fn with_list(base: &str, node: &str) -> Self {
        let (topic, base, node) = (list_topic(base), base.to_owned(), node.to_owned());
        let list = List { topic, base, node, heard: false, wanted: String::new(), said: None };
        Self { list: Some(list), ..Self::default() }
    }

    /// Records that all retained messages have arrived.
    pub(super) fn hear_all(&mut self) {
        if let Some(list) = &mut self.list
            && !list.heard
        {
            list.heard = true;
            self.renew_list();
        }
    }

    /// Rebuilds the list. It names a topic from before its first message until after its removal.
    fn renew_list(&mut self) {
        let payload = self.list.as_ref().map(|list| self.list_payload(list)).unwrap_or_default();
        if let Some(list) = &mut self.list {
            list.wanted = payload;
        }
    }

    fn list_payload(&self, list: &List) -> String {
        let all: BTreeSet<_> = self.wanted.keys().chain(self.said.keys()).chain(&self.found).collect();
        let below = |topic: &'_ &String| topic.strip_prefix(&list.base).is_some_and(|rest| rest.starts_with('/'));
        let mut bytes = 0;
        let topics: Vec<_> = all
            .into_iter()
            .filter(below)
            .filter_map(|topic| topic.get(list.base.len() + 1..))
            .take_while(|topic| {
                bytes += topic.len() + 3;
                bytes <= LISTED_BYTES_MAX
            })
            .collect();
        if topics.is_empty() {
            return String::new();
        }
        json!({ "origin": { "name": ORIGIN }, "node": list.node, "topics": topics }).to_string()
    }

    /// Sets the wanted messages. If the picture is `complete`, our other topics are removed.
    pub(super) fn want(&mut self, picture: Picture, complete: bool) {
        (self.wanted, self.complete, self.waits) = (picture, complete, false);
        self.renew_list();
    }

    /// Records a retained message of ours.
    pub(super) fn find(&mut self, topic: String) {
        if self.found.len() < FOUND_MAX {
            self.found.insert(topic);
        }
    }

    /// Handles a message under a topic, which may be our own.
    pub(super) fn hear(&mut self, topic: &str, payload: &[u8]) {
        match self.said.get(topic) {
            Some(said) if said.as_bytes() != payload => _ = self.foreign.insert(topic.to_owned()),
            _ => _ = self.foreign.remove(topic),
        }
    }

    /// Schedules overwritten and removed topics for sending.
    pub(super) fn heal(&mut self) {
        for topic in std::mem::take(&mut self.foreign) {
            if self.said.remove(&topic).is_some() && !self.wanted.contains_key(&topic) {
                self.find(topic);
            }
        }
    }

    /// After a lost connection all messages are sent again: they may not have arrived, and the broker may have lost its retained ones.
    pub(super) fn lose(&mut self) {
        let said = std::mem::take(&mut self.said);
        said.into_keys().for_each(|topic| self.find(topic));
        self.foreign.clear();
        if let Some(list) = &mut self.list {
            (list.heard, list.said) = (false, None);
        }
    }

    /// The next message; an empty payload removes the topic's retained one.
    pub(super) fn next(&self) -> Option<(&str, &str)> {
        let list = self.list.as_ref().filter(|list| list.heard && list.said.as_ref() != Some(&list.wanted));
        if let Some(list) = list {
            return Some((list.topic.as_str(), list.wanted.as_str()));
        }
        let news = self.wanted.iter().find(|(topic, payload)| self.said.get(*topic) != Some(payload));
        let news = news.map(|(topic, payload)| (topic.as_str(), payload.as_str()));
        let entity = || self.stale().find(|topic| is_entity(topic));
        let other = || self.stale().find(|_| !self.waits);
        news.or_else(|| entity().or_else(other).map(|topic| (topic, "")))
    }

    /// Whether all messages are sent and all removals done.
    pub(super) fn is_done(&self) -> bool {
        let is_listed = |list: &List| list.heard && list.said.as_ref() == Some(&self.list_payload(list));
        self.next().is_none() && self.stale().next().is_none() && self.list.as_ref().is_none_or(is_listed)
    }

    /// Topics that are no longer wanted.
    fn stale(&self) -> impl Iterator<Item = &str> {
        let known = self.said.keys().chain(&self.found).filter(|_| self.complete);
        known.filter(|topic| !self.wanted.contains_key(*topic)).map(String::as_str)
    }

    /// Records that a topic's message was sent.
    pub(super) fn done(&mut self, topic: &str) {
        if let Some(list) = self.list.as_mut().filter(|list| list.topic == topic) {
            list.said = Some(list.wanted.clone());
            return;
        }
        self.found.remove(topic);
        self.foreign.remove(topic);
        match self.wanted.get(topic) {
            Some(payload) => self.said.insert(topic.to_owned(), payload.clone()),
            None => {
                self.waits |= is_entity(topic);
                self.said.remove(topic)
            }
        };
    }
}

/// Whether a topic makes an entity in Home Assistant.
fn is_entity(topic: &str) -> bool {
    topic.ends_with("/config")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(of: &[(&str, &str)]) -> Picture {
        of.iter().map(|(topic, payload)| ((*topic).to_owned(), (*payload).to_owned())).collect()
    }

    fn send(outbox: &mut Outbox) -> Vec<(String, String)> {
        let mut sent = Vec::new();
        while let Some((topic, payload)) = outbox.next().map(|(topic, payload)| (topic.to_owned(), payload.to_owned()))
        {
            outbox.done(&topic);
            sent.push((topic, payload));
        }
        sent
    }

    #[test]
    fn only_news_is_said_and_what_is_gone_is_taken_away() {
        let mut outbox = Outbox::default();
        outbox.want(picture(&[("a", "1"), ("b", "1")]), true);
        assert_eq!(send(&mut outbox).len(), 2);
        outbox.want(picture(&[("a", "2"), ("b", "1")]), true);
        assert_eq!(send(&mut outbox), [("a".to_owned(), "2".to_owned())]);
        outbox.want(picture(&[("b", "1")]), true);
        assert_eq!(send(&mut outbox), [("a".to_owned(), String::new())]);
        assert_eq!(outbox.next(), None);
    }

    #[test]
    fn what_somebody_overwrites_is_said_again() {
        let mut outbox = Outbox::default();
        outbox.want(picture(&[("a", "1"), ("b", "1"), ("c", "1")]), true);
        send(&mut outbox);
        // Our own messages come back. A later change has not come back yet.
        outbox.hear("a", b"1");
        outbox.hear("b", b"offline");
        outbox.hear("c", b"");
        outbox.hear("z", b"of somebody else's");
        outbox.heal();
        assert_eq!(send(&mut outbox), [("b".to_owned(), "1".to_owned()), ("c".to_owned(), "1".to_owned())]);
        outbox.heal();
        assert_eq!(outbox.next(), None, "once");
        // By now it is unwanted.
        outbox.hear("b", b"offline");
        outbox.want(picture(&[("a", "1"), ("c", "1")]), true);
        outbox.heal();
        assert_eq!(send(&mut outbox), [("b".to_owned(), String::new())]);
        outbox.hear("b", b"");
        outbox.heal();
        assert_eq!(outbox.next(), None);
    }

    #[test]
    fn what_an_earlier_run_left_goes_once_it_is_known_to_be_stale() {
        let mut outbox = Outbox::default();
        outbox.find("old".to_owned());
        outbox.find("a".to_owned());
        outbox.want(picture(&[("status", "online")]), false);
        assert_eq!(send(&mut outbox).len(), 1, "the rooms are not known yet");
        outbox.want(picture(&[("a", "1"), ("status", "online")]), true);
        assert_eq!(send(&mut outbox), [("a".to_owned(), "1".to_owned()), ("old".to_owned(), String::new())]);
    }

    #[test]
    fn after_a_lost_connection_everything_is_said_again_and_the_stale_taken_away() {
        let mut outbox = Outbox::default();
        outbox.want(picture(&[("a", "1"), ("b", "1")]), true);
        send(&mut outbox);
        outbox.lose();
        outbox.want(picture(&[("a", "1")]), true);
        assert_eq!(send(&mut outbox), [("a".to_owned(), "1".to_owned()), ("b".to_owned(), String::new())]);
    }

    #[test]
    fn a_topic_is_listed_before_it_is_said_and_until_it_is_gone() {
        let named = |payload: &str| listed(payload.as_bytes(), "b", "node").into_iter().collect::<Vec<_>>();
        let mut outbox = Outbox::with_list("b", "node");
        outbox.want(picture(&[("b/rooms/a", "1"), ("b/status", "online"), ("ha/x/config", "{}")]), true);
        outbox.find("b/rooms/old".to_owned());
        outbox.hear_all();
        let sent = send(&mut outbox);
        assert_eq!(sent[0].0, "b/bridge/topics");
        assert_eq!(named(&sent[0].1), ["b/rooms/a", "b/rooms/old", "b/status"]);
        assert_eq!(sent.last().unwrap(), &("b/rooms/old".to_owned(), String::new()));
        assert!(!outbox.is_done(), "the list still names what has gone");
        outbox.want(Picture::new(), true);
        send(&mut outbox);
        outbox.want(Picture::new(), true);
        send(&mut outbox);
        outbox.want(Picture::new(), true);
        assert_eq!(send(&mut outbox), [("b/bridge/topics".to_owned(), String::new())]);
        assert!(outbox.is_done());
        let foreign = sent[0].1.replace("\"roomcast\"", "\"else\"");
        assert!(named(&foreign).is_empty() && listed(sent[0].1.as_bytes(), "b", "other").is_empty());
    }

    #[test]
    fn entities_go_before_what_they_tell() {
        let mut outbox = Outbox::default();
        outbox.want(picture(&[("a/room", "1"), ("ha/room/config", "{}")]), true);
        send(&mut outbox);
        outbox.want(Picture::new(), true);
        assert_eq!(send(&mut outbox), [("ha/room/config".to_owned(), String::new())]);
        assert!(!outbox.is_done());
        outbox.want(Picture::new(), true);
        assert_eq!(send(&mut outbox), [("a/room".to_owned(), String::new())]);
        assert!(outbox.is_done());
    }

    #[test]
    fn a_broker_full_of_our_topics_fills_no_memory() {
        let mut outbox = Outbox::default();
        (0..2 * FOUND_MAX).for_each(|n| outbox.find(n.to_string()));
        assert_eq!(outbox.found.len(), FOUND_MAX);
    }
}
