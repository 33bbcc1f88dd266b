//! Passes questions from outside the robot to the daemon, as text, if the configuration allows them.

use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError};
use std::time::{Duration, Instant};

use roomcast_ipc::{Domain, IpcError, QuestionPort, question};
use zenoh::Wait;
use zenoh::query::Query;

use crate::config::{Ask, Config};
use crate::keys::Keys;
use crate::stop::Stop;

/// Most questions that wait for an answer. More are refused.
pub const WAITING_MAX: usize = 8;
/// Longest wait of a question, in the queue and for the daemon together.
const PATIENCE: Duration = Duration::from_secs(5);
const TICK: Duration = Duration::from_millis(200);

/// The allowed questions: the name in keys, and the daemon's service.
#[must_use]
pub fn allowed(ask: &Ask) -> Vec<(&'static str, &'static str)> {
    let all = [
        (ask.moment, "moment", question::MOMENT),
        (ask.map_change, "map-change", question::MAP_CHANGE),
        (ask.person, "person", question::PERSON),
    ];
    all.into_iter().filter(|(may, ..)| *may).map(|(_, name, service)| (name, service)).collect()
}

/// A question that waits for its answer.
pub struct Asked {
    service: &'static str,
    query: Query,
    since: Instant,
}

/// Queues a question, or refuses it if the queue is full.
pub fn take(to: &SyncSender<Asked>, service: &'static str, query: Query) {
    if let Err(TrySendError::Full(asked) | TrySendError::Disconnected(asked)) =
        to.try_send(Asked { service, query, since: Instant::now() })
    {
        let _answered = asked.query.reply_err("too many questions wait; ask again").wait();
    }
}

/// Answers questions until asked to stop.
///
/// # Errors
///
/// [`IpcError`] when a service cannot be opened.
pub fn run(config: &Config, domain: &Domain, asked: &Receiver<Asked>, stop: &Stop) -> Result<(), IpcError> {
    answer(config, domain, asked, PATIENCE, stop)
}

