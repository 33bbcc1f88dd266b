//! When a broker is told to be done with a message.

use std::collections::VecDeque;

use rumqttc::v5::AsyncClient;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::Publish;
use tokio::sync::watch;

use super::MESSAGES_AHEAD_MAX;
use crate::narrator::Settled;

/// A number of lines that are settled, as somebody else counts them: who tells, and who listens.
#[must_use]
pub fn settled() -> (Settled, SettledNews) {
    let (told, news) = watch::channel(0);
    (Box::new(move |lines| _ = told.send_replace(lines)), SettledNews(news))
}

/// Hears how many lines are settled; see [`settled`].
#[derive(Debug, Clone)]
pub struct SettledNews(watch::Receiver<u64>);

/// Messages of this connection that the broker has not seen acknowledged, oldest first, each with the line that has to be settled before.
#[derive(Debug, Default)]
pub(super) struct Acknowledgements {
    pub(super) waiting: VecDeque<(u64, u16)>,
    /// Acknowledgements that the client has and has not sent.
    pub(super) on_way: usize,
    /// Lines that were written.
    pub(super) written: u64,
    /// None where a line is settled when it is written.
    pub(super) news: Option<SettledNews>,
}

impl Acknowledgements {
    /// Adds a message. A broker that sends further ahead than it may waits in vain for the oldest, and sends them again.
    pub(super) fn put(&mut self, message: &Publish, line: u64) {
        if message.qos == QoS::AtMostOnce {
            return;
        }
        if self.waiting.len() > usize::from(u16::MAX) {
            self.waiting.pop_front();
        }
        self.waiting.push_back((line, message.pkid));
    }

    /// Acknowledges what may be, in its order, as far as the client has room.
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

    /// Whether one more message may be said before another one is acknowledged.
    pub(super) fn have_room(&self) -> bool {
        self.waiting.len() + self.on_way < usize::from(MESSAGES_AHEAD_MAX)
    }

    /// Whether the broker may wait for an acknowledgement.
    pub(super) fn are_open(&self) -> bool {
        !self.waiting.is_empty() || self.on_way > 0
    }

    /// The connection has ended, and what was on its way with it.
    pub(super) fn forget(&mut self) {
        self.waiting.clear();
        self.on_way = 0;
    }

    /// Waits until more is settled; an error when nobody will tell any more.
    pub(super) async fn news(&mut self) -> std::io::Result<()> {
        match &mut self.news {
            Some(news) => news.0.changed().await.map_err(|_| std::io::ErrorKind::BrokenPipe.into()),
            None => std::future::pending().await,
        }
    }
}
