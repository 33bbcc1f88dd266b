//! The planner's process: its ports, clock and files.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use roomcast_core::ids::BootNs;
use roomcast_ipc::raw::{
    DecisionV1, ForecastV1, Message, PersonForecastsV1, RobotReportV1, RoomScoresV1, decision_flags, report_kind,
};
use roomcast_ipc::{Awaited, Domain, IpcError, Publisher, Subscriber, sequence};
use sd_notify::NotifyState;

use super::state::Database;
use super::{DatedAhead, Planner};
use crate::awake::Awake;
use crate::clock;
use crate::config::Config;
use crate::daemon::Zone;
use crate::logging::Limiter;
use crate::notify::notify;
use crate::participant::{PLANNER, join};
use crate::receive::receive;
use crate::setup;
use crate::stop::Stop;

/// The longest wait of decisions for the forecast of the scores and the persons' sets, which follow directly.
const FORECAST_PATIENCE: Duration = Duration::from_millis(5);
/// For so many microseconds the planner polls for them, since they come sooner than a sleeping process wakes.
const FORECAST_POLL_US: u64 = 300;
/// Earlier messages of other planners and the bridge arrive within two of their ticks; decisions of a new planner wait for them.
const HISTORY_PATIENCE: Duration = Duration::from_millis(250);
const QUIET_NS: u64 = 5_000_000_000;

/// Places for the next messages: they are large.
#[derive(Default)]
struct Newest(Box<ForecastV1>, Box<PersonForecastsV1>);

/// Takes forecasts and persons that came. Returns whether the planner has those of its scores.
fn take_forecasts(
    planner: &mut Planner,
    (forecasts, persons): (&Subscriber<ForecastV1>, &Subscriber<PersonForecastsV1>),
    Newest(forecast, each): &mut Newest,
    log: &mut Limiter,
) -> Result<bool, IpcError> {
    while receive(forecasts, forecast, log)? {
        is_taken::<ForecastV1>(planner.take_forecast(forecast, clock::monotonic_ns()), log);
    }
    while receive(persons, each, log)? {
        is_taken::<PersonForecastsV1>(planner.take_persons(each, clock::monotonic_ns()), log);
    }
    let now_ns = clock::monotonic_ns();
    Ok(!planner.lacks_forecast() && !planner.lacks_sets(now_ns) && !planner.expects_persons(now_ns))
}

/// Runs until asked to stop.
///
/// # Errors
///
/// [`IpcError`] when a service cannot be opened or is lost.
pub fn run(config: &Config, domain: &Domain, stop: &Stop) -> Result<(), IpcError> {
    let node = join(domain, &PLANNER.name(&config.planner.robot))?.be_the_only_one()?;
    let scores = node.subscriber::<RoomScoresV1>()?;
    let forecasts = node.subscriber::<ForecastV1>()?;
    let persons = node.subscriber::<PersonForecastsV1>()?;
    // Decisions for robots of this domain, and for others through `roomcast-zenoh`.
    let others = config.planner.avoid_robots.then(|| node.subscriber::<DecisionV1>()).transpose()?;
    let reports = node.subscriber::<RobotReportV1>()?;
    let decisions = node.publisher::<DecisionV1>()?;
    // Decisions name the robot by this number.
    let number = sequence::source_of_name(&config.planner.robot);
    let mut database = config.daemon.state_directory().map(|directory| Database::new(&directory, number));
    let mut planner = restored(config, database.as_mut());
    let mut log = Limiter::new(QUIET_NS);
    // At the start the scores need a moment to arrive, so their absence counts only after the deadline.
    let patience_ns = clock::monotonic_ns().saturating_add(config.planner.deadline_ms.saturating_mul(1_000_000));
    let (mut snapshot, mut newest) = (Box::<RoomScoresV1>::default(), Newest::default());
    let mut other = DecisionV1::default();
    let (mut early, mut awake) = (VecDeque::new(), Awake::new(config.ipc.spin_us));
    let mut for_forecasts = Awake::new(config.ipc.spin_us.max(FORECAST_POLL_US));
    // If two robots go to one room, one of them must leave at once.
    let mut awaited: Vec<&dyn Awaited> = vec![&scores, &reports];
    awaited.extend(others.iter().map(|others| others as &dyn Awaited));
    // A robot that pauses for lack of sets continues when they come.
    if config.planner.avoid_sets {
        awaited.push(&persons);
    }
    let behind_scores: Vec<&dyn Awaited> = vec![&forecasts, &persons];
    if others.is_some() {
        // Without this wait, the first decision may be for a taken room.
        std::thread::sleep(HISTORY_PATIENCE);
    }
    notify(&[NotifyState::Ready]);
    while !stop.requested() {
        awake.wait(planner.idle(clock::monotonic_ns()), |patience| roomcast_ipc::wait_for_any(&awaited, patience))?;
        let mut has_scores = false;
        while receive(&scores, &mut snapshot, &mut log)? {
            has_scores |= is_taken::<RoomScoresV1>(planner.take(&snapshot, clock::monotonic_ns()), &mut log);
        }
        if has_scores {
            awake.heard();
            for_forecasts.heard();
        }
        let waits_until = Instant::now() + FORECAST_PATIENCE;
        while !take_forecasts(&mut planner, (&forecasts, &persons), &mut newest, &mut log)? && has_scores {
            let left = waits_until.saturating_duration_since(Instant::now());
            let wait = |left| roomcast_ipc::wait_for_any(&behind_scores, left);
            if left.is_zero() || !for_forecasts.wait(left, wait)? {
                break;
            }
        }
        if let Some(others) = &others {
            while receive(others, &mut other, &mut log)? {
                planner.take_other(&other, clock::monotonic_ns());
            }
        }
        warn_of_rooms(&mut planner);
        take_reports(&mut planner, &reports, &mut early, &mut log)?;
        let now_ns = clock::monotonic_ns();
        if planner.stale(now_ns) != decision_flags::NO_SCORES || now_ns >= patience_ns {
            decide(&mut planner, now_ns, &decisions, &mut log)?;
        }
        // The rest can wait for the decision.
        decisions.tick()?;
        if let Some(database) = &mut database {
            database.keep(&planner);
        }
        notify(&[NotifyState::Watchdog]);
    }
    notify(&[NotifyState::Stopping]);
    tracing::info!("stopped");
    Ok(())
}

