//! `roomcast record`: everything on the services into an MCAP file.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crossbeam::channel::bounded;
use roomcast_core::ids::BootNs;
use roomcast_ipc::{
    DecisionV1, ForecastV1, IncludedV1, Message, NarrationV1, PersonForecastsV1, PersonScoresV1, RobotReportV1,
    RoomScoresV1, Subscriber, limits, question, score_flags,
};
use roomcast_services::clock;

use super::choice::choice;
use super::top::{SILENCE, silence};
use super::{CommandResult, Failure, count, ranges, service};
use roomcast_services::logging::{self, Limiter};
use roomcast_services::moment::Moment;
use roomcast_services::recording::ros2::Ros2Recorder;
use roomcast_services::recording::{self, Profile, Received, Recorded, Recorder, Recording, RecordingError};

use crate::decided::{Decided, News};
use crate::exit_code;

/// Arguments of `roomcast record`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    /// The file to write; it must not exist yet.
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// For whom the file is written.
    #[arg(long, value_parser = choice::<Profile>(), default_value_t)]
    profile: Profile,
    /// Record scores and forecasts that the daemon only repeats, too.
    #[arg(long)]
    heartbeats: bool,
    /// Stop after so many seconds; without it, at ctrl-C.
    #[arg(long, value_name = "SECONDS", value_parser = ranges::some())]
    seconds: Option<u64>,
}

/// How often the services are looked at. Room scores have a buffer of 2, and come a few milliseconds apart at most.
const POLL: Duration = Duration::from_millis(2);
/// How often the file is brought up to date: what a crash may cost.
const FLUSH: Duration = Duration::from_secs(5);
/// A forecast of the same scores is recorded once in so many nanoseconds: a minute. All of them would be 5 GiB a day.
const FORECAST_NS: u64 = 60_000_000_000;
/// How long the daemon may take to tell its map.
const PATIENCE: Duration = Duration::from_secs(5);

/// How often it is said that the daemon does not tell its map.
const COMPLAINT_NS: u64 = 60_000_000_000;

/// Reads a recording, and says so where its recorder was ended before it finished it.
///
/// # Errors
/// When it is none, or damaged.
pub(super) fn read(path: &Path) -> Result<Recording, Failure> {
    read_until(path, &|| false)
}

/// As [`read`], until somebody asks to stop.
///
/// # Errors
/// As [`read`], and when somebody asked to stop.
pub(super) fn read_until(path: &Path, is_stopped: &dyn Fn() -> bool) -> Result<Recording, Failure> {
    let recording = recording::read_until(path, is_stopped).map_err(|error| match error {
        RecordingError::Stopped { .. } => Failure::new(exit_code::INTERRUPTED, error),
        error => Failure::new(exit_code::INPUT, error),
    })?;
    if recording.is_torn {
        let messages = count(recording.messages.len(), "message");
        super::tell(format!(
            "{} ends within a record, as of a recorder that was killed: what comes before is read, {messages}",
            path.display()
        ));
    }
    Ok(recording)
}

/// The recorder of a profile.
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
            Self::Roomcast(recorder) => recorder.attach(moment, received),
            Self::Ros2(recorder) => recorder.tell(moment),
        }
    }

    fn flush(&mut self) -> Result<(), RecordingError> {
        match self {
            Self::Roomcast(recorder) => recorder.flush(),
            Self::Ros2(recorder) => recorder.flush(),
        }
    }

    /// Ends the file; how many messages it has.
    fn finish(&mut self) -> Result<u64, RecordingError> {
        match self {
            Self::Roomcast(recorder) => recorder.finish().map(|()| recorder.written()),
            Self::Ros2(recorder) => recorder.finish().map(|()| recorder.written()),
        }
    }

    /// What the file lacks when the daemon does not tell its map.
    fn without_map(&self) -> &'static str {
        match self {
            Self::Roomcast(_) => {
                "the daemon did not tell its map, and is asked again; until it does, explaining this recording needs the scene file"
            }
            Self::Ros2(_) => {
                "the daemon did not tell its map, and is asked again; until it does, the recording has no markers of its rooms"
            }
        }
    }
}

/// A daemon's start and its map.
type Map = (u64, [u8; 32]);

/// Which map the recording has, and which the daemon is asked for.
#[derive(Debug, Default)]
struct MapAsked {
    known: Option<Map>,
    asked: Option<Map>,
}

