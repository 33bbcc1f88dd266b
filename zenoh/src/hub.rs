//! A hub keeps this machine's lines of narration on disk until every robot has confirmed them.

use std::any::Any;
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::os::unix::fs::{DirEntryExt, FileExt, FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

use roomcast_ipc::clock;
use sd_notify::NotifyState;
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use crate::config::{Config, ConfigError};
use crate::delay::clock_id;
use crate::delivery::Delivery;
use crate::keys::Keys;
use crate::limiter::Limiter;
use crate::line::{Age, LINE_BYTES_MAX, line_of};
use crate::link::{Declare, Link, LinkError};
use crate::namesake::{Order, Rival};
use crate::robot::notify;
use crate::spool::{self, Kept, Place, Spool, SpoolError, open_plain};
use crate::stop::Stop;
use crate::understood::Understood;
use crate::wire::{self, Confirmed, Fault, Hex, Narrated, Said};

/// Most lines that wait for the disk. If the queue is full, the input waits.
const LINES_MAX: usize = 256;
/// Most queued reports of robots. More are dropped; robots repeat them.
const HEARD_MAX: usize = 64;
const TICK: Duration = Duration::from_millis(20);
/// How often a followed file is checked for new bytes.
const LOOK: Duration = Duration::from_millis(50);
/// A replaced file is left after this much silence, once the new file has content. Its writer may write to it until it learns of the new one.
const LEAVE: Duration = Duration::from_secs(1);

const NAMESAKE: &str = "another hub narrates in this hub's name; this one was first, and the other one ends: give each hub of the site a name of its own (hub.name)";

/// Why a hub ends.
#[derive(Debug, thiserror::Error)]
pub enum HubError {
    /// The configuration.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The connection to the router.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The spool.
    #[error(transparent)]
    Spool(#[from] SpoolError),
    /// Another hub uses this hub's name.
    #[error(
        "another hub narrates as {0:?} at this site, and was first: give each hub of the site a name of its own (hub.name), or end the other one"
    )]
    Namesake(String),
    /// The input.
    #[error("cannot read {path}: {source}")]
    Input {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The thread that reads the input.
    #[error("the program has a fault: what reads {path} has ended by a panic, which the log has")]
    Panic {
        /// The file.
        path: PathBuf,
    },
    /// The system refuses a thread.
    #[error("cannot start a thread: {0}; {limit}", limit = roomcast_ipc::limits::on_threads())]
    Thread(io::Error),
}

impl HubError {
    /// Whether the configuration, the command line or a file in them is at fault. A restart does not help then.
    #[must_use]
    pub fn is_of_configuration(&self) -> bool {
        match self {
            Self::Config(_) | Self::Namesake(_) | Self::Link(LinkError::Config(_)) => true,
            Self::Input { source, .. } => matches!(
                source.kind(),
                io::ErrorKind::NotFound | io::ErrorKind::PermissionDenied | io::ErrorKind::IsADirectory
            ),
            Self::Spool(error) => spool::is_of_configuration(error),
            Self::Link(_) | Self::Panic { .. } | Self::Thread(_) => false,
        }
    }
}

/// Longest wait, after the last confirmation, for reports of how the last events were understood.
const EXPLAINED_NS: u64 = 3_000_000_000;
/// If a robot is not heard for this long after the start, the log warns.
const UNHEARD_NS: u64 = 15_000_000_000;

/// A line, and the input's place behind it.
type Line = (Vec<u8>, Place);

/// This many bytes before a place show whether a file is still the same.
const TAIL_BYTES: usize = 64;

#[derive(Debug, Default)]
struct Tail(Vec<u8>);

impl Tail {
    /// The bytes before a place of a file.
    fn before(file: &File, at: u64) -> io::Result<Self> {
        let bytes = at.min(TAIL_BYTES as u64);
        let mut tail = vec![0; bytes as usize];
        file.read_exact_at(&mut tail, at - bytes)?;
        Ok(Self(tail))
    }

    fn push(&mut self, bytes: &[u8]) {
        self.0.extend_from_slice(bytes.get(bytes.len().saturating_sub(TAIL_BYTES)..).unwrap_or_default());
        self.0.drain(..self.0.len().saturating_sub(TAIL_BYTES));
    }

    fn sum(&self) -> u32 {
        crc32fast::hash(&self.0)
    }

    /// Whether a line ended with them, or none has begun.
    fn is_line_end(&self) -> bool {
        self.0.last().is_none_or(|last| *last == b'\n')
    }
}

/// A file that grows. If the bytes before the next ones have changed, it was overwritten and gives no more bytes.
struct Followed {
    file: File,
    at: u64,
    tail: Tail,
}

impl Followed {
    fn is_written_over(&self) -> bool {
        Tail::before(&self.file, self.at).map_or(true, |tail| tail.0 != self.tail.0)
    }
}

impl Read for Followed {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.file.read_at(buffer, self.at)?;
        // Checked after reading, so that no overwrite can come between.
        if read == 0 || self.is_written_over() {
            return Ok(0);
        }
        self.tail.push(buffer.get(..read).unwrap_or_default());
        self.at += read as u64;
        Ok(read)
    }
}

