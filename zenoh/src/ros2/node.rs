//! A ROS 2 node on rmw_zenoh: its keys, liveliness tokens, publishers and subscribers. The formats are those of rmw_zenoh's design document.

use std::collections::{BTreeMap, BTreeSet};

use roomcast_ipc::clock;
use roomcast_ros2::types::{self, Message};
use serde::Serialize;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig};

/// The durability of a topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kept {
    /// The last message is kept for later subscribers: ROS 2's transient-local, depth 1.
    Last,
    /// Volatile, depth 10.
    Not,
}

impl Kept {
    /// As in liveliness tokens: reliability, durability, history and depth, deadline, lifespan, liveliness; empty for defaults.
    const fn qos(self) -> &'static str {
        match self {
            Self::Last => ":1:,1:,:,:,,",
            Self::Not => "::,10:,:,:,,",
        }
    }
}

struct Topic {
    publisher: AdvancedPublisher<'static>,
    _token: LivelinessToken,
    gid: [u8; 16],
    sequence: i64,
}

/// A node. Its entities disappear when it is dropped.
pub struct Node {
    session: Session,
    domain: u32,
    name: String,
    entities: u32,
    topics: BTreeMap<String, Topic>,
    _heard: Vec<(Subscriber<()>, LivelinessToken)>,
    _token: LivelinessToken,
}

/// A name as in tokens, where a slash would end a part of the key.
fn mangled(name: &str) -> String {
    name.replace('/', "%")
}

fn key(domain: u32, topic: &str, kind: &str, hash: &str) -> String {
    format!("{domain}/{}/{kind}/{hash}", topic.trim_start_matches('/'))
}

impl Node {
    /// Creates a node of this name in the root namespace.
    ///
    /// # Errors
    ///
    /// The error of zenoh.
    pub fn new(session: Session, domain: u32, name: &str) -> zenoh::Result<Self> {
        let zid = session.zid();
        let token = session.liveliness().declare_token(format!("@ros2_lv/{domain}/{zid}/0/0/NN/%/%/{name}")).wait()?;
        let name = name.to_owned();
        Ok(Self { session, domain, name, entities: 0, topics: BTreeMap::new(), _heard: Vec::new(), _token: token })
    }

    /// Declares another entity's token. `kind` is MP for a publisher, MS for a subscriber.
    fn token<M: Message>(&mut self, kind: &str, topic: &str, kept: Kept) -> zenoh::Result<(String, LivelinessToken)> {
        self.entities += 1;
        let (domain, zid, number, name) = (self.domain, self.session.zid(), self.entities, &self.name);
        let (topic, qos) = (mangled(topic), kept.qos());
        let key = format!("@ros2_lv/{domain}/{zid}/0/{number}/{kind}/%/%/{name}/{topic}/{}/{}/{qos}", M::TYPE, M::HASH);
        let token = self.session.liveliness().declare_token(key.clone()).wait()?;
        Ok((key, token))
    }

    /// Publishes a message on a topic, which begins with a slash.
    ///
    /// # Errors
    ///
    /// The error of zenoh or of the message.
    pub fn publish<M: Message + Serialize>(&mut self, topic: &str, kept: Kept, message: &M) -> zenoh::Result<()> {
        let bytes = types::encode(message)?;
        if !self.topics.contains_key(topic) {
            let (name, token) = self.token::<M>("MP", topic, kept)?;
            let publisher = self.session.declare_publisher(key(self.domain, topic, M::TYPE, M::HASH));
            let publisher = publisher.congestion_control(CongestionControl::Drop);
            let publisher = match kept {
                Kept::Last => publisher.cache(CacheConfig::default().max_samples(1)).publisher_detection().wait()?,
                Kept::Not => publisher.advanced().wait()?,
            };
            self.topics.insert(topic.to_owned(), Topic { publisher, _token: token, gid: gid(&name), sequence: 0 });
        }
        let Some(topic) = self.topics.get_mut(topic) else { return Ok(()) };
        topic.sequence += 1;
        let attachment = attachment(topic.sequence, clock::unix_ns().cast_signed(), topic.gid);
        topic.publisher.put(bytes).attachment(attachment).wait()
    }

