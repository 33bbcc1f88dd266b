//! The daemon: receives narration, scores the rooms, publishes.
//!
//! ```text
//! scoring thread: inbox -> board -> room scores, item scores; heartbeat, status
//! relief thread:  the inbox while the scoring thread is busy
//! main thread:    signals, watchdog
//!
//! inbox: narration port -> intake -> journal
//! ```
//!
//! The inbox belongs to one thread at a time. The scoring thread reads it while it has nothing else to do, so that an event wakes one
//! thread, not two. Before a step that may take long it hands the inbox to the relief thread, so that nothing that arrives meanwhile is
//! lost: it waits in a queue and becomes part of the next step. The relief thread returns the inbox soon after the step.

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam::channel::{Receiver, Sender, bounded};
use crossbeam::select;
use hdrhistogram::Histogram;
use roomcast_ipc::{
    AnswerPort, Domain, ForecastV1, IpcError, ItemScoresPublisher, NarrationV1, Node, PersonForecastsV1,
    PersonScoresV1, Publisher, RoomScoresV1, StatusResponseV1, StatusServer, Subscriber, clock, question, score_flags,
    sequence, text,
};
use sd_notify::NotifyState;

use crate::config::{Config, DaemonConfig};
use crate::logging::Limiter;
use crate::no_model::NoModel;
use crate::notify::notify;
use crate::setup::{self, SetupError};
use crate::stop::Stop;
use asked::{Answered, Question};
use habits_file::Keeper;
use habits_question::{After, Importing};
use roomcast_core::narration::{Observation, SOMEBODY, Said};
use roomcast_core::pipeline::Prepared;
use roomcast_core::scorer::LanguageModel;
use roomcast_core::text::has_words;
use roomcast_llama::affinity::{self, AffinityError};

mod asked;
mod board;
mod cycle;
mod habits;
mod habits_file;
mod habits_question;
mod intake;
pub mod journal;
mod map_change;
mod person_question;
mod persons;
mod persons_file;

pub use asked::{ANSWERS_REMEMBERED, QUESTION_NAME_BYTES_MAX};
pub use board::{Board, BoardError, Entry, MapError};
pub use cycle::Cycle;
pub use habits::{HomeHabits, Memory, Zone};
pub use habits_file::{HabitsFile, decode_memory, encode_memory};
pub use habits_question::{HabitsAnswer, HabitsLine, HabitsQuestion, IMPORT_BYTES_MAX, PART_BYTES};
pub use intake::{FORMER_SOURCES_MAX, Intake, IntakeCounters, SOURCES_OF_A_PORT, SentenceCost, Taken};
pub use journal::{Journal, JournalError, JournalHandle, JournalOptions, Recovered};
pub use map_change::{KeptMap, MapAnswer, MapQuestion, Outcome};
pub use person_question::{PersonAnswer, PersonLine, PersonQuestion};
pub use persons::{Persons, flag_words, presence_word};
pub use persons_file::{KeptPerson, PersonsFile};

/// Observations that may wait for the scorer.
const QUEUE: usize = 65_536;
/// Messages taken from the port at once: a flood of them must not keep the scorer from its steps.
const AT_ONCE: usize = 2048;
/// How often connections are renewed at least. Whoever joins or asks by this contract's crate wakes the daemon by itself.
const TICK: Duration = Duration::from_millis(250);
/// How often the main thread looks after the others.
const SUPERVISE: Duration = Duration::from_millis(500);
/// The relief thread has the inbox at most so long after a step; an event that comes meanwhile wakes both threads.
const RELIEF: Duration = Duration::from_millis(5);
/// While a step that takes less runs, the port holds what comes: waking another thread would take longer than most of it.
const SHORT_STEP_NS: u64 = 200_000;
/// Scores wait at most this long for the journal; after that they are sent without claiming what it does not hold yet.
const JOURNAL_PATIENCE: Duration = Duration::from_millis(5);
/// A question to forget somebody waits at most this long for the journal.
const FORGET_PATIENCE: Duration = Duration::from_secs(5);
/// How often what dead participants left is removed.
const CLEAN_UP_NS: u64 = 1_000_000_000;
const LOG_INTERVAL_NS: u64 = 5_000_000_000;

fn journal_options(config: &DaemonConfig) -> Option<JournalOptions> {
    let directory = config.state_directory()?;
    Some(JournalOptions { directory, bytes_max: config.journal_bytes, sync_ms: config.journal_sync_ms })
}