fn is_at(file: &File, place: Place) -> io::Result<bool> {
    if file.metadata()?.ino() != place.file {
        return Ok(false);
    }
    let is_same = |tail: Tail| place.before.map_or_else(|| tail.is_line_end(), |sum| sum == tail.sum());
    match Tail::before(file, place.at) {
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(false),
        tail => tail.map(is_same),
    }
}

/// The file that was read up to this place, if a log rotation renamed it within its folder.
fn renamed(path: &Path, place: Place) -> Option<File> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let named = fs::read_dir(folder).ok()?.flatten().filter(|entry| entry.ino() == place.file);
    let mut files = named.filter_map(|entry| open_plain(File::options().read(true), &entry.path()).ok());
    files.find(|file| is_at(file, place).unwrap_or(false))
}

/// Opens a followed file at the place that was read, or at its end if that is unknown. A file that was renamed since is read first. Returns the
/// place.
fn follow(path: &Path, from: Option<Place>) -> io::Result<(BufReader<Followed>, Place)> {
    let mut file = open_plain(File::options().read(true), path)?;
    let at = match from {
        None => file.metadata()?.len(),
        Some(Place { at: 0, .. }) => 0,
        Some(from) if is_at(&file, from)? => from.at,
        Some(from) => match renamed(path, from) {
            Some(before) => {
                tracing::info!(path = %path.display(), "the input was renamed: what is left of it is read first");
                file = before;
                from.at
            }
            None => {
                tracing::warn!(path = %path.display(), "the input is not the file that it was: it is read from its start");
                0
            }
        },
    };
    let (tail, ino) = (Tail::before(&file, at)?, file.metadata()?.ino());
    let place = Place { file: ino, at, before: Some(tail.sum()) };
    Ok((BufReader::new(Followed { file, at, tail }), place))
}

enum Input {
    Stream(Box<dyn BufRead + Send>),
    Followed(BufReader<Followed>),
}

impl Input {
    /// Opens the input and returns its place; a file is followed from `from`. It is opened once: if a FIFO's reader leaves, its writer is killed and
    /// its line is lost.
    fn open(path: &Path, from: Option<Place>) -> io::Result<(Self, Place)> {
        if path.as_os_str() == "-" {
            return Ok((Self::Stream(Box::new(BufReader::new(io::stdin()))), Place::default()));
        }
        let kind = fs::metadata(path)?.file_type();
        // A folder could be opened, but not read.
        if kind.is_dir() {
            return Err(io::ErrorKind::IsADirectory.into());
        }
        if kind.is_file() {
            let (file, place) = follow(path, from)?;
            return Ok((Self::Followed(file), place));
        }
        // If the hub itself is a writer, the FIFO opens before another writer comes and does not end when the last one leaves.
        let stream = File::options().read(true).write(kind.is_fifo()).open(path)?;
        Ok((Self::Stream(Box::new(BufReader::new(stream))), Place::default()))
    }

    fn reader(&mut self) -> &mut dyn BufRead {
        match self {
            Self::Stream(stream) => stream,
            Self::Followed(file) => file,
        }
    }

    fn tail(&self) -> Tail {
        match self {
            Self::Stream(_) => Tail::default(),
            Self::Followed(file) => Tail(file.get_ref().tail.0.clone()),
        }
    }

    /// The silence after which a followed file is left, if it was replaced or overwritten.
    fn left_after(&self, path: &Path, place: Place) -> Option<Duration> {
        let Self::Followed(file) = self else { return None };
        // During a replacement the path may not exist.
        let about = fs::metadata(path).ok()?;
        if about.ino() == place.file {
            return file.get_ref().is_written_over().then_some(LOOK);
        }
        // While the new file is empty, its writer still has the old one.
        (about.len() > 0 || !about.is_file()).then_some(LEAVE)
    }
}

