//! The daemon: receives narration, scores the rooms, publishes.
//!
//! ```text
//! scoring thread: receiver -> engine -> room scores, item scores; heartbeat, status
//! standby thread:  the receiver while the scoring thread is busy
//! ahead thread:   scores of likely next events, at a lower priority
//! main thread:    signals, watchdog
//!
//! receiver: narration port -> intake -> journal
//! ```
//!
//! One thread at a time owns the receiver. The scoring thread reads it while idle, so that an event wakes one thread and not two. Before a step that may
//! take long it hands the receiver to the standby thread, which queues new events for the next step. The standby thread returns the receiver soon after the
//! step.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam::channel::{Receiver, Sender, bounded};
use crossbeam::select;
use roomcast_ipc::raw::{NarrationV1, StatusResponseV1};
use roomcast_ipc::{Domain, IpcError, Node, limits, sequence, text};
use sd_notify::NotifyState;

use crate::awake::Awake;
use crate::clock;
use crate::config::{Config, DaemonConfig};
use crate::embedded;
use crate::no_model::NoModel;
use crate::notify::notify;
use crate::participant::join;
use crate::setup::{self, SetupError};
use crate::stop::Stop;
use receiver::{Counters, EventReceiver, ReceiverLoan};

use roomcast_core::draft::Drafter;
use roomcast_core::guess::Counts;
use roomcast_core::habits::HabitsOptions;
use roomcast_core::ids::BootNs;
use roomcast_core::scorer::{IsStopped, LanguageModel, ModelInfo, TokenCounter};
use roomcast_llama::LlamaModel;
use roomcast_llama::affinity::{self, AffinityError};
use roomcast_llama::memory;
use scoring::{Ports, Scoring, Tools};

mod answers;
mod asked;
mod cycle;
mod engine;
mod habits;
mod habits_question;
mod intake;
pub mod journal;
mod map_change;
mod person_question;
mod persons;
mod persons_file;
#[cfg(test)]
mod played;
mod prefetch;
mod prefetch_thread;
mod receiver;
mod scoring;
mod sleep;
mod zone;

pub use asked::{ANSWERS_REMEMBERED, QUESTION_NAME_BYTES_MAX};
pub use cycle::Cycle;
pub use engine::{Engine, EngineError, Entry, MapError, SENSORS_MAX};
pub use habits::{HomeHabits, Memory};
pub use habits_question::{HabitsAnswer, HabitsLine, HabitsQuestion, IMPORT_BYTES_MAX, PART_BYTES, VisitsLine};
pub use intake::{FORMER_SOURCES_MAX, HELD_S, Intake, IntakeCounters, SOURCES_OF_A_PORT, SentenceCost, Taken};
pub use journal::{HabitRows, Journal, JournalError, JournalHandle, KeptPerson, PersonDay, Recovered, week};
pub use map_change::{KeptMap, MapAnswer, MapQuestion, Outcome};
pub use person_question::{
    By, NoisySensor, PersonAnswer, PersonLine, PersonQuestion, PlaceLine, UNDERSTOOD_MAX, UnderstoodLine,
    UnderstoodPerson, Whereabouts, WhyLine,
};
pub use persons::{NotRenamed, Persons, flag_words};
pub use persons_file::PersonsFile;
pub use prefetch::{Now, Prefetcher};
pub use zone::{NoZone, Zone};

/// How often the main thread checks the other threads.
const SUPERVISE: Duration = Duration::from_millis(500);
/// How often resources of dead participants are removed.
const CLEAN_UP_NS: u64 = 1_000_000_000;
const LOG_INTERVAL_NS: u64 = 5_000_000_000;

/// The journal and its content; none without a state directory.
fn open_journal(config: &DaemonConfig) -> Result<(Option<Journal>, Recovered), JournalError> {
    let Some(directory) = config.state_directory() else { return Ok((None, Recovered::default())) };
    let sync_every = Duration::from_millis(config.journal_sync_ms.max(1));
    Journal::open(&directory, config.journal_bytes, sync_every).map(|(journal, recovered)| (Some(journal), recovered))
}

