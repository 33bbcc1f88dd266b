//! The narrator: publishes events from activity programs, JSON lines or plain lines.
//!
//! While a narrator runs, none of its narrations are lost. Unconfirmed ones are at most as many as the service's history holds (32), so a
//! restarted daemon receives each of them. Room scores confirm narrations: they name the newest one of each source that they contain.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, bounded};
use roomcast_ipc::raw::{Message, NAME_BYTES, NarrationV1, RoomScoresV1, narration_kind};
use roomcast_ipc::{Domain, IpcError, MessageError, Node, Publisher, Subscriber, sequence, text};
use sd_notify::NotifyState;

use crate::clock;
use crate::config::{IntakeLimits, NarratorConfig};
pub use crate::line::{Faults, InputError, Item, Who, line_item};
use crate::line::{LINE_BYTES_MAX, item_by};
use crate::logging::Limiter;
use crate::notify::notify;
use crate::participant::join;
use crate::setup;
use crate::stop::Stop;
use crate::token_bucket::TokenBucket;
use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_core::narration::Program;
use roomcast_core::text::odd_name;

/// Most unconfirmed narrations: the size of the service's history, which a restarted daemon receives.
const UNDER_WAY: u64 = NarrationV1::SERVICE.history as u64;
const TICK: Duration = Duration::from_millis(100);
/// The log names this many rejected lines at once, for files that a person writes, and then one in this time, since a broker may send any
/// number.
const REFUSALS_AT_ONCE: u64 = 32;
const REFUSAL_NS: u64 = 1_000_000_000;
/// The log mentions an odd name of a person once in this time.
const ODD_NAME_NS: u64 = 60_000_000_000;

#[must_use]
fn program_items(program: &Program, person: &Who) -> Vec<Item> {
    let items = program.steps.iter().map(|action| Item {
        duration_s: action.entry().duration_s,
        ..Item::new(narration_kind::ACTION, action.to_string(), person.clone())
    });
    items.collect()
}

/// The next item of the input, and the time when it was read, if it is live.
type Told = (Option<BootNs>, Result<Item, InputError>);

/// The source of the narration.
pub enum Input {
    /// All items are known.
    Items(Vec<Item>),
    /// All items, and the faults of malformed lines.
    Log {
        /// The items.
        items: Vec<Item>,
        /// The faults of the other lines.
        faults: Faults,
    },
    /// Lines, as they come.
    Lines {
        /// "standard input" or the file's name.
        name: String,
        /// The stream.
        stream: Box<dyn Read + Send>,
        /// The person of lines without one.
        person: Who,
        /// Called with the number of settled lines, if needed.
        settled: Option<Settled>,
    },
}

/// Receives the number of settled lines from the first on. The daemon has confirmed or dropped them, or they are not narrations. Their
/// sender may discard them.
pub type Settled = Box<dyn FnMut(u64) + Send>;

impl Input {
    /// `-` is standard input, line by line. A FIFO is read for ever. A file with a title and actions is a program; any other file is read
    /// line by line. The bare name of a shipped program opens that.
    ///
    /// # Errors
    ///
    /// [`InputError`] when it cannot be read.
    pub fn open(path: &Path, person: Who) -> Result<Self, InputError> {
        let name = path.display().to_string();
        if name == "-" {
            return Ok(Self::lines("standard input".to_owned(), io::stdin(), person));
        }
        if let Some(shipped) = setup::shipped_program(path) {
            return Ok(Self::Items(program_items(&shipped?, &person)));
        }
        if matches!(path.try_exists(), Ok(false)) {
            return Err(InputError::Missing(name));
        }
        let read = |source| InputError::Read(name.clone(), source);
        if std::fs::metadata(path).map_err(read)?.file_type().is_fifo() {
            // An own writer keeps the stream open after its last other writer has left.
            let stream = File::options().read(true).write(true).open(path).map_err(read)?;
            return Ok(Self::lines(name, stream, person));
        }
        let mut stream = File::open(path).map_err(read)?;
        if Self::is_program(&mut stream).map_err(read)? {
            let program = Program::load(path)?;
            program.notes.iter().for_each(|note| tracing::warn!(%note, "skipped"));
            return Ok(Self::Items(program_items(&program, &person)));
        }
        let stream = File::open(path).map_err(read)?;
        Ok(Self::lines(name, stream, person))
    }