/// Reads lines until the input ends. A file that was overwritten or replaced is read from its start. An overlong line is cut and its rest skipped.
fn read_lines(path: &Path, opened: (Input, Place), lines: &SyncSender<Line>, stop: &Stop) -> io::Result<()> {
    let (mut input, mut place) = opened;
    let mut tail = input.tail();
    // If a file is read from its end, the first line may be the rest of one.
    let (mut text, mut is_rest, mut is_told) = (Vec::new(), !tail.is_line_end(), false);
    let mut silent_since = None::<Instant>;
    while !stop.requested() {
        let (had, left) = (text.len(), (LINE_BYTES_MAX + 1).saturating_sub(text.len() as u64).max(1));
        let read = input.reader().take(left).read_until(b'\n', &mut text)? as u64;
        tail.push(text.get(had..).unwrap_or_default());
        if read > 0 {
            silent_since = None;
        }
        place = Place { at: place.at + read, before: Some(tail.sum()), ..place };
        let is_whole = text.ends_with(b"\n");
        if is_whole || text.len() as u64 > LINE_BYTES_MAX {
            let text = std::mem::take(&mut text);
            if !std::mem::replace(&mut is_rest, !is_whole) && lines.send((text, place)).is_err() {
                return Ok(());
            }
        } else if read == 0 {
            if let Input::Stream(_) = input {
                if !text.is_empty() && !is_rest {
                    let _last = lines.send((text, place));
                }
                return Ok(());
            }
            let left_after = input.left_after(path, place);
            // Bytes that were written to the old file until now are read first.
            silent_since = left_after.map(|_| silent_since.unwrap_or_else(Instant::now));
            if left_after.zip(silent_since).is_some_and(|(silence, since)| since.elapsed() >= silence) {
                match follow(path, Some(Place::default())) {
                    Ok((file, start)) => {
                        // The last line of a replaced file gets no line end.
                        let is_left = left_after == Some(LEAVE);
                        if is_left && !text.is_empty() && !is_rest && lines.send((text, place)).is_err() {
                            return Ok(());
                        }
                        tracing::warn!(path = %path.display(), "the input was written over or is another file: it is read from its start");
                        (input, place, text, is_rest) = (Input::Followed(file), start, Vec::new(), false);
                        (tail, is_told, silent_since) = (Tail::default(), false, None);
                    }
                    Err(error) if !std::mem::replace(&mut is_told, true) => {
                        tracing::warn!(path = %path.display(), %error, "the input cannot be followed: it is waited for");
                    }
                    Err(_) => {}
                }
            }
            thread::sleep(LOOK);
        }
    }
    Ok(())
}

/// Runs until asked to stop, or until the input has ended and everything is confirmed. Returns how much of it every robot has.
///
/// # Errors
///
/// [`HubError`]. A router or robot that is away is no error.
pub fn run(config: &Config, input: &Path, stop: &Stop) -> Result<Outcome, HubError> {
    config.check_hub()?;
    let mut spool = Spool::open(&config.hub.spool, config.hub.keep)?;
    let failed = |source| HubError::Input { path: input.to_owned(), source };
    let opened = Input::open(input, spool.input()).map_err(failed)?;
    let (to_robots, heard) = sync_channel(HEARD_MAX);
    let link = Link::start(&config.router, declare(config, to_robots))?;
    let (to_spool, lines) = sync_channel::<Line>(LINES_MAX);
    let (path, reading) = (input.to_owned(), stop.clone());
    let reader = move || {
        let read = read_lines(&path, opened, &to_spool, &reading);
        if let Err(error) = &read {
            let path = path.display();
            tracing::error!(%path, %error, "the input cannot be read any more: what was read is still sent, then this hub ends");
        }
        read
    };
    let reader = thread::Builder::new().name("reader".to_owned()).spawn(reader).map_err(HubError::Thread)?;
    notify(&[NotifyState::Ready]);
    let mut hub = Hub::new(config, &mut spool);
    let mut ended = false;
    while !(stop.requested() || ended && hub.is_done(&spool)) {
        ended |= hub.keep(&lines, &mut spool)?;
        hub.hear(&heard, &mut spool)?;
        hub.send(&link, &mut spool);
        notify(&[NotifyState::Watchdog]);
    }
    notify(&[NotifyState::Stopping]);
    // A reader that waits for input ends with the process.
    if ended || reader.is_finished() {
        reader.join().map_err(|_| HubError::Panic { path: input.to_owned() })?.map_err(failed)?;
    }
    Ok(hub.outcome(&spool))
}

