//! A hub: lines of narration of this machine, kept on disk until every robot has confirmed them.

use std::any::Any;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread;
use std::time::Duration;

use roomcast_ipc::clock;
use sd_notify::NotifyState;
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use crate::config::{Config, ConfigError};
use crate::delay::clock_id;
use crate::delivery::Delivery;
use crate::keys::Keys;
use crate::limiter::Limiter;
use crate::line::{LINE_BYTES_MAX, line_of};
use crate::link::{Declare, Link, LinkError};
use crate::robot::notify;
use crate::spool::{Dated, Place, Spool, SpoolError};
use crate::stop::Stop;
use crate::wire::{self, Confirmed, Fault, Hex, Narrated};

/// Lines that wait to be kept; the input waits then.
const LINES_MAX: usize = 256;
/// Words of robots that wait to be looked at; more are dropped, and said again.
const HEARD_MAX: usize = 64;
const TICK: Duration = Duration::from_millis(20);

/// Why a hub ends.
#[derive(Debug, thiserror::Error)]
pub enum HubError {
    /// The configuration.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The way to the router.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// What is kept.
    #[error(transparent)]
    Spool(#[from] SpoolError),
    /// The input.
    #[error("cannot read {path}: {source}")]
    Input {
        /// The file.
        path: PathBuf,
        /// The system's word.
        source: io::Error,
    },
    /// The thread that reads the input.
    #[error("the program has a fault: what reads {path} has ended by a panic, which the log has")]
    Panic {
        /// The file.
        path: PathBuf,
    },
    /// The system gives no thread.
    #[error("cannot start a thread: {0}; is a limit on tasks set too low?")]
    Thread(io::Error),
}

/// A robot that was not heard for so long since the start is told of.
const UNHEARD_NS: u64 = 15_000_000_000;

/// A line that was read, up to this place of the input.
type Line = (Vec<u8>, Place);

/// Opens a file that is followed, behind what was read of it; at its end where nobody knows how much that was. Gives where it is.
fn follow(path: &Path, from: Option<Place>) -> io::Result<(BufReader<File>, Place)> {
    let mut file = File::open(path)?;
    let about = file.metadata()?;
    let at = match from {
        None => about.len(),
        Some(Place { at: 0, .. }) => 0,
        Some(from) => {
            let mut before = [0];
            let is_same = from.file == about.ino() && from.at <= about.len() && {
                file.seek(SeekFrom::Start(from.at - 1))?;
                file.read_exact(&mut before)?;
                before == *b"\n"
            };
            if !is_same {
                tracing::warn!(path = %path.display(), "the input is not the file that it was: it is read from its start");
            }
            if is_same { from.at } else { 0 }
        }
    };
    file.seek(SeekFrom::Start(at))?;
    Ok((BufReader::new(file), Place { file: about.ino(), at }))
}

/// Reads lines until the input ends. A file that grows is followed from `from`; of one that became shorter or was replaced, from its start.
/// Of a line that is too long the beginning is given, and the rest passed over.
fn read_lines(path: &Path, from: Option<Place>, lines: &SyncSender<Line>, stop: &Stop) -> io::Result<()> {
    let standard = path.as_os_str() == "-";
    let is_file = !standard && std::fs::metadata(path)?.is_file();
    let fifo = !standard && std::fs::metadata(path)?.file_type().is_fifo();
    let mut place = Place::default();
    let mut input: Box<dyn BufRead> = if standard {
        Box::new(BufReader::new(io::stdin()))
    } else if is_file {
        let (file, at) = follow(path, from)?;
        place = at;
        Box::new(file)
    } else {
        // With a writer of its own a FIFO does not end when the last other writer leaves.
        Box::new(BufReader::new(File::options().read(true).write(fifo).open(path)?))
    };
    let (mut text, mut is_rest, mut was_other) = (Vec::new(), false, false);
    while !stop.requested() {
        let left = (LINE_BYTES_MAX + 1).saturating_sub(text.len() as u64).max(1);
        let read = input.by_ref().take(left).read_until(b'\n', &mut text)? as u64;
        place.at += read;
        let is_whole = text.ends_with(b"\n");
        if is_whole || text.len() as u64 > LINE_BYTES_MAX {
            let text = std::mem::take(&mut text);
            if !std::mem::replace(&mut is_rest, !is_whole) && lines.send((text, place)).is_err() {
                return Ok(());
            }
        } else if read == 0 {
            if !is_file {
                if !text.is_empty() && !is_rest {
                    let _last = lines.send((text, place));
                }
                return Ok(());
            }
            // While it is being replaced there may be none.
            let is_other =
                std::fs::metadata(path).is_ok_and(|about| about.ino() != place.file || about.len() < place.at);
            // What was written to the old one until now is read first.
            if is_other
                && was_other
                && let Ok((file, start)) = follow(path, Some(Place::default()))
            {
                tracing::warn!(path = %path.display(), "the input became shorter or is another file: it is read from its start");
                (input, place, text, is_rest) = (Box::new(file), start, Vec::new(), false);
            }
            was_other = is_other;
            thread::sleep(Duration::from_millis(50));
        }
    }
    Ok(())
}

/// Runs until asked to stop, or until the input has ended and everything is confirmed. Gives how much of it every robot has.
///
/// # Errors
///
/// [`HubError`]; a router or robot that is away is none.
pub fn run(config: &Config, input: &Path, stop: &Stop) -> Result<Outcome, HubError> {
    config.check_hub()?;
    let mut spool = Spool::open(&config.hub.spool, config.hub.keep)?;
    let failed = |source| HubError::Input { path: input.to_owned(), source };
    if input.as_os_str() != "-" {
        File::options().read(true).open(input).map(drop).map_err(failed)?;
    }
    let (to_robots, heard) = sync_channel(HEARD_MAX);
    let link = Link::start(&config.router, declare(config, to_robots))?;
    let (to_spool, lines) = sync_channel::<Line>(LINES_MAX);
    let (path, from, reading) = (input.to_owned(), spool.input(), stop.clone());
    let reader = move || {
        let read = read_lines(&path, from, &to_spool, &reading);
        if let Err(error) = &read {
            let path = path.display();
            tracing::error!(%path, %error, "the input cannot be read any more: what was read is still sent, then this hub ends");
        }
        read
    };
    let reader = thread::Builder::new().name("reader".to_owned()).spawn(reader).map_err(HubError::Thread)?;
    notify(&[NotifyState::Ready]);
    let mut hub = Hub::new(config, &spool);
    let mut ended = false;
    while !(stop.requested() || ended && hub.is_done(&spool)) {
        ended |= hub.keep(&lines, &mut spool)?;
        hub.hear(&heard, &mut spool);
        hub.send(&link, &mut spool);
        notify(&[NotifyState::Watchdog]);
    }
    notify(&[NotifyState::Stopping]);
    // One that waits for input ends with the process.
    if ended || reader.is_finished() {
        reader.join().map_err(|_| HubError::Panic { path: input.to_owned() })?.map_err(failed)?;
    }
    Ok(hub.outcome(&spool))
}

/// What became of the narration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Outcome {
    /// The last number.
    pub last: u64,
    /// Up to this number every robot's daemon has dealt with it.
    pub confirmed: u64,
    /// Lines that were no narration.
    pub refused: u64,
    /// Narrations that a robot has not in its scores, of the robot that lost most: they were too many to keep, its daemon dropped them, or the
    /// disk lost which numbers they had.
    pub lost: u64,
}

