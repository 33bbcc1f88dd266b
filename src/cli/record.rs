//! `roomcast record`: records the messages of all services into an MCAP file.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, bounded};
use roomcast_core::ids::BootNs;
use roomcast_ipc::raw::{IncludedV1, score_flags};
use roomcast_ipc::{Node, limits, question};
use roomcast_services::clock;

use super::choice::choice;
use super::flow::Subscribers;
use super::top::{SILENCE, silence};
use super::{CommandResult, Failure, count, ranges, service};
use roomcast_services::logging::Limiter;
use roomcast_services::moment::Moment;
use roomcast_services::recording::ros2::Ros2Recorder;
use roomcast_services::recording::{self, Profile, Received, Recorded, Recorder, Recording, RecordingError};

use crate::decided::{Decided, News};

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    /// The file to write; it must not exist yet.
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// The format of the file.
    #[arg(long, value_parser = choice::<Profile>(), default_value_t)]
    profile: Profile,
    /// Record scores and forecasts that the daemon only repeats, too.
    #[arg(long)]
    heartbeats: bool,
    /// Stop after so many seconds; without it, at ctrl-C.
    #[arg(long, value_name = "SECONDS", value_parser = ranges::some())]
    seconds: Option<u64>,
}

/// Period of reading the services. Room scores have a buffer of 2, and may arrive a few milliseconds apart.
const POLL: Duration = Duration::from_millis(2);
/// Period of flushing the file: a crash loses at most this much.
const FLUSH: Duration = Duration::from_secs(5);
/// Forecasts of the same scores are recorded once a minute. All of them would be 5 GiB a day.
const FORECAST_NS: u64 = 60_000_000_000;
/// Timeout of the daemon's answer, and of the last one.
const PATIENCE: Duration = Duration::from_secs(5);
const LAST: Duration = Duration::from_secs(2);

/// Period of the warning that answers are missing.
const COMPLAINT_NS: u64 = 60_000_000_000;

/// Reads a recording; says so if its recorder did not finish it.
pub(super) fn read(path: &Path) -> Result<Recording, Failure> {
    read_until(path, &|| false)
}

/// As [`read`], until a stop is requested.
pub(super) fn read_until(path: &Path, is_stopped: &dyn Fn() -> bool) -> Result<Recording, Failure> {
    let recording = recording::read_until(path, is_stopped).map_err(|error| match error {
        RecordingError::Stopped { .. } => Failure::interrupted(error),
        _ => Failure::input(error),
    })?;
    if recording.is_torn {
        tell_torn(path, &format!(", {}", count(recording.messages.len(), "message")));
    }
    Ok(recording)
}

/// Says that a recorder was killed.
pub(super) fn tell_torn(path: &Path, read: &str) {
    let path = path.display();
    super::tell(format_args!(
        "{path} ends within a record, as of a recorder that was killed: what comes before is read{read}"
    ));
}

enum Output {
    Roomcast(Box<Recorder>),
    Ros2(Box<Ros2Recorder>),
}

impl Output {
    fn create(args: &Args, robot: &str) -> Result<Self, RecordingError> {
        Ok(match args.profile {
            Profile::Roomcast => Self::Roomcast(Box::new(Recorder::create(&args.file)?)),
            Profile::Ros2 => Self::Ros2(Box::new(Ros2Recorder::create(&args.file, robot)?)),
        })
    }

    fn write(&mut self, message: &Recorded, received: Received) -> Result<(), RecordingError> {
        match self {
            Self::Roomcast(recorder) => recorder.write(message, received),
            Self::Ros2(recorder) => recorder.write(message, received),
        }
    }

    fn tell(&mut self, moment: &Moment, received: Received) -> Result<(), RecordingError> {
        match self {
            Self::Roomcast(recorder) => recorder.keep(moment, received),
            Self::Ros2(recorder) => recorder.tell(moment),
        }
    }

    fn flush(&mut self) -> Result<(), RecordingError> {
        match self {
            Self::Roomcast(recorder) => recorder.flush(),
            Self::Ros2(recorder) => recorder.flush(),
        }
    }

    /// Finishes the file; returns its number of messages.
    fn finish(&mut self) -> Result<u64, RecordingError> {
        match self {
            Self::Roomcast(recorder) => recorder.finish().map(|()| recorder.written()),
            Self::Ros2(recorder) => recorder.finish().map(|()| recorder.written()),
        }
    }
}