/// The result of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Outcome {
    /// The last number.
    pub last: u64,
    /// Every robot's daemon has processed the numbers up to this one.
    pub confirmed: u64,
    /// Lines that were not narration.
    pub refused: u64,
    /// Narrations missing from the scores of the robot that lost most: the hub could not keep them, its daemon dropped them, or the disk lost their
    /// numbers.
    pub lost: u64,
}

struct Robot {
    name: String,
    key: String,
    delivery: Delivery,
    rival: Rival,
    /// The number of the last explained event, if the robot reports how its daemon understood events.
    explained: Option<u64>,
    /// Whether the log has warned that the robot is not heard.
    is_told: bool,
    log: Limiter,
}

struct Hub {
    name: String,
    clock: Hex,
    robots: Vec<Robot>,
    started_ns: u64,
    refused: u64,
    log: Limiter,
    /// When every robot had confirmed the last line.
    done_ns: Option<u64>,
    /// Lines that the disk refused. They are saved before more lines are read.
    unsaved: Vec<Kept>,
}

impl Hub {
    fn new(config: &Config, spool: &mut Spool) -> Self {
        let robots = config.hub.robots.iter().map(|robot| {
            let key = Keys::new(&config.site.name, robot).narration(&config.hub.name);
            let delivery = Delivery::from(spool.first(), spool.last(), spool.confirmed());
            let (rival, log) = (Rival::default(), Limiter::default());
            Robot { name: robot.clone(), key, delivery, rival, explained: None, is_told: false, log }
        });
        let (refused, log, unsaved, started_ns) = (0, Limiter::default(), Vec::new(), clock::monotonic_ns());
        let (name, clock, robots) = (config.hub.name.clone(), Hex(clock_id()), robots.collect());
        // If an earlier start kept too many narrations, the excess counts as lost by this one.
        spool.trim();
        Self { name, clock, robots, started_ns, refused, log, done_ns: None, unsaved }
    }

    /// Saves the lines that have come; returns whether the input has ended.
    fn keep(&mut self, lines: &Receiver<Line>, spool: &mut Spool) -> Result<bool, HubError> {
        let mut ended = false;
        if self.unsaved.is_empty() {
            let first = match lines.recv_timeout(TICK) {
                Ok(first) => Some(first),
                Err(RecvTimeoutError::Timeout) => None,
                Err(RecvTimeoutError::Disconnected) => {
                    thread::sleep(TICK);
                    ended = true;
                    None
                }
            };
            for (bytes, at) in first.into_iter().chain(lines.try_iter().take(LINES_MAX)) {
                match Self::read(&bytes, at) {
                    Ok(dated) => self.unsaved.extend(dated),
                    Err(fault) => {
                        self.refused += 1;
                        if let Some(not_told) = self.log.pass("line", clock::monotonic_ns()) {
                            tracing::warn!(narrator = self.name, %fault, not_told, "a line is no narration");
                        }
                    }
                }
            }
        } else {
            thread::sleep(TICK);
        }
        if !self.unsaved.is_empty() {
            match spool.append(self.unsaved.clone()) {
                Ok(()) => self.unsaved.clear(),
                Err(error) => {
                    if let Some(not_told) = self.log.pass("not kept", clock::monotonic_ns()) {
                        tracing::error!(%error, not_told, "narration cannot be kept; the input waits");
                    }
                }
            }
        }
        Ok(ended)
    }

    fn read(bytes: &[u8], at: Place) -> Result<Option<Kept>, Fault> {
        let is_first = at.at == bytes.len() as u64;
        let read = line_of(bytes, is_first, clock::unix_ns())?;
        let dated =
            |(observation, Age { age_ns, ahead_ns })| Kept::new(observation, age_ns, Some(at)).with_ahead(ahead_ns);
        Ok(read.map(dated))
    }

