//! A small HTTP server on a loopback address, for metrics and for the page of `roomcast view`.
//!
//! Requests have to name a loopback address or `localhost`: a page elsewhere, whose name leads here, reads nothing through somebody's browser.
//! Any user of the machine can connect. What connections can take is bounded by [`CONNECTIONS_MAX`], [`HEADER_BYTES_MAX`] and
//! [`REQUEST_TIME`], and each is closed after one answer.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::convert::Infallible;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use hyper::header::{ALLOW, HOST, HeaderValue};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{HeaderMap, Method, Response, StatusCode, Uri};
use hyper_util::rt::TokioIo;
use roomcast_core::ids::BootNs;
use roomcast_services::clock;
use roomcast_services::notify::Watchdog;
use roomcast_services::stop::Stop;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpListener;
use tokio::task::{JoinHandle, LocalSet};
use tokio::time::timeout;

/// Connections that are served at a time; for a further one the oldest is closed.
pub const CONNECTIONS_MAX: usize = 16;
/// Bytes that a request may have before its body; a body is not read.
pub const HEADER_BYTES_MAX: usize = 16 << 10;
/// Time that a connection has for its request and for reading the answer.
pub const REQUEST_TIME: Duration = Duration::from_secs(5);
const TICK: Duration = Duration::from_millis(100);
/// How long the serving thread may take for a turn before it no longer counts as alive.
const TURN_MAX: Duration = Duration::from_secs(2);

/// Why nothing can be served.
#[derive(Debug, thiserror::Error)]
pub enum HttpError {
    /// An address that others could reach.
    #[error("this is served on a loopback address alone, not on {0}: give 127.0.0.1:PORT or [::1]:PORT")]
    NotLoopback(SocketAddr),
    /// The port cannot be had.
    #[error("cannot serve on {address}: {reason}; is the port taken? give another one")]
    Listen {
        /// Where.
        address: SocketAddr,
        /// The system's word.
        reason: String,
    },
    /// The thread that answers could not be started.
    #[error("cannot start the thread that serves HTTP: {0}; is a limit on tasks or descriptors set too low?")]
    Thread(std::io::Error),
    /// The thread that answers has ended by itself.
    #[error("the thread that serves HTTP has ended unexpectedly; start this command again and report it")]
    Ended,
}

/// A request, as far as it is read.
#[derive(Debug, Clone, Copy)]
pub struct Request<'a> {
    /// The address that is asked for.
    pub uri: &'a Uri,
    /// Its header lines.
    pub headers: &'a HeaderMap,
}

/// A thread that answers requests.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    turned_ns: Arc<AtomicU64>,
    thread: std::thread::JoinHandle<std::io::Result<()>>,
    stop: Stop,
    watchdog: Watchdog,
}