    fn lines(name: String, stream: impl Read + Send + 'static, person: Who) -> Self {
        Self::Lines { name, stream: Box::new(stream), person, settled: None }
    }

    /// A program has a title: its first line is no action, no JSON and no sentence, and some later line is an action.
    fn is_program(stream: &mut File) -> io::Result<bool> {
        let mut start = Vec::new();
        stream.take(64 * 1024).read_to_end(&mut start)?;
        let text = String::from_utf8_lossy(&start);
        let mut lines = text.lines().map(str::trim_start).filter(|line| !line.is_empty());
        let titled = lines
            .next()
            .is_some_and(|line| !line.starts_with(['[', '{']) && !line.trim_end().ends_with(['.', '!', '?']));
        Ok(titled && lines.any(|line| line.starts_with('[')))
    }
}

impl Input {
    /// Gives each item, and each fault in words, to `take` until it returns false. It publishes no events.
    pub fn each(self, mut take: impl FnMut(Result<Item, String>) -> bool) {
        let (items, faults) = match self {
            Self::Items(items) => (items, Faults::default()),
            Self::Log { items, faults } => (items, faults),
            Self::Lines { name, stream, person, .. } => {
                let (sender, items) = bounded(1);
                // The reader may wait for a line for ever. It ends with its stream or with the program.
                let _reader = std::thread::spawn(move || read_lines(&name, stream, &person, &sender));
                let _all = items.iter().all(|(_, item)| take(item.map_err(|error| error.to_string())));
                return;
            }
        };
        let told: Vec<_> = faults.told().iter().map(|fault| Err(fault.clone())).collect();
        let _all = told.into_iter().chain(items.into_iter().map(Ok)).all(take);
    }
}

/// The pace of the narration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// Seconds before each narration. If 0, only the daemon's confirmations and the rate limit slow the narrator.
    Seconds(f64),
    /// A factor on the speed of the actions' real durations.
    Speed(f64),
}

impl Pace {
    fn before(self, item: &Item) -> Duration {
        let seconds = match self {
            Self::Seconds(seconds) => seconds,
            Self::Speed(speed) => item.duration_s / speed,
        };
        // Longer than any wait, and still within the range of a clock.
        const LONGEST_S: f64 = 1e9;
        match seconds.is_nan() {
            true => Duration::ZERO,
            false => Duration::from_secs_f64(seconds.clamp(0.0, LONGEST_S)),
        }
    }
}

/// The outcome of the narrations.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Outcome {
    /// Narrations sent.
    pub sent: u64,
    /// Of these, contained in the daemon's scores.
    pub confirmed: u64,
    /// Of these, rejected: too costly, too fast, lost, or sent by another process under this name.
    pub dropped: u64,
    /// Lines that were not narrations.
    pub refused: u64,
    /// The input was read to its end and each narration is settled or was waited for, without a signal before.
    #[serde(skip)]
    pub is_whole: bool,
    /// The source and the epoch of this start.
    #[serde(skip)]
    pub start: (u64, u64),
}

/// Numbers narrations and tracks confirmations. Pure: time is an argument.
#[derive(Debug, Clone)]
pub struct Account {
    source: u64,
    source_name: [u8; NAME_BYTES],
    epoch: u64,
    outcome: Outcome,
    /// The newest confirmation: epoch, highest processed number, and the number of narrations of this epoch in the scores.
    named: Option<(u64, u64, u64)>,
}

impl Account {
    /// A new account for the narrator of this name; `epoch` is random per start.
    #[must_use]
    pub fn new(name: &str, epoch: u64) -> Self {
        Self {
            source: sequence::source_of_name(name),
            source_name: text::encode_cut(name),
            epoch,
            outcome: Outcome { start: (sequence::source_of_name(name), epoch), ..Outcome::default() },
            named: None,
        }
    }