    fn hear(&mut self, heard: &Receiver<(usize, Vec<u8>)>, spool: &mut Spool) -> Result<(), HubError> {
        for (robot, bytes) in heard.try_iter() {
            let Some(Robot { name, delivery, rival, explained, log, .. }) = self.robots.get_mut(robot) else {
                continue;
            };
            let now_ns = clock::monotonic_ns();
            if let Ok(understood) = wire::read::<Understood>(&bytes) {
                if understood.epoch.0 == spool.epoch() {
                    *explained = Some(print_understood(name, explained.unwrap_or(0), understood));
                }
                continue;
            }
            let said = match wire::read::<Said>(&bytes) {
                Ok(Said { confirmed, explains }) => {
                    if explains {
                        explained.get_or_insert(0);
                    }
                    confirmed
                }
                Err(fault) => {
                    if let Some(not_told) = log.pass("no confirmation", now_ns) {
                        tracing::warn!(robot = name, %fault, not_told, "no confirmation");
                    }
                    continue;
                }
            };
            match rival.hear(said.epoch.0, spool.epoch()) {
                Some(Order::Second) => return Err(HubError::Namesake(self.name.clone())),
                Some(Order::First) => {
                    if let Some(not_told) = log.pass("namesake", now_ns) {
                        tracing::error!(robot = name, not_told, "{NAMESAKE}");
                    }
                }
                None => {}
            }
            let refused = delivery.refused();
            delivery.hear(said, spool.epoch(), spool.last(), now_ns);
            if delivery.refused() > refused
                && let Some(not_told) = log.pass("dropped", now_ns)
            {
                let refused = delivery.refused();
                tracing::error!(
                    robot = name,
                    refused,
                    not_told,
                    "a robot has dropped narration: its bridge's log says why"
                );
            }
            if said.epoch.0 == spool.epoch() && said.next > spool.last() + 1 {
                self.number_on(robot, said, spool);
            }
        }
        Ok(())
    }

    /// Skips the numbers that a robot has and this spool lacks: the end of its file was lost.
    fn number_on(&mut self, robot: usize, said: Confirmed, spool: &mut Spool) {
        let numbered = spool.number_on(said.next);
        if let Ok(Some(_)) = numbered {
            self.robots.iter_mut().for_each(|robot| robot.delivery.given_before(spool.last()));
        }
        let Some(Robot { name, delivery, log, .. }) = self.robots.get_mut(robot) else { return };
        match numbered {
            Ok(Some(gone)) => {
                tracing::error!(
                    robot = name,
                    gone,
                    "the spool has lost its end: numbers go on behind those that a robot has; is the disk failing?"
                );
                delivery.hear(said, spool.epoch(), spool.last(), clock::monotonic_ns());
            }
            Ok(None) => {
                if let Some(not_told) = log.pass("far ahead", clock::monotonic_ns()) {
                    let (next, last) = (said.next, spool.last());
                    tracing::error!(
                        robot = name,
                        next,
                        last,
                        not_told,
                        "a robot expects a number far ahead of the spool, and does not take what comes: if the spool is an old copy, end this hub and empty the files narration.db and narration.db-wal in it"
                    );
                }
            }
            Err(error) => {
                if let Some(not_told) = log.pass("not passed over", clock::monotonic_ns()) {
                    tracing::error!(%error, not_told, "numbers that a robot has cannot be passed over");
                }
            }
        }
    }

    fn send(&mut self, link: &Link, spool: &mut Spool) {
        let last = spool.last();
        for Robot { name: robot, key, delivery, is_told, log, .. } in &mut self.robots {
            let waited_ns = clock::monotonic_ns().saturating_sub(self.started_ns);
            if !delivery.is_known()
                && waited_ns >= UNHEARD_NS
                && link.is_connected()
                && !std::mem::replace(is_told, true)
            {
                tracing::warn!(
                    robot,
                    "nothing is heard of this robot: does its bridge run, with this site's and robot's name, and this hub as a [[narrator]]?"
                );
            }
            let lost = delivery.lost();
            delivery.give_up_before(spool.first());
            if delivery.lost() > lost
                && let Some(not_told) = log.pass("away", clock::monotonic_ns())
            {
                let lost = delivery.lost();
                tracing::error!(robot, lost, not_told, "a robot was away for longer than narration is kept (hub.keep)");
            }
            while let Some(number) = delivery.next(last, clock::monotonic_ns())
                && let Some(kept) = spool.get(number)
            {
                let narrated = Narrated {
                    epoch: Hex(spool.epoch()),
                    sequence: number,
                    first: delivery.first(),
                    age_ns: spool.age_ns(kept),
                    ahead_ns: kept.ahead_ns,
                    sent_ns: clock::monotonic_ns(),
                    clock: self.clock,
                    observation: kept.observation.clone(),
                };
                let sent = serde_json::to_vec(&narrated).is_ok_and(|bytes| link.put(key, bytes));
                if !sent {
                    break;
                }
                delivery.sent(clock::monotonic_ns());
            }
        }
        let everywhere = self.robots.iter().map(|robot| robot.delivery.begin()).min().unwrap_or(0);
        if let Err(error) = spool.confirm(everywhere)
            && let Some(not_told) = self.log.pass("not forgotten", clock::monotonic_ns())
        {
            tracing::warn!(%error, not_told, "the spool stays longer than it has to be");
        }
    }

