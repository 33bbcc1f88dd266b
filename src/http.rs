//! A small HTTP server on a loopback address, for metrics and for the page of `roomcast view`.
//!
//! Requests must name a loopback address or `localhost`, so that a foreign page with a name that resolves here cannot read through a browser. Any
//! user of the machine can connect. [`CONNECTIONS_MAX`], [`HEADER_BYTES_MAX`] and [`REQUEST_TIME`] bound the cost, and each connection is closed
//! after one answer.

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

/// Most connections at a time. A further one closes the oldest.
pub const CONNECTIONS_MAX: usize = 16;
/// Most bytes of a request's head. A body is not read.
pub const HEADER_BYTES_MAX: usize = 16 << 10;
/// Time of a connection for its request and its answer.
pub const REQUEST_TIME: Duration = Duration::from_secs(5);
const TICK: Duration = Duration::from_millis(100);
/// If a turn of the serving thread takes longer, the thread counts as hung.
const TURN_MAX: Duration = Duration::from_secs(2);

#[derive(Debug, thiserror::Error)]
pub enum HttpError {
    /// An address that other machines could reach.
    #[error("this is served on a loopback address alone, not on {0}: give 127.0.0.1:PORT or [::1]:PORT")]
    NotLoopback(SocketAddr),
    #[error("cannot serve on {address}: {reason}; is the port taken? give another one")]
    Listen { address: SocketAddr, reason: String },
    #[error("cannot start the thread that serves HTTP: {0}; is a limit on tasks or descriptors set too low?")]
    Thread(std::io::Error),
    #[error("the thread that serves HTTP has ended unexpectedly; start this command again and report it")]
    Ended,
}

#[derive(Debug, Clone, Copy)]
pub struct Request<'a> {
    /// Whether the request changes something (POST); else it reads (GET).
    pub changes: bool,
    pub uri: &'a Uri,
    pub headers: &'a HeaderMap,
}

#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    turned_ns: Arc<AtomicU64>,
    thread: std::thread::JoinHandle<std::io::Result<()>>,
    stop: Stop,
    watchdog: Watchdog,
}

impl Server {
    /// Answers every GET and POST request on `address` by `answer` until `stop`.
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

    /// The address, with the port that was chosen for port 0.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Feeds systemd's watchdog while the serving thread makes turns. The caller does this at every turn of its loop.
    ///
    /// # Errors
    /// [`HttpError::Ended`] if the thread has ended without a stop request.
    pub fn look_after(&mut self) -> Result<(), HttpError> {
        if self.thread.is_finished() && !self.stop.requested() {
            return Err(HttpError::Ended);
        }
        if turns(BootNs(self.turned_ns.load(Ordering::Relaxed)), clock::monotonic_ns()) {
            self.watchdog.lives();
        }
        Ok(())
    }

    /// Waits for the thread, which checks for a stop every tick.
    pub fn join(self) {
        let _ended = self.thread.join();
    }
}

/// Whether the serving thread has made a turn recently.
fn turns(turned_ns: BootNs, now_ns: BootNs) -> bool {
    u128::from(now_ns.since(turned_ns)) <= TURN_MAX.as_nanos()
}

/// Serves connections on this thread until asked to stop, and notes each turn.
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
                // Idle connections must not block new ones.
                if connections.len() == CONNECTIONS_MAX
                    && let Some(oldest) = connections.pop_front()
                {
                    oldest.abort();
                }
                connections.push_back(tokio::task::spawn_local(converse(stream, Rc::clone(&answer))));
            }
            Err(error) => {
                tracing::warn!(%error, "a connection failed");
                // A system limit, for instance on descriptors, does not pass at once.
                tokio::time::sleep(TICK).await;
            }
        }
    }
    Ok(())
}

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
            Method::GET | Method::POST => {
                let mut answer = answer.borrow_mut();
                let changes = request.method() == Method::POST;
                (*answer)(Request { changes, uri: request.uri(), headers: request.headers() })
            }
            _ => only_get(),
        };
        async move { Ok::<_, Infallible>(response) }
    });
    let mut http = http1::Builder::new();
    // One timeout covers the whole conversation. A client that closes its sending side after the request still gets an answer.
    http.keep_alive(false).half_close(true).max_buf_size(HEADER_BYTES_MAX).header_read_timeout(None);
    match timeout(REQUEST_TIME, http.serve_connection(TokioIo::new(stream), service)).await {
        Ok(Ok(())) => {}
        Ok(Err(error)) => {
            tracing::debug!(%error, "a connection sent no request, or did not read its answer to the end")
        }
        Err(_) => tracing::debug!("a request took too long"),
    }
}

/// Whether a request names this machine. A foreign page's name may resolve to it too.
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

/// The answer where nothing can be changed.
#[must_use]
pub fn only_get() -> Response<String> {
    let mut response = refusal(StatusCode::METHOD_NOT_ALLOWED, "only GET");
    response.headers_mut().insert(ALLOW, HeaderValue::from_static("GET"));
    response
}

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