    /// The next message, observed now unless the item has a time.
    ///
    /// # Errors
    ///
    /// [`MessageError`] when the text cannot be a message; no number is used up then.
    pub fn next(&mut self, item: &Item, now_ns: BootNs, now_unix_ns: UnixNs) -> Result<NarrationV1, MessageError> {
        let message = item.message()?;
        let observed_unix_ns = item.observed_unix_ns.unwrap_or(now_unix_ns);
        // If the input's clock is fast, both times are ahead: the daemon corrects and counts that.
        let ahead_ns = observed_unix_ns.since(now_unix_ns);
        // An event from before the machine's start has no monotonic time: 0, as in the contract.
        let age_ns = now_unix_ns.since(observed_unix_ns);
        self.outcome.sent += 1;
        Ok(NarrationV1 {
            source: self.source,
            epoch: self.epoch,
            sequence: self.outcome.sent,
            observed_ns: now_ns.saturating_sub(age_ns).saturating_add(ahead_ns).0,
            observed_unix_ns: observed_unix_ns.0,
            source_name: self.source_name,
            ..message
        })
    }

    /// Processes the confirmations of checked scores.
    pub fn confirm(&mut self, scores: &RoomScoresV1) {
        for included in scores.included() {
            if (included.source, included.epoch) != (self.source, self.epoch) {
                continue;
            }
            let (_, before, taken_before) = self.named.unwrap_or_default();
            let same_daemon = self.named.is_none_or(|(epoch, ..)| epoch == scores.epoch);
            let sequence = included.sequence.min(self.outcome.sent);
            if sequence < before || (same_daemon && sequence == before) {
                continue;
            }
            let (dealt_with, dropped) = (sequence - before, sequence.saturating_sub(included.accepted));
            // Narrations that earlier scores have named are settled. A restarted daemon may know fewer of them. Then only later narrations
            // are known to be taken.
            let dropped = dropped.saturating_sub(before.saturating_sub(taken_before));
            let dropped = if same_daemon || dropped <= dealt_with { dropped.min(dealt_with) } else { 0 };
            self.outcome.dropped += dropped;
            self.outcome.confirmed += dealt_with - dropped;
            self.named = Some((scores.epoch, sequence, included.accepted));
        }
    }

    /// The outcome of the narrations so far.
    #[must_use]
    pub fn outcome(&self) -> Outcome {
        self.outcome
    }

    /// Narrations that the daemon has not processed.
    #[must_use]
    pub fn under_way(&self) -> u64 {
        self.outcome.sent - self.outcome.confirmed - self.outcome.dropped
    }

    /// Whether one more would survive a restart of the daemon.
    #[must_use]
    pub fn may_send(&self) -> bool {
        self.under_way() < UNDER_WAY
    }
}

/// Keeps a narrator below the daemon's rate limit for one source, since the daemon drops the excess. Pure: time is an argument.
///
/// It allows half of the daemon's burst and nine tenths of its rate: messages need not arrive as evenly as they are sent.
#[derive(Debug, Clone)]
pub struct Throttle(TokenBucket);

impl Throttle {
    /// A full bucket for a daemon with these limits.
    #[must_use]
    pub fn new(limits: IntakeLimits, now_ns: BootNs) -> Self {
        let (rate_per_s, burst) = (0.9 * limits.rate_per_s, (0.5 * limits.burst).max(1.0));
        let limits = IntakeLimits { rate_per_s, burst };
        Self(TokenBucket::full(limits, now_ns))
    }

    /// The wait before the next narration; zero is now. A rate of 0 is no limit.
    pub fn wait(&mut self, now_ns: BootNs) -> Duration {
        self.0.wait(now_ns)
    }

    /// Notes that one was sent.
    pub fn sent(&mut self) {
        self.0.take();
    }
}

/// Tracks settled lines. Pure: the account's numbers are arguments.
#[derive(Debug, Default)]
struct Lines {
    /// For each open line, the number of settled narrations at which it is settled.
    open: VecDeque<u64>,
    settled: u64,
}

impl Lines {
    /// Adds the next line: it is settled when `narrations` are, with its own if it has one.
    fn take(&mut self, narrations: u64) {
        self.open.push_back(narrations);
    }

    /// The number of settled lines, if it has grown, when `narrations` are settled.
    fn settle(&mut self, narrations: u64) -> Option<u64> {
        let before = self.settled;
        while self.open.front().is_some_and(|needs| *needs <= narrations) {
            self.open.pop_front();
            self.settled += 1;
        }
        (self.settled > before).then_some(self.settled)
    }
}