/// Why the daemon ended, or did not begin.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DaemonError {
    /// Model, map or configuration.
    #[error(transparent)]
    Setup(#[from] SetupError),
    /// The map does not fit into messages.
    #[error(transparent)]
    Board(#[from] BoardError),
    /// A service.
    #[error(transparent)]
    Ipc(#[from] IpcError),
    /// The cores.
    #[error(transparent)]
    Affinity(#[from] AffinityError),
    /// The journal.
    #[error(transparent)]
    Journal(#[from] JournalError),
    /// A thread could not be started.
    #[error("cannot start the {name} thread: {source}; is a limit on tasks set too low?")]
    Thread {
        /// Which.
        name: &'static str,
        /// The system's word.
        source: std::io::Error,
    },
    /// A thread stands still.
    #[error("the {name} thread has not moved for {seconds} s (daemon.hang_s): giving up, so that it can be restarted")]
    Hung {
        /// Which.
        name: &'static str,
        /// How long.
        seconds: u64,
    },
    /// A thread ended by itself.
    #[error("the {name} thread ended unexpectedly; the log says why")]
    Ended {
        /// Which.
        name: &'static str,
    },
}

/// Runs until asked to stop, with the configured model.
///
/// Both ways to run are compiled here: in the program, which calls them, they would be compiled at the end of every build, when
/// nothing else is left to do beside them.
///
/// # Errors
///
/// [`DaemonError`] when it cannot begin, hangs, or a service is lost.
pub fn run(config: &Config, domain: &Domain, stop: &Stop) -> Result<(), DaemonError> {
    run_with(config, domain, stop, setup::configured_model)
}

/// Runs until asked to stop, with every word as likely as every other: what is left is the price of everything but the model.
///
/// # Errors
///
/// [`DaemonError`] when it cannot begin, hangs, or a service is lost.
pub fn run_without_model(config: &Config, domain: &Domain, stop: &Stop) -> Result<(), DaemonError> {
    run_with(config, domain, stop, |_| Ok(NoModel::default()))
}

/// Runs with the model that `model` gives.
fn run_with<M: LanguageModel + Send + 'static>(
    config: &Config,
    domain: &Domain,
    stop: &Stop,
    model: impl FnOnce(&Config) -> Result<M, SetupError> + Send,
) -> Result<(), DaemonError> {
    let node = domain.open("roomcast-daemon")?;
    // First the service that only one daemon can hold, then the inbox, then the model, which takes longest: narration that comes
    // meanwhile waits in the port.
    let scores = node.publisher::<RoomScoresV1>()?;
    let items = node.item_scores_publisher()?;
    let forecasts = node.publisher::<ForecastV1>()?;
    let persons = node.publisher::<PersonScoresV1>()?;
    let person_forecasts = node.publisher::<PersonForecastsV1>()?;
    let status = node.status_server()?;
    let narration = node.subscriber::<NarrationV1>()?;
    let (map_changes, moments) = (node.answer_port(question::MAP_CHANGE)?, node.answer_port(question::MOMENT)?);
    let (person_questions, habits_questions) =
        (node.answer_port(question::PERSON)?, node.answer_port(question::HABITS)?);
    let configured = setup::load_map(config.scene.path.as_deref())?;
    let kept_map = config.daemon.state_directory().map(|directory| KeptMap::new(&directory, &configured));
    let map = kept_map.as_ref().and_then(KeptMap::load).unwrap_or(configured);
    let pipeline = set_up(|| setup::open_with(config, &map, model))??;
    let model_name = pipeline.model().name.clone();
    let (token_counter, sentence_tokens_max) = (pipeline.token_counter(), Arc::new(AtomicUsize::new(0)));
    let board = Board::new(pipeline, map, config.grounding, sequence::random_epoch())?;
    let names = config.daemon.state_directory().map(|directory| PersonsFile::load(&directory)).unwrap_or_default();
    let board = board.with_persons(Persons::new(config.persons.clone(), names)).with_forecast(config.forecast);
    // Who only names narrators elsewhere does not say that those here are strangers.
    let guards = config.daemon.narrator.iter().any(|known| !known.relayed);
    let named = config.daemon.narrator.iter().filter(|_| guards);
    let board = board.with_named(named.map(|known| sequence::source_of_name(&known.name)));
    let (keeper, memory) = match config.daemon.state_directory() {
        Some(directory) => {
            let (file, memory) = HabitsFile::load(&directory, config.habits.options());
            let keeper = Keeper::start(file).map_err(|source| DaemonError::Thread { name: "habits", source })?;
            (Some(keeper), memory)
        }
        None => (None, Memory::new(config.habits.options())),
    };
    let board = board.with_habits(HomeHabits::new(memory, Zone::local()));
    let mut cycle = Cycle::new(board, config.daemon.heartbeat_ms * 1_000_000);

    sentence_tokens_max.store(cycle.board().sentence_tokens_max(), Ordering::Relaxed);
    let mut intake = Intake::new(config.daemon.intake)
        .with_narrators(&config.daemon.narrator)
        .with_cost(SentenceCost::new(token_counter, Arc::clone(&sentence_tokens_max)));
    let (journal, restored) = match journal_options(&config.daemon) {
        Some(options) => {
            restore(&options, &mut cycle, &mut intake).map(|(journal, restored)| (Some(journal), restored))?
        }
        None => (None, 0),
    };

    let (queue_in, queue) = bounded(QUEUE);
    let counters = Arc::new(Mutex::new((IntakeCounters::default(), 0)));
    let progress_ns = Progress::default();
    let journal_handle = journal.as_ref().map(Journal::handle);
    let limiter = || Limiter::new(LOG_INTERVAL_NS);
    let inbox = Inbox {
        narration,
        message: Box::default(),
        intake,
        journal,
        counters: Arc::clone(&counters),
        more: false,
        log_refused: limiter(),
        log_costly: limiter(),
        log_port: limiter(),
    };
    // There is one inbox: sending it never waits.
    let ((to_relief, from_scoring), (to_scoring, from_relief)) = (bounded(1), bounded(1));
    let busy = Arc::new(AtomicBool::new(false));
    let relief = Relief {
        from_scoring,
        to_scoring,
        queue: queue_in,
        busy: Arc::clone(&busy),
        progress: progress_ns.clone(),
        stop: stop.clone(),
    };
    let snapshot = cycle.board().snapshot();
    let mut scoring = Scoring {
        ready: false,
        scores,
        items,
        forecasts,
        persons,
        person_forecasts,
        status,
        map_changes,
        answered: Answered::default(),
        kept_map,
        moments,
        person_questions,
        answered_persons: Answered::default(),
        habits_questions,
        answered_habits: Answered::default(),
        importing: Importing::default(),
        keeper,
        save_ns: (config.habits.save_s * 1e9) as u64,
        saved_ns: clock::monotonic_ns(),
        inbox: Some(Box::new(inbox)),
        inbox_lost: false,
        to_relief,
        from_relief,
        busy,
        step_ns: u64::MAX,
        sentence_tokens_max,
        queue,
        journal: journal_handle,
        counters,
        progress: progress_ns.clone(),
        latency_ns: Histogram::new_with_max(60_000_000_000, 3).ok(),
        tally: StatusResponseV1 {
            epoch: snapshot.epoch,
            started_unix_ns: clock::unix_ns(),
            restored,
            model_fingerprint: snapshot.model_fingerprint,
            map_fingerprint: snapshot.map_fingerprint,
            process: std::process::id(),
            minor: 2,
            version: text::encode_cut(env!("CARGO_PKG_VERSION")),
            map: text::encode_cut(cycle.board().map().name()),
            model: text::encode_cut(&model_name),
            ..Default::default()
        },
        cycle,
        log: limiter(),
        stop: stop.clone(),
    };
    let cores = config.model.cores.clone();
    let (ending, ended) = bounded(2);
    let scoring = spawn("scoring", &ending, move || {
        affinity::bind(&cores)?;
        Ok::<(), DaemonError>(scoring.run()?)
    })?;
    let relief = spawn("relief", &ending, move || relief.run())?;
    supervise(config, &node, stop, &progress_ns, &ended, scoring, relief)
}

/// Opens the journal, and enters what a former run of the daemon wrote. Gives how many observations that were.
fn restore<M: LanguageModel>(
    options: &JournalOptions,
    cycle: &mut Cycle<M>,
    intake: &mut Intake,
) -> Result<(Journal, u64), DaemonError> {
    let (journal, recovered) = Journal::open(options)?;
    let (restored, damaged_bytes) = (recovered.observations.len() as u64, recovered.damaged_bytes);
    let costly = cycle.restore(recovered, intake, clock::monotonic_ns(), clock::unix_ns());
    if costly > 0 {
        let most = cycle.board().sentence_tokens_max();
        tracing::warn!(
            costly,
            "the journal has sentences of more than the {most} tokens that a window holds; they are left out: raise model.context_tokens and history.tokens to have them"
        );
    }
    tracing::info!(restored, damaged_bytes, directory = %options.directory.display(), "journal read");
    Ok((journal, restored))
}

/// The main thread's work: signals, the watchdog, what dead participants left. Returns when the threads have ended.
fn supervise(
    config: &Config,
    node: &Node,
    stop: &Stop,
    progress_ns: &Progress,
    ended: &Receiver<&'static str>,
    scoring: JoinHandle<Result<(), DaemonError>>,
    relief: JoinHandle<()>,
) -> Result<(), DaemonError> {
    let mut cleaned_ns = 0;
    while !stop.requested() {
        let name = select! {
            recv(ended) -> name => name.ok(),
            recv(stop.woken()) -> _ => None,
            default(SUPERVISE) => None,
        };
        if let Some(name) = name
            && !stop.requested()
        {
            // The relief thread ends with the scoring thread, whose end is the cause then.
            if name == "relief" && ended.recv_timeout(SUPERVISE).is_err() {
                return Err(DaemonError::Ended { name });
            }
            return Err(match scoring.join() {
                Ok(Err(error)) => error,
                _ => DaemonError::Ended { name: "scoring" },
            });
        }
        let now_ns = clock::monotonic_ns();
        let (name, still_ns) = progress_ns.slowest(now_ns);
        if still_ns > config.daemon.hang_s.saturating_mul(1_000_000_000) {
            return Err(DaemonError::Hung { name, seconds: still_ns / 1_000_000_000 });
        }
        notify(&[NotifyState::Watchdog]);
        if now_ns.saturating_sub(cleaned_ns) >= CLEAN_UP_NS {
            node.clean_up_dead();
            cleaned_ns = now_ns;
        }
    }
    notify(&[NotifyState::Stopping]);
    // The relief thread returns the inbox; the scoring thread finishes what it has received.
    relief.join().map_err(|_| DaemonError::Ended { name: "relief" })?;
    scoring.join().map_err(|_| DaemonError::Ended { name: "scoring" })??;
    tracing::info!("stopped");
    Ok(())
}

/// Starts a thread that says in `ending` when it ends, however it does.
fn spawn<T: Send + 'static>(
    name: &'static str,
    ending: &Sender<&'static str>,
    run: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, DaemonError> {
    struct Ending(&'static str, Sender<&'static str>);
    impl Drop for Ending {
        fn drop(&mut self) {
            // Each says it once, and there is room for both.
            let _said = self.1.try_send(self.0);
        }
    }
    let ending = Ending(name, ending.clone());
    let run = move || {
        let _ending = ending;
        run()
    };
    std::thread::Builder::new().name(name.to_owned()).spawn(run).map_err(|source| DaemonError::Thread { name, source })
}

/// Runs what uses the model before the scoring thread does, on a thread that ends with it.
///
/// The threads of a decoder call belong to the thread that makes it, and stay as long as that one. Beside the scoring thread's they would be
/// more than there are cores, and of so many OpenMP puts to sleep whoever waits for the others, a hundred times in a call: an event
/// took twice the time.
fn set_up<T: Send>(run: impl FnOnce() -> T + Send) -> Result<T, DaemonError> {
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().name("setup".to_owned()).spawn_scoped(scope, run);
        let thread = thread.map_err(|source| DaemonError::Thread { name: "setup", source })?;
        thread.join().map_err(|_| DaemonError::Ended { name: "setup" })
    })
}

/// When each thread moved last, in monotonic nanoseconds: what the watchdog looks at.
#[derive(Debug, Clone)]
struct Progress {
    relief_ns: Arc<AtomicU64>,
    scoring_ns: Arc<AtomicU64>,
}

impl Default for Progress {
    fn default() -> Self {
        let now = || Arc::new(AtomicU64::new(clock::monotonic_ns()));
        Self { relief_ns: now(), scoring_ns: now() }
    }
}

impl Progress {
    /// The thread that stood still longest, and for how long, in nanoseconds.
    fn slowest(&self, now_ns: u64) -> (&'static str, u64) {
        let still = |moved: &AtomicU64| now_ns.saturating_sub(moved.load(Ordering::Relaxed));
        let (relief_ns, scoring_ns) = (still(&self.relief_ns), still(&self.scoring_ns));
        if relief_ns > scoring_ns { ("relief", relief_ns) } else { ("scoring", scoring_ns) }
    }
}

/// Counters of the intake, and sources known.
type Counters = Arc<Mutex<(IntakeCounters, usize)>>;

/// Hears narrators, for whoever has it.
struct Inbox {
    narration: Subscriber<NarrationV1>,
    /// What the port gave last.
    message: Box<NarrationV1>,
    intake: Intake,
    journal: Option<Journal>,
    counters: Counters,
    /// The port was not emptied the last time.
    more: bool,
    log_refused: Limiter,
    log_costly: Limiter,
    log_port: Limiter,
}

impl Inbox {
    /// Sleeps until there is narration or `patience` has passed; gives what is there to `take`.
    fn listen(&mut self, patience: Duration, take: impl FnMut(Heard)) {
        // The port wakes once for all that came, so nothing would wake for what was left there.
        let waited = if self.more { Ok(true) } else { self.narration.wait(patience) };
        let received = waited.and_then(|_| self.drain(take));
        if let Err(error) = received {
            // A port that fails may recover, when file descriptors become free for instance.
            if let Some(held_back) = self.log_port.pass(clock::monotonic_ns()) {
                tracing::error!(%error, held_back, "cannot receive narration");
            }
            std::thread::sleep(patience);
        }
    }

    fn drain(&mut self, mut take: impl FnMut(Heard)) -> Result<(), IpcError> {
        let mut messages = 0;
        while messages < AT_ONCE
            && let Some((checked, sender)) = self.narration.receive_from(&mut self.message)?
        {
            messages += 1;
            let now_ns = clock::monotonic_ns();
            let received = checked.map(|()| &*self.message);
            let source = received.as_ref().map_or(0, |received| received.source);
            if !self.intake.knows_port(sender) {
                self.intake.note_alive(self.narration.senders());
            }
            // A killed narrator's successor has its voice at once.
            let epoch = received.as_ref().map_or(0, |received| received.epoch);
            if self.intake.is_contested(source, epoch, sender) {
                self.intake.note_alive(self.narration.senders().into_iter().filter(|sender| sender.is_running()));
            }
            let name = self.message.source_name();
            let refused = match self.intake.receive(received, sender, now_ns) {
                Taken::Accepted { observation, missed, voice, leaves, binds } => {
                    let number = self.journal.as_mut().map_or(0, |journal| {
                        if binds {
                            journal.bind((observation.source, observation.epoch), sender);
                        }
                        journal.append(&observation)
                    });
                    let entry = Entry { observation, received_ns: now_ns, after_gap: missed > 0, voice, leaves };
                    take(Heard::Entry(entry, number));
                    (missed > 0).then(|| format!("{missed} narrations before it were lost"))
                }
                Taken::Duplicate => None,
                Taken::Limited => Some("it comes faster than daemon.intake allows, and is dropped".to_owned()),
                Taken::Forged => Some(
                    "another process speaks in its name, and is not heard: end one of the two, or restart the narrator"
                        .to_owned(),
                ),
                Taken::Costly { tokens, most, first } => {
                    take(Heard::PassedOver { source, epoch: self.message.epoch, sequence: self.message.sequence });
                    // Sources may be invented.
                    if first && let Some(held_back) = self.log_costly.pass(now_ns) {
                        tracing::warn!(
                            source,
                            name,
                            tokens,
                            most,
                            held_back,
                            "a sentence costs more tokens than a window holds, and is dropped, as others of this source will be: shorten it, or raise model.context_tokens and history.tokens"
                        );
                    }
                    None
                }
                Taken::Malformed(why) => Some(why),
            };
            if let Some(why) = refused
                && let Some(held_back) = self.log_refused.pass(now_ns)
            {
                tracing::warn!(source, why, held_back, "narration");
            }
        }
        self.more = messages == AT_ONCE;
        if messages > 0 {
            let counters = (self.intake.counters(), self.intake.sources());
            *self.counters.lock().unwrap_or_else(PoisonError::into_inner) = counters;
        }
        Ok(())
    }
}

/// What the inbox gives the scorer.
enum Heard {
    /// An accepted observation, with its number in the journal.
    Entry(Entry, u64),
    /// One that was refused for good.
    PassedOver { source: u64, epoch: u64, sequence: u64 },
}

/// Listens while the scoring thread is busy.
struct Relief {
    from_scoring: Receiver<Box<Inbox>>,
    to_scoring: Sender<Box<Inbox>>,
    queue: Sender<Heard>,
    busy: Arc<AtomicBool>,
    progress: Progress,
    stop: Stop,
}

impl Relief {
    fn run(self) {
        let moved = |now_ns| self.progress.relief_ns.store(now_ns, Ordering::Relaxed);
        loop {
            // Without the inbox it has nothing to do, and so cannot stand still. It ends with the scoring thread.
            moved(u64::MAX);
            let Ok(mut inbox) = self.from_scoring.recv() else { return };
            loop {
                moved(clock::monotonic_ns());
                // It fails only when the scoring thread is gone, and the main thread sees that too.
                inbox.listen(RELIEF, |heard| drop(self.queue.send(heard)));
                if !self.busy.load(Ordering::Acquire) || self.stop.requested() {
                    break;
                }
            }
            // It fails only when the scoring thread is gone, and the main thread sees that too.
            let _given = self.to_scoring.send(inbox);
        }
    }
}

struct Scoring<M> {
    cycle: Cycle<M>,
    ready: bool,
    scores: Publisher<RoomScoresV1>,
    items: ItemScoresPublisher,
    forecasts: Publisher<ForecastV1>,
    persons: Publisher<PersonScoresV1>,
    person_forecasts: Publisher<PersonForecastsV1>,
    status: StatusServer,
    map_changes: AnswerPort,
    answered: Answered<MapAnswer>,
    kept_map: Option<KeptMap>,
    moments: AnswerPort,
    person_questions: AnswerPort,
    answered_persons: Answered<PersonAnswer>,
    habits_questions: AnswerPort,
    answered_habits: Answered<HabitsAnswer>,
    importing: Importing,
    /// Writes what was learned; none without a state directory.
    keeper: Option<Keeper>,
    save_ns: u64,
    saved_ns: u64,
    /// The relief thread has it otherwise.
    inbox: Option<Box<Inbox>>,
    /// The relief thread has ended, and the inbox with it.
    inbox_lost: bool,
    to_relief: Sender<Box<Inbox>>,
    from_relief: Receiver<Box<Inbox>>,
    /// The relief thread is to keep the inbox.
    busy: Arc<AtomicBool>,
    /// What the last step took, as a guess at the next.
    step_ns: u64,
    /// What a sentence may cost with the map in use, for the intake.
    sentence_tokens_max: Arc<AtomicUsize>,
    queue: Receiver<Heard>,
    journal: Option<JournalHandle>,
    counters: Counters,
    progress: Progress,
    latency_ns: Option<Histogram<u64>>,
    tally: StatusResponseV1,
    log: Limiter,
    stop: Stop,
}

impl<M: LanguageModel> Scoring<M> {
    fn run(&mut self) -> Result<(), IpcError> {
        loop {
            let last = self.inbox_lost || (self.stop.requested() && self.inbox.is_some());
            // A changed map is scored at once.
            let wait = !last && !self.cycle.step_due(clock::monotonic_ns());
            let idle = || Duration::from_nanos(self.cycle.idle_ns(clock::monotonic_ns())).min(TICK);
            self.take(if wait { idle() } else { Duration::ZERO });
            let now_ns = clock::monotonic_ns();
            self.progress.scoring_ns.store(now_ns, Ordering::Relaxed);
            let events = self.cycle.waiting() as u64;
            if self.cycle.step_due(now_ns) {
                if !last && self.step_ns >= SHORT_STEP_NS {
                    lend_inbox(&mut self.inbox, &self.to_relief, &self.busy);
                }
                self.step(now_ns);
                self.step_ns = clock::monotonic_ns().saturating_sub(now_ns);
            }
            self.send(events)?;
            if last {
                self.finish_habits();
                return Ok(());
            }
            // What comes after may wait for the scores: looking for questions alone takes as long as a small step.
            self.renew_connections()?;
            if self.change_map()? || self.answer_about_persons()? {
                self.cycle.score_again();
            }
            self.answer_about_habits()?;
            self.status.answer(|| self.tally())?;
            // Whoever asks meanwhile waits for the first scores of a changed map.
            if self.cycle.board().is_scored() {
                let board = self.cycle.board_mut();
                let mut moment = || serde_json::to_string(&board.moment(clock::monotonic_ns())).unwrap_or_default();
                self.moments.answer(|_| moment())?;
            }
            if self.queue.is_empty() {
                self.cycle.tidy();
                self.look_after_habits(now_ns);
            }
            self.busy.store(false, Ordering::Release);
        }
    }

    /// Sleeps until there is narration or `patience` has passed, and takes in all that was received.
    fn take(&mut self, patience: Duration) {
        if self.inbox.is_none() {
            select! {
                recv(self.from_relief) -> inbox => {
                    self.inbox_lost = inbox.is_err();
                    self.inbox = inbox.ok();
                }
                recv(self.queue) -> received => if let Ok(heard) = received { enter(&mut self.cycle, heard) },
                default(patience) => {}
            }
        }
        // First what the relief thread received, while it had the inbox.
        for heard in self.queue.try_iter() {
            enter(&mut self.cycle, heard);
        }
        if let Some(inbox) = &mut self.inbox {
            let patience = if self.cycle.waiting() > 0 { Duration::ZERO } else { patience };
            inbox.listen(patience, |heard| enter(&mut self.cycle, heard));
        }
    }

    /// Hands the newest messages to whoever has joined since.
    fn renew_connections(&mut self) -> Result<(), IpcError> {
        self.scores.tick()?;
        if self.items.tick()? && self.cycle.board().snapshot().sequence > 0 {
            self.send_items()?;
        }
        if self.forecasts.tick()? && self.cycle.board().snapshot().sequence > 0 {
            self.forecasts.send(self.cycle.board_mut().forecast(clock::monotonic_ns()))?;
        }
        if self.persons.tick()? && self.cycle.board().snapshot().sequence > 0 {
            self.persons.send(self.cycle.board_mut().person_scores(clock::monotonic_ns()))?;
        }
        if self.person_forecasts.tick()? && self.cycle.board().snapshot().sequence > 0 {
            self.person_forecasts.send(self.cycle.board_mut().person_forecasts(clock::monotonic_ns()))?;
        }
        Ok(())
    }

    fn send_items(&self) -> Result<(), IpcError> {
        let Some((header, items)) = self.cycle.board().items() else { return Ok(()) };
        self.items.send(header, items)
    }

    fn step(&mut self, now_ns: u64) {
        self.tally.steps += 1;
        self.tally.merged += (self.cycle.waiting() as u64).saturating_sub(1);
        if let Err(error) = self.cycle.step(now_ns, clock::unix_ns()) {
            self.tally.failed_steps += 1;
            if let Some(held_back) = self.log.pass(now_ns) {
                tracing::error!(%error, held_back, "scoring failed; the narration is kept and scored with the next step");
            }
            return;
        }
        let (journal, mut attributed) = (&self.journal, 0);
        self.cycle.board_mut().tell_outcomes(|outcome| {
            let number = journal.as_ref().map_or(0, |journal| journal.append(outcome));
            attributed = if outcome.by_fit { number } else { attributed };
        });
        self.cycle.rests_on(attributed);
        if let Some(journal) = &self.journal
            && !journal.wait_for(self.cycle.scored_record(), JOURNAL_PATIENCE)
            && let Some(held_back) = self.log.pass(now_ns)
        {
            tracing::warn!(
                held_back,
                "the journal is slower than the scorer; narration is confirmed when it is written"
            );
        }
    }

    /// Sends what is to be sent now; `events` narrations came since the last time.
    fn send(&mut self, events: u64) -> Result<(), IpcError> {
        let before_ns = clock::monotonic_ns();
        let written = self.journal.as_ref().map_or(u64::MAX, JournalHandle::written);
        if !self.cycle.message_due(before_ns, written) {
            return Ok(());
        }
        let behind = !self.queue.is_empty() || self.inbox.as_ref().is_some_and(|inbox| inbox.more);
        let Some(message) = self.cycle.message(before_ns, written, behind) else { return Ok(()) };
        self.scores.send(message)?;
        let (is_heartbeat, after_ns) = (message.has(score_flags::HEARTBEAT), clock::monotonic_ns());
        // Behind the scores, which wait for nothing; a planner waits for the forecast that belongs to them. Time alone changes where a
        // person may be, so a heartbeat has a new one too. All are sent, whoever listens: who joins later is given the last one, which is
        // no older than the scores, and names nobody who is forgotten.
        self.send_about_persons(before_ns)?;
        if is_heartbeat {
            self.tally.heartbeats += 1;
            return Ok(());
        }
        self.tally.published += 1;
        // Also what a step before took in that failed: its wait was the longest.
        if let Some(received_ns) = self.cycle.newly_received_ns()
            && let Some(latency_ns) = &mut self.latency_ns
        {
            latency_ns.saturating_record(after_ns.saturating_sub(received_ns));
        }
        let message = self.cycle.board().snapshot();
        self.tally.sequence = message.sequence;
        if self.items.wanted() {
            self.send_items()?;
        }
        // Every event has one of these: metrics and the status answer tell the same in sum.
        tracing::debug!(
            sequence = message.sequence,
            events,
            wait_us = message.wait_ns / 1000,
            tokenise_us = message.tokenise_ns / 1000,
            prefix_us = message.prefix_ns / 1000,
            trie_us = message.trie_ns / 1000,
            ground_us = message.ground_ns / 1000,
            publish_us = (after_ns - before_ns) / 1000,
            label_mass = message.label_mass,
            "step"
        );
        if !self.ready {
            self.ready = true;
            let board = self.cycle.board();
            let (model, map) = (board.pipeline().model().name.as_str(), board.map().name());
            let (labels, rooms) = (board.pipeline().prepared().labels().len(), message.rooms().len());
            tracing::info!(model, map, labels, rooms, "ready: the first scores are out");
            notify(&[NotifyState::Ready]);
        }
        Ok(())
    }

    /// Sends the forecast, the persons' scores and their forecasts.
    fn send_about_persons(&mut self, now_ns: u64) -> Result<(), IpcError> {
        self.forecasts.send(self.cycle.board_mut().forecast(now_ns))?;
        self.persons.send(self.cycle.board_mut().person_scores(now_ns))?;
        self.person_forecasts.send(self.cycle.board_mut().person_forecasts(now_ns))
    }

    /// Does what was asked of the map; returns whether it changed.
    fn change_map(&mut self) -> Result<bool, IpcError> {
        let Self { cycle, answered, kept_map, map_changes, tally, inbox, to_relief, busy, sentence_tokens_max, .. } =
            self;
        let board = cycle.board_mut();
        let mut changed = false;
        map_changes.answer(|asked| {
            answered.answer::<MapQuestion>(asked, |asked| {
                lend_inbox(inbox, to_relief, busy);
                let answer = answer_change(board, kept_map.as_ref(), asked);
                if answer.outcome == Outcome::Applied {
                    changed = true;
                    tally.map_fingerprint = board.map().fingerprint();
                    sentence_tokens_max.store(board.sentence_tokens_max(), Ordering::Relaxed);
                }
                let MapAnswer { outcome, reason, items, new_labels, .. } = &answer;
                let reason = reason.as_deref().map(for_the_log);
                tracing::info!(?outcome, reason, items, new_labels, "map change");
                answer
            })
        })?;
        Ok(changed)
    }

    /// Answers questions about persons; returns whether somebody was forgotten or has another name.
    fn answer_about_persons(&mut self) -> Result<bool, IpcError> {
        let Self { cycle, answered_persons, person_questions, journal, keeper, inbox, to_relief, busy, .. } = self;
        let board = cycle.board_mut();
        let mut changed = false;
        person_questions.answer(|asked| {
            answered_persons.answer::<PersonQuestion>(asked, |asked| {
                let changes = asked.as_ref().is_ok_and(|asked| asked.id().is_some());
                if changes {
                    lend_inbox(inbox, to_relief, busy);
                }
                let answer = answer_about_person(board, (journal.as_ref(), keeper.as_ref()), asked);
                if changes {
                    changed |= answer.done;
                    let reason = answer.reason.as_deref().map(for_the_log);
                    tracing::info!(done = answer.done, reason, kept = answer.kept, "person");
                }
                answer
            })
        })?;
        Ok(changed)
    }

    /// Answers questions about habits.
    fn answer_about_habits(&mut self) -> Result<(), IpcError> {
        let Self { cycle, answered_habits, importing, habits_questions, keeper, inbox, to_relief, busy, .. } = self;
        let board = cycle.board_mut();
        habits_questions.answer(|asked| {
            answered_habits.answer::<HabitsQuestion>(asked, |asked| {
                lend_inbox(inbox, to_relief, busy);
                let (mut answer, after) = habits_question::answer(board, importing, asked, clock::monotonic_ns());
                answer.kept = keeper.is_some();
                if after == After::Forget {
                    if let Err(error) = write_habits(board, keeper.as_ref()) {
                        answer.reason = Some(format!(
                            "it holds until the daemon starts again: the habits file cannot be written: {error}"
                        ));
                        answer.kept = false;
                    }
                    let reason = answer.reason.as_deref().map(for_the_log);
                    tracing::info!(reason, kept = answer.kept, "habits were forgotten or replaced");
                }
                answer
            })
        })?;
        Ok(())
    }

    /// Lets habits count time, and has them written now and then.
    fn look_after_habits(&mut self, now_ns: u64) {
        let board = self.cycle.board_mut();
        board.tick(now_ns, clock::unix_ns());
        let is_due = now_ns.saturating_sub(self.saved_ns) >= self.save_ns;
        let Some(keeper) = self.keeper.as_ref().filter(|_| is_due) else { return };
        self.saved_ns = now_ns;
        if let Some(memory) = board.habits_mut().memory_if_changed()
            && !keeper.write(memory)
        {
            board.habits_mut().keep_changed();
        }
    }

    /// Writes what was learned, before the end.
    fn finish_habits(&mut self) {
        // What was observed last, too.
        self.cycle.tidy();
        let memory = self.cycle.board_mut().habits_mut().memory_if_changed();
        if let Some(keeper) = &mut self.keeper {
            keeper.finish(memory);
        }
    }

    fn tally(&self) -> StatusResponseV1 {
        let (counters, sources) = *self.counters.lock().unwrap_or_else(PoisonError::into_inner);
        let quantile = |q| self.latency_ns.as_ref().map_or(0, |latency_ns| latency_ns.value_at_quantile(q));
        let habits = self.cycle.board().habits().learned();
        StatusResponseV1 {
            learned: habits.observations as u64,
            habits_bytes: habits.bytes as u64,
            habits_counts: habits.counts as u64,
            habits_names: habits.names as u32,
            habits_persons: habits.persons as u32,
            answered_ns: clock::monotonic_ns(),
            received: counters.received,
            accepted: counters.accepted,
            duplicates: counters.duplicates,
            missed: counters.missed,
            malformed: counters.malformed,
            limited: counters.limited,
            forged: counters.forged,
            costly: counters.costly,
            sources: sources as u32,
            persons: self.cycle.board().snapshot().persons,
            waiting: self.queue.len() as u64,
            latency_p50_ns: quantile(0.5),
            latency_p99_ns: quantile(0.99),
            latency_max_ns: self.latency_ns.as_ref().map_or(0, |latency_ns| latency_ns.max()),
            journal_bytes: self.journal.as_ref().map_or(0, JournalHandle::bytes),
            journal_failures: self.journal.as_ref().map_or(0, JournalHandle::failures),
            ..self.tally
        }
    }
}

fn enter<M: LanguageModel>(cycle: &mut Cycle<M>, heard: Heard) {
    match heard {
        Heard::Entry(entry, number) => cycle.enter(entry, number),
        Heard::PassedOver { source, epoch, sequence } => cycle.pass_over(source, epoch, sequence),
    }
}

/// A reason as a line of the log has room for: it may quote a question, which may be long.
fn for_the_log(reason: &str) -> String {
    reason.chars().take(200).collect()
}

/// Gives the inbox to the relief thread, for as long as `busy` is set, if it does not have it already.
fn lend_inbox(inbox: &mut Option<Box<Inbox>>, to_relief: &Sender<Box<Inbox>>, busy: &AtomicBool) {
    busy.store(true, Ordering::Release);
    if let Some(inbox) = inbox.take() {
        // It fails only when the relief thread is gone, and the main thread sees that too.
        let _handed = to_relief.send(inbox);
    }
}

/// Does what was asked about persons, and says who is known then.
fn answer_about_person<M: LanguageModel>(
    board: &mut Board<M>,
    kept: (Option<&JournalHandle>, Option<&Keeper>),
    asked: Result<PersonQuestion, String>,
) -> PersonAnswer {
    let find = |board: &Board<M>, who: &str| {
        board
            .persons()
            .find(who)
            .ok_or_else(|| format!("nobody is known as {who:?}: `roomcast person list` says who is"))
    };
    let result = asked.and_then(|question| match question {
        PersonQuestion::List => Ok(None),
        PersonQuestion::Rename { who, name, .. } => {
            let person = find(board, &who)?;
            board.rename(person, &name).map(|()| None)
        }
        PersonQuestion::Forget { who, .. } => {
            // Of somebody who is known no more the files may still tell.
            let (is_known, person) = (find(board, &who), board.persons().meant(&who));
            let (left, records) = forget(board, kept, person, &who);
            if records == 0 { is_known.map(|_| left) } else { Ok(left) }
        }
    });
    let now_ns = i64::try_from(clock::monotonic_ns()).unwrap_or(i64::MAX);
    let (done, left) = (result.is_ok(), result.unwrap_or_else(Some));
    let kept = done && left.is_none() && board.persons().file().is_kept();
    PersonAnswer { done, reason: left, kept, persons: board.persons().lines(now_ns) }
}

/// Forgets a person, also on the disk; gives what could not be forgotten there, and how many records of the journal were theirs.
fn forget<M: LanguageModel>(
    board: &mut Board<M>,
    (journal, keeper): (Option<&JournalHandle>, Option<&Keeper>),
    person: u32,
    who: &str,
) -> (Option<String>, usize) {
    let file = board.persons().file().clone();
    let mut names = board.persons().names_of(person);
    names.extend(Some(who.trim().to_lowercase()).filter(|who| who.parse::<u32>().is_err()));
    let is_theirs = move |observation: &Observation, found: Option<u32>| {
        let is_name = |name: &str| file.number_of(name) == person || names.iter().any(|own| Said::may_mean(own, name));
        let own = match (&observation.name, found) {
            (Some(name), _) => file.number_of(name) == person || names.iter().any(|own| Said::may_be_one(own, name)),
            (None, Some(found)) => found == person,
            (None, None) if observation.person == SOMEBODY => observation.said.may_name(is_name),
            (None, None) => observation.person == person,
        };
        let text = || match &observation.said {
            Said::Sentence(sentence) => sentence.as_str().to_lowercase(),
            Said::Presence(statement) => {
                format!("{statement}, {}", statement.subject().unwrap_or_default()).to_lowercase()
            }
        };
        let names_them = || match &observation.said {
            Said::Presence(statement) => statement.names().any(is_name),
            Said::Sentence(_) => false,
        };
        // What others did to them, and rooms that are called after them, tell of them, too.
        own || names_them() || names.iter().any(|name| has_words(&text(), name))
    };
    board.forget(person);
    let in_journal = journal.map_or(Ok(0), |journal| journal.forget(person, is_theirs, FORGET_PATIENCE));
    let records = *in_journal.as_ref().unwrap_or(&1);
    let in_file = board.persons_mut().file_mut().remove(person);
    let in_habits = write_habits(board, keeper);
    let error = in_journal.err().or(in_file.err()).or(in_habits.err());
    let left = error.map(|error| {
        format!("they are forgotten until the daemon starts again: the state directory cannot be written: {error}")
    });
    (left, records)
}

/// Writes what is left of what was learned after somebody was forgotten, and waits for it.
fn write_habits<M: LanguageModel>(board: &mut Board<M>, keeper: Option<&Keeper>) -> std::io::Result<()> {
    let Some(keeper) = keeper else { return Ok(()) };
    let habits = board.habits_mut();
    let Some(memory) = habits.memory_if_changed() else { return Ok(()) };
    keeper.forget(memory, FORGET_PATIENCE).inspect_err(|_| habits.keep_changed())
}

/// Applies a change to the board, if it can be, and says what became of it.
fn answer_change<M: LanguageModel>(
    board: &mut Board<M>,
    kept_map: Option<&KeptMap>,
    asked: Result<MapQuestion, String>,
) -> MapAnswer {
    let start_ns = clock::monotonic_ns();
    let in_use = hex::encode(board.map().fingerprint());
    let result = asked.map_err(|reason| (Outcome::Refused, reason)).and_then(|question| {
        if let Some(expected) = question.expected_map.filter(|expected| !expected.eq_ignore_ascii_case(&in_use)) {
            return Err((Outcome::OtherMap, format!("the map in use is {in_use}, not {expected}")));
        }
        let refused = |error: &dyn std::error::Error| (Outcome::Refused, crate::logging::chain(error));
        let map = board.map().changed(question.changes).map_err(|error| refused(&error))?;
        board.change_map(map).map_err(|error| refused(&error))
    });
    let regrouped_in_ns = clock::monotonic_ns().saturating_sub(start_ns);
    let kept = result.is_ok()
        && kept_map.is_some_and(|kept_map| {
            kept_map
                .keep(board.map())
                .inspect_err(|error| tracing::error!(%error, "the changed map cannot be kept for a restart"))
                .is_ok()
        });
    let (outcome, reason, prepared) = match result {
        Ok(prepared) => (Outcome::Applied, None, prepared),
        Err((outcome, reason)) => (outcome, Some(reason), Prepared::default()),
    };
    MapAnswer {
        outcome,
        reason,
        map: hex::encode(board.map().fingerprint()),
        epoch: format!("{:016x}", board.snapshot().epoch),
        sequence: board.snapshot().sequence,
        rooms: board.map().rooms().len(),
        items: board.map().items().len(),
        outside: board.pipeline().grounding().unassigned().len(),
        new_labels: prepared.new_labels,
        prepared_again: prepared.again,
        regrouped_in_ns,
        kept,
    }
}