fn restored(config: &Config, database: Option<&mut Database>) -> Planner {
    let mut planner = Planner::new(&config.planner, sequence::random_epoch());
    planner = planner.with_home(&config.persons.residents, Zone::local());
    match setup::load_map(config.scene.path.as_deref()) {
        Ok(map) => planner = planner.with_map(map, config.grounding.level),
        Err(error) => tracing::warn!(%error, "without the scene, reports and rules have to name rooms by their ids"),
    }
    let Some(database) = database else { return planner };
    planner = planner.with_orders(database.orders());
    match database.round() {
        Some(round) => planner.with_kept(round),
        None => planner,
    }
}

fn warn_of_rooms(planner: &mut Planner) {
    while let Some((robot, room)) = planner.robot_of_another_map() {
        let robot = format!("{robot:016x}");
        tracing::warn!(
            robot,
            room,
            "another robot goes to a room that the map in use does not have, so that it is not kept clear of: give both robots one map, or rooms of the same ids"
        );
    }
    let unknown = planner.rooms_not_on_the_map();
    if !unknown.is_empty() {
        let rooms = unknown.join(", ");
        tracing::warn!(
            rooms,
            "quiet hours or rooms of [planner] name rooms that the map does not have, and have no effect there: give a room's id or name"
        );
    }
}

/// A reporter may leave at once, so reports are taken from the port even though the rooms are known only with the first scores.
fn take_reports(
    planner: &mut Planner,
    reports: &Subscriber<RobotReportV1>,
    early: &mut VecDeque<RobotReportV1>,
    log: &mut Limiter,
) -> Result<(), IpcError> {
    let mut report = RobotReportV1::default();
    while receive(reports, &mut report, log)? {
        if early.len() == RobotReportV1::SERVICE.buffer {
            // Repeated kinds of reports make way for the others.
            let is_repeated =
                |known: &RobotReportV1| matches!(known.kind, report_kind::BATTERY | report_kind::POSITION);
            early.remove(early.iter().position(is_repeated).unwrap_or(0));
        }
        early.push_back(report);
    }
    if planner.knows_rooms() {
        early.drain(..).for_each(|report| take_report(planner, &report, log));
    }
    Ok(())
}

/// Whether the planner has taken a message; logs a rejection.
fn is_taken<M: Message>(taken: Result<(), DatedAhead>, log: &mut Limiter) -> bool {
    if let Err(error) = taken
        && let Some(not_told) = log.pass(clock::monotonic_ns())
    {
        tracing::warn!(%error, not_told, service = M::SERVICE.name, "a message is not used");
    }
    taken.is_ok()
}

fn take_report(planner: &mut Planner, report: &RobotReportV1, log: &mut Limiter) {
    let now_ns = clock::monotonic_ns();
    tracing::debug!(kind = report.kind, room = report.room(), note = report.note(), "report of the robot");
    if let Err(fault) = planner.take_report(report, now_ns)
        && let Some(not_told) = log.pass(now_ns)
    {
        tracing::warn!(%fault, not_told, reporter = report.robot_name(), "a report is not used whole");
    }
}

fn decide(
    planner: &mut Planner,
    now_ns: BootNs,
    decisions: &Publisher<DecisionV1>,
    log: &mut Limiter,
) -> Result<(), IpcError> {
    match planner.decide(now_ns, clock::unix_ns()) {
        Ok(None) => {}
        Ok(Some(decision)) => {
            decisions.send(&decision)?;
            tracing::info!(
                sequence = decision.sequence,
                from = decision.from(),
                to = decision.to(),
                probability = decision.probability,
                fallback = decision.has(decision_flags::FALLBACK),
                scores = decision.scores_sequence,
                age_us = decision.scores_age_ns / 1000,
                cancels = decision.cancels,
                why = decision.reason(),
                "decision"
            );
        }
        Err(error) => {
            if let Some(not_told) = log.pass(now_ns) {
                tracing::error!(%error, not_told, "the policy cannot decide; the robot stays");
            }
        }
    }
    Ok(())
}