struct Narrator {
    narration: Publisher<NarrationV1>,
    scores: Subscriber<RoomScoresV1>,
    account: Account,
    throttle: Throttle,
    lines: Lines,
    settled: Option<Settled>,
}

impl Narrator {
    fn new(node: &Node, config: &NarratorConfig, limits: IntakeLimits) -> Result<Self, IpcError> {
        let account = Account::new(&config.name, sequence::random_epoch());
        let throttle = Throttle::new(limits, clock::monotonic_ns());
        let (narration, scores) = (node.publisher()?, node.subscriber()?);
        Ok(Self { narration, scores, account, throttle, lines: Lines::default(), settled: None })
    }

    /// Adds a line that was sent or is not a narration, and reports the settled lines.
    fn take_line(&mut self) {
        if self.settled.is_some() {
            self.lines.take(self.account.outcome.sent);
            self.settle();
        }
    }

    fn settle(&mut self) {
        if let Some(settled) = &mut self.settled
            && let Some(lines) = self.lines.settle(self.account.outcome.sent - self.account.under_way())
        {
            settled(lines);
        }
    }

    fn send(&mut self, item: &Item, observed_ns: BootNs) -> Result<(), IpcError> {
        let waited_ns = clock::monotonic_ns().since(observed_ns);
        let message = self.account.next(item, observed_ns, clock::unix_ns().saturating_sub(waited_ns));
        let message = message.map_err(|source| IpcError::Refused { service: NarrationV1::SERVICE.name, source })?;
        self.throttle.sent();
        self.narration.send(&message)?;
        Ok(())
    }

    /// Sleeps up to `timeout` for a confirmation.
    fn confirm(&mut self, timeout: Duration) -> Result<(), IpcError> {
        self.narration.tick()?;
        notify(&[NotifyState::Watchdog]);
        self.scores.wait(timeout.min(TICK))?;
        while let Some(scores) = self.scores.receive()? {
            self.account.confirm(&scores);
        }
        self.settle();
        Ok(())
    }
}

/// The narrator of corrections ("Jon is in the office").
pub const CORRECTIONS: &str = "roomcast-person";

/// Publishes all of `input`, no faster than a daemon with these limits accepts, and stays until it is confirmed or `linger_s` is over.
///
/// # Errors
///
/// [`IpcError`] when a service cannot be opened or is lost. Lines that are no narration are logged, counted, and skipped.
pub fn run(
    config: &NarratorConfig,
    limits: IntakeLimits,
    domain: &Domain,
    input: Input,
    pace: Pace,
    stop: &Stop,
) -> Result<Outcome, IpcError> {
    let node = join(domain, &format!("roomcast-narrator-{}", config.name))?;
    let mut sender = Narrator::new(&node, config, limits)?;
    let items = begin_reading(input, &mut sender)?;
    notify(&[NotifyState::Ready]);
    let mut log = Limiter::with_burst(REFUSAL_NS, REFUSALS_AT_ONCE);
    let mut log_odd = Limiter::new(ODD_NAME_NS);
    let mut warned = false;
    while let Some((read_ns, item)) = next(&items, &mut sender, stop)? {
        let item = match item {
            Ok(item) => item,
            Err(error) => {
                sender.account.outcome.refused += 1;
                sender.take_line();
                if let Some(not_told) = log.pass(clock::monotonic_ns()) {
                    tracing::warn!(%error, not_told, "skipped");
                }
                continue;
            }
        };
        if let Who::Name(name) = &item.person
            && let Some(odd) = odd_name(name, [])
            && let Some(not_told) = log_odd.pass(clock::monotonic_ns())
        {
            tracing::warn!(not_told, "a person's name is odd: {odd}");
        }
        let pause = pace.before(&item);
        let due = Instant::now() + pause;
        while !stop.requested() && Instant::now() < due {
            sender.confirm(due.saturating_duration_since(Instant::now()))?;
        }
        // A wait for the daemon must not delay the time of the event. An item of a recorded input is observed at its turn.
        let observed_ns = read_ns.filter(|_| pause.is_zero()).unwrap_or_else(clock::monotonic_ns);
        loop {
            let wait = sender.throttle.wait(clock::monotonic_ns());
            if wait.is_zero() || stop.requested() {
                break;
            }
            sender.confirm(wait)?;
        }
        let waiting = Instant::now();
        while !stop.requested() && !sender.account.may_send() {
            sender.confirm(TICK)?;
            if !warned && waiting.elapsed() > Duration::from_secs(5) {
                warned = true;
                tracing::warn!(
                    under_way = sender.account.under_way(),
                    "no daemon has confirmed anything for 5 s, with nothing lost: one may be busy, or none may run in this domain; `roomcast top` shows which"
                );
            }
        }
        if stop.requested() {
            break;
        }
        sender.send(&item, observed_ns)?;
        sender.take_line();
    }
    let is_read = !stop.requested();
    let linger = Instant::now() + Duration::try_from_secs_f64(config.linger_s).unwrap_or(Duration::ZERO);
    while !stop.requested() && sender.account.under_way() > 0 && Instant::now() < linger {
        sender.confirm(TICK)?;
    }
    sender.account.outcome.is_whole = is_read && (sender.account.under_way() == 0 || !stop.requested());
    // The daemon has every narration. A slow recorder may not, and sent messages are lost when their publisher leaves, so this waits.
    if sender.account.outcome.sent > 0 && !stop.requested() {
        sender.confirm(Duration::ZERO)?;
        std::thread::sleep(TICK);
    }
    notify(&[NotifyState::Stopping]);
    Ok(sender.account.outcome)
}