impl MapAsked {
    /// Whether the daemon is to be asked for this map: one question at a time.
    fn is_wanted(&self, map: Map) -> bool {
        self.asked.is_none() && self.known != Some(map)
    }

    /// The daemon has told its map, or had no time: then it is asked again.
    fn hear(&mut self, has_told: bool) {
        let asked = self.asked.take();
        self.known = if has_told { asked } else { self.known };
    }
}

/// A publisher's start, and the number of what it said.
type Name = (u64, u64);

/// What was recorded last of what the services say again and again.
#[derive(Debug, Default)]
struct Known {
    scores: Option<(Name, u32, Vec<IncludedV1>)>,
    persons: Option<Name>,
    forecast: Forecasts,
    person_forecasts: Forecasts,
    decided: Decided,
}

impl Known {
    /// Whether a message only says again what the recording has.
    fn repeats(&mut self, message: &Recorded, now_ns: BootNs) -> bool {
        match message {
            // Scores that claim more, because the journal has it now, or whose scorer has failed since, say something new.
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
            // A bridge to other robots sends theirs again to who joins.
            Recorded::Decision(decision) => self.decided.take(decision) == News::None,
            Recorded::Narration(_) | Recorded::RobotReport(_) => false,
        }
    }
}

/// What is expected changes a little as time passes, so of the forecasts of the same scores one a minute is kept.
#[derive(Debug, Default)]
struct Forecasts {
    last: Option<Name>,
    /// When the minute began.
    minute_ns: Option<BootNs>,
}

impl Forecasts {
    fn repeats(&mut self, name: Name, now_ns: BootNs) -> bool {
        let is_same = self.last.replace(name) == Some(name);
        // What is new in between begins no other minute: whoever compares forecasts with what came finds one of each.
        let is_within = self.minute_ns.is_some_and(|begun_ns| now_ns.since(begun_ns) < FORECAST_NS);
        if !is_within {
            self.minute_ns = Some(now_ns);
        }
        is_same && is_within
    }
}