    fn is_done(&mut self, spool: &Spool) -> bool {
        if !self.unsaved.is_empty() || self.robots.iter().any(|robot| robot.delivery.begin() < spool.last()) {
            return false;
        }
        let now_ns = clock::monotonic_ns();
        let since_ns = *self.done_ns.get_or_insert(now_ns);
        let is_explained = |robot: &Robot| robot.explained.is_none_or(|last| last >= spool.last());
        self.robots.iter().all(is_explained) || now_ns.saturating_sub(since_ns) >= EXPLAINED_NS
    }

    fn outcome(&self, spool: &Spool) -> Outcome {
        let of_all = || self.robots.iter().map(|robot| &robot.delivery);
        Outcome {
            last: spool.last(),
            confirmed: of_all().map(Delivery::confirmed).min().unwrap_or(0),
            refused: self.refused,
            lost: of_all().map(|delivery| delivery.lost().saturating_add(delivery.refused())).max().unwrap_or(0),
        }
    }
}

/// Prints how a robot understood the events after `last`, one line of JSON each; returns the number of the last one.
fn print_understood(robot: &str, mut last: u64, Understood { understood, .. }: Understood) -> u64 {
    for mut line in understood {
        let number = line.get("sequence").and_then(serde_json::Value::as_u64).unwrap_or(0);
        if number > last {
            last = number;
            line.insert("robot".to_owned(), robot.into());
            // Standard output may be closed.
            let _printed = writeln!(io::stdout(), "{}", serde_json::Value::Object(line));
        }
    }
    last
}