    /// A topic with a name that begins with `begin` stays only if `named` has it. Its last message is dropped with it.
    pub fn keep(&mut self, begin: &str, named: &BTreeSet<String>) {
        self.topics.retain(|topic, _| !topic.starts_with(begin) || named.contains(topic));
    }

    /// Subscribes to a topic.
    ///
    /// # Errors
    ///
    /// The error of zenoh.
    pub fn hear<M: Message>(
        &mut self,
        topic: &str,
        take: impl Fn(Sample) + Send + Sync + 'static,
    ) -> zenoh::Result<()> {
        let (_, token) = self.token::<M>("MS", topic, Kept::Not)?;
        // Any hash: Humble has none, and messages are checked anyway.
        let subscriber =
            self.session.declare_subscriber(key(self.domain, topic, M::TYPE, "*")).callback(take).wait()?;
        self._heard.push((subscriber, token));
        Ok(())
    }
}

/// Sixteen bytes that identify an entity: twice the 64-bit FNV-1a of its token's key.
fn gid(name: &str) -> [u8; 16] {
    let half = |text: &str| roomcast_ipc::sequence::source_of_name(text).to_le_bytes();
    let mut gid = [0; 16];
    let (first, second) = gid.split_at_mut(8);
    first.copy_from_slice(&half(name));
    second.copy_from_slice(&half(&format!("{name}/gid")));
    gid
}

/// The attachment of each message: its number, its wall-clock time, and its publisher.
fn attachment(sequence: i64, unix_ns: i64, gid: [u8; 16]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(33);
    bytes.extend(sequence.to_le_bytes());
    bytes.extend(unix_ns.to_le_bytes());
    bytes.push(16);
    bytes.extend(gid);
    bytes
}

#[cfg(test)]
mod tests {
    use super::types::Text;
    use super::*;

    #[test]
    fn keys_are_those_of_the_design_document() {
        let key = key(0, "/chatter", Text::TYPE, Text::HASH);
        assert_eq!(
            key,
            "0/chatter/std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
        );
        assert_eq!(mangled("/roomcast/rooms"), "%roomcast%rooms");
    }

    /// Visitors come and go, and a forgotten person must not keep a topic.
    #[test]
    fn topics_of_persons_who_are_gone_go() {
        let mut config = zenoh::Config::default();
        for (key, value) in
            [("scouting/multicast/enabled", "false"), ("listen/endpoints", "[]"), ("timestamping/enabled", "true")]
        {
            config.insert_json5(key, value).unwrap();
        }
        let session = zenoh::open(config).wait().unwrap();
        let mut node = Node::new(session, 0, "roomcast").unwrap();
        let text = Text { data: "kitchen".to_owned() };
        node.publish("/roomcast/rooms", Kept::Last, &text).unwrap();
        for visitor in 0..100 {
            let topic = format!("/roomcast/person/p_{visitor}");
            node.publish(&topic, Kept::Last, &text).unwrap();
            node.keep("/roomcast/person/", &BTreeSet::from([topic.clone()]));
            assert_eq!(node.topics.keys().map(String::as_str).collect::<Vec<_>>(), [&topic, "/roomcast/rooms"]);
        }
        node.keep("/roomcast/person/", &BTreeSet::new());
        assert_eq!(node.topics.len(), 1);
    }

    #[test]
    fn an_attachment_is_33_bytes() {
        let bytes = attachment(1, 2, gid("a"));
        assert_eq!((bytes.len(), bytes[0], bytes[8], bytes[16]), (33, 1, 2, 16));
        assert_ne!(gid("a"), gid("b"));
    }
}
