//! The connection to the router: a client that does not listen, reconnects by itself, and queues nothing for absent peers.

use std::any::Any;
use std::collections::BTreeMap;
use std::io;
use std::net::{TcpStream, ToSocketAddrs};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::{Config, Session, Wait};

use crate::config::Router;

/// How often an unreachable router is tried again.
const OPEN_AGAIN: Duration = Duration::from_secs(1);
/// How often the connection is checked.
const LOOK: Duration = Duration::from_millis(200);
/// A session whose connection stays lost for this long is opened again.
const REOPEN: Duration = Duration::from_secs(30);
/// Timeout of the check of a router's port after a failure.
const LOOK_AT_PORT: Duration = Duration::from_secs(1);
/// The same failure is logged once in this time.
const QUIET: Duration = Duration::from_secs(60);
/// A connection that is silent for this long counts as cut. Each side sends four times in that period.
const LEASE_MS: u64 = 5_000;
/// Larger messages from any sender are dropped before they are put together: zenoh's own limit is a gigabyte.
pub const MESSAGE_BYTES_MAX: usize = 2 << 20;

/// Why a link cannot start.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// zenoh refuses the configuration.
    #[error("router: {0}")]
    Config(zenoh::Error),
    /// The system refuses a thread.
    #[error("cannot start the thread of the link: {0}; {limit}", limit = roomcast_ipc::limits::on_threads())]
    Thread(io::Error),
}

/// Declares subscribers, queryables and tokens on each new session. They hold until they are dropped.
pub type Declare = Box<dyn Fn(&Session) -> zenoh::Result<Vec<Box<dyn Any + Send>>> + Send>;

/// A session and its declarations, dropped in this order.
struct Open {
    publishers: BTreeMap<String, Publisher<'static>>,
    _declared: Vec<Box<dyn Any + Send>>,
    session: Session,
}

#[derive(Default)]
struct Shared {
    open: Mutex<Option<Open>>,
    connected: AtomicBool,
    stop: AtomicBool,
    sessions: AtomicU64,
    connections: AtomicU64,
}