struct Robot {
    name: String,
    key: String,
    delivery: Delivery,
    /// It was told that nothing is heard of it.
    is_told: bool,
}

struct Hub {
    name: String,
    clock: Hex,
    robots: Vec<Robot>,
    started_ns: u64,
    refused: u64,
    log: Limiter,
    /// The disk failed, so nothing more is read for a moment.
    unsaved: Vec<Dated>,
}

impl Hub {
    fn new(config: &Config, spool: &Spool) -> Self {
        let robots = config.hub.robots.iter().map(|robot| {
            let key = Keys::new(&config.site.name, robot).narration(&config.hub.name);
            let delivery = Delivery::from(spool.first(), spool.last());
            Robot { name: robot.clone(), key, delivery, is_told: false }
        });
        let (refused, log, unsaved, started_ns) = (0, Limiter::default(), Vec::new(), clock::monotonic_ns());
        let (name, clock, robots) = (config.hub.name.clone(), Hex(clock_id()), robots.collect());
        Self { name, clock, robots, started_ns, refused, log, unsaved }
    }

    /// Keeps the lines that have come; whether the input has ended.
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
                        if let Some(held_back) = self.log.pass(clock::monotonic_ns()) {
                            tracing::warn!(narrator = self.name, %fault, held_back, "a line is no narration");
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
                    if let Some(held_back) = self.log.pass(clock::monotonic_ns()) {
                        tracing::error!(%error, held_back, "narration cannot be kept; the input waits");
                    }
                }
            }
        }
        Ok(ended)
    }

    fn read(bytes: &[u8], at: Place) -> Result<Option<Dated>, Fault> {
        let is_first = at.at == bytes.len() as u64;
        let read = line_of(bytes, is_first, clock::unix_ns())?;
        Ok(read.map(|(observation, age_ns)| Dated::new(observation, age_ns, at)))
    }

    /// Takes what robots say of how far they are.
    fn hear(&mut self, heard: &Receiver<(usize, Vec<u8>)>, spool: &mut Spool) {
        for (robot, bytes) in heard.try_iter() {
            let Some(Robot { name, delivery, .. }) = self.robots.get_mut(robot) else { continue };
            let now_ns = clock::monotonic_ns();
            let said = match wire::read::<Confirmed>(&bytes) {
                Ok(said) => said,
                Err(fault) => {
                    if let Some(held_back) = self.log.pass(now_ns) {
                        tracing::warn!(robot = name, %fault, held_back, "no confirmation");
                    }
                    continue;
                }
            };
            let refused = delivery.refused();
            delivery.hear(said, spool.epoch(), spool.last(), now_ns);
            if delivery.refused() > refused
                && let Some(held_back) = self.log.pass(now_ns)
            {
                let refused = delivery.refused();
                tracing::error!(
                    robot = name,
                    refused,
                    held_back,
                    "a robot has dropped narration: its bridge's log says why"
                );
            }
            if said.epoch.0 == spool.epoch() && said.next > spool.last() + 1 {
                self.number_on(robot, said, spool);
            }
        }
    }

    /// A robot has numbers that this spool has not: its end was lost.
    fn number_on(&mut self, robot: usize, said: Confirmed, spool: &mut Spool) {
        let name = self.robots.get(robot).map_or("", |robot| robot.name.as_str()).to_owned();
        let numbered = spool.number_on(said.next);
        match numbered {
            Ok(Some(gone)) => {
                tracing::error!(
                    robot = name,
                    gone,
                    "the spool has lost its end: numbers go on behind those that a robot has; is the disk failing?"
                );
                for Robot { delivery, .. } in &mut self.robots {
                    delivery.given_before(spool.last());
                }
                if let Some(Robot { delivery, .. }) = self.robots.get_mut(robot) {
                    delivery.hear(said, spool.epoch(), spool.last(), clock::monotonic_ns());
                }
            }
            Ok(None) => {
                if let Some(held_back) = self.log.pass(clock::monotonic_ns()) {
                    let (next, last) = (said.next, spool.last());
                    tracing::error!(
                        robot = name,
                        next,
                        last,
                        held_back,
                        "a robot expects a number far ahead of the spool, and does not take what comes: where the spool is an old copy, remove it"
                    );
                }
            }
            Err(error) => {
                if let Some(held_back) = self.log.pass(clock::monotonic_ns()) {
                    tracing::error!(%error, held_back, "numbers that a robot has cannot be passed over");
                }
            }
        }
    }

    /// Sends what may be sent, and forgets what every robot has.
    fn send(&mut self, link: &Link, spool: &mut Spool) {
        let last = spool.last();
        for Robot { name: robot, key, delivery, is_told } in &mut self.robots {
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
                && let Some(held_back) = self.log.pass(clock::monotonic_ns())
            {
                let lost = delivery.lost();
                tracing::error!(
                    robot,
                    lost,
                    held_back,
                    "a robot was away for longer than narration is kept (hub.keep)"
                );
            }
            while let Some(number) = delivery.next(last, clock::monotonic_ns())
                && let Some(kept) = spool.get(number)
            {
                let narrated = Narrated {
                    epoch: Hex(spool.epoch()),
                    sequence: number,
                    first: delivery.first(),
                    age_ns: spool.age_ns(kept),
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
            && let Some(held_back) = self.log.pass(clock::monotonic_ns())
        {
            tracing::warn!(%error, held_back, "the spool stays longer than it has to be");
        }
    }

    fn is_done(&self, spool: &Spool) -> bool {
        self.unsaved.is_empty() && self.robots.iter().all(|robot| robot.delivery.begin() >= spool.last())
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

    #[test]
    fn a_file_is_followed_from_a_place() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        std::fs::write(&path, "one\ntwo\nthr").unwrap();
        let (to, lines) = sync_channel(16);
        let stop = Stop::default();
        let (own, reading) = (path.clone(), stop.clone());
        let file = std::fs::metadata(&path).unwrap().ino();
        let thread = thread::spawn(move || read_lines(&own, Some(Place { file, at: 4 }), &to, &reading));
        let heard = || lines.recv_timeout(Duration::from_secs(60)).unwrap();
        assert_eq!(heard(), (b"two\n".to_vec(), Place { file, at: 8 }));
        let append = |text: &[u8]| File::options().append(true).open(&path).unwrap().write_all(text).unwrap();
        append(b"ee\n");
        assert_eq!(heard(), (b"three\n".to_vec(), Place { file, at: 14 }));
        std::fs::write(&path, "new\n").unwrap();
        assert_eq!(heard(), (b"new\n".to_vec(), Place { file, at: 4 }));
        // It is replaced by a longer one.
        std::fs::rename(&path, folder.path().join("old")).unwrap();
        std::fs::write(&path, "another\n").unwrap();
        let another = std::fs::metadata(&path).unwrap().ino();
        assert_eq!(heard(), (b"another\n".to_vec(), Place { file: another, at: 8 }));
        // The rest of a line that is too long is no line.
        append(&[vec![b'x'; 3 * LINE_BYTES_MAX as usize], b"\nlast\n".to_vec()].concat());
        assert_eq!(heard().0.len() as u64, LINE_BYTES_MAX + 1);
        assert_eq!(heard().0, b"last\n");
        stop.request();
        thread.join().unwrap().unwrap();
    }

    #[test]
    fn a_file_that_is_not_what_it_was_is_read_from_its_start() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        std::fs::write(&path, "one\ntwo\n").unwrap();
        let file = std::fs::metadata(&path).unwrap().ino();
        let begins = |from| follow(&path, from).unwrap().1;
        assert_eq!(begins(Some(Place { file, at: 4 })), Place { file, at: 4 });
        for other in [Place { file: file + 1, at: 4 }, Place { file, at: 5 }, Place { file, at: 9 }] {
            assert_eq!(begins(Some(other)), Place { file, at: 0 });
        }
        assert_eq!(begins(None), Place { file, at: 8 });
    }

    #[test]
    fn a_mark_before_the_first_line_is_no_part_of_it() {
        let text = "\u{feff}They sit.\n".as_bytes();
        let at = text.len() as u64;
        assert!(Hub::read(text, Place { file: 1, at }).unwrap().is_some());
        Hub::read(text, Place { file: 1, at: at + 5 }).unwrap_err();
    }
}