/// Why the daemon ended or failed to start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DaemonError {
    /// Model, map or configuration.
    #[error(transparent)]
    Setup(#[from] SetupError),
    /// The map does not fit into messages.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// A service.
    #[error(transparent)]
    Ipc(#[from] IpcError),
    /// The limit on address space is too low.
    #[error("{0}")]
    AddressSpace(String),
    /// The cores.
    #[error(transparent)]
    Affinity(#[from] AffinityError),
    /// The journal.
    #[error(transparent)]
    Journal(#[from] JournalError),
    /// A thread could not be started.
    #[error("cannot start the {name} thread: {source}; {}", limits::on_threads())]
    Thread {
        /// Its name.
        name: &'static str,
        /// The system's error.
        source: std::io::Error,
    },
    /// A thread made no progress.
    #[error("the {name} thread has not moved for {seconds} s (daemon.hang_s): giving up, so that it can be restarted")]
    Hung {
        /// Its name.
        name: &'static str,
        /// For how long.
        seconds: u64,
    },
    /// A thread ended by itself.
    #[error("the {name} thread ended unexpectedly; the log says why")]
    Ended {
        /// Its name.
        name: &'static str,
    },
}

/// Runs until asked to stop, with the configured model.
///
/// `run` and `run_without_model` are compiled in this crate. In the program they would be compiled last, when the build has no other work left to run
/// in parallel.
///
/// # Errors
///
/// [`DaemonError`] when the daemon cannot start, hangs, or loses a service.
pub fn run(config: &Config, domain: &Domain, stop: &Stop) -> Result<(), DaemonError> {
    run_with(config, domain, stop, setup::configured_model)
}

/// Runs until asked to stop, with uniform token probabilities, to measure the cost of everything except the model.
///
/// # Errors
///
/// [`DaemonError`] when the daemon cannot start, hangs, or loses a service.
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
    // llama.cpp, and a thread without memory for its first allocations, end the process by a signal.
    let model_bytes = config.model.path.as_deref().and_then(|path| path.metadata().ok()).map_or(0, |file| file.len());
    if let Some(fault) = limits::too_little_address_space(limits::DAEMON_BYTES_MIN.saturating_add(model_bytes)) {
        return Err(DaemonError::AddressSpace(fault));
    }
    let node = join(domain, "roomcast-daemon")?;
    // The services come first, because only one daemon can hold the scores' service; then the receiver; then the model, which takes longest. Events that
    // arrive during loading wait in the port.
    let ports = Ports::open(&node)?;
    let narration = node.subscriber::<NarrationV1>()?;
    let (handle, prefetching) = prefetch_thread::pair(config.scoring.prepare_share, config.scoring.prepare_on_battery);
    let (journal, mut recovered) = open_journal(&config.daemon)?;
    let journal_handle = journal.as_ref().map(|journal| journal.handle.clone());
    let Some(loaded) =
        stop.while_loading(|| load(config, journal_handle.clone(), &mut recovered, model, prefetching.is_stopped()))
    else {
        return Ok(());
    };
    let Loaded { engine, ahead, scene, token_counter } = loaded?;
    memory::return_freed();
    embedded::release_model();
    let mut cycle = Cycle::new(engine, config.daemon.heartbeat_ms * 1_000_000);
    let sentence_tokens_max = Arc::new(AtomicUsize::new(cycle.engine().sentence_tokens_max()));
    let mut intake = Intake::new(config.daemon.intake)
        .with_narrators(&config.daemon.narrator)
        .with_cost(SentenceCost::new(token_counter, Arc::clone(&sentence_tokens_max)));
    let restored = if journal.is_some() { restore(recovered, &mut cycle, &mut intake) } else { 0 };
    let tally = first_tally(cycle.engine(), restored);
    let (counters, progress) = (Counters::default(), Progress::default());
    let tools = Tools {
        scene,
        save_ns: (config.habits.save_s * 1e9) as u64,
        sentence_tokens_max,
        journal: journal_handle,
        counters: Arc::clone(&counters),
        progress: progress.clone(),
        handle: ahead.is_some().then_some(handle),
        stop: stop.clone(),
    };
    let moved_ns = Arc::clone(&progress.scoring_ns);
    cycle.engine_mut().watch_model(Arc::new(move || moved_ns.store(clock::monotonic_ns().0, Ordering::Relaxed)));
    let receiver = EventReceiver::new(narration, intake, journal, counters);
    let (receiver, standby) =
        ReceiverLoan::new(receiver, Awake::new(config.ipc.spin_us), progress.clone(), stop.clone());
    let mut scoring = Scoring::new(cycle, ports, receiver, tools, tally);
    let cores = config.model.cores.clone();
    let (ending, ended) = bounded(THREADS);
    let scoring = spawn(SCORING, &ending, move || {
        affinity::bind(&cores)?;
        Ok::<(), DaemonError>(scoring.run()?)
    })?;
    let standby = spawn("standby", &ending, move || standby.run())?;
    let cores = config.model.cores.clone();
    let work_ahead = move |ahead| {
        // If the scorer has cores of its own, the prefetcher uses only these, too.
        affinity::bind(&cores)?;
        prefetching.run(ahead);
        Ok::<(), DaemonError>(())
    };
    let ahead = ahead.map(|ahead| spawn("ahead", &ending, move || work_ahead(ahead))).transpose()?;
    supervise(config, &node, stop, &progress, &ended, Threads { scoring, standby, ahead })
}

/// Everything that is loaded before the daemon listens.
struct Loaded<M> {
    engine: Engine<M>,
    /// `None` when prefetching is off.
    ahead: Option<Prefetcher<M, LlamaModel>>,
    /// The fingerprint of the configured scene, hexadecimal.
    scene: String,
    token_counter: TokenCounter,
}

/// Reads map, model, persons and habits.
fn load<M: LanguageModel + Send + 'static>(
    config: &Config,
    journal: Option<JournalHandle>,
    recovered: &mut Recovered,
    model: impl FnOnce(&Config) -> Result<M, SetupError> + Send,
    is_stopped: IsStopped,
) -> Result<Loaded<M>, DaemonError> {
    let state = config.daemon.state_directory();
    if state.is_none() {
        tracing::warn!(
            "nothing is stored: confirmed events, names and habits end with the daemon, unless daemon.state names a folder"
        );
    }
    for odd in config.persons.odd_names([]) {
        tracing::warn!("persons.residents: {odd}");
    }
    let configured = setup::load_map(config.scene.path.as_deref())?;
    let scene = hex::encode(configured.fingerprint());
    let map = recovered.map.take().and_then(|map| map.of(&configured)).unwrap_or(configured);
    let pipeline = set_up(|| setup::open_with(config, &map, model))??;
    if let Some(reason) = &pipeline.inside().model().weakness {
        tracing::warn!(
            reason,
            "the scores of this model are noise: forecasts leave them out, and all messages have the flag MODEL_WEAK. Use another model; `roomcast model check \
             FILE` tests one"
        );
    }
    let token_counter = pipeline.inside().token_counter();
    // If the configuration names only relayed narrators, local ones are not unknown narrators.
    let guards = config.daemon.narrator.iter().any(|known| !known.relayed);
    let named = config.daemon.narrator.iter().filter(|_| guards);
    let names = PersonsFile::new(std::mem::take(&mut recovered.persons), journal);
    let memory = memory(state.as_deref(), recovered.habits.take(), config.habits.options());
    let preparer = match config.scoring.prepare {
        0 => Ok(None),
        _ => pipeline.inside().preparer(Arc::clone(&is_stopped)),
    };
    let preparer = preparer.unwrap_or_else(|error| {
        tracing::warn!(%error, "no memory for a second cache: no answers are prepared. With scoring.prepare = 0 none is asked for");
        None
    });
    let counts = || Counts::from_json(embedded::FORMS).unwrap_or_default();
    let ahead = preparer.map(|preparer| {
        let drafter = drafter(config, pipeline.inside().model(), is_stopped);
        Prefetcher::new(preparer, counts(), Arc::clone(pipeline.inside().prepared()), config.scoring.prepare)
            .with_drafter(drafter)
    });
    let engine = Engine::new(pipeline, map, config.grounding, sequence::random_epoch())?
        .with_persons(Persons::new(config.persons.clone(), names))
        .with_forecast(config.forecast)
        .with_named(named.map(|known| (sequence::source_of_name(&known.name), known.may)))
        .with_habits(HomeHabits::new(memory, Zone::local()))
        .with_readings();
    Ok(Loaded { engine, ahead, scene, token_counter })
}

/// The habits of the state database, or of an earlier version's file.
fn memory(directory: Option<&Path>, rows: Option<HabitRows>, options: HabitsOptions) -> Memory {
    let memory = match rows {
        Some(rows) => rows
            .memory(options)
            .map_err(|reason| {
                tracing::warn!(
                    reason,
                    "the habits in the state database cannot be used: only its events are learned again"
                );
            })
            .ok(),
        None => directory.and_then(|directory| journal::old_habits(directory, options)).inspect(|_| {
            tracing::info!(
                "the habits are of an earlier version: counts that are still in use are kept, and the weights are learned again"
            );
        }),
    };
    memory.unwrap_or_else(|| Memory::new(options))
}

/// The embedded model for guesses, if another model is configured and memory suffices for both.
fn drafter(config: &Config, configured: &ModelInfo, is_stopped: IsStopped) -> Option<Drafter<LlamaModel>> {
    if !config.scoring.draft || config.model.path.is_none() {
        return None;
    }
    let draft = || -> Result<Option<Drafter<LlamaModel>>, SetupError> {
        let correction = setup::pipeline_options(config)?.correction;
        let embedded = setup::load_model(None, &config.model.llama_options())?;
        if embedded.info().fingerprint == configured.fingerprint {
            return Ok(None);
        }
        Ok(embedded.twin(is_stopped)?.map(|model| Drafter::new(model, correction)))
    };
    draft().unwrap_or_else(|error| {
        tracing::warn!(%error, "the embedded model has no say in what is guessed. With scoring.draft = false it is not asked for");
        None
    })
}

/// The first status answer.
fn first_tally<M: LanguageModel>(engine: &Engine<M>, restored: u64) -> StatusResponseV1 {
    let snapshot = engine.snapshot();
    StatusResponseV1 {
        epoch: snapshot.epoch,
        started_unix_ns: clock::unix_ns().0,
        restored,
        model_fingerprint: snapshot.model_fingerprint,
        map_fingerprint: snapshot.map_fingerprint,
        process: std::process::id(),
        minor: 3,
        version: text::encode_cut(env!("CARGO_PKG_VERSION")),
        map: text::encode_cut(engine.map().name()),
        model: text::encode_cut(&engine.pipeline().inside().model().name),
        ..Default::default()
    }
}

/// Restores the events of a former run. Returns their number.
fn restore<M: LanguageModel>(recovered: Recovered, cycle: &mut Cycle<M>, intake: &mut Intake) -> u64 {
    let (restored, damaged) = (recovered.observations.len() as u64, recovered.damaged);
    let costly = cycle.restore(recovered, intake, clock::monotonic_ns(), clock::unix_ns());
    if costly > 0 {
        let most = cycle.engine().sentence_tokens_max();
        tracing::warn!(
            costly,
            "the state database has sentences of more than the {most} tokens that a window holds; they are left out: raise model.context_tokens and history.tokens to have them"
        );
    }
    tracing::info!(restored, damaged, "state database read");
    if damaged > 0 {
        tracing::warn!(damaged, "events of the state database are damaged, and were left out");
    }
    restored
}

/// Number of threads. If the scoring thread ends, the others end.
const THREADS: usize = 3;
const SCORING: &str = "scoring";

struct Threads {
    scoring: JoinHandle<Result<(), DaemonError>>,
    standby: JoinHandle<()>,
    ahead: Option<JoinHandle<Result<(), DaemonError>>>,
}

/// Runs the main thread: signals, the watchdog, cleaning up after dead participants. Returns when the threads have ended.
fn supervise(
    config: &Config,
    node: &Node,
    stop: &Stop,
    progress_ns: &Progress,
    ended: &Receiver<&'static str>,
    threads: Threads,
) -> Result<(), DaemonError> {
    let Threads { scoring, standby, ahead } = threads;
    let (mut cleaned_ns, mut was_still) = (BootNs(0), false);
    let (awake, woken) = bounded::<()>(0);
    stop.then(move || drop(awake));
    while !stop.requested() {
        let name = select! {
            recv(ended) -> name => name.ok(),
            recv(woken) -> _ => None,
            default(SUPERVISE) => None,
        };
        if let Some(name) = name
            && !stop.requested()
        {
            // The other threads end with the scoring thread, so its end is the cause.
            let is_by_scoring =
                || std::iter::from_fn(|| ended.recv_timeout(SUPERVISE).ok()).any(|name| name == SCORING);
            if name != SCORING && !is_by_scoring() {
                return Err(DaemonError::Ended { name });
            }
            return Err(match scoring.join() {
                Ok(Err(error)) => error,
                _ => DaemonError::Ended { name: SCORING },
            });
        }
        let now_ns = clock::monotonic_ns();
        let (name, still_ns) = progress_ns.slowest(now_ns);
        let is_still = still_ns > config.daemon.hang_s.saturating_mul(1_000_000_000);
        // After a suspension no thread has moved for long. A thread that has not moved by the next check either hangs.
        if is_still && was_still {
            return Err(DaemonError::Hung { name, seconds: still_ns / 1_000_000_000 });
        }
        was_still = is_still;
        notify(&[NotifyState::Watchdog]);
        if now_ns.since(cleaned_ns) >= CLEAN_UP_NS {
            node.clean_up_dead();
            cleaned_ns = now_ns;
        }
    }
    notify(&[NotifyState::Stopping]);
    // The standby thread returns the receiver, and the scoring thread finishes the received events.
    standby.join().map_err(|_| DaemonError::Ended { name: "standby" })?;
    scoring.join().map_err(|_| DaemonError::Ended { name: SCORING })??;
    ahead.map_or(Ok(Ok(())), JoinHandle::join).map_err(|_| DaemonError::Ended { name: "ahead" })??;
    tracing::info!("stopped");
    Ok(())
}

/// Starts a thread that reports its end in `ending`, also after a panic.
fn spawn<T: Send + 'static>(
    name: &'static str,
    ending: &Sender<&'static str>,
    run: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, DaemonError> {
    struct Ending(&'static str, Sender<&'static str>);
    impl Drop for Ending {
        fn drop(&mut self) {
            // Each thread reports once, and the channel has room for all.
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

/// Runs model work on a temporary thread before the scoring thread starts.
///
/// Threads of a decoder call belong to the calling thread and live as long as it. Together with the scoring thread's there would be more threads than
/// cores. OpenMP then puts waiting threads to sleep, a hundred times in a call: an event took twice the time.
fn set_up<T: Send>(run: impl FnOnce() -> T + Send) -> Result<T, DaemonError> {
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().name("setup".to_owned()).spawn_scoped(scope, run);
        let thread = thread.map_err(|source| DaemonError::Thread { name: "setup", source })?;
        thread.join().map_err(|_| DaemonError::Ended { name: "setup" })
    })
}

/// When each thread moved last, in monotonic nanoseconds, for the watchdog.
#[derive(Debug, Clone)]
struct Progress {
    standby_ns: Arc<AtomicU64>,
    scoring_ns: Arc<AtomicU64>,
}

impl Default for Progress {
    fn default() -> Self {
        let now = || Arc::new(AtomicU64::new(clock::monotonic_ns().0));
        Self { standby_ns: now(), scoring_ns: now() }
    }
}

impl Progress {
    /// The thread without progress for the longest time, and that time in nanoseconds.
    fn slowest(&self, now_ns: BootNs) -> (&'static str, u64) {
        let still = |moved: &AtomicU64| now_ns.since(BootNs(moved.load(Ordering::Relaxed)));
        let (standby_ns, scoring_ns) = (still(&self.standby_ns), still(&self.scoring_ns));
        if standby_ns > scoring_ns { ("standby", standby_ns) } else { ("scoring", scoring_ns) }
    }
}