impl Shared {
    fn open(&self) -> MutexGuard<'_, Option<Open>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A connection to a router. It closes when it is dropped.
pub struct Link {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

/// zenoh's configuration for a client of one router.
///
/// # Errors
///
/// [`LinkError::Config`].
pub fn client(router: &Router) -> Result<Config, LinkError> {
    let mut config = Config::default();
    let mut set =
        |key: &str, value: serde_json::Value| config.insert_json5(key, &value.to_string()).map_err(LinkError::Config);
    set("mode", "client".into())?;
    set("connect/endpoints", vec![router.connect.clone()].into())?;
    set("listen/endpoints", serde_json::json!([]))?;
    set("scouting/multicast/enabled", false.into())?;
    set("scouting/gossip/enabled", false.into())?;
    set("timestamping/enabled", true.into())?;
    set("transport/link/tx/lease", LEASE_MS.into())?;
    set("transport/link/rx/max_message_size", MESSAGE_BYTES_MAX.into())?;
    if router.connect.starts_with("tls/") {
        let file = |path: &Option<std::path::PathBuf>| path.as_ref().map(|path| path.display().to_string());
        set("transport/link/tls/root_ca_certificate", file(&router.ca).into())?;
        set("transport/link/tls/connect_certificate", file(&router.certificate).into())?;
        set("transport/link/tls/connect_private_key", file(&router.key).into())?;
        set("transport/link/tls/enable_mtls", true.into())?;
        set("transport/link/tls/verify_name_on_connect", true.into())?;
    }
    Ok(config)
}

impl Link {
    /// Connects, and retries while the router is away. `declare` is called at every new session.
    ///
    /// # Errors
    ///
    /// [`LinkError`].
    pub fn start(router: &Router, declare: Declare) -> Result<Self, LinkError> {
        let (config, name) = (client(router)?, router.connect.clone());
        let shared = Arc::<Shared>::default();
        let own = Arc::clone(&shared);
        let thread = std::thread::Builder::new().name("link".to_owned());
        let thread = thread.spawn(move || turn(&own, &config, &name, &declare)).map_err(LinkError::Thread)?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// Whether a router is connected.
    #[must_use]
    pub fn is_connected(&self) -> bool {
        self.shared.connected.load(Ordering::Relaxed)
    }

    /// How often a router was reached. A message that was sent without a router is lost, so callers publish and ask again when this number changes.
    #[must_use]
    pub fn connections(&self) -> u64 {
        self.shared.connections.load(Ordering::Relaxed)
    }

    /// Sends bytes to the present subscribers; returns whether they went out. A message that cannot go at once is dropped.
    pub fn put(&self, key: &str, bytes: Vec<u8>) -> bool {
        if !self.is_connected() {
            return false;
        }
        let mut open = self.shared.open();
        let Some(open) = open.as_mut() else { return false };
        if !open.publishers.contains_key(key) {
            let publisher = open.session.declare_publisher(key.to_owned());
            // Without batches, which would make a message wait.
            match publisher.congestion_control(CongestionControl::Drop).express(true).wait() {
                Ok(publisher) => drop(open.publishers.insert(key.to_owned(), publisher)),
                Err(_) => return false,
            }
        }
        open.publishers.get(key).is_some_and(|publisher| publisher.put(bytes).wait().is_ok())
    }

    /// The open session and its number.
    #[must_use]
    pub fn session(&self) -> Option<(u64, Session)> {
        let number = self.shared.sessions.load(Ordering::Relaxed);
        self.shared.open().as_ref().map(|open| (number, open.session.clone()))
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ended = thread.join();
        }
    }
}

fn turn(shared: &Shared, config: &Config, router: &str, declare: &Declare) {
    let mut told = None::<Instant>;
    let stop = || shared.stop.load(Ordering::Relaxed);
    while !stop() {
        let opened = zenoh::open(config.clone()).wait().and_then(|session| {
            let declared = declare(&session)?;
            Ok(Open { publishers: BTreeMap::new(), _declared: declared, session })
        });
        match opened {
            Ok(open) => {
                shared.sessions.fetch_add(1, Ordering::Relaxed);
                *shared.open() = Some(open);
                watch(shared, router);
                shared.connected.store(false, Ordering::Relaxed);
                // Taken out first: closing takes a while, and senders must not wait for it.
                let open = shared.open().take();
                drop(open);
            }
            Err(error) => {
                if told.is_none_or(|told| told.elapsed() >= QUIET) {
                    told = Some(Instant::now());
                    let why = why(router).unwrap_or_else(|| first_words(&error.to_string()));
                    tracing::warn!(router, why, "no connection, trying again");
                }
                let start = Instant::now();
                while start.elapsed() < OPEN_AGAIN && !stop() {
                    std::thread::sleep(LOOK);
                }
            }
        }
    }
}

/// Why there is no session, from a check of the port: zenoh gives no reason.
fn why(router: &str) -> Option<String> {
    let (protocol, address) = router.split_once('/')?;
    let reached = address.to_socket_addrs().and_then(|mut addresses| {
        let first = addresses.next().ok_or(io::ErrorKind::NotFound)?;
        TcpStream::connect_timeout(&first, LOOK_AT_PORT)
    });
    match reached {
        Err(error) => Some(error.to_string()),
        Ok(_) if protocol == "tls" => Some(
            "somebody listens there, and no session comes about: is its certificate of router.ca and for this host, and router.certificate \
             of an authority that it knows, with its own router.key?"
                .to_owned(),
        ),
        Ok(_) => None,
    }
}

/// zenoh's errors end with places in its own source.
fn first_words(error: &str) -> String {
    error.split(" at /").next().unwrap_or_default().trim().to_owned()
}

fn watch(shared: &Shared, router: &str) {
    let mut lost = None::<Instant>;
    while !shared.stop.load(Ordering::Relaxed) {
        let connected =
            shared.open().as_ref().is_some_and(|open| open.session.info().routers_zid().wait().next().is_some());
        if shared.connected.swap(connected, Ordering::Relaxed) != connected {
            if connected {
                shared.connections.fetch_add(1, Ordering::Relaxed);
                tracing::info!(router, "connected");
            } else {
                tracing::warn!(router, "connection lost, trying again");
            }
        }
        if connected {
            lost = None;
        } else if lost.get_or_insert_with(Instant::now).elapsed() >= REOPEN {
            return;
        }
        std::thread::sleep(LOOK);
    }
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn it_is_said_why_there_is_no_session() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        assert!(why(&format!("tls/{address}")).unwrap().contains("router.certificate"));
        assert_eq!(why(&format!("tcp/{address}")), None);
        drop(listener);
        assert!(why(&format!("tcp/{address}")).unwrap().contains("refused"));
        assert_eq!(first_words("Unable to connect! at /home/a/b.rs:1."), "Unable to connect!");
    }
}
