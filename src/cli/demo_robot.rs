//! The robot of `roomcast demo`: it hears decisions and sends reports over the real services, and works for its time in the simulated home. It has
//! its own thread, since its time does not wait for the output.

use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use roomcast_core::ids::BootNs;
use roomcast_ipc::raw::{DecisionV1, RobotReportV1, action};
use roomcast_ipc::{Domain, IpcError, Publisher, sequence};
use roomcast_services::clock;

use super::{CommandResult, Failure};
use roomcast_services::config::PlannerConfig;
use roomcast_services::reporter::{Kind, Report, Reporter};

const TICK: Duration = Duration::from_millis(50);

pub(super) struct DemoRobot {
    /// Dropped to end it.
    stop: Sender<()>,
    thread: JoinHandle<Result<(), String>>,
}

impl DemoRobot {
    /// Starts a robot that works for `stay` in each target room.
    pub(super) fn start(domain: &Domain, stay: Duration) -> Result<Self, Failure> {
        let (stop, stopped) = channel();
        let domain = domain.clone();
        let live = move || live(&domain, stay, &stopped);
        let thread = std::thread::Builder::new().name("robot".to_owned()).spawn(live);
        let thread = thread.map_err(|error| Failure::failed(format!("no robot: {error}")))?;
        Ok(Self { stop, thread })
    }

    pub(super) fn end(self) -> CommandResult {
        drop(self.stop);
        let ended = self.thread.join().unwrap_or_else(|_| Err("it panicked".to_owned()));
        ended.map_err(|error| Failure::ipc(format!("the demo's robot: {error}")))
    }
}

fn live(domain: &Domain, stay: Duration, stopped: &Receiver<()>) -> Result<(), String> {
    let ipc = |error: IpcError| error.to_string();
    let name = PlannerConfig::default().robot;
    let mut reporter = Reporter::new(&name, sequence::random_epoch()).map_err(|error| error.to_string())?;
    let node = domain.open("roomcast-robot").map_err(ipc)?;
    let decisions = node.subscriber::<DecisionV1>().map_err(ipc)?;
    let reports = node.publisher::<RobotReportV1>().map_err(ipc)?;
    let stay_ns = u64::try_from(stay.as_nanos()).unwrap_or(u64::MAX);
    // The decision in progress, and when its work ends.
    let mut work: Option<(u64, BootNs)> = None;
    while stopped.try_recv() == Err(TryRecvError::Empty) {
        let left = work.map(|(_, ends_ns)| Duration::from_nanos(ends_ns.since(clock::monotonic_ns())));
        decisions.wait(left.map_or(TICK, |left| left.min(TICK))).map_err(ipc)?;
        while let Some(decision) = decisions.receive().map_err(ipc)? {
            work = (decision.action == action::GO)
                .then(|| (decision.sequence, BootNs(decision.decided_ns).saturating_add(stay_ns)));
            if work.is_some() {
                say(&mut reporter, &reports, Kind::Started, decision.sequence)?;
            }
        }
        if let Some((decision, _)) = work.take_if(|(_, ends_ns)| clock::monotonic_ns() >= *ends_ns) {
            say(&mut reporter, &reports, Kind::Finished, decision)?;
        }
        reports.tick().map_err(ipc)?;
    }
    Ok(())
}

fn say(reporter: &mut Reporter, reports: &Publisher<RobotReportV1>, kind: Kind, decision: u64) -> Result<(), String> {
    let report = Report { decision: Some(decision), ..Report::new(kind) };
    let message = reporter.message(&report, clock::monotonic_ns(), clock::unix_ns());
    reports.send(&message.map_err(|error| error.to_string())?).map_err(|error| error.to_string())?;
    Ok(())
}