/// Records until it is asked to stop.
///
/// # Errors
///
/// When a service cannot be opened, or the file cannot be written.
pub fn run(args: &Args) -> CommandResult {
    if args.file.as_os_str() == "-" {
        let why = "a recording goes into a file, not to standard output: its index is written last and points back; give a file's name";
        return Err(Failure::new(exit_code::USAGE, why));
    }
    let stop = service::stop()?;
    let _log = logging::init();
    let (config, domain) = args.service.load()?;
    let ipc = |error| Failure::new(exit_code::IPC, error);
    let node = domain.open("roomcast-record").map_err(ipc)?;
    // What narrators said before is not of this recording: it may be of somebody whom the home has forgotten since, and a replay would bring them
    // back.
    let narration = node.subscriber_from_now::<NarrationV1>().map_err(ipc)?;
    let scores = node.subscriber::<RoomScoresV1>().map_err(ipc)?;
    let persons = node.subscriber::<PersonScoresV1>().map_err(ipc)?;
    let forecast = node.subscriber::<ForecastV1>().map_err(ipc)?;
    let forecasts = node.subscriber::<PersonForecastsV1>().map_err(ipc)?;
    let decisions = node.subscriber::<DecisionV1>().map_err(ipc)?;
    let reports = node.subscriber::<RobotReportV1>().map_err(ipc)?;
    let output = |error| {
        let code = match error {
            RecordingError::Exists { .. } => exit_code::INPUT,
            _ => exit_code::FAILURE,
        };
        Failure::new(code, error)
    };
    let mut recorder = Output::create(args, &config.planner.robot).map_err(output)?;
    // The daemon is asked by a thread of its own, so that nothing is missed meanwhile.
    let port = node.question_port(question::MOMENT).map_err(ipc)?;
    let (ask, asked) = bounded(1);
    let (tell, told) = bounded(1);
    let asking = std::thread::Builder::new().name("map".to_owned());
    let asking = asking.spawn(move || {
        while asked.recv().is_ok() {
            let moment = port.ask("{}", PATIENCE).map_err(|error| error.to_string());
            let moment = moment.and_then(|text| Moment::from_json(&text).map_err(|error| error.to_string()));
            if tell.send(moment).is_err() {
                break;
            }
        }
    });
    asking.map_err(|error| {
        let text = format!("cannot start the thread that asks for the map: {error}; {}", limits::on_threads());
        Failure::new(exit_code::FAILURE, text)
    })?;
    let (mut map, mut log) = (MapAsked::default(), Limiter::new(COMPLAINT_NS));
    let mut known = Known::default();
    let (started, mut flushed) = (Instant::now(), Instant::now());
    let mut is_silent = true;
    let interrupted = loop {
        // What came before the end is still recorded.
        let is_over = args.seconds.map(|seconds| started.elapsed() >= Duration::from_secs(seconds));
        let ends = stop.requested() || is_over == Some(true);
        // In the order of the flow: what scores contain stands before them.
        let mut news = Vec::new();
        take(&narration, &mut news, |message| Recorded::Narration(Box::new(message)))?;
        take(&scores, &mut news, |message| Recorded::RoomScores(Box::new(message)))?;
        take(&persons, &mut news, |message| Recorded::PersonScores(Box::new(message)))?;
        take(&forecast, &mut news, |message| Recorded::Forecast(Box::new(message)))?;
        take(&forecasts, &mut news, |message| Recorded::PersonForecasts(Box::new(message)))?;
        take(&decisions, &mut news, |message| Recorded::Decision(Box::new(message)))?;
        take(&reports, &mut news, |message| Recorded::RobotReport(Box::new(message)))?;
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
            // Another daemon, or another map: what it is goes into the file too.
            if let Recorded::RoomScores(scores) = message
                && map.is_wanted((scores.epoch, scores.map_fingerprint))
                && ask.try_send(()).is_ok()
            {
                map.asked = Some((scores.epoch, scores.map_fingerprint));
            }
        }
        match told.try_recv() {
            Ok(Ok(moment)) => {
                map.hear(true);
                recorder.tell(&moment, received).map_err(output)?;
            }
            Ok(Err(error)) => {
                map.hear(false);
                if let Some(not_told) = log.pass(clock::monotonic_ns()) {
                    tracing::warn!(error, not_told, "{}", recorder.without_map());
                }
            }
            Err(_) => {}
        }
        if flushed.elapsed() > FLUSH {
            recorder.flush().map_err(output)?;
            flushed = Instant::now();
        }
        if ends {
            break is_over == Some(false);
        }
        if news.is_empty() {
            // A narrator that says one thing and leaves is gone within milliseconds.
            roomcast_ipc::wait_for_any(&[&narration, &scores], POLL).map_err(ipc)?;
        }
    };
    let written = recorder.finish().map_err(output)?;
    let malformed = [
        narration.malformed(),
        scores.malformed(),
        persons.malformed(),
        forecast.malformed(),
        forecasts.malformed(),
        decisions.malformed(),
        reports.malformed(),
    ];
    let malformed: u64 = malformed.iter().sum();
    let told = format!("{written} messages in {}; {malformed} malformed ones left out", args.file.display());
    if interrupted {
        return Err(service::interrupted(&told));
    }
    super::tell(told);
    Ok(())
}

fn take<M: Message>(
    subscriber: &Subscriber<M>,
    news: &mut Vec<Recorded>,
    wrap: impl Fn(M) -> Recorded,
) -> CommandResult {
    while let Some(message) = subscriber.receive().map_err(|error| Failure::new(exit_code::IPC, error))? {
        news.push(wrap(message));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Persons' forecasts came into the file with each event alone, and nothing was there to compare an idle hour with.
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
            // Something is said after 100 s.
            for (message, kept) in both(1 + u64::from(second >= 100)).iter().zip(&mut kept) {
                if !known.repeats(message, BootNs((7 + second) * second_ns)) {
                    kept.push(second);
                }
            }
        }
        assert_eq!(kept, [[0, 60, 100, 120, 180], [0, 60, 100, 120, 180]]);
    }

    #[test]
    fn a_daemon_that_had_no_time_is_asked_again_for_its_map() {
        let (first, second) = ((1, [1; 32]), (1, [2; 32]));
        let mut map = MapAsked::default();
        assert!(map.is_wanted(first));
        map.asked = Some(first);
        assert!(!map.is_wanted(first) && !map.is_wanted(second), "one question at a time");
        map.hear(false);
        assert!(map.is_wanted(first));
        map.asked = Some(first);
        map.hear(true);
        assert!(!map.is_wanted(first) && map.is_wanted(second));
        map.asked = Some(second);
        map.hear(false);
        assert!(!map.is_wanted(first) && map.is_wanted(second), "what is known stays");
    }
}
