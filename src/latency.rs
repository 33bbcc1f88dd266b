//! Measures round trips between processes over several paths, one sample at a time.
//!
//! Each path is measured at the process where it begins and ends, and carries the same sizes: a narration out, a snapshot of scores back. The
//! yardsticks do no work in between:
//!
//! | path | there | back |
//! | --- | --- | --- |
//! | `eventfd` | a counter | a counter: the bare cost of waking two processes |
//! | `unix-socket` | a sequenced packet of a narration's size | one of the scores' size |
//! | `bare-iceoryx2` | publish, notify, receive, with a narration's layout | likewise with the scores' layout |
//! | `event-to-scores` | narration to the daemon | its scores, with all work for them |
//! | `event-to-scores-prepared` | likewise, for scores that were ready before the narration (`scoring.prepare`) | |
//! | `event-to-scores-computed` | likewise, for the other scores, if there are both kinds | |
//! | `event-to-decision` | narration to the daemon | the decision of the planner after its scores |

use std::os::fd::{AsFd, OwnedFd};
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use roomcast_ipc::bare::{BareReceiver, BareSender};
use roomcast_ipc::raw::{DecisionV1, NarrationV1, RoomScoresV1, narration_kind, score_flags};
use roomcast_ipc::{IpcError, MessageError, Node, Publisher, Subscriber, clock, sequence};
use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};
use rustix::io::Errno;
use rustix::net::{AddressFamily, RecvFlags, SendFlags, SocketFlags, SocketType, recv, send, socketpair};
use serde::Serialize;

use roomcast_services::stop::Stop;

/// After this time an answer counts as lost.
const PATIENCE: Duration = Duration::from_secs(30);
/// How often an answering process checks for a stop.
const TICK: Duration = Duration::from_millis(100);
const REQUEST: &str = "roomcast/latency/request";
const REPLY: &str = "roomcast/latency/reply";

/// A measured path.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Path {
    /// Narration published to scores received.
    EventToScores,
    /// The same, for scores that were ready before.
    EventToScoresPrepared,
    /// The same, for the other scores.
    EventToScoresComputed,
    /// Narration published to decision received.
    EventToDecision,
    /// Two messages over iceoryx2 by itself.
    BareIceoryx2,
    /// Two packets over a Unix socket.
    UnixSocket,
    /// Two wake-ups.
    Eventfd,
}