fn declare(config: &Config, heard: SyncSender<(usize, Vec<u8>)>) -> Declare {
    let config = config.clone();
    Box::new(move |session: &Session| {
        let mut declared: Vec<Box<dyn Any + Send>> = Vec::new();
        for (number, robot) in config.hub.robots.iter().enumerate() {
            let heard = heard.clone();
            let take = move |sample: Sample| {
                if sample.payload().len() <= wire::BYTES_MAX {
                    let _said_again = heard.try_send((number, sample.payload().to_bytes().into_owned()));
                }
            };
            let key = Keys::new(&config.site.name, robot).confirmed(&config.hub.name);
            declared.push(Box::new(session.declare_subscriber(key).callback(take).wait()?));
        }
        Ok(declared)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    struct Reading {
        lines: Receiver<Line>,
        stop: Stop,
        thread: Option<thread::JoinHandle<io::Result<()>>>,
    }

    impl Reading {
        fn start(path: &Path, from: Option<Place>) -> Self {
            let (to, lines) = sync_channel(16);
            let stop = Stop::default();
            let (path, reading, opened) = (path.to_owned(), stop.clone(), Input::open(path, from).unwrap());
            let thread = Some(thread::spawn(move || read_lines(&path, opened, &to, &reading)));
            Self { lines, stop, thread }
        }

        fn heard(&self) -> Line {
            self.lines.recv_timeout(Duration::from_secs(60)).unwrap()
        }

        fn text(&self) -> String {
            String::from_utf8(self.heard().0).unwrap()
        }
    }

    impl Drop for Reading {
        fn drop(&mut self) {
            self.stop.request();
            self.thread.take().unwrap().join().unwrap().unwrap();
        }
    }

    fn ino(path: &Path) -> u64 {
        fs::metadata(path).unwrap().ino()
    }

    fn behind(file: u64, text: &str) -> Place {
        let mut tail = Tail::default();
        tail.push(text.as_bytes());
        Place { file, at: text.len() as u64, before: Some(tail.sum()) }
    }

    fn append(path: &Path, text: &[u8]) {
        File::options().append(true).open(path).unwrap().write_all(text).unwrap();
    }

    #[test]
    fn a_file_is_followed_from_a_place() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        fs::write(&path, "one\ntwo\nthr").unwrap();
        let file = ino(&path);
        let reading = Reading::start(&path, Some(behind(file, "one\n")));
        assert_eq!(reading.heard(), (b"two\n".to_vec(), behind(file, "one\ntwo\n")));
        append(&path, b"ee\n");
        assert_eq!(reading.heard(), (b"three\n".to_vec(), behind(file, "one\ntwo\nthree\n")));
        fs::write(&path, "new\n").unwrap();
        assert_eq!(reading.heard(), (b"new\n".to_vec(), behind(file, "new\n")));
        // The file is replaced by a longer one.
        fs::rename(&path, folder.path().join("old")).unwrap();
        fs::write(&path, "another\n").unwrap();
        assert_eq!(reading.heard(), (b"another\n".to_vec(), behind(ino(&path), "another\n")));
        // The rest of an overlong line is not a line.
        append(&path, &[vec![b'x'; 3 * LINE_BYTES_MAX as usize], b"\nlast\n".to_vec()].concat());
        assert_eq!(reading.heard().0.len() as u64, LINE_BYTES_MAX + 1);
        assert_eq!(reading.text(), "last\n");
    }

    /// Half a sentence can mean something else.
    #[test]
    fn a_file_that_is_written_over_by_a_longer_one_is_read_from_its_start() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        fs::write(&path, "Ada sits down.\nAda gets").unwrap();
        let reading = Reading::start(&path, Some(Place::default()));
        assert_eq!(reading.text(), "Ada sits down.\n");
        // In one write, so that the file never looks shorter.
        let over = b"Ben opens the door of the big wardrobe.\nBen grabs the milk.\n";
        File::options().write(true).open(&path).unwrap().write_all_at(over, 0).unwrap();
        assert_eq!(reading.text(), "Ben opens the door of the big wardrobe.\n");
        assert_eq!(reading.text(), "Ben grabs the milk.\n");
    }

    #[test]
    fn a_file_that_is_not_what_it_was_is_read_from_its_start() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        fs::write(&path, "one\ntwo\n").unwrap();
        let file = ino(&path);
        let begins = |from| follow(&path, from).unwrap().1.at;
        assert_eq!(begins(Some(behind(file, "one\n"))), 4);
        assert_eq!(begins(Some(Place { before: None, ..behind(file, "one\n") })), 4, "a spool of before");
        for other in [
            behind(file + 1, "one\n"),
            behind(file, "six\n"),
            behind(file, "one\ntwo\nthree\n"),
            Place { before: None, ..behind(file, "one\nt") },
        ] {
            assert_eq!(begins(Some(other)), 0, "{other:?}");
        }
        assert_eq!(begins(None), 8);
    }

    /// If the place is unknown, a line may have begun before the end.
    #[test]
    fn the_rest_of_a_line_of_which_nobody_knows_the_beginning_is_no_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        fs::write(&path, "Ada sits down.\nAda does not le").unwrap();
        let reading = Reading::start(&path, None);
        append(&path, b"ave.\n");
        let first = loop {
            append(&path, b"Ben sits down.\n");
            if let Ok((line, _)) = reading.lines.recv_timeout(Duration::from_millis(200)) {
                break line;
            }
        };
        assert_eq!(first, b"Ben sits down.\n");
    }

    #[test]
    fn a_tail_is_the_last_bytes() {
        let mut tail = Tail::default();
        assert!(tail.is_line_end(), "no line has begun");
        for (bytes, is_line_end) in [(vec![b'x'; 200], false), (b"y".to_vec(), false), (b"\n".to_vec(), true)] {
            tail.push(&bytes);
            assert_eq!((tail.0.len(), tail.is_line_end()), (TAIL_BYTES, is_line_end));
        }
        assert!(tail.0.ends_with(b"xxy\n"));
    }

    /// The log was rotated while the hub was away, and had unread lines.
    #[test]
    fn a_file_that_was_renamed_is_read_to_its_end_first() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        fs::write(&path, "one\ntwo\nthree\n").unwrap();
        let from = behind(ino(&path), "one\n");
        fs::rename(&path, folder.path().join("lines.1")).unwrap();
        fs::write(&path, "four\n").unwrap();
        let reading = Reading::start(&path, Some(from));
        assert_eq!([(); 3].map(|()| reading.text()), ["two\n", "three\n", "four\n"]);
    }

    /// A log's writer uses the old file until it learns of the new one.
    #[test]
    fn what_is_written_to_a_file_after_it_was_renamed_is_read_before_the_new_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        fs::write(&path, "").unwrap();
        let mut writer = File::options().append(true).open(&path).unwrap();
        let reading = Reading::start(&path, Some(Place::default()));
        fs::rename(&path, folder.path().join("lines.1")).unwrap();
        fs::write(&path, "").unwrap();
        for late in ["one\n", "two\n", "three\n"] {
            // Longer than several checks: the reader must stay with the old file.
            thread::sleep(4 * LOOK);
            writer.write_all(late.as_bytes()).unwrap();
            assert_eq!(reading.text(), late);
        }
        writer.write_all(b"four\n").unwrap();
        append(&path, b"five\n");
        assert_eq!([(); 2].map(|()| reading.text()), ["four\n", "five\n"]);
    }

    #[test]
    fn the_last_line_of_a_file_that_was_renamed_needs_no_end() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        fs::write(&path, "one\ntwo").unwrap();
        let reading = Reading::start(&path, Some(Place::default()));
        assert_eq!(reading.text(), "one\n");
        fs::rename(&path, folder.path().join("lines.1")).unwrap();
        fs::write(&path, "three\n").unwrap();
        assert_eq!([(); 2].map(|()| reading.text()), ["two", "three\n"]);
    }

    #[test]
    fn a_fifo_is_read_from_its_first_writer_on_and_waits_for_none() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        rustix::fs::mkfifoat(rustix::fs::CWD, &path, rustix::fs::Mode::from_raw_mode(0o600)).unwrap();
        let reading = Reading::start(&path, None);
        for line in ["They sit.\n", "They stand up.\n"] {
            append(&path, line.as_bytes());
            assert_eq!(reading.text(), line);
        }
        // The reader is not at the end of the file: it checks for a stop after a line.
        reading.stop.request();
        append(&path, b"They leave.\n");
    }

    /// Reading a folder fails, and opening a FIFO waits for its other end.
    #[test]
    fn what_is_no_plain_file_is_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        fs::create_dir(&path).unwrap();
        let refused = || follow(&path, Some(Place::default())).err().unwrap().to_string();
        assert!(refused().contains("no plain file"));
        fs::remove_dir(&path).unwrap();
        let mode = rustix::fs::Mode::from_raw_mode(0o600);
        rustix::fs::mkfifoat(rustix::fs::CWD, &path, mode).unwrap();
        assert!(refused().contains("no plain file"));
    }

    #[test]
    fn a_folder_is_no_input() {
        let folder = tempfile::tempdir().unwrap();
        let source = Input::open(folder.path(), None).err().unwrap();
        assert!(HubError::Input { path: folder.path().to_owned(), source }.is_of_configuration());
    }

    /// Regression: they counted as confirmed, though no robot was ever there.
    #[test]
    fn what_is_kept_no_more_after_a_start_is_lost_and_not_confirmed() {
        let folder = tempfile::tempdir().unwrap();
        let mut config = Config::default();
        config.hub.robots = vec!["robot-1".to_owned()];
        let outcomes = [1000, 100, 1000].map(|keep| {
            let mut spool = Spool::open(folder.path(), keep).unwrap();
            if spool.last() == 0 {
                let dated = || Hub::read(b"They sit.\n", Place::default()).unwrap().unwrap();
                spool.append((0..300).map(|_| dated()).collect()).unwrap();
            }
            let mut hub = Hub::new(&config, &mut spool);
            // As after a send.
            hub.robots[0].delivery.give_up_before(spool.first());
            spool.confirm(hub.robots[0].delivery.begin()).unwrap();
            hub.outcome(&spool)
        });
        let outcome = |lost| Outcome { last: 300, confirmed: 0, refused: 0, lost };
        assert_eq!(outcomes, [outcome(0), outcome(200), outcome(0)]);
    }

    #[test]
    fn a_mark_before_the_first_line_is_no_part_of_it() {
        let text = "\u{feff}They sit.\n";
        assert!(Hub::read(text.as_bytes(), behind(1, text)).unwrap().is_some());
        Hub::read(text.as_bytes(), behind(1, &format!("One.\n{text}"))).unwrap_err();
    }
}