/// Starts a thread that reads the input.
fn begin_reading(mut input: Input, sender: &mut Narrator) -> Result<Receiver<Told>, IpcError> {
    let (items_in, items) = bounded(1);
    if let Input::Lines { settled, .. } = &mut input {
        sender.settled = settled.take();
    }
    if let Input::Log { faults, .. } = &input {
        sender.account.outcome.refused += faults.count();
        faults.told().iter().for_each(|error| tracing::warn!(%error, "skipped"));
        let further = faults.count() - faults.told().len() as u64;
        if further > 0 {
            tracing::warn!(further, "skipped further lines");
        }
    }
    // A read may block for ever. The thread ends with its stream, or with the process.
    let reader = move || match input {
        Input::Items(items) | Input::Log { items, .. } => {
            items.into_iter().try_for_each(|item| items_in.send((None, Ok(item)))).is_ok()
        }
        Input::Lines { name, stream, person, .. } => read_lines(&name, stream, &person, &items_in),
    };
    let failed =
        |error| IpcError::Port { service: NarrationV1::SERVICE.name, operation: "read", cause: Box::new(error) };
    std::thread::Builder::new().name("reader".to_owned()).spawn(reader).map_err(failed)?;
    Ok(items)
}

/// The next item; `None` at the end. It keeps the ports alive while it waits.
fn next(items: &Receiver<Told>, sender: &mut Narrator, stop: &Stop) -> Result<Option<Told>, IpcError> {
    while !stop.requested() {
        match items.recv_timeout(TICK) {
            Ok(item) => return Ok(Some(item)),
            Err(RecvTimeoutError::Timeout) => sender.confirm(Duration::ZERO)?,
            Err(RecvTimeoutError::Disconnected) => return Ok(None),
        }
    }
    Ok(None)
}

/// Returns whether the whole stream was read.
fn read_lines(name: &str, stream: Box<dyn Read + Send>, person: &Who, items: &Sender<Told>) -> bool {
    let mut stream = BufReader::new(stream);
    let mut bytes = Vec::new();
    let tell = |item| items.send((Some(clock::monotonic_ns()), item));
    for line in 1.. {
        bytes.clear();
        let read = stream.by_ref().take(LINE_BYTES_MAX + 1).read_until(b'\n', &mut bytes);
        let item = match read {
            Ok(0) => return true,
            Ok(_) => {
                let is_cut = bytes.len() as u64 > LINE_BYTES_MAX && bytes.last() != Some(&b'\n');
                if is_cut && let Err(source) = stream.skip_until(b'\n') {
                    let _gone = tell(Err(InputError::Read(name.to_owned(), source)));
                    return false;
                }
                match item_by(&bytes, line == 1, person, clock::unix_ns()).transpose() {
                    Some(item) => item,
                    None => continue,
                }
            }
            Err(source) => {
                let _gone = tell(Err(InputError::Read(name.to_owned(), source)));
                return false;
            }
        };
        if tell(item.map_err(|source| InputError::Line(line, source))).is_err() {
            return false;
        }
    }
    true
}