#[derive(Debug, thiserror::Error)]
pub enum LatencyError {
    #[error(transparent)]
    Ipc(#[from] IpcError),
    #[error(transparent)]
    Message(#[from] MessageError),
    #[error("the {path} path failed: {source}")]
    System { path: &'static str, source: Errno },
    #[error("nothing came back over the {path} path within {} s: the process at its other end hangs or has ended", PATIENCE.as_secs())]
    NoAnswer { path: &'static str },
    #[error("the histogram cannot be made: {0}")]
    Histogram(#[from] hdrhistogram::CreationError),
}

#[derive(Debug)]
pub enum Probe {
    /// [`Path::Eventfd`]: the descriptor for writing, then the one for reading.
    Eventfd(OwnedFd, OwnedFd),
    UnixSocket(OwnedFd),
    BareIceoryx2(Box<(BareSender<NarrationV1>, BareReceiver<RoomScoresV1>)>),
    Scores(Narrator, Subscriber<RoomScoresV1>),
    Decision(Narrator, Subscriber<DecisionV1>),
}

#[derive(Debug)]
pub struct Narrator {
    port: Publisher<NarrationV1>,
    sentences: Vec<NarrationV1>,
    source: u64,
    epoch: u64,
    sequence: u64,
}

impl Narrator {
    /// A narrator that repeats `sentences` in order.
    ///
    /// # Errors
    /// If the service cannot be opened or a sentence is no message.
    pub fn new(node: &Node, name: &str, sentences: &[String]) -> Result<Self, LatencyError> {
        let sentences = sentences.iter().map(|text| NarrationV1::new(narration_kind::SENTENCE, text));
        Ok(Self {
            port: node.publisher()?,
            sentences: sentences.collect::<Result<_, _>>()?,
            source: sequence::source_of_name(name),
            epoch: sequence::random_epoch(),
            sequence: 0,
        })
    }

    fn next(&mut self) -> NarrationV1 {
        let place = usize::try_from(self.sequence).unwrap_or(0) % self.sentences.len().max(1);
        self.sequence += 1;
        NarrationV1 {
            source: self.source,
            epoch: self.epoch,
            sequence: self.sequence,
            observed_ns: clock::monotonic_ns(),
            observed_unix_ns: clock::unix_ns(),
            ..self.sentences.get(place).copied().unwrap_or_default()
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sample {
    /// From before the message to after its answer.
    pub elapsed_ns: u64,
    /// Whether the answer was ready before the message.
    pub prepared: bool,
}

impl Probe {
    #[must_use]
    pub fn path(&self) -> Path {
        match self {
            Self::Eventfd(..) => Path::Eventfd,
            Self::UnixSocket(_) => Path::UnixSocket,
            Self::BareIceoryx2(_) => Path::BareIceoryx2,
            Self::Scores(..) => Path::EventToScores,
            Self::Decision(..) => Path::EventToDecision,
        }
    }

    /// Two event counters, and the input and output descriptors for the answering process.
    ///
    /// # Errors
    /// If the system refuses them.
    pub fn eventfd() -> Result<(Self, OwnedFd, OwnedFd), LatencyError> {
        let counter =
            || eventfd(0, EventfdFlags::CLOEXEC).map_err(|source| LatencyError::System { path: "eventfd", source });
        let (there, back) = (counter()?, counter()?);
        let copy = |fd: &OwnedFd| {
            rustix::io::fcntl_dupfd_cloexec(fd, 3).map_err(|source| LatencyError::System { path: "eventfd", source })
        };
        let (input, output) = (copy(&there)?, copy(&back)?);
        Ok((Self::Eventfd(there, back), input, output))
    }

    /// A pair of connected sockets, one for the answering process.
    ///
    /// # Errors
    /// If the system refuses them.
    pub fn unix_socket() -> Result<(Self, OwnedFd), LatencyError> {
        let (here, there) = socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None)
            .map_err(|source| LatencyError::System { path: "unix-socket", source })?;
        Ok((Self::UnixSocket(here), there))
    }

    /// Both ends of a bare iceoryx2 round trip.
    ///
    /// # Errors
    /// If a service cannot be opened.
    pub fn bare_iceoryx2(node: &Node) -> Result<Self, LatencyError> {
        Ok(Self::BareIceoryx2(Box::new((BareSender::open(node, REQUEST)?, BareReceiver::open(node, REPLY)?))))
    }

    /// Sends once and waits for the answer.
    ///
    /// # Errors
    /// If a path fails or no answer comes.
    pub fn measure(&mut self) -> Result<Sample, LatencyError> {
        let of = |start| Sample { elapsed_ns: nanoseconds(start), prepared: false };
        match self {
            Self::Eventfd(there, back) => {
                let start = Instant::now();
                wake(there)?;
                await_wake(back, PATIENCE)?.ok_or(LatencyError::NoAnswer { path: "eventfd" })?;
                Ok(of(start))
            }
            Self::UnixSocket(socket) => {
                let failed = |source| LatencyError::System { path: "unix-socket", source };
                let mut reply = [0_u8; size_of::<RoomScoresV1>()];
                let start = Instant::now();
                send(&*socket, &[1; size_of::<NarrationV1>()], SendFlags::empty()).map_err(failed)?;
                if !readable(&*socket, PATIENCE).map_err(failed)? {
                    return Err(LatencyError::NoAnswer { path: "unix-socket" });
                }
                let (_, bytes) = recv(&*socket, reply.as_mut_slice(), RecvFlags::empty()).map_err(failed)?;
                let sample = of(start);
                if bytes == reply.len() { Ok(sample) } else { Err(LatencyError::NoAnswer { path: "unix-socket" }) }
            }
            Self::BareIceoryx2(ports) => {
                let (there, back) = &**ports;
                let message = NarrationV1::default();
                let start = Instant::now();
                there.send(&message)?;
                back.receive(PATIENCE)?.ok_or(LatencyError::NoAnswer { path: "bare-iceoryx2" })?;
                Ok(of(start))
            }
            Self::Scores(narrator, scores) => {
                let message = narrator.next();
                let key = (message.source, message.epoch);
                let start = Instant::now();
                narrator.port.send(&message)?;
                let scores = wait_for(scores, "event-to-scores", |scores| {
                    scores.included().iter().any(|i| (i.source, i.epoch) == key && i.sequence >= message.sequence)
                })?;
                Ok(Sample { prepared: scores.has(score_flags::PREPARED), ..of(start) })
            }
            Self::Decision(narrator, decisions) => {
                let message = narrator.next();
                let start = Instant::now();
                narrator.port.send(&message)?;
                wait_for(decisions, "event-to-decision", |decision| decision.observed_ns >= message.observed_ns)?;
                Ok(of(start))
            }
        }
    }
}

fn wait_for<M: roomcast_ipc::raw::Message>(
    port: &Subscriber<M>,
    path: &'static str,
    is_it: impl Fn(&M) -> bool,
) -> Result<M, LatencyError> {
    let end = Instant::now() + PATIENCE;
    let mut message = M::default();
    loop {
        while port.receive_into(&mut message)? {
            if is_it(&message) {
                return Ok(message);
            }
        }
        let left = end.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(LatencyError::NoAnswer { path });
        }
        port.wait(left)?;
    }
}

fn wake(counter: &OwnedFd) -> Result<(), LatencyError> {
    rustix::io::write(counter, &1_u64.to_ne_bytes())
        .map_err(|source| LatencyError::System { path: "eventfd", source })?;
    Ok(())
}

/// Whether the counter was raised within `timeout`. Reading resets it.
fn await_wake(counter: &OwnedFd, timeout: Duration) -> Result<Option<()>, LatencyError> {
    let failed = |source| LatencyError::System { path: "eventfd", source };
    if !readable(counter, timeout).map_err(failed)? {
        return Ok(None);
    }
    rustix::io::read(counter, &mut [0; 8]).map_err(failed)?;
    Ok(Some(()))
}

fn readable(fd: impl AsFd, timeout: Duration) -> Result<bool, Errno> {
    let timeout = Timespec::try_from(timeout).map_err(|_| Errno::INVAL)?;
    match poll(&mut [PollFd::new(&fd, PollFlags::IN)], Some(&timeout)) {
        Ok(ready) => Ok(ready > 0),
        Err(Errno::INTR) => Ok(false),
        Err(error) => Err(error),
    }
}

/// Answers every message over one of the yardsticks until asked to stop. For descriptors, the ends are standard input and output.
///
/// # Errors
/// If the path fails or does not answer.
pub fn echo(path: Path, node: &Node, stop: &Stop) -> Result<(), LatencyError> {
    match path {
        Path::Eventfd => {
            let copy = |fd: std::os::fd::BorrowedFd<'_>| {
                rustix::io::fcntl_dupfd_cloexec(fd, 3)
                    .map_err(|source| LatencyError::System { path: "eventfd", source })
            };
            let (input, output) = (copy(std::io::stdin().as_fd())?, copy(std::io::stdout().as_fd())?);
            while !stop.requested() {
                if await_wake(&input, TICK)?.is_some() {
                    wake(&output)?;
                }
            }
        }
        Path::UnixSocket => {
            let failed = |source| LatencyError::System { path: "unix-socket", source };
            let (input, reply) = (std::io::stdin(), [2_u8; size_of::<RoomScoresV1>()]);
            let mut request = [0_u8; size_of::<NarrationV1>()];
            while !stop.requested() {
                if !readable(&input, TICK).map_err(failed)? {
                    continue;
                }
                let (_, bytes) = recv(&input, request.as_mut_slice(), RecvFlags::empty()).map_err(failed)?;
                if bytes == 0 {
                    return Ok(());
                }
                send(&input, &reply, SendFlags::empty()).map_err(failed)?;
            }
        }
        Path::BareIceoryx2
        | Path::EventToScores
        | Path::EventToScoresPrepared
        | Path::EventToScoresComputed
        | Path::EventToDecision => {
            let (requests, replies) =
                (BareReceiver::<NarrationV1>::open(node, REQUEST)?, BareSender::open(node, REPLY)?);
            let reply = RoomScoresV1::default();
            while !stop.requested() {
                if requests.receive(TICK)?.is_some() {
                    replies.send(&reply)?;
                }
            }
        }
    }
    Ok(())
}

/// Keeps every core busy until asked to stop, as the rest of a robot's software may.
pub fn spin(stop: &Stop) {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..cores {
            scope.spawn(|| {
                // More than a second-level cache holds, so that caches are contended too.
                let mut memory = vec![1_u64; 1 << 18];
                while !stop.requested() {
                    for (place, value) in (0_u64..).zip(&mut memory) {
                        *value = value.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(place);
                    }
                    std::hint::black_box(&memory);
                }
            });
        }
    });
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Row {
    pub path: Path,
    /// "model", or "none" for the scorer without cost; for a yardstick, the scorer during its measurement.
    pub scorer: &'static str,
    /// "idle", or "busy" with one spinning thread per core.
    pub load: &'static str,
    pub n: u64,
    pub p50_ns: u64,
    pub p90_ns: u64,
    pub p99_ns: u64,
    pub p999_ns: u64,
    pub max_ns: u64,
}

impl Row {
    #[must_use]
    pub fn new(path: Path, scorer: &'static str, load: &'static str, samples_ns: &Histogram<u64>) -> Self {
        let at = |quantile| samples_ns.value_at_quantile(quantile);
        Self {
            path,
            scorer,
            load,
            n: samples_ns.len(),
            p50_ns: at(0.5),
            p90_ns: at(0.9),
            p99_ns: at(0.99),
            p999_ns: at(0.999),
            max_ns: samples_ns.max(),
        }
    }
}

#[derive(Debug)]
pub struct Taken {
    /// One histogram for each probe, in order.
    pub histograms: Vec<Histogram<u64>>,
    /// Times from event to scores, if the scores were ready before the event.
    pub prepared: Histogram<u64>,
    /// The other scores.
    pub computed: Histogram<u64>,
}

/// Measures the probes in turn, `samples` times each after `warm_up`, with a pause before every sample.
///
/// The paths are interleaved, so that other load affects all alike.
///
/// # Errors
/// If a path fails. A stop ends the measurement early, with the samples so far.
pub fn interleaved(
    probes: &mut [Probe],
    samples: u64,
    warm_up: u64,
    pause: Duration,
    stop: &Stop,
    mut progress: impl FnMut(),
) -> Result<Taken, LatencyError> {
    let histogram = || Histogram::new_with_max(60_000_000_000, 3);
    let (mut prepared, mut computed) = (histogram()?, histogram()?);
    let mut histograms = probes.iter().map(|_| histogram()).collect::<Result<Vec<_>, _>>()?;
    for round in 0..warm_up + samples {
        for (probe, histogram) in probes.iter_mut().zip(&mut histograms) {
            rest(pause, stop);
            if stop.requested() {
                return Ok(Taken { histograms, prepared, computed });
            }
            let sample = probe.measure()?;
            if round >= warm_up {
                histogram.saturating_record(sample.elapsed_ns);
                if probe.path() == Path::EventToScores {
                    let own = if sample.prepared { &mut prepared } else { &mut computed };
                    own.saturating_record(sample.elapsed_ns);
                }
            }
        }
        progress();
    }
    Ok(Taken { histograms, prepared, computed })
}

/// Sleeps in ticks, so that a stop ends a long pause. A short pause is one sleep.
fn rest(pause: Duration, stop: &Stop) {
    const TICK: Duration = Duration::from_millis(200);
    let mut left = pause;
    while !left.is_zero() && !stop.requested() {
        let now = left.min(TICK);
        std::thread::sleep(now);
        left -= now;
    }
}

fn nanoseconds(since: Instant) -> u64 {
    u64::try_from(since.elapsed().as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_sums_up_its_samples() {
        let mut samples_ns = Histogram::new_with_max(1_000_000, 3).unwrap();
        (1..=1000).for_each(|ns| samples_ns.record(ns).unwrap());
        let row = Row::new(Path::Eventfd, "none", "idle", &samples_ns);
        assert_eq!(
            (row.n, row.p50_ns, row.p90_ns, row.p99_ns, row.p999_ns, row.max_ns),
            (1000, 500, 900, 990, 999, 1000)
        );
    }

    #[test]
    fn a_stop_ends_a_pause_of_any_length() {
        let stop = Stop::new();
        stop.request();
        rest(Duration::MAX, &stop);
        rest(Duration::from_millis(1), &Stop::new());
    }

    #[test]
    fn sockets_and_counters_carry_there_and_back() {
        let (mut probe, there) = Probe::unix_socket().unwrap();
        let answer = std::thread::spawn(move || {
            let mut request = [0_u8; size_of::<NarrationV1>()];
            let (_, bytes) = recv(&there, request.as_mut_slice(), RecvFlags::empty()).unwrap();
            assert_eq!(bytes, request.len());
            send(&there, &[2; size_of::<RoomScoresV1>()], SendFlags::empty()).unwrap();
        });
        assert!(probe.measure().unwrap().elapsed_ns > 0);
        answer.join().unwrap();

        let (mut probe, input, output) = Probe::eventfd().unwrap();
        let answer = std::thread::spawn(move || {
            await_wake(&input, PATIENCE).unwrap().unwrap();
            wake(&output).unwrap();
        });
        assert!(probe.measure().unwrap().elapsed_ns > 0);
        answer.join().unwrap();
    }
}