/// Asks the daemon for the data behind its newest scores. A thread asks, so that no message is missed.
struct Moments {
    ask: Sender<()>,
    told: Receiver<Result<Moment, String>>,
    /// The newest scores, the scores that were asked for, and those of the last answer.
    newest: Option<Name>,
    asked: Option<Name>,
    known: Option<Name>,
    log: Limiter,
}

impl Moments {
    fn start(node: &Node) -> Result<Self, Failure> {
        let port = node.question_port(question::MOMENT)?;
        let (ask, asked) = bounded(1);
        let (tell, told) = bounded(1);
        let asking = move || {
            while asked.recv().is_ok() {
                let moment = port.ask("{}", PATIENCE).map_err(|error| error.to_string());
                let moment = moment.and_then(|text| Moment::from_json(&text).map_err(|error| error.to_string()));
                if tell.send(moment).is_err() {
                    break;
                }
            }
        };
        std::thread::Builder::new().name("moments".to_owned()).spawn(asking).map_err(|error| {
            let text = format!("cannot start the thread that asks the daemon: {error}; {}", limits::on_threads());
            Failure::failed(text)
        })?;
        Ok(Self { ask, told, newest: None, asked: None, known: None, log: Limiter::new(COMPLAINT_NS) })
    }

    /// Asks about the newest scores, one question at a time. Returns whether an answer is missing.
    fn ask(&mut self) -> bool {
        if self.asked.is_none() && self.newest != self.known && self.ask.try_send(()).is_ok() {
            self.asked = self.newest;
        }
        self.asked.is_some()
    }

    fn hear(&mut self, patience: Duration) -> Option<Moment> {
        let answer = self.told.recv_timeout(patience).ok()?;
        let asked = self.asked.take();
        match answer {
            Ok(moment) => {
                let epoch = u64::from_str_radix(&moment.epoch, 16).unwrap_or_default();
                self.known = Some((epoch, moment.sequence));
                // The daemon is ahead of its messages. Steps in between have no moment of their own.
                if self.newest.is_some_and(|newest| newest.0 == epoch && newest.1 < moment.sequence) {
                    self.newest = self.known;
                }
                Some(moment)
            }
            Err(error) => {
                self.known = asked;
                if let Some(not_told) = self.log.pass(clock::monotonic_ns()) {
                    tracing::warn!(
                        error,
                        not_told,
                        "the daemon gave no data behind its scores: they cannot be explained"
                    );
                }
                None
            }
        }
    }
}

/// A publisher's start, and the number of its message.
type Name = (u64, u64);

/// The last recorded messages of services that repeat them.
#[derive(Debug, Default)]
struct Known {
    scores: Option<(Name, u32, Vec<IncludedV1>)>,
    persons: Option<Name>,
    forecast: Forecasts,
    person_forecasts: Forecasts,
    decided: Decided,
}

impl Known {
    fn repeats(&mut self, message: &Recorded, now_ns: BootNs) -> bool {
        match message {
            // Scores with new flags or confirmations are new: the journal has more now, or the scorer has failed.
            Recorded::RoomScores(scores) => {
                let flags = scores.flags & !score_flags::HEARTBEAT;
                let said = Some(((scores.epoch, scores.sequence), flags, scores.included().to_vec()));
                let is_same = said == self.scores;
                self.scores = said;
                is_same && scores.has(score_flags::HEARTBEAT)
            }
            Recorded::PersonScores(scores) => {
                let name = Some((scores.epoch, scores.sequence));
                std::mem::replace(&mut self.persons, name) == name
            }
            Recorded::Forecast(forecast) => self.forecast.repeats((forecast.epoch, forecast.sequence), now_ns),
            Recorded::PersonForecasts(forecasts) => {
                self.person_forecasts.repeats((forecasts.epoch, forecasts.sequence), now_ns)
            }
            // A bridge sends other robots' decisions again to new subscribers.
            Recorded::Decision(decision) => self.decided.take(decision) == News::None,
            Recorded::Narration(_) | Recorded::RobotReport(_) => false,
        }
    }
}

/// Forecasts change a little with time, so forecasts of the same scores are recorded once a minute.
#[derive(Debug, Default)]
struct Forecasts {
    last: Option<Name>,
    /// When the minute began.
    minute_ns: Option<BootNs>,
}