/// Creates a FIFO that only this user can write to; an existing one stays.
///
/// # Errors
///
/// [`InputError::MakeFifo`] when it cannot be made, [`InputError::NoFifo`] when something else is there.
pub fn make_fifo(path: &PathBuf) -> Result<(), InputError> {
    use rustix::fs::{CWD, FileType, Mode, mknodat};
    match mknodat(CWD, path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0) {
        Ok(()) => Ok(()),
        Err(rustix::io::Errno::EXIST) if std::fs::metadata(path).is_ok_and(|found| found.file_type().is_fifo()) => {
            Ok(())
        }
        Err(rustix::io::Errno::EXIST) => Err(InputError::NoFifo(path.clone())),
        Err(error) => Err(InputError::MakeFifo(path.clone(), error.into())),
    }
}

#[cfg(test)]
mod tests {
    use roomcast_core::ids::PersonId;
    use roomcast_ipc::Sender;

    use super::*;
    use crate::eventually::eventually;

    /// A clock can add any of them.
    #[test]
    fn no_pace_is_too_slow_for_a_clock() {
        let item = Item { duration_s: 3600.0, ..Item::new(narration_kind::SENTENCE, "They sit.", Who::Somebody) };
        for (pace, seconds) in [
            (Pace::Seconds(2.0), 2.0),
            (Pace::Speed(2.0), 1800.0),
            (Pace::Seconds(f64::MAX), 1e9),
            (Pace::Speed(1e-300), 1e9),
            (Pace::Speed(f64::MIN_POSITIVE), 1e9),
            (Pace::Seconds(-1.0), 0.0),
            (Pace::Seconds(f64::NAN), 0.0),
        ] {
            assert_eq!(pace.before(&item).as_secs_f64(), seconds, "{pace:?}");
            assert!(Instant::now().checked_add(pace.before(&item)).is_some());
        }
    }

    #[test]
    fn a_throttled_narrator_loses_nothing_at_the_intake() {
        use crate::daemon::{Intake, Taken};
        let limits = IntakeLimits::default();
        let (mut throttle, mut intake) = (Throttle::new(limits, BootNs(0)), Intake::new(limits));
        let mut account = Account::new("test", 1);
        let item = Item::new(narration_kind::SENTENCE, "They sit.", Who::Somebody);
        let (mut now_ns, mut arrived_ns) = (0, 0);
        for number in 0..20_000_u64 {
            loop {
                let wait = throttle.wait(BootNs(now_ns));
                if wait.is_zero() {
                    break;
                }
                now_ns += u64::try_from(wait.as_nanos()).unwrap().max(1);
            }
            throttle.sent();
            let message = account.next(&item, BootNs(now_ns), UnixNs(0)).unwrap();
            // The daemon receives them up to a second late and 32 at once.
            arrived_ns =
                u64::max(arrived_ns, now_ns + if number < 64 { 1_000_000_000 } else { (31 - number % 32) * 900_000 });
            let taken = intake.take(&message, Sender::simulated(1), BootNs(arrived_ns));
            assert!(matches!(taken, Taken::Accepted { missed: 0, .. }), "{number}");
        }
        assert!(now_ns > 15_000_000_000, "20 000 take 20 s, less the burst: {now_ns} ns");
        assert_eq!(
            Throttle::new(IntakeLimits { rate_per_s: 0.0, ..limits }, BootNs(0)).wait(BootNs(0)),
            Duration::ZERO
        );
    }

