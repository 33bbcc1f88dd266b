//! Questions of others to the daemon, where the configuration allows them: as text, as they are asked in the robot's own domain.

use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender};
use std::time::Duration;

use roomcast_ipc::{Domain, IpcError, QuestionPort, question};
use zenoh::Wait;
use zenoh::query::Query;

use crate::config::Ask;
use crate::stop::Stop;

/// Questions that wait for their answer; more are refused.
pub const WAITING_MAX: usize = 8;
/// How long the daemon has for an answer.
const PATIENCE: Duration = Duration::from_secs(5);
const TICK: Duration = Duration::from_millis(200);

/// The questions that are allowed: their name in keys, and the daemon's service.
#[must_use]
pub fn allowed(ask: &Ask) -> Vec<(&'static str, &'static str)> {
    let all = [
        (ask.moment, "moment", question::MOMENT),
        (ask.map_change, "map-change", question::MAP_CHANGE),
        (ask.person, "person", question::PERSON),
    ];
    all.into_iter().filter(|(may, ..)| *may).map(|(_, name, service)| (name, service)).collect()
}

/// A question of somebody.
pub type Asked = (&'static str, Query);

/// Takes a question, or refuses it where too many wait.
pub fn take(to: &SyncSender<Asked>, service: &'static str, query: Query) {
    if let Err(refused) = to.try_send((service, query)) {
        let (std::sync::mpsc::TrySendError::Full((_, query)) | std::sync::mpsc::TrySendError::Disconnected((_, query))) =
            refused;
        let _answered = query.reply_err("too many questions wait; ask again").wait();
    }
}

/// Answers until asked to stop.
///
/// # Errors
///
/// [`IpcError`] when a service cannot be opened.
pub fn run(domain: &Domain, services: &[&'static str], asked: &Receiver<Asked>, stop: &Stop) -> Result<(), IpcError> {
    let node = domain.open("roomcast-zenoh-ask")?;
    let mut ports = Vec::<(&str, QuestionPort)>::new();
    for service in services {
        ports.push((service, node.question_port(service)?));
    }
    while !stop.requested() {
        let (service, query) = match asked.recv_timeout(TICK) {
            Ok(asked) => asked,
            Err(RecvTimeoutError::Timeout) => continue,
            Err(RecvTimeoutError::Disconnected) => {
                std::thread::sleep(TICK);
                continue;
            }
        };
        let Some((_, port)) = ports.iter().find(|(name, _)| *name == service) else { continue };
        let text = query.payload().map(|payload| payload.to_bytes().into_owned()).unwrap_or_default();
        let answer = match String::from_utf8(text) {
            Ok(text) => port.ask(&text, PATIENCE).map_err(|error| error.to_string()),
            Err(_) => Err("a question is text".to_owned()),
        };
        // Whoever asked may have left.
        let _answered = match answer {
            Ok(answer) => query.reply(query.key_expr().clone(), answer).wait(),
            Err(error) => query.reply_err(error).wait(),
        };
    }
    Ok(())
}
