//! Acknowledges messages to a broker.

use std::collections::VecDeque;

use rumqttc::v5::AsyncClient;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::Publish;
use tokio::sync::watch;

use super::MESSAGES_AHEAD_MAX;
use crate::narrator::Settled;

/// A channel for the number of settled lines.
#[must_use]
pub fn settled() -> (Settled, SettledNews) {
    let (told, news) = watch::channel(0);
    (Box::new(move |lines| _ = told.send_replace(lines)), SettledNews(news))
}

/// Receives the number of settled lines; see [`settled`].
#[derive(Debug, Clone)]
pub struct SettledNews(watch::Receiver<u64>);

/// Unacknowledged messages of this connection, oldest first, each with the line that must be settled first.
#[derive(Debug, Default)]
pub(super) struct Acknowledgements {
    pub(super) waiting: VecDeque<(u64, u16)>,
    /// Acknowledgements in the client's queue.
    pub(super) on_way: usize,
    pub(super) written: u64,
    pub(super) news: Option<SettledNews>,
}

impl Acknowledgements {
    /// Adds a message. If a broker sends too far ahead, the oldest entry is dropped, and the broker sends that message again.
    pub(super) fn put(&mut self, message: &Publish, line: u64) {
        if message.qos == QoS::AtMostOnce {
            return;
        }
        if self.waiting.len() > usize::from(u16::MAX) {
            self.waiting.pop_front();
        }
        self.waiting.push_back((line, message.pkid));
    }

    /// Acknowledges settled messages in order, as far as the client has room.
    pub(super) fn send(&mut self, client: &AsyncClient) {
        let settled = self.news.as_mut().map_or(self.written, |news| *news.0.borrow_and_update());
        while let Some((_, pkid)) = self.waiting.front().filter(|(line, _)| *line <= settled) {
            if client.try_ack(&Publish { qos: QoS::AtLeastOnce, pkid: *pkid, ..Publish::default() }).is_err() {
                return;
            }
            self.waiting.pop_front();
            self.on_way += 1;
        }
    }

    pub(super) fn have_room(&self) -> bool {
        self.waiting.len() + self.on_way < usize::from(MESSAGES_AHEAD_MAX)
    }

    pub(super) fn are_open(&self) -> bool {
        !self.waiting.is_empty() || self.on_way > 0
    }

    pub(super) fn forget(&mut self) {
        self.waiting.clear();
        self.on_way = 0;
    }

    /// Waits for more settled lines; an error if the other end is gone.
    pub(super) async fn news(&mut self) -> std::io::Result<()> {
        match &mut self.news {
            Some(news) => news.0.changed().await.map_err(|_| std::io::ErrorKind::BrokenPipe.into()),
            None => std::future::pending().await,
        }
    }
}
