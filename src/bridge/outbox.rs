//! What is to stand at the broker, and what stands there. Pure: it decides, others send.

use std::collections::{BTreeMap, BTreeSet};

/// Topics of earlier runs that are remembered until they are known to be wanted or not.
pub(super) const FOUND_MAX: usize = 4096;

/// Retained messages by topic.
pub(super) type Picture = BTreeMap<String, String>;

#[derive(Debug, Default)]
pub(super) struct Outbox {
    wanted: Picture,
    /// What was said over this connection.
    said: Picture,
    /// Topics of ours that the broker has kept from before.
    found: BTreeSet<String>,
    /// Whether the picture has everything, so that what is not in it may go.
    complete: bool,
    /// Entities have gone since the picture was drawn: what they tell goes after them, or whoever shows them would read emptiness.
    waits: bool,
}

impl Outbox {
    /// What is to stand there from now on. Where the picture is `complete`, all else of ours is to go.
    pub(super) fn want(&mut self, picture: Picture, complete: bool) {
        (self.wanted, self.complete, self.waits) = (picture, complete, false);
    }

    /// The broker has kept a message of ours from before.
    pub(super) fn find(&mut self, topic: String) {
        if self.found.len() < FOUND_MAX {
            self.found.insert(topic);
        }
    }

    /// What was said may not have arrived, and what the broker keeps may be lost: all of it is to be said again.
    pub(super) fn lose(&mut self) {
        let said = std::mem::take(&mut self.said);
        said.into_keys().for_each(|topic| self.find(topic));
    }

    /// What is to be said next; an empty message takes a topic's last one away.
    pub(super) fn next(&self) -> Option<(&str, &str)> {
        let news = self.wanted.iter().find(|(topic, payload)| self.said.get(*topic) != Some(payload));
        let news = news.map(|(topic, payload)| (topic.as_str(), payload.as_str()));
        let entity = || self.stale().find(|topic| is_entity(topic));
        let other = || self.stale().find(|_| !self.waits);
        news.or_else(|| entity().or_else(other).map(|topic| (topic, "")))
    }

    /// Whether nothing is left to be said or to go, also later.
    pub(super) fn is_done(&self) -> bool {
        self.next().is_none() && self.stale().next().is_none()
    }

    /// Topics that nobody wants any more.
    fn stale(&self) -> impl Iterator<Item = &str> {
        let known = self.said.keys().chain(&self.found).filter(|_| self.complete);
        known.filter(|topic| !self.wanted.contains_key(*topic)).map(String::as_str)
    }

    /// It was said.
    pub(super) fn done(&mut self, topic: &str) {
        self.found.remove(topic);
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