impl Forecasts {
    fn repeats(&mut self, name: Name, now_ns: BootNs) -> bool {
        let is_same = self.last.replace(name) == Some(name);
        // New forecasts in between do not start another minute, so that each minute has one for comparison.
        let is_within = self.minute_ns.is_some_and(|begun_ns| now_ns.since(begun_ns) < FORECAST_NS);
        if !is_within {
            self.minute_ns = Some(now_ns);
        }
        is_same && is_within
    }
}

pub fn run(args: &Args) -> CommandResult {
    if args.file.as_os_str() == "-" {
        let why = "a recording goes into a file, not to standard output: its index is written last and points back; give a file's name";
        return Err(Failure::usage(why));
    }
    let (stop, _log, config, domain) = args.service.begin()?;
    let node = domain.open("roomcast-record")?;
    let ports = Subscribers::open(&node)?;
    let output = |error| match error {
        RecordingError::Exists { .. } => Failure::input(error),
        _ => Failure::failed(error),
    };
    let mut recorder = Output::create(args, &config.planner.robot).map_err(output)?;
    let mut moments = Moments::start(&node)?;
    let mut known = Known::default();
    let (started, mut flushed) = (Instant::now(), Instant::now());
    let mut is_silent = true;
    let interrupted = loop {
        // Messages from before the end are still recorded.
        let is_over = args.seconds.map(|seconds| started.elapsed() >= Duration::from_secs(seconds));
        let ends = stop.requested() || is_over == Some(true);
        let news = ports.news()?;
        let received = Received { unix_ns: clock::unix_ns(), monotonic_ns: clock::monotonic_ns() };
        is_silent &= !news.iter().any(|message| matches!(message, Recorded::RoomScores(_)));
        if is_silent && started.elapsed() >= SILENCE {
            is_silent = false;
            super::tell(format_args!("roomcast: {}; this records what comes", silence(&domain)));
        }
        for message in &news {
            let repeated = known.repeats(message, received.monotonic_ns);
            if args.heartbeats || !repeated {
                recorder.write(message, received).map_err(output)?;
            }
        }
        for message in &news {
            if let Recorded::RoomScores(scores) = message {
                moments.newest = Some((scores.epoch, scores.sequence));
            }
        }
        // At the end the last answer is waited for.
        let patience = if ends { LAST } else { Duration::ZERO };
        while moments.ask() {
            let Some(moment) = moments.hear(patience) else { break };
            recorder.tell(&moment, received).map_err(output)?;
        }
        if flushed.elapsed() > FLUSH {
            recorder.flush().map_err(output)?;
            flushed = Instant::now();
        }
        if ends {
            break is_over == Some(false);
        }
        if news.is_empty() {
            // A narrator with one line may leave within milliseconds.
            roomcast_ipc::wait_for_any(&[&ports.narration, &ports.scores], POLL)?;
        }
    };
    let written = recorder.finish().map_err(output)?;
    let malformed = ports.malformed();
    let told = format!("{written} messages in {}; {malformed} malformed ones left out", args.file.display());
    if interrupted {
        return Err(service::interrupted(&told));
    }
    super::tell(told);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_ipc::raw::{ForecastV1, PersonForecastsV1};

    /// Regression: persons' forecasts were recorded only after events, so idle hours had none for comparison.
    #[test]
    fn of_repeated_forecasts_there_is_one_a_minute_of_rooms_and_of_persons() {
        let second_ns = 1_000_000_000;
        let both = |sequence| {
            [
                Recorded::Forecast(Box::new(ForecastV1 { epoch: 1, sequence, ..Default::default() })),
                Recorded::PersonForecasts(Box::new(PersonForecastsV1 { epoch: 1, sequence, ..Default::default() })),
            ]
        };
        let (mut known, mut kept) = (Known::default(), [Vec::new(), Vec::new()]);
        for second in 0..200 {
            // There is an event after 100 s.
            for (message, kept) in both(1 + u64::from(second >= 100)).iter().zip(&mut kept) {
                if !known.repeats(message, BootNs((7 + second) * second_ns)) {
                    kept.push(second);
                }
            }
        }
        assert_eq!(kept, [[0, 60, 100, 120, 180], [0, 60, 100, 120, 180]]);
    }
}