impl Server {
    /// Answers every GET request on `address` with what `answer` makes of it, until `stop`.
    ///
    /// # Errors
    /// [`HttpError`] for an address that is not loopback or is taken.
    pub fn start(
        address: SocketAddr,
        stop: &Stop,
        answer: impl FnMut(Request<'_>) -> Response<String> + Send + 'static,
    ) -> Result<Self, HttpError> {
        if !address.ip().is_loopback() {
            return Err(HttpError::NotLoopback(address));
        }
        let failed = |error: std::io::Error| HttpError::Listen { address, reason: error.to_string() };
        let listener = std::net::TcpListener::bind(address).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let turned_ns = Arc::new(AtomicU64::new(clock::monotonic_ns().0));
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build();
        let runtime = runtime.map_err(HttpError::Thread)?;
        let (turned, asked) = (Arc::clone(&turned_ns), stop.clone());
        let thread = std::thread::Builder::new()
            .name("serve".to_owned())
            .spawn(move || LocalSet::new().block_on(&runtime, serve(listener, answer, &turned, &asked)));
        let thread = thread.map_err(HttpError::Thread)?;
        Ok(Self { address, turned_ns, thread, stop: stop.clone(), watchdog: Watchdog::default() })
    }

    /// Where it is, with the port that was found for port 0.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Tells systemd that this process lives, as long as the thread turns. Whoever has started the thread calls this at every turn of
    /// its own.
    ///
    /// # Errors
    /// [`HttpError::Ended`] where the thread has ended and nobody has asked it to.
    pub fn look_after(&mut self) -> Result<(), HttpError> {
        if self.thread.is_finished() && !self.stop.requested() {
            return Err(HttpError::Ended);
        }
        if turns(BootNs(self.turned_ns.load(Ordering::Relaxed)), clock::monotonic_ns()) {
            self.watchdog.lives();
        }
        Ok(())
    }

    /// Waits until the thread has ended, which looks at the wish to stop every tick.
    pub fn join(self) {
        let _ended = self.thread.join();
    }
}

/// Whether the serving thread, which last turned then, is at work.
fn turns(turned_ns: BootNs, now_ns: BootNs) -> bool {
    u128::from(now_ns.since(turned_ns)) <= TURN_MAX.as_nanos()
}

/// Serves connections on this thread until it is asked to stop, and notes each turn.
async fn serve(
    listener: std::net::TcpListener,
    answer: impl FnMut(Request<'_>) -> Response<String> + 'static,
    turned_ns: &AtomicU64,
    stop: &Stop,
) -> std::io::Result<()> {
    let listener = TcpListener::from_std(listener)?;
    let answer = Rc::new(RefCell::new(answer));
    let mut connections: VecDeque<JoinHandle<()>> = VecDeque::with_capacity(CONNECTIONS_MAX);
    while !stop.requested() {
        turned_ns.store(clock::monotonic_ns().0, Ordering::Relaxed);
        let Ok(accepted) = timeout(TICK, listener.accept()).await else { continue };
        match accepted {
            Ok((stream, _)) => {
                connections.retain(|connection| !connection.is_finished());
                // Whoever holds connections without a word is in nobody's way.
                if connections.len() == CONNECTIONS_MAX
                    && let Some(oldest) = connections.pop_front()
                {
                    oldest.abort();
                }
                connections.push_back(tokio::task::spawn_local(converse(stream, Rc::clone(&answer))));
            }
            Err(error) => {
                tracing::warn!(%error, "a connection failed");
                // A limit of the system, such as that of descriptors, does not pass at once.
                tokio::time::sleep(TICK).await;
            }
        }
    }
    Ok(())
}

/// One request over a connection, and its answer.
pub async fn converse(
    stream: impl AsyncRead + AsyncWrite + Unpin,
    answer: Rc<RefCell<impl FnMut(Request<'_>) -> Response<String>>>,
) {
    let service = service_fn(|request: hyper::Request<hyper::body::Incoming>| {
        let host = request.headers().get(HOST).and_then(|host| host.to_str().ok());
        let response = match *request.method() {
            _ if !host.is_some_and(is_own_name) => {
                refusal(StatusCode::MISDIRECTED_REQUEST, "ask for a loopback address by its number, or for localhost")
            }
            Method::GET => {
                let mut answer = answer.borrow_mut();
                (*answer)(Request { uri: request.uri(), headers: request.headers() })
            }
            _ => {
                let mut response = refusal(StatusCode::METHOD_NOT_ALLOWED, "only GET");
                response.headers_mut().insert(ALLOW, HeaderValue::from_static("GET"));
                response
            }
        };
        async move { Ok::<_, Infallible>(response) }
    });
    let mut http = http1::Builder::new();
    // The one limit on time is around all of it. Who says no more after a request still gets an answer.
    http.keep_alive(false).half_close(true).max_buf_size(HEADER_BYTES_MAX).header_read_timeout(None);
    match timeout(REQUEST_TIME, http.serve_connection(TokioIo::new(stream), service)).await {
        Ok(Ok(())) => {}
        Ok(Err(error)) => {
            tracing::debug!(%error, "a connection sent no request, or did not read its answer to the end")
        }
        Err(_) => tracing::debug!("a request took too long"),
    }
}

/// Whether a request was meant for this machine: a name that a page elsewhere owns may lead here, too.
fn is_own_name(host: &str) -> bool {
    let (is_own, port) = match host.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((name, port)) => (name.parse::<Ipv6Addr>().is_ok_and(|address| address.is_loopback()), port),
        None => {
            let (name, port) = host.split_at(host.find(':').unwrap_or(host.len()));
            let is_loopback = name.parse::<Ipv4Addr>().is_ok_and(|address| address.is_loopback());
            (name.eq_ignore_ascii_case("localhost") || is_loopback, port)
        }
    };
    let is_number = |port: &str| port.bytes().all(|byte| byte.is_ascii_digit()) && port.parse::<u16>().is_ok();
    is_own && (port.is_empty() || port.strip_prefix(':').is_some_and(is_number))
}

/// An answer that refuses, with a reason in words.
#[must_use]
pub fn refusal(status: StatusCode, why: &str) -> Response<String> {
    let mut response = Response::new(format!("{why}\n"));
    *response.status_mut() = status;
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_for_another_name_are_not_meant_for_this_machine() {
        for host in ["127.0.0.1:9465", "localhost:9465", "localhost", "[::1]:9465", "127.0.0.1", "[::1]"] {
            assert!(is_own_name(host), "{host}");
        }
        for host in [
            "evil.example:9465",
            "127.0.0.1.evil.example",
            "192.168.1.2:9465",
            "",
            "localhost.evil.example:1",
            "[::2]:9465",
            "localhost:evil",
            "localhost:",
            "localhost:+80",
            "localhost:65536",
            "localhost:80:80",
            "localhost:80/evil",
            "127.0.0.1:evil",
            "[::1]evil",
            "[::1]:evil",
            "[127.0.0.1]",
            "[localhost]",
            "::1",
            "[::1",
            ":80",
            "evil@localhost",
        ] {
            assert!(!is_own_name(host), "{host}");
        }
    }

    #[test]
    fn a_serving_thread_that_stands_still_is_no_sign_of_life() {
        assert!(turns(BootNs(7), BootNs(7)) && turns(BootNs(7), BootNs(2_000_000_007)) && turns(BootNs(9), BootNs(7)));
        assert!(!turns(BootNs(7), BootNs(2_000_000_008)));
    }
}