    /// Rows "sequence 2^64 - 1" and "a sentence of one kilobyte" of the attacks: a rejected narration is not confirmed.
    #[test]
    fn what_the_daemon_dropped_is_not_confirmed() {
        let mut account = Account::new("test", 5);
        let item = Item::new(narration_kind::SENTENCE, "They sit.", Who::Number(PersonId(0)));
        let scores = |daemon, sequence, accepted| {
            let mut scores = RoomScoresV1 { epoch: daemon, source_count: 1, ..Default::default() };
            let source = sequence::source_of_name("test");
            scores.included[0] = roomcast_ipc::raw::IncludedV1 { source, epoch: 5, sequence, accepted, observed_ns: 0 };
            scores
        };
        let figures = |account: &Account| (account.outcome.confirmed, account.outcome.dropped, account.under_way());
        for _ in 0..10 {
            account.next(&item, BootNs(1), UnixNs(1)).unwrap();
        }
        account.confirm(&scores(1, 4, 3));
        assert_eq!(figures(&account), (3, 1, 6));
        account.confirm(&scores(1, 4, 3));
        account.confirm(&scores(1, 6, 5));
        assert_eq!(figures(&account), (5, 1, 4));
        // A restarted daemon with the whole state database, and another one that has dropped most of it.
        account.confirm(&scores(2, 8, 6));
        assert_eq!(figures(&account), (6, 2, 2));
        account.confirm(&scores(3, 9, 1));
        assert_eq!(figures(&account), (7, 2, 1));
        account.confirm(&scores(3, u64::MAX, 1));
        assert_eq!(figures(&account), (7, 3, 0));
    }

    #[test]
    fn what_was_observed_before_is_sent_with_its_time() {
        let mut account = Account::new("test", 1);
        let sat = |observed_unix_ns| Item {
            observed_unix_ns,
            ..Item::new(narration_kind::SENTENCE, "They sit.", Who::Somebody)
        };
        let mut times = |item: &Item, now_ns, now_unix_ns| {
            let message = account.next(item, now_ns, now_unix_ns).unwrap();
            (message.observed_ns, message.observed_unix_ns)
        };
        assert_eq!(times(&sat(None), BootNs(500), UnixNs(10_000)), (500, 10_000));
        assert_eq!(times(&sat(Some(UnixNs(9_900))), BootNs(500), UnixNs(10_000)), (400, 9_900));
        // Before the machine's start, and by a fast clock, which the daemon corrects.
        assert_eq!(times(&sat(Some(UnixNs(1_000))), BootNs(500), UnixNs(10_000)), (0, 1_000));
        assert_eq!(times(&sat(Some(UnixNs(10_001))), BootNs(500), UnixNs(10_000)), (501, 10_001));
    }

    /// Gives one line per read, and counts them.
    struct Given(std::sync::Arc<std::sync::atomic::AtomicU64>);