fn answer(
    config: &Config,
    domain: &Domain,
    asked: &Receiver<Asked>,
    patience: Duration,
    stop: &Stop,
) -> Result<(), IpcError> {
    let node = domain.open("roomcast-zenoh-ask")?;
    let keys = Keys::new(&config.site.name, config.robot.key());
    let mut ports = Vec::<(&str, String, QuestionPort)>::new();
    for (name, service) in allowed(&config.ask) {
        ports.push((service, keys.ask(name), node.question_port(service)?));
    }
    while !stop.requested() {
        let Asked { service, query, since } = match asked.recv_timeout(TICK) {
            Ok(asked) => asked,
            Err(RecvTimeoutError::Timeout) => continue,
            Err(RecvTimeoutError::Disconnected) => {
                std::thread::sleep(TICK);
                continue;
            }
        };
        let Some((_, key, port)) = ports.iter().find(|(name, ..)| *name == service) else { continue };
        let text = query.payload().map(|payload| payload.to_bytes().into_owned()).unwrap_or_default();
        // The asker of an old question already got an error. The daemon must not act on it later.
        let left = patience.saturating_sub(since.elapsed());
        let answer = match String::from_utf8(text) {
            Err(_) => Err("a question is text".to_owned()),
            // With less time than this, the daemon could act on the question and answer too late.
            Ok(_) if left < patience / 5 => Err("the daemon answers nobody; it was not asked: ask again".to_owned()),
            Ok(text) => port.ask(&text, left).map_err(|error| error.to_string()),
        };
        // The asker may have left.
        let _answered = match answer {
            // Each robot replies by its own key. With one key for all, a question to all robots would get only one answer.
            Ok(answer) => query.reply(key, answer).wait(),
            Err(error) => query.reply_err(error).wait(),
        };
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::sync::mpsc::sync_channel;
    use std::thread;

    use super::*;

    fn alone() -> zenoh::Session {
        let mut alone = zenoh::Config::default();
        for (key, value) in
            [("listen/endpoints", "[]"), ("scouting/multicast/enabled", "false"), ("scouting/gossip/enabled", "false")]
        {
            alone.insert_json5(key, value).unwrap();
        }
        zenoh::open(alone).wait().unwrap()
    }

    /// Regression: a person got a name minutes after the request had failed.
    #[test]
    fn what_was_asked_while_the_daemon_was_away_is_not_done_later() {
        let session = alone();
        let folder = tempfile::Builder::new().prefix("rcb-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(folder.path().join("d"), &format!("late-{}", std::process::id())).unwrap();
        let mut config = Config::default();
        config.ask.person = true;
        let (to, asked) = sync_channel(WAITING_MAX);
        let key = Keys::new(&config.site.name, config.robot.key()).ask("person");
        let heard = move |query: Query| take(&to, question::PERSON, query);
        session.declare_queryable(&key).callback(heard).background().wait().unwrap();
        let stop = Stop::default();
        thread::scope(|scope| {
            let (own, config, domain) = (&stop, &config, &domain);
            scope.spawn(move || answer(config, domain, &asked, Duration::from_millis(300), own).unwrap());
            let _ends = stop.at_end();
            let ask = |text: &str| session.get(&key).payload(text).timeout(4 * PATIENCE).wait().unwrap();
            let replies: Vec<_> = (0..WAITING_MAX).map(|number| ask(&format!("early {number}"))).collect();
            for replies in replies {
                assert!(replies.recv().unwrap().result().is_err(), "the daemon is away");
            }
            let port = domain.open("daemon").unwrap().answer_port(question::PERSON).unwrap();
            let (mut done, mut answered) = (Vec::new(), false);
            while !answered {
                let replies = ask("now");
                while !replies.is_disconnected() || !replies.is_empty() {
                    port.answer(|asked| {
                        done.push(asked.unwrap().to_owned());
                        "done".to_owned()
                    })
                    .unwrap();
                    if let Ok(Some(reply)) = replies.try_recv() {
                        answered = reply.result().is_ok();
                    }
                    // The daemon's pace.
                    thread::sleep(Duration::from_millis(1));
                }
            }
            assert!(done.iter().all(|asked| asked == "now"), "{done:?}");
        });
        domain.clean_up().unwrap();
    }

    /// Regression: all robots answered by one key, so the asker got one answer without the robot's name.
    #[test]
    fn each_robot_answers_a_question_to_all_by_its_own_key() {
        let session = alone();
        let folder = tempfile::Builder::new().prefix("rcb-").tempdir_in("/tmp").unwrap();
        let stop = Stop::default();
        let robots = ["robot-1", "robot-2"];
        let domains =
            robots.map(|robot| Domain::new(folder.path().join(robot), &format!("ask-{}", std::process::id())).unwrap());
        let answers = thread::scope(|scope| {
            for (robot, domain) in robots.into_iter().zip(&domains) {
                let mut config = Config::default();
                (config.robot.name, config.ask.person) = (robot.to_owned(), true);
                let (to, asked) = sync_channel(WAITING_MAX);
                let key = Keys::new(&config.site.name, robot).ask("person");
                let heard = move |query: Query| take(&to, question::PERSON, query);
                session.declare_queryable(key).callback(heard).background().wait().unwrap();
                let stop = &stop;
                scope.spawn(move || run(&config, domain, &asked, stop).unwrap());
                scope.spawn(move || {
                    let port = domain.open("daemon").unwrap().answer_port(question::PERSON).unwrap();
                    while !stop.requested() {
                        port.answer(|asked| format!("{robot} was asked {}", asked.unwrap())).unwrap();
                        // The daemon's pace.
                        thread::sleep(Duration::from_millis(1));
                    }
                });
            }
            let _ends = stop.at_end();
            let replies =
                session.get("roomcast/home/*/ask/person").payload("who").timeout(4 * PATIENCE).wait().unwrap();
            let of = |sample: zenoh::sample::Sample| {
                (sample.key_expr().to_string(), sample.payload().try_to_string().unwrap().into_owned())
            };
            replies.into_iter().map(|reply| of(reply.into_result().unwrap())).collect::<BTreeMap<_, _>>()
        });
        let own = |robot: &str| (format!("roomcast/home/{robot}/ask/person"), format!("{robot} was asked who"));
        assert_eq!(answers, robots.map(own).into());
        for domain in &domains {
            domain.clean_up().unwrap();
        }
    }
}