    impl Read for Given {
        fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
            let line = b"They sit.\n";
            buffer[..line.len()].copy_from_slice(line);
            self.0.fetch_add(1, std::sync::atomic::Ordering::SeqCst);
            Ok(line.len())
        }
    }

    /// Without a daemon, a narrator waits with items that it has read. Their time is when they were read, not when they are sent.
    #[test]
    fn what_waited_for_a_daemon_was_observed_before() {
        use std::sync::atomic::Ordering::SeqCst;
        let folder = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(folder.path().join("d"), &format!("waits-{}", std::process::id())).unwrap();
        let node = domain.open("test").unwrap();
        let (heard, scores) = (node.subscriber::<NarrationV1>().unwrap(), node.publisher::<RoomScoresV1>().unwrap());
        let (stop, given) = (Stop::new(), std::sync::Arc::default());
        let input = Input::Lines {
            name: "test".to_owned(),
            stream: Box::new(Given(std::sync::Arc::clone(&given))),
            person: Who::Somebody,
            settled: None,
        };
        let config = NarratorConfig { name: "test".to_owned(), linger_s: 0.0 };
        let limits = IntakeLimits { rate_per_s: 0.0, ..IntakeLimits::default() };
        let (own_stop, own_domain) = (stop.clone(), domain.clone());
        let thread =
            std::thread::spawn(move || run(&config, limits, &own_domain, input, Pace::Seconds(0.0), &own_stop));
        // One item is in hand, one is in the channel, and the next was read after both.
        eventually("all are read ahead", || (given.load(SeqCst) >= UNDER_WAY + 3).then_some(()));
        let back_ns = clock::monotonic_ns();
        let mut newest: Option<NarrationV1> = None;
        let mut late = 0;
        while newest.is_none_or(|newest| newest.sequence < UNDER_WAY + 8) {
            heard.wait(TICK).unwrap();
            while let Some(narration) = heard.receive().unwrap() {
                assert!(narration.observed_ns > 0 && narration.sequence > newest.map_or(0, |newest| newest.sequence));
                let wall_ns =
                    clock::unix_ns().saturating_sub(clock::monotonic_ns().since(BootNs(narration.observed_ns)));
                assert!(wall_ns.0.abs_diff(narration.observed_unix_ns) < 1_000_000_000, "both clocks say the same");
                if narration.sequence <= UNDER_WAY + 2 {
                    assert!(narration.observed_ns <= back_ns.0, "{}", narration.sequence);
                } else {
                    late += usize::from(narration.observed_ns > back_ns.0);
                }
                newest = Some(narration);
            }
            if let Some(newest) = &newest {
                let mut confirms = RoomScoresV1 { epoch: 1, sequence: newest.sequence, ..Default::default() };
                (confirms.room_count, confirms.source_count) = (1, 1);
                confirms.room[0].id = text::encode("id", "kitchen").unwrap();
                confirms.included[0] = roomcast_ipc::raw::IncludedV1 {
                    source: newest.source,
                    epoch: newest.epoch,
                    sequence: newest.sequence,
                    accepted: newest.sequence,
                    observed_ns: newest.observed_ns,
                };
                scores.send(&confirms).unwrap();
            }
        }
        assert!(late > 0, "what was read since has its own time");
        stop.request();
        let outcome = thread.join().unwrap().unwrap();
        assert!(!outcome.is_whole, "it was stopped before the end");
        drop((heard, scores, node));
        let _left = domain.clean_up();
    }

    /// Editors on Windows put one at the start of a file.
    #[test]
    fn a_byte_order_mark_is_no_part_of_the_first_line() {
        let (items_in, items) = bounded(16);
        let text = "\u{feff}They open the fridge.\n\u{feff}They grab the milk.\n";
        assert!(read_lines("test", Box::new(io::Cursor::new(text)), &Who::Somebody, &items_in));
        drop(items_in);
        let told: Vec<bool> = items.iter().map(|(_, item)| item.is_ok()).collect();
        assert_eq!(told, [true, false], "elsewhere it is a hidden character");
    }

    #[test]
    fn a_stream_is_read_to_its_end_over_bad_lines() {
        let long = "a".repeat(20_000);
        let text = format!("They sit.\n\n{long}\nThey stand up.\n[Fly] <mug> (1)\nThey leave.");
        let (items_in, items) = bounded(100);
        assert!(read_lines("test", Box::new(io::Cursor::new(text)), &Who::Somebody, &items_in));
        drop(items_in);
        let read: Vec<_> =
            items.iter().map(|(_, item)| item.map(|item| item.text).map_err(|error| error.to_string())).collect();
        assert_eq!(read.len(), 5);
        assert!(read[1].as_ref().unwrap_err().starts_with("line 3: "));
        assert!(read[3].as_ref().unwrap_err().starts_with("line 5: "));
        assert_eq!(read[4].as_deref(), Ok("They leave."));
    }

    #[test]
    fn shipped_programs_go_by_name_and_programs_by_content() {
        let Input::Items(items) =
            Input::open(Path::new("p0-breakfast-and-television"), Who::Number(PersonId(2))).unwrap()
        else {
            panic!()
        };
        assert!(items.iter().all(|item| item.person == Who::Number(PersonId(2)) && item.duration_s > 0.0));
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("a.txt");
        std::fs::write(&file, "Make coffee\n\n[Walk] <kitchen> (1)\n").unwrap();
        assert!(matches!(Input::open(&file, Who::Somebody).unwrap(), Input::Items(items) if items.len() == 1));
        std::fs::write(&file, "They walk to the kitchen.\nThey sit.\n").unwrap();
        assert!(matches!(Input::open(&file, Who::Somebody).unwrap(), Input::Lines { .. }));
        let missing = Input::open(Path::new("p0-breakfast"), Who::Somebody).err().unwrap().to_string();
        assert!(missing.starts_with("there is no file p0-breakfast: "), "{missing}");
        assert!(missing.contains("p0-breakfast-and-television, ") && missing.contains("g2-end-of-shift"), "{missing}");
    }

    #[test]
    fn a_fifo_is_made_once_and_nothing_else_is_taken_for_one() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("narration");
        make_fifo(&path).unwrap();
        make_fifo(&path).unwrap();
        let file = directory.path().join("file");
        std::fs::write(&file, "").unwrap();
        assert!(matches!(make_fifo(&file), Err(InputError::NoFifo { .. })));
    }
}
